"""Camera and lidar against MuJoCo's single-ray function and against closed forms."""

from __future__ import annotations

import dataclasses
import math

import mujoco
import numpy as np
import pytest

from robotbrain.errors import InputError
from robotbrain.sim import (
    IDEAL_SENSORS,
    CameraExtrinsics,
    CameraIntrinsics,
    LidarSpec,
    Obstacle,
    Point2D,
    Pose2D,
    RayCamera,
    RayLidar,
    RobotSim,
    Scene,
    SegmentationClass,
    SensorParams,
    World,
    build_scene,
    generate_world,
)
from robotbrain.sim.dataset import random_free_position
from robotbrain.sim.scene import GROUP_ROBOT


def configuration(scene: Scene, x: float, y: float, yaw: float, tilt: float = 0.0) -> np.ndarray:
    """Configuration at rest with the robot somewhere else, pitched by ``tilt``."""
    q = np.array(scene.model.qpos0)
    turn, lean = np.empty(4), np.empty(4)
    mujoco.mju_axisAngle2Quat(turn, np.array([0.0, 0.0, 1.0]), yaw)
    mujoco.mju_axisAngle2Quat(lean, np.array([0.0, 1.0, 0.0]), tilt)
    q[:3] = x, y, 0.0
    mujoco.mju_mulQuat(q[3:7], turn, lean)
    return q


@pytest.fixture(scope="module")
def scenes() -> list[Scene]:
    return [build_scene(generate_world(seed)) for seed in range(4)]


@pytest.fixture(scope="module")
def empty() -> World:
    """A room with nothing but the marker, the robot looking at it from 2 m."""
    world = generate_world(0, 0.0)
    return dataclasses.replace(world, obstacles=(), start=Pose2D(-1.0, 0.5, 0.0), goal=Point2D(1.0, 0.5))


def test_every_pixel_against_mj_ray(scenes: list[Scene]) -> None:
    """Geom and depth of each pixel as ``mj_ray`` gives them from the pixel's centre; boxes moved and turned."""
    rng = np.random.default_rng(5)
    marker_pixels = 0
    for scene in scenes:
        camera = RayCamera(scene)
        goal = scene.world.goal
        x, y = random_free_position(scene.world, rng, near_marker=True)
        q = configuration(scene, x, y, math.atan2(goal.y - y, goal.x - x), tilt=0.03)
        for address in scene.box_qpos:
            q[address : address + 2] += rng.normal(0.0, 0.3, 2)
            q[address + 3 : address + 7] = rng.normal(size=4)
            q[address + 3 : address + 7] /= np.linalg.norm(q[address + 3 : address + 7])
        image = camera.render(q)

        model, data = scene.model, mujoco.MjData(scene.model)
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        body = data.body("base").xmat.reshape(3, 3)
        eye = data.body("base").xpos + body @ [0.10, 0.0, 0.26]
        c, s = math.cos(0.14), math.sin(0.14)
        groups = np.array([1, 1, 1, 1, 0, 1], np.uint8)
        for v in range(64):
            for u in range(64):
                right = (u + 0.5 - 32) / 32 * math.tan(math.radians(40.0))
                down = (v + 0.5 - 32) / 32 * math.tan(math.radians(32.2))
                # forward, left and up of the robot, the camera tilted down by 0.14 rad
                ray = body @ [c - s * down, -right, -s - c * down]
                length = np.linalg.norm(ray)
                geom = np.full(1, -2, np.int32)
                hit = mujoco.mj_ray(model, data, eye, ray / length, groups, 1, -1, geom)
                assert image.geom_id[v, u] == geom[0], (v, u)
                if geom[0] < 0:
                    assert image.depth[v, u] == np.inf
                    assert image.classes[v, u] == SegmentationClass.BACKGROUND
                else:
                    assert image.depth[v, u] == pytest.approx(hit / length, rel=1e-6)
        names = np.array([*scene.geom_names, ""])[image.geom_id]
        marker = np.char.startswith(names, "marker_")
        assert np.array_equal(image.classes == SegmentationClass.MARKER, marker)
        assert np.array_equal(image.classes == SegmentationClass.FLOOR, names == "floor")
        marker_pixels += int(marker.sum())
    assert marker_pixels > 100  # the visual-only geoms were in view


def test_robot_never_sees_itself(scenes: list[Scene]) -> None:
    """A camera tilted straight down from inside the body sees the floor only."""
    scene = scenes[0]
    x, y = scene.world.start.x, scene.world.start.y
    image = RayCamera(scene, extrinsics=CameraExtrinsics(0.0, 0.0, 0.26, pitch=math.pi / 2)).render(
        configuration(scene, x, y, 0.0)
    )
    assert (scene.model.geom_group[image.geom_id.ravel()] != GROUP_ROBOT).all()
    assert (image.classes == SegmentationClass.FLOOR).all()
    assert image.depth == pytest.approx(np.full((64, 64), 0.26), rel=1e-6)  # depth is along the axis


def test_floor_depth_closed_form(empty: World) -> None:
    """A level camera at height h sees floor at depth h / ((v - cy) / fy)."""
    scene = build_scene(empty)
    k = CameraIntrinsics.from_fov()
    image = RayCamera(scene, k, CameraExtrinsics(0.1, 0.0, 0.3, pitch=0.0)).render(configuration(scene, 0.0, -3.0, 0.0))
    rows, columns = np.nonzero(image.classes == SegmentationClass.FLOOR)
    assert len(rows) > 500
    assert image.depth[rows, columns] == pytest.approx(0.3 * k.fy / (rows - k.cy), rel=1e-5)


def test_projection_and_back(empty: World) -> None:
    """Camera matrix and mounting agree with the rays: the sign's middle projects into the sign's pixels, and
    its pixels lead back to the sign."""
    scene = build_scene(empty)
    camera = RayCamera(scene)
    image = camera.render(configuration(scene, -1.0, 0.5, 0.0))
    k, mount = camera.intrinsics, camera.extrinsics
    middle = np.array([2.0 - 0.225, 0.0, 0.80])  # front face of the sign, in base_link
    u, v, w = k.matrix @ (mount.rotation.T @ (middle - mount.position))
    assert scene.geom_names[image.geom_id[round(v / w), round(u / w)]] == "marker_sign"
    rows, columns = np.nonzero(np.array([*scene.geom_names, ""])[image.geom_id] == "marker_sign")
    depth = image.depth[rows, columns].astype(float)
    pixels = np.stack([columns, rows, np.ones_like(rows)])
    points = mount.to_base((np.linalg.inv(k.matrix) @ pixels * depth).T)
    off_front, off_underside = np.abs(points[:, 0] - 1.775), np.abs(points[:, 2] - 0.70)
    assert np.minimum(off_front, off_underside).max() < 1e-5
    assert (off_front < 1e-5).sum() > 80
    assert np.abs(points[:, 1]).max() <= 0.2251
    assert points[:, 2].min() >= 0.6999
    x, y, z, q = mount.quaternion_xyzw
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, np.array([q, x, y, z]))
    assert matrix.reshape(3, 3) == pytest.approx(mount.rotation, abs=1e-12)


def test_optical_frame_convention() -> None:
    level = CameraExtrinsics(pitch=0.0).rotation
    assert level @ [0.0, 0.0, 1.0] == pytest.approx([1.0, 0.0, 0.0])  # forward
    assert level @ [1.0, 0.0, 0.0] == pytest.approx([0.0, -1.0, 0.0])  # image right is the robot's right
    assert level @ [0.0, 1.0, 0.0] == pytest.approx([0.0, 0.0, -1.0])  # image down is down
    assert (CameraExtrinsics(pitch=0.2).rotation @ [0.0, 0.0, 1.0])[2] < 0.0  # positive pitch looks down


def test_marker_shows_both_tones_and_obstacles_do_not(empty: World) -> None:
    """Unlit colours: with ambient light of 1 every marker pixel is one of its two tones."""
    look = dataclasses.replace(empty.look, ambient=1.0, tint=(1.0, 1.0, 1.0))
    for pattern in ("stripes", "chequer"):
        world = dataclasses.replace(empty, look=dataclasses.replace(look, marker_pattern=pattern))
        scene = build_scene(world)
        image = RayCamera(scene).render(configuration(scene, -0.2, 0.5, 0.0))
        tones = (np.array(look.marker) * 255.0).astype(int)
        distance = np.abs(image.rgb[..., None, :].astype(int) - tones).max(-1)
        marker = image.classes == SegmentationClass.MARKER
        assert (distance[marker].min(-1) <= 1).all()
        share = (distance[marker].argmin(-1) == 0).mean()
        assert 0.25 < share < 0.75
        assert (distance[~marker].min(-1) > 8).all()


def test_lambert_shading(empty: World) -> None:
    """A wall lit at an angle shows ambient + (1 - ambient) cos(angle) of its colour."""
    light = np.array([-0.5, 0.3, 0.8]) / np.linalg.norm([-0.5, 0.3, 0.8])
    look = dataclasses.replace(
        empty.look, light=tuple(light.tolist()), ambient=0.4, wall=(0.5, 0.6, 0.7), tint=(1.0, 0.9, 0.8)
    )
    scene = build_scene(dataclasses.replace(empty, look=look, goal=Point2D(-3.0, -3.0)))
    image = RayCamera(scene).render(configuration(scene, 2.0, 0.0, 0.0))  # facing the east wall, normal -x
    wall = image.rgb[np.array([*scene.geom_names, ""])[image.geom_id] == "outer_east"]
    expected = 255 * np.array([0.5, 0.6, 0.7]) * [1.0, 0.9, 0.8] * (0.4 + 0.6 * -light[0])
    assert len(wall) > 300
    assert np.abs(wall - expected).max() <= 1.0


def test_camera_errors(scenes: list[Scene]) -> None:
    camera = RayCamera(scenes[0])
    q = np.array(scenes[0].model.qpos0)
    plain = camera.render(q)
    tinted = camera.render(q, dataclasses.replace(IDEAL_SENSORS, camera_tint=(0.5, 1.0, 1.0), camera_exposure=0.8))
    assert np.abs(tinted.rgb - plain.rgb * [0.4, 0.8, 0.8]).max() <= 1.0
    noisy = camera.render(
        q, dataclasses.replace(IDEAL_SENSORS, camera_noise=4.0, depth_noise=0.01), np.random.default_rng(0)
    )
    middle = (plain.rgb > 40) & (plain.rgb < 215)
    assert (noisy.rgb.astype(float) - plain.rgb)[middle].std() == pytest.approx(4.0, rel=0.1)
    hit = np.isfinite(plain.depth)
    error = noisy.depth[hit] - plain.depth[hit]
    assert (error / plain.depth[hit] ** 2).std() == pytest.approx(0.01, rel=0.1)
    assert np.array_equal(np.isinf(noisy.depth), ~hit)


def ray_range(world: World, x: float, y: float, angle: float, height: float) -> float:
    """Where a level ray meets the first edge of what reaches its height: lines crossed one by one."""
    best = math.inf
    direction = np.array([math.cos(angle), math.sin(angle)])
    for o in (*world.outer_walls, *world.obstacles):
        if o.height < height:
            continue
        corners = o.corners()
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            matrix = np.stack([direction, a - b], -1)
            if abs(np.linalg.det(matrix)) < 1e-12:
                continue
            t, s = np.linalg.solve(matrix, a - (x, y))
            if t > 0 and 0 <= s <= 1:
                best = min(best, t)
    return best


def test_lidar_against_line_crossings(scenes: list[Scene]) -> None:
    """Every range; low boxes and the marker are not seen, and what is beyond 8 m is +inf."""
    rng, beyond = np.random.default_rng(1), 0
    for scene in scenes:
        lidar = RayLidar(scene)
        x, y = random_free_position(scene.world, rng)
        yaw = rng.uniform(-3, 3)
        ranges = lidar.scan(configuration(scene, x, y, yaw))
        expected = [ray_range(scene.world, x, y, yaw + a, lidar.spec.height) for a in lidar.spec.angles]
        expected = np.where(np.array(expected) <= 8.0, expected, np.inf)
        beyond += int(np.isinf(expected).sum())
        assert ranges == pytest.approx(expected, rel=1e-5)
    lidar = RayLidar(scenes[0], LidarSpec(range_max=2.0))
    assert np.isinf(lidar.scan(np.array(scenes[0].model.qpos0))).any()


def test_lidar_looks_through_the_sign(empty: World) -> None:
    """Even at the sign's height: it hangs from the ceiling only for the camera."""
    scan = RayLidar(build_scene(empty), LidarSpec(height=1.0)).scan(np.array(build_scene(empty).model.qpos0))
    assert scan[60] == pytest.approx(5.0, abs=1e-5)


def test_lidar_noise_and_dropout(scenes: list[Scene]) -> None:
    lidar, q = RayLidar(scenes[1]), np.array(scenes[1].model.qpos0)
    sensors = dataclasses.replace(SensorParams(), lidar_noise=0.02, lidar_dropout=0.1)
    rng = np.random.default_rng(0)
    clean = lidar.scan(q)
    scans = np.array([lidar.scan(q, sensors, rng) for _ in range(60)])
    error = (scans - clean)[np.isfinite(scans) & np.isfinite(clean)]
    assert error.std() == pytest.approx(0.02, rel=0.1)
    assert np.isinf(scans[:, np.isfinite(clean)]).mean() == pytest.approx(0.1, abs=0.02)


def test_angles_are_those_of_a_laser_scan() -> None:
    spec = LidarSpec()
    assert spec.angle_min == -math.pi
    assert spec.angle_increment == pytest.approx(2 * math.pi / 120)
    assert len(spec.angles) == 120
    assert spec.angles[60] == pytest.approx(0.0)  # straight ahead


def test_low_box_is_seen_by_camera_only(empty: World) -> None:
    box = Obstacle("box_0", "box", 0.2, 0.5, 0.3, 0.2, 0.15, 0.06, True, (0.4, 0.3, 0.2, 1.0))
    sim = RobotSim(dataclasses.replace(empty, obstacles=(box,)), sensors=IDEAL_SENSORS)
    scan = sim.read_lidar()
    assert scan is not None
    assert scan.ranges[60] == pytest.approx(5.0, abs=1e-3)  # straight on to the east wall
    assert (sim.truth.camera_image().classes == SegmentationClass.OBSTACLE)[32:, 20:44].any()


def test_bad_arguments_are_named(scenes: list[Scene]) -> None:
    with pytest.raises(InputError, match="camera width"):
        CameraIntrinsics.from_fov(width=0)
    with pytest.raises(InputError, match="lidar rays"):
        LidarSpec(rays=0)
    with pytest.raises(InputError, match="camera colours"):
        RayCamera(scenes[0]).set_colours(np.zeros((1, 3)))
