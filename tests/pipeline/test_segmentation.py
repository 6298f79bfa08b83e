"""From pixels to metres, against a camera whose geometry is independent of ours: the simulator's."""

from __future__ import annotations

import numpy as np
import pytest

from robotbrain.errors import InputError
from robotbrain.pipeline.segmentation import (
    FLOOR,
    MARKER,
    OBSTACLE,
    CameraModel,
    back_project,
    decode,
    ground_points,
    locate_marker,
    preprocess,
)
from robotbrain.sim import IDEAL_SENSORS, RobotSim, generate_world


def nominal(sim: RobotSim) -> CameraModel:
    k, mount = sim.camera.intrinsics, sim.camera.extrinsics
    return CameraModel(k.fx, k.fy, k.cx, k.cy, (mount.x, mount.y, mount.z), mount.pitch)


def test_back_projection_agrees_with_the_simulators_own_geometry() -> None:
    sim = RobotSim(generate_world(3), sensors=IDEAL_SENSORS)
    image = sim.truth.camera_image()
    points = back_project(image.depth, nominal(sim))
    optical = sim.camera.intrinsics.rays() * image.depth[..., None]
    finite = np.isfinite(image.depth)
    np.testing.assert_allclose(points[finite], sim.camera.extrinsics.to_base(optical[finite]), atol=1e-5)
    assert np.isnan(points[~finite]).all()
    # and with the world: what the simulator labels floor lies at height zero
    assert np.abs(points[image.classes == FLOOR][:, 2]).max() < 0.01


@pytest.mark.parametrize("seed", range(6))
def test_the_marker_is_located_from_any_side(seed: int) -> None:
    world = generate_world(seed, difficulty=0.0)
    sim = RobotSim(world, sensors=IDEAL_SENSORS)
    rng = np.random.default_rng(seed)
    qpos = sim.truth.qpos()
    located = 0
    for _ in range(12):
        distance, angle = rng.uniform(0.9, 3.5), rng.uniform(-np.pi, np.pi)
        x, y = world.goal.x + distance * np.cos(angle), world.goal.y + distance * np.sin(angle)
        if max(abs(x), abs(y)) > 3.6:
            continue
        yaw = angle + np.pi + rng.uniform(-0.3, 0.3)
        qpos[:7] = x, y, 0, np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)
        image = sim.camera.render(qpos)
        seen = locate_marker(image.classes, back_project(image.depth, nominal(sim)))
        if seen is None:
            continue
        located += 1
        cos, sin = np.cos(yaw), np.sin(yaw)
        there = (x + cos * seen[0] - sin * seen[1], y + sin * seen[0] + cos * seen[1])
        assert np.hypot(there[0] - world.goal.x, there[1] - world.goal.y) < 0.2
    assert located >= 3


def test_ground_points_keep_what_stops_a_robot_and_nothing_else() -> None:
    heights = np.array([[0.0, 0.01, 0.1, 0.3, 0.9, 0.0]])
    points = np.stack([np.full_like(heights, 1.0), np.zeros_like(heights), heights], axis=-1)
    points[0, 5, 0] = 9.0  # too far
    mask = np.array([[FLOOR, OBSTACLE, OBSTACLE, OBSTACLE, OBSTACLE, FLOOR]], dtype=np.uint8)
    floor, obstacles = ground_points(mask, points)
    assert len(floor) == 1 and len(obstacles) == 2
    mask[0, 2] = FLOOR  # the network may err: 10 cm above the floor is no floor
    assert [len(p) for p in ground_points(mask, points)] == [1, 2]
    mask[0, 0] = MARKER
    assert len(ground_points(mask, points)[0]) == 1


def test_a_few_marker_pixels_or_ones_at_box_height_are_no_marker() -> None:
    mask = np.full((4, 4), MARKER, dtype=np.uint8)
    points = np.zeros((4, 4, 3))
    points[..., 0] = 2.0
    assert locate_marker(mask, points) == pytest.approx((2.0, 0.0))
    points[..., 2] = 0.3
    assert locate_marker(mask, points) is None
    points[..., 2] = 0.0
    mask[:3] = FLOOR
    mask[3, 3] = FLOOR
    assert locate_marker(mask, points) is None


@pytest.mark.parametrize("bad", [np.zeros((4, 4, 3)), np.zeros((4, 4), np.uint8), np.zeros((4, 4, 4), np.uint8)])
def test_preprocess_refuses_what_is_no_image(bad: np.ndarray) -> None:
    with pytest.raises(InputError, match="image"):
        preprocess(bad)


def test_decode_takes_the_likeliest_class_and_refuses_other_shapes() -> None:
    logits = np.zeros((1, 4, 2, 3))
    logits[0, 2, 1, 1] = 5.0
    assert decode(logits)[1, 1] == 2
    with pytest.raises(InputError, match="logits"):
        decode(logits[0])
