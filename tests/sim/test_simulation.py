"""Physics, firmware and sensors of the robot against closed forms."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from robotbrain.errors import InputError
from robotbrain.sim import (
    IDEAL_SENSORS,
    SURROGATE_RANGES,
    Obstacle,
    Point2D,
    Pose2D,
    RobotParams,
    RobotSim,
    SensorParams,
    UnstableError,
    World,
    generate_world,
    surrogate_robot,
)
from robotbrain.sim.robot import BaseFirmware

MS = 1_000_000
SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def empty() -> World:
    world = generate_world(0, 0.0)
    return dataclasses.replace(world, obstacles=(), start=Pose2D(-2.0, 0.5, 0.7), goal=Point2D(3.0, 3.0))


def drive(sim: RobotSim, v: float, w: float, seconds: float) -> None:
    """Hold a command, sent at 20 Hz."""
    end = sim.now_ns + round(seconds * SECOND)
    while sim.now_ns < end:
        sim.set_twist(v, w)
        sim.advance_to(min(sim.now_ns + 50 * MS, end))


def test_straight_drive_closed_form(empty: World) -> None:
    """Way = v t - v^2 / 2a (the ramp) - v tau (the motors' lag), along the start heading."""
    sim = RobotSim(empty)
    drive(sim, 0.5, 0.0, 4.0)
    way = 0.5 * 4.0 - 0.5**2 / 2.0 - 0.5 * 0.04
    pose = sim.truth.pose
    assert sim.truth.twist.v == pytest.approx(0.5, abs=0.005)
    assert math.hypot(pose.x + 2.0, pose.y - 0.5) == pytest.approx(way, abs=0.02)
    assert math.atan2(pose.y - 0.5, pose.x + 2.0) == pytest.approx(0.7, abs=0.005)
    assert sim.truth.path_length == pytest.approx(way, abs=0.02)
    assert not sim.truth.collided


def test_turn_on_the_spot(empty: World) -> None:
    sim = RobotSim(empty)
    drive(sim, 0.0, 1.0, 3.0)
    assert sim.truth.twist.w == pytest.approx(1.0, abs=0.01)
    turned = 1.0 * 3.0 - 1.0 / (2 * 4.0) - 0.04
    assert (sim.truth.pose.yaw - 0.7) % (2 * math.pi) == pytest.approx(turned, abs=0.03)
    assert math.hypot(sim.truth.pose.x + 2.0, sim.truth.pose.y - 0.5) < 0.01


def test_encoders_dead_reckon_to_the_true_pose(empty: World) -> None:
    """Without slip or errors, integrating wheel angles with the robot's geometry gives its pose."""
    sim = RobotSim(empty, sensors=IDEAL_SENSORS)
    x, y, yaw, before = -2.0, 0.5, 0.7, np.zeros(2)
    for k in range(1, 300):
        sim.set_twist(0.4, 0.8 * math.sin(k / 30))
        sim.advance_to(k * 20 * MS)
        after = sim.read_encoders().position
        left, right = (after - before) * 0.06
        before = after
        middle = yaw + (right - left) / 0.30 / 2
        x, y, yaw = (
            x + (left + right) / 2 * math.cos(middle),
            y + (left + right) / 2 * math.sin(middle),
            yaw + (right - left) / 0.30,
        )
    pose = sim.truth.pose
    assert sim.truth.path_length > 2.0
    assert math.hypot(x - pose.x, y - pose.y) < 0.01
    assert yaw == pytest.approx(pose.yaw, abs=0.01)


def test_wheel_radius_errors_bend_the_path(empty: World) -> None:
    """Unequal wheels turn a straight command into w = v (right - left) / track."""
    sim = RobotSim(empty, RobotParams(wheel_radius_error=(-0.02, 0.02)))
    drive(sim, 0.4, 0.0, 3.0)
    assert sim.truth.twist.w == pytest.approx(0.4 * 0.04 / 0.30, rel=0.05)


def test_limits(empty: World) -> None:
    """Speed, turning rate and acceleration stay within the contract whatever is commanded."""
    sim = RobotSim(empty)
    fastest = quickest = 0.0
    for k in range(1, 61):
        sim.set_twist(50.0, -50.0)
        before = sim.truth.twist.v
        sim.advance_to(k * 50 * MS)
        fastest = max(fastest, sim.truth.twist.v)
        quickest = max(quickest, abs(sim.truth.twist.w))
        assert (sim.truth.twist.v - before) / 0.05 <= 1.0 * 1.05 + 0.05
    assert fastest == pytest.approx(0.6, abs=0.01)
    assert quickest == pytest.approx(1.8, abs=0.03)


def test_watchdog_and_command_delay(empty: World) -> None:
    sim = RobotSim(empty, RobotParams(command_delay_s=0.1))
    sim.set_twist(0.5, 0.0)
    sim.advance_to(100 * MS)
    assert abs(sim.truth.twist.v) < 1e-3  # not there yet
    sim.advance_to(550 * MS)
    assert sim.truth.twist.v > 0.3
    sim.advance_to(1500 * MS)  # the command lapsed at 0.6 s
    assert abs(sim.truth.twist.v) < 5e-3


def test_backlash_delays_the_wheel_and_leads_the_encoder() -> None:
    """The motor turns through the play before the wheel feels it, then the encoder stays half the play ahead."""
    firmware = BaseFirmware(RobotParams(backlash_rad=0.2, motor_lag_s=0.0, max_acceleration=1e6), 0.005)
    firmware.command(0.06, 0.0)  # 1 rad/s
    free = [firmware.step(0.0, 0.0) for _ in range(19)]
    assert set(free) == {(0.0, 0.0)}  # inside the play the servo follows the standing wheel: no torque
    for _ in range(3):
        engaged = firmware.step(0.0, 0.0)
    assert engaged == pytest.approx((1.0, 1.0))
    assert firmware.play == pytest.approx([0.1, 0.1])


def test_imu(empty: World) -> None:
    sim = RobotSim(empty, sensors=IDEAL_SENSORS)
    assert sim.read_imu().linear_acceleration == pytest.approx([0.0, 0.0, 9.81])
    sim.advance_to(300 * MS)
    assert sim.read_imu().linear_acceleration == pytest.approx([0.0, 0.0, 9.81], abs=0.02)
    turned, last = 0.0, sim.truth.pose.yaw
    for _ in range(100):
        sim.set_twist(0.0, 1.0)
        sim.advance_to(sim.now_ns + 10 * MS)
        turned += 0.01 * sim.read_imu().angular_velocity[2]
    assert turned == pytest.approx(sim.truth.pose.yaw - last, abs=0.01)
    drive(sim, 0.0, 0.0, 1.0)
    sim.read_imu()
    drive(sim, 0.6, 0.0, 0.3)  # ramping at 1 m/s^2; the lag takes a little off the mean
    force = sim.read_imu().linear_acceleration
    assert 0.75 < force[0] < 1.02
    assert abs(force[1]) < 0.1
    biased = RobotSim(empty, sensors=dataclasses.replace(IDEAL_SENSORS, gyro_bias=(0.0, 0.0, 0.02)))
    biased.advance_to(100 * MS)
    assert biased.read_imu().angular_velocity[2] == pytest.approx(0.02, abs=1e-3)


def test_centripetal_force(empty: World) -> None:
    """On a circle the IMU feels v w towards the middle."""
    sim = RobotSim(empty, sensors=IDEAL_SENSORS)
    drive(sim, 0.5, 1.0, 2.0)
    sim.read_imu()
    drive(sim, 0.5, 1.0, 0.05)
    assert sim.read_imu().linear_acceleration[1] == pytest.approx(0.5, abs=0.05)


def test_encoder_ticks_and_slip(empty: World) -> None:
    sim = RobotSim(empty, sensors=dataclasses.replace(IDEAL_SENSORS, encoder_ticks=100))
    drive(sim, 0.3, 0.2, 1.0)
    ticks = sim.read_encoders().position / (2 * math.pi / 100)
    assert ticks == pytest.approx(np.round(ticks), abs=1e-9)
    ends = []
    for seed in range(40):
        slipping = RobotSim(empty, sensors=dataclasses.replace(IDEAL_SENSORS, encoder_slip=0.05), seed=seed)
        for _ in range(10):
            drive(slipping, 0.5, 0.0, 0.05)
            slipping.read_encoders()
        ends.append(slipping.read_encoders().position)
    rolled = np.mean(ends)
    assert np.std(ends) == pytest.approx(0.05 * math.sqrt(rolled), rel=0.3)


def test_collision_is_seen_once_and_named(empty: World) -> None:
    wall = Obstacle("wall_0", "wall", 0.0, 0.5, 0.0, 0.05, 1.0, 0.8, False, (1.0, 1.0, 1.0, 1.0))
    sim = RobotSim(dataclasses.replace(empty, obstacles=(wall,), start=Pose2D(-1.0, 0.5, 0.0)))
    drive(sim, 0.4, 0.0, 1.0)
    assert not sim.truth.collisions
    drive(sim, 0.4, 0.0, 3.0)
    assert sim.truth.collided == {"wall_0"}
    first = sim.truth.collisions[0]
    # the chassis (0.18 m) meets the face at x = -0.05 after 0.77 m: ramp and lag cost 0.096 m more
    assert first.stamp_ns / SECOND == pytest.approx((0.77 + 0.08 + 0.016) / 0.4, abs=0.05)
    assert first.speed == pytest.approx(0.4, abs=0.02)
    assert sim.truth.pose.x == pytest.approx(-0.23, abs=0.02)
    assert sim.truth.touching == {"wall_0"}


def test_boxes_rest_until_pushed(empty: World) -> None:
    near = Obstacle("box_0", "box", 0.0, 0.5, 0.0, 0.2, 0.2, 0.2, True, (0.5, 0.5, 0.5, 1.0))
    low = dataclasses.replace(near, name="box_1", y=-1.5, half_z=0.06)
    sim = RobotSim(dataclasses.replace(empty, obstacles=(near, low), start=Pose2D(-1.0, 0.5, 0.0)))
    before = sim.truth.obstacle_poses()
    drive(sim, 0.4, 0.0, 1.0)
    assert sim.truth.obstacle_poses() == before
    drive(sim, 0.4, 0.0, 3.0)
    after = sim.truth.obstacle_poses()
    assert after[0].x > before[0].x + 0.1
    assert after[1] == before[1]
    assert "box_0" in sim.truth.collided


def test_low_box_stops_the_robot_and_the_sign_does_not(empty: World) -> None:
    world = dataclasses.replace(empty, start=Pose2D(-1.0, 0.5, 0.0), goal=Point2D(0.5, 0.5))
    through = RobotSim(world)
    drive(through, 0.5, 0.0, 4.0)
    assert through.truth.pose.x > 0.5
    assert not through.truth.collided
    low = Obstacle("box_0", "box", 0.0, 0.5, 0.0, 0.2, 0.2, 0.05, True, (0.5, 0.5, 0.5, 1.0))
    sim = RobotSim(dataclasses.replace(world, obstacles=(low,)))
    drive(sim, 0.5, 0.0, 4.0)
    assert "box_0" in sim.truth.collided


def run_log(seed: int, camera_every: int, sensor_seed: int = 3) -> tuple[list[bytes], bytes]:
    sim = RobotSim(generate_world(seed), *surrogate_robot(1), seed=sensor_seed)
    log = []
    for k in range(1, 41):
        sim.set_twist(0.3, 0.5 * math.cos(k / 7))
        sim.advance_to(k * 25 * MS)
        wheels, imu = sim.read_encoders(), sim.read_imu()
        log += [wheels.position.tobytes(), wheels.velocity.tobytes(), imu.angular_velocity.tobytes()]
        if k % 4 == 0 and (scan := sim.read_lidar()):
            log.append(scan.ranges.tobytes())
        if k % camera_every == 0:
            sim.read_camera()
    frame = sim.read_camera()
    return log, frame.rgb.tobytes() + frame.depth.tobytes() if frame else b""


def test_runs_repeat_byte_for_byte_and_seeds_differ() -> None:
    assert run_log(2, 4) == run_log(2, 4)
    assert run_log(2, 4) != run_log(3, 4)
    assert run_log(2, 4)[0] != run_log(2, 4, sensor_seed=4)[0]


def test_reading_one_sensor_leaves_the_others_alone() -> None:
    assert run_log(2, 2)[0] == run_log(2, 1000)[0]


def test_lost_and_late_readings(empty: World) -> None:
    sensors = dataclasses.replace(SensorParams(), camera_drop=0.3, lidar_drop=0.5, camera_latency_s=0.04)
    sim = RobotSim(empty, sensors=sensors)
    frames = [sim.read_camera() for _ in range(200)]
    assert sum(f is None for f in frames) / 200 == pytest.approx(0.3, abs=0.1)
    assert sum(sim.read_lidar() is None for _ in range(200)) / 200 == pytest.approx(0.5, abs=0.12)
    got = next(f for f in frames if f is not None)
    assert got.available_ns - got.stamp_ns == 40 * MS


def test_time_runs_forward_in_whole_steps(empty: World) -> None:
    sim = RobotSim(empty)
    sim.advance_to(12 * MS)
    assert sim.now_ns == 10 * MS
    sim.advance_to(10 * MS)
    for bad in (9 * MS, -1, 0.5, None):
        with pytest.raises(InputError, match="advance_to"):
            sim.advance_to(bad)  # type: ignore[arg-type]


def test_bad_input_is_named(empty: World) -> None:
    sim = RobotSim(empty)
    for v, w in ((math.nan, 0.0), (0.0, math.inf)):
        with pytest.raises(InputError, match="set_twist"):
            sim.set_twist(v, w)
    for change in ({"mass": 0.0}, {"motor_lag_s": -1.0}, {"wheel_radius_error": (math.nan, 0.0)}, {"track": 2.0}):
        with pytest.raises(InputError, match=rf"robot\.{next(iter(change))}"):
            RobotParams(**change)  # type: ignore[arg-type]
    for change in ({"camera_drop": 1.5}, {"gyro_bias": (0.0, 0.0)}, {"encoder_ticks": 0}, {"lidar_noise": -0.1}):
        with pytest.raises(InputError, match=rf"sensors\.{next(iter(change))}"):
            SensorParams(**change)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="seed"):
        RobotSim(empty, seed=-1)
    with pytest.raises(InputError, match="seed"):
        surrogate_robot(-1)


@pytest.mark.parametrize(("place", "value"), [(0, math.nan), (8, math.nan), (8, 1e12)])
def test_instability_is_reported(
    empty: World, place: int, value: float, tmp_path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A NaN or an absurd speed, of the robot or of a box only, ends the run with an error of ours."""
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its log into the working directory
    box = Obstacle("box_0", "box", 0.0, 2.5, 0.0, 0.2, 0.2, 0.2, True, (0.5, 0.5, 0.5, 1.0))
    sim = RobotSim(dataclasses.replace(empty, obstacles=(box,)))
    sim.advance_to(50 * MS)
    sim._data.qvel[place] = value
    with pytest.raises(UnstableError, match="unstable"):
        sim.advance_to(100 * MS)


def test_surrogates_differ_from_the_nominal_robot_within_the_ranges() -> None:
    assert surrogate_robot(5) == surrogate_robot(5)
    assert surrogate_robot(5) != surrogate_robot(6)
    draws = [surrogate_robot(seed) for seed in range(200)]
    for name, (low, high) in SURROGATE_RANGES.items():
        values = np.ravel([getattr(p, name) for pair in draws for p in pair if hasattr(p, name)])
        assert low <= values.min() < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < values.max() <= high


def test_surrogate_drives(empty: World) -> None:
    for seed in range(5):
        sim = RobotSim(empty, *surrogate_robot(seed))
        drive(sim, 0.4, 0.0, 3.0)
        assert sim.truth.twist.v == pytest.approx(0.4, rel=0.04)
        drive(sim, 0.0, 0.0, 1.0)
        assert abs(sim.truth.twist.v) < 0.01


def test_driving_straight_at_the_goal_fails() -> None:
    """A robot that steers straight at the goal reaches it on at most 10 of 100 seeds of default difficulty."""
    reached = 0
    for seed in range(1000, 1100):
        world = generate_world(seed)
        sim = RobotSim(world)
        for k in range(1, 401):
            pose = sim.truth.pose
            bearing = math.atan2(world.goal.y - pose.y, world.goal.x - pose.x) - pose.yaw
            bearing = math.atan2(math.sin(bearing), math.cos(bearing))
            sim.set_twist(0.6 if abs(bearing) < 0.3 else 0.0, 2.0 * bearing)
            sim.advance_to(k * 50 * MS)
            if sim.truth.collided:
                break
            if sim.truth.distance_to_goal < 0.35:
                reached += 1
                break
    assert reached <= 10
