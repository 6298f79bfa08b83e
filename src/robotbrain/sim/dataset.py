"""Labelled camera images for training perception, with looks and camera errors randomised."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from robotbrain.errors import InputError
from robotbrain.sim.camera import CameraExtrinsics, CameraIntrinsics, RayCamera
from robotbrain.sim.checks import check_range, check_seed
from robotbrain.sim.generate import draw_colour, draw_look, generate_world
from robotbrain.sim.geometry import Array
from robotbrain.sim.robot import CHASSIS_RADIUS, SensorParams
from robotbrain.sim.scene import Scene, build_scene
from robotbrain.sim.world import World

POSE_CLEARANCE = CHASSIS_RADIUS + 0.03
"""Free radius (m) around every pose that an image is taken from."""
TOWARDS_MARKER = 0.6
"""Share of the poses that face the marker, give or take half the field of view."""
NEAR_MARKER = 0.3
"""Share of the poses drawn within ``NEAR_RADIUS`` of the marker."""
NEAR_RADIUS = 2.5
_TILT = 0.015  # rad: the base pitches and rolls a little when it drives


class LabelledImages(NamedTuple):
    """Images and their classes, n in all.

    Args:
        images: uint8 (n, height, width, 3).
        labels: ``SegmentationClass`` of each pixel, uint8 (n, height, width).
        depth: metres, float32 (n, height, width); +inf for no return.
    """

    images: NDArray[np.uint8]
    labels: NDArray[np.uint8]
    depth: NDArray[np.float32]


def render_dataset(
    seeds: Iterable[int],
    n_per_world: int = 16,
    *,
    difficulty: tuple[float, float] = (0.2, 1.0),
    randomise_look: bool = True,
    intrinsics: CameraIntrinsics | None = None,
    extrinsics: CameraExtrinsics | None = None,
) -> LabelledImages:
    """Take ``n_per_world`` images from random free poses in the world of each seed.

    Args:
        seeds: of the worlds; keep those of training and of test apart.
        n_per_world: images of each world.
        difficulty: range that each world's difficulty is drawn from.
        randomise_look: draw colours, light, tint, exposure and noise anew for every image; otherwise each world
            keeps its own look and the camera is nominal.
        intrinsics: of the camera; 64x64 by default.
        extrinsics: mounting of the camera.

    Returns:
        Images, labels and depths in the order of the seeds. The same arguments give the same bytes.

    Raises:
        InputError: no seeds, or a number out of range.
    """
    chosen = [check_seed("dataset seed", seed) for seed in seeds]
    if not chosen:
        raise InputError("seeds", given=chosen, expected="at least one seed", fix="Pass for example range(100).")
    check_range("n_per_world", n_per_world, 1, 100_000)
    check_range("difficulty[1]", difficulty[1], 0.0, 1.0)
    check_range("difficulty[0]", difficulty[0], 0.0, difficulty[1])
    k = intrinsics or CameraIntrinsics.from_fov()
    n = len(chosen) * n_per_world
    out = LabelledImages(
        np.empty((n, k.height, k.width, 3), np.uint8),
        np.empty((n, k.height, k.width), np.uint8),
        np.empty((n, k.height, k.width), np.float32),
    )
    for i, seed in enumerate(chosen):
        rng = np.random.default_rng(np.random.SeedSequence([0xDA7A, seed]))
        scene = build_scene(generate_world(seed, float(rng.uniform(*difficulty))))
        camera = RayCamera(scene, k, extrinsics)
        rest = np.array(scene.model.qpos0)
        for j in range(i * n_per_world, (i + 1) * n_per_world):
            sensors = _randomise(camera, rng) if randomise_look else SensorParams()
            frame = camera.render(_random_pose(scene, rest, rng), sensors, rng)
            out.images[j], out.labels[j], out.depth[j] = frame.rgb, frame.classes, frame.depth
    return out


def random_free_position(world: World, rng: np.random.Generator, near_marker: bool = False) -> Array:
    """A position (2,) with ``POSE_CLEARANCE`` around it, anywhere or within ``NEAR_RADIUS`` of the marker."""
    while True:
        if near_marker:
            radius, angle = NEAR_RADIUS * math.sqrt(rng.random()), rng.uniform(-math.pi, math.pi)
            point = np.array([world.goal.x + radius * math.cos(angle), world.goal.y + radius * math.sin(angle)])
        else:
            point = rng.uniform((-world.half_x, -world.half_y), (world.half_x, world.half_y))
        if world.clearance(point) >= POSE_CLEARANCE:
            return point


def _random_pose(scene: Scene, rest: Array, rng: np.random.Generator) -> Array:
    """Configuration with the robot at a random free pose, a little tilted."""
    world = scene.world
    x, y = random_free_position(world, rng, bool(rng.random() < NEAR_MARKER))
    yaw = rng.uniform(-math.pi, math.pi)
    if rng.random() < TOWARDS_MARKER:
        yaw = math.atan2(world.goal.y - y, world.goal.x - x) + rng.uniform(-0.7, 0.7)
    qpos = rest.copy()
    qpos[:3] = x, y, 0.0
    turn, tilt = np.empty(4), np.empty(4)
    mujoco.mju_axisAngle2Quat(turn, np.array([0.0, 0.0, 1.0]), yaw)
    mujoco.mju_euler2Quat(tilt, np.array([*rng.normal(0.0, _TILT, 2), 0.0]), "xyz")
    mujoco.mju_mulQuat(qpos[3:7], turn, tilt)
    return qpos


def _randomise(camera: RayCamera, rng: np.random.Generator) -> SensorParams:
    """Give the camera's scene a new look and return new camera errors."""
    scene = camera.scene
    look = draw_look(rng)
    camera.look = look
    kinds = {o.name: o.kind for o in scene.world.obstacles}
    colours = scene.geom_colour.copy()
    for i, name in enumerate(scene.geom_names):
        if name in kinds:
            colours[i] = draw_colour(kinds[name], rng, look)
        elif name.startswith("outer_"):
            colours[i] = look.wall
    camera.set_colours(colours)
    r, g, b = (float(t) for t in rng.uniform(0.88, 1.12, 3))
    return dataclasses.replace(
        SensorParams(),
        camera_tint=(r, g, b),
        camera_exposure=float(rng.uniform(0.75, 1.25)),
        camera_noise=float(rng.uniform(1.0, 7.0)),
    )
