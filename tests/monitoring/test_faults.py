"""Faults do what they say, the same in every run, and leave no trace when taken out."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import Image, Imu, JointState, LaserScan, PointCloud2
from std_msgs.msg import String

from robotbrain.errors import InputError
from robotbrain.monitoring.faults import (
    Blackout,
    DropFrames,
    Fault,
    FrozenSensor,
    LateFrames,
    Noise,
    Outliers,
    SensorBias,
    StampOffset,
    WrongFrameId,
)
from robotbrain.monitoring.faults_device import CpuHog, Slowdown, ThermalThrottling
from robotbrain.ros import DeviceResources, SimContext
from robotbrain.ros.conversions import (
    cloud_to_points,
    image_to_numpy,
    ns_to_time,
    numpy_to_image,
    points_to_cloud,
    time_to_ns,
)

MS = 1_000_000


def sent(
    make: Callable[[int], Any], faults: Sequence[Fault], count: int = 50, period_ms: int = 100
) -> list[tuple[float, Any]]:
    """Publish ``make(k)`` on /topic every period through faults; return (time in ms, message) of what arrives."""
    context = SimContext()
    context.log_sink = lambda _: None
    for fault in faults:
        fault.install(context)
    node, found = Node("sensor", context=context), list[tuple[float, Any]]()
    publisher = node.create_publisher(type(make(0)), "/topic", 10)
    taker = Node("taker", context=context)
    taker.create_subscription(type(make(0)), "/topic", lambda m: found.append((context.now_ns / MS, m)), 10)
    for number in range(count):
        context.schedule(number * period_ms * MS, lambda k: publisher.publish(make(k)), number)
    context.run_for(count * period_ms * 1e-3 + 20)
    return found


def scan(k: int) -> LaserScan:
    message = LaserScan(angle_min=0.0, angle_increment=0.1, range_max=10.0)
    message.header.stamp, message.header.frame_id = ns_to_time(k * 100 * MS), "lidar_link"
    message.ranges = [math.inf, *([2.0 + k] * 99)]
    return message


def imu(k: int) -> Imu:
    message = Imu()
    message.header.stamp = ns_to_time(k * 100 * MS)
    message.angular_velocity.z = 0.5
    return message


def test_noise_has_the_spread_asked_for_and_spares_what_is_no_number() -> None:
    found = sent(scan, [Noise("/topic", 0.05)])
    assert len(found) == 50
    errors = np.array([np.array(m.ranges)[1:] - (2.0 + k) for k, (_, m) in enumerate(found)])
    assert errors.std() == pytest.approx(0.05, rel=0.05) and abs(errors.mean()) < 0.005
    assert all(m.ranges[0] == math.inf for _, m in found)
    assert [m.header for _, m in found] == [scan(k).header for k in range(50)]


@pytest.mark.parametrize(
    "fault",
    [
        Noise("/topic", 0.1),
        Outliers("/topic", 0.2),
        DropFrames("/topic", 0.4, 3.0),
        LateFrames("/topic", 70.0, 0.5, jitter_ms=30.0),
    ],
    ids=lambda fault: type(fault).__name__,
)
def test_a_fault_is_the_same_in_every_run_and_another_with_another_seed(fault: Any) -> None:
    import dataclasses

    first, second = sent(scan, [fault]), sent(scan, [fault])
    assert first == second
    assert sent(scan, [dataclasses.replace(fault, seed=1)]) != first
    # Another fault beside it does not change what is drawn.
    assert [m.ranges[5] for _, m in sent(scan, [StampOffset("/topic", 5.0), fault])] == [m.ranges[5] for _, m in first]


def test_frames_are_lost_at_the_rate_and_in_bursts_of_the_length_asked_for() -> None:
    for rate, burst in ((0.1, 1.0), (0.3, 4.0), (0.6, 10.0)):
        got = {round(m.ranges[1] - 2) for _, m in sent(scan, [DropFrames("/topic", rate, burst)], 3000, 10)}
        lost = [k not in got for k in range(3000)]
        runs = sum(now and not before for before, now in zip([False, *lost], lost, strict=False))
        assert np.mean(lost) == pytest.approx(rate, rel=0.2)
        assert sum(lost) / runs == pytest.approx(burst, rel=0.2)
    assert not sent(scan, [DropFrames("/topic", 1.0)])
    assert len(sent(scan, [DropFrames("/topic", 0.0)])) == 50


def test_late_frames_arrive_late_and_may_be_overtaken() -> None:
    assert [t for t, _ in sent(scan, [LateFrames("/topic", 30.0)])] == [k * 100 + 30 for k in range(50)]
    found = sent(scan, [LateFrames("/topic", 250.0, 0.5)])
    order = [m.header.stamp.sec * 1000 + m.header.stamp.nanosec // MS for _, m in found]
    assert sorted(order) == [k * 100 for k in range(50)] and order != sorted(order)


def test_biases_are_added_and_scales_multiplied() -> None:
    for _, message in sent(imu, [SensorBias("/topic", (0.0, 0.1, 0.2), scale=2.0)]):
        w = message.angular_velocity
        assert (w.x, w.y, w.z) == pytest.approx((0, 0.1, 1.2))
    wheels = JointState(name=["left", "right"], position=[1.0, 2.0], velocity=[3.0, 4.0])
    ((_, message),) = sent(lambda _: wheels, [SensorBias("/topic", 0.5, field="velocity")], 1)
    assert list(message.velocity) == [3.5, 4.5] and list(message.position) == [1.0, 2.0]


def test_images_clouds_and_odometry_can_be_disturbed() -> None:
    pixels = np.full((8, 9, 3), 250, dtype=np.uint8)
    ((_, image),) = sent(lambda _: numpy_to_image(pixels, "rgb8"), [Noise("/topic", 20.0)], 1)
    assert isinstance(image, Image)
    changed = image_to_numpy(image)
    assert changed.shape == pixels.shape and changed.dtype == np.uint8 and changed.max() == 255 and changed.std() > 5

    points = np.arange(30, dtype=np.float32).reshape(10, 3)
    ((_, cloud),) = sent(lambda _: points_to_cloud(points), [SensorBias("/topic", (1.0, -1.0))], 1)
    assert isinstance(cloud, PointCloud2)
    np.testing.assert_allclose(cloud_to_points(cloud), points + np.array([1, -1, 0], dtype=np.float32))

    ((_, odometry),) = sent(lambda _: Odometry(), [SensorBias("/topic", 3.0)], 1)
    assert (odometry.pose.pose.position.x, odometry.pose.pose.position.y) == (3.0, 3.0)


def test_outliers_replace_their_share() -> None:
    values = np.array([m.ranges for _, m in sent(scan, [Outliers("/topic", 0.25, 20.0, 30.0)])])
    hit = (values >= 20) & (values <= 30) & np.isfinite(values)
    untouched = np.array([scan(k).ranges for k in range(50)])
    wild = hit & ((untouched < 20) | (untouched > 30))
    assert wild[:10].mean() == pytest.approx(0.25, rel=0.2)


def test_frames_and_stamps_lie_as_told() -> None:
    for k, (_, message) in enumerate(sent(scan, [WrongFrameId("/topic", "map"), StampOffset("/topic", -250.0)])):
        assert message.header.frame_id == "map"
        assert time_to_ns(message.header.stamp) == max(0, k * 100 - 250) * MS
        assert list(message.ranges) == list(scan(k).ranges)


def test_a_frozen_sensor_repeats_itself_with_fresh_stamps() -> None:
    found = [m for _, m in sent(scan, [FrozenSensor("/topic", during=(1.0, 2.0))])]
    for k, message in enumerate(found):
        assert message.ranges[1] == 2.0 + (10 if 10 <= k < 20 else k)
        assert time_to_ns(message.header.stamp) == k * 100 * MS


def test_a_blackout_begins_and_ends_on_time() -> None:
    times = [t for t, _ in sent(scan, [Blackout("/topic", during=(1.0, 2.0))])]
    assert times == [k * 100 for k in range(50) if not 10 <= k < 20]


def test_a_fault_can_be_taken_out_again() -> None:
    context = SimContext(resources=DeviceResources(2))
    context.log_sink = lambda _: None
    faults = [Blackout("/topic"), Slowdown("gpu", 3.0), CpuHog(2), ThermalThrottling("nano-4gb")]
    removers = [fault.install(context) for fault in faults]
    assert context.filters and context.slowdown["gpu"] == 3.0 and context.nodes
    for remove in removers:
        remove()
    assert not context.filters and not context.nodes
    assert set(context.slowdown.values()) <= {1.0}
    context.run_for(5.0)
    assert set(context.slowdown.values()) <= {1.0}


def work(faults: Sequence[Fault], cores: int = 2, resource: str = "cpu") -> list[float]:
    """Return how long a callback of 10 ms takes each second, ms."""
    context = SimContext(resources=DeviceResources(cores))
    context.log_sink = lambda _: None
    for fault in faults:
        fault.install(context)
    node, times = Node("worker", context=context), list[float]()
    node.create_timer(1.0, lambda: context.charge(10 * MS, resource) and None)
    context.add_callback_tap(lambda r: times.append((r.end_ns - r.start_ns) / MS) if r.node == "/worker" else None)
    context.run_for(10.5)
    return times


def test_a_hog_takes_its_share_of_the_cores() -> None:
    assert work([]) == [10.0] * 10
    # Processor sharing: seven want two cores.
    assert work([CpuHog(6)]) == pytest.approx([35.0] * 10, rel=0.01)
    assert work([CpuHog(6)], cores=8) == [10.0] * 10


def test_a_slowdown_lasts_as_long_as_it_should() -> None:
    times = work([Slowdown("gpu", 4.0, during=(2.5, 5.5))], resource="gpu")
    assert times == [40.0 if 2 < second <= 5 else 10.0 for second in range(1, 11)]
    assert work([Slowdown("cpu", 2.0), Slowdown("cpu", 3.0)]) == pytest.approx([60.0] * 10)
    assert work([Slowdown("cpu", 2.0)], resource="gpu") == [10.0] * 10


def test_a_cool_module_is_left_alone_and_a_hot_one_throttles_as_the_twin_says() -> None:
    from robotbrain.jetson.catalogue import load_module
    from robotbrain.jetson.twin.runtime import simulate_heat, thermal_model

    cool = ThermalThrottling("orin-nano-8gb")
    assert work([cool], resource="gpu") == [10.0] * 10
    assert cool.log.throttled_s == 0 and len(cool.log.time_s) == 11

    hot = ThermalThrottling("orin-nano-8gb", ambient_c=75.0, cooling="passive", start_c=101.0)
    times = work([hot], resource="gpu")
    model = thermal_model(load_module("orin-nano-8gb"), "passive", 75.0)
    power = dict(zip(hot.log.time_s, hot.log.power_w[1:], strict=False))
    # The same model and governor, fed with the power that the run drew.
    wanted = simulate_heat(model, lambda t, _: power[round(t, 6)], 9.0, start_c=101.0)
    np.testing.assert_allclose(hot.log.temperature_c[:10], wanted.temperature_c, atol=1e-9)
    np.testing.assert_allclose(hot.log.clock[:10], wanted.clock)
    assert min(hot.log.clock) < 0.9
    # The worker's timer comes first where both are due, so it meets the clock of the step before.
    assert times == pytest.approx([10 / clock for clock in hot.log.clock[:10]])


@pytest.mark.parametrize(
    "make",
    [
        lambda: Noise("scan", 0.1),
        lambda: Noise("/scan", -1.0),
        lambda: Noise("/scan", math.nan),
        lambda: Noise("/scan", 0.1, seed=-1),
        lambda: Noise("/scan", 0.1, during=(3.0, 1.0)),
        lambda: DropFrames("/scan", 1.5),
        lambda: DropFrames("/scan", 0.8, burst=1.0),
        lambda: LateFrames("/scan", -5.0),
        lambda: LateFrames("/scan", 5.0, 2.0),
        lambda: Outliers("/scan", 0.1, 3.0, 2.0),
        lambda: StampOffset("/scan", math.inf),
        lambda: WrongFrameId("/scan", 3),  # type: ignore[arg-type]
        lambda: SensorBias("/scan", "much"),  # type: ignore[arg-type]
        lambda: CpuHog(0),
        lambda: CpuHog(1, duty=1.5),
        lambda: Slowdown("tpu", 2.0),
        lambda: Slowdown("gpu", 0.0),
        lambda: ThermalThrottling("toaster"),
        lambda: ThermalThrottling("nano-4gb", ambient_c=200.0),
        lambda: ThermalThrottling("nano-4gb", start_c=math.nan),
    ],
)
def test_parameters_out_of_range_are_refused(make: Callable[[], object]) -> None:
    with pytest.raises(InputError):
        make()


def test_faults_that_do_not_fit_the_message_say_so() -> None:
    for fault, words in (
        (Noise("/topic", 1.0), "std_msgs/msg/String"),
        (WrongFrameId("/topic"), "messages with a header"),
        (StampOffset("/topic", 1.0), "messages with a header"),
    ):
        with pytest.raises(InputError, match=words):
            sent(lambda _: String(data="x"), [fault], 1)
    with pytest.raises(InputError, match="angular_velocity"):
        sent(imu, [Noise("/topic", 1.0, field="speed")], 1)
    with pytest.raises(InputError, match="3"):
        sent(imu, [SensorBias("/topic", (1.0, 2.0))], 1)
    # On every topic, what has no header passes.
    assert len(sent(lambda _: String(data="x"), [StampOffset("*", 1.0)], 3)) == 3
    with pytest.raises(InputError, match="DeviceResources"):
        ThermalThrottling("nano-4gb").install(SimContext())


def test_faults_reach_a_drive_and_none_leaves_it_as_it_was() -> None:
    from robotbrain.pipeline.brain import drive

    plain = drive(6000, time_limit=2)
    harmless = [Noise("/scan", 0.0), LateFrames("/camera/image", 0.0), Slowdown("cpu", 1.0), DropFrames("/imu", 0.0)]
    assert drive(6000, time_limit=2, attach=[f.install for f in harmless]).log_sha256 == plain.log_sha256
    dark = drive(6000, time_limit=2, attach=[Blackout("/camera/image").install])
    assert len(plain.perception_ms) > 10 and not len(dark.perception_ms)


def test_nodes_refuse_messages_in_a_wrong_frame_and_say_so_once() -> None:
    from geometry_msgs.msg import PointStamped

    from robotbrain.pipeline.nodes.poses import FrameCheck

    context = SimContext()
    lines: list[str] = []
    context.log_sink = lambda record: lines.append(str(record))
    check = FrameCheck(Node("mapper", context=context))

    def seen(frame: str) -> PointStamped:
        message = PointStamped()
        message.header.frame_id = frame
        return message

    assert check.expect("marker", seen("base_link"), "base_link") and check.expect("marker", seen(""), "base_link")
    assert [check.expect("marker", seen("map"), "base_link") for _ in range(3)] == [False] * 3
    assert [check.sensor("scan", seen(f)) for f in ("laser", "laser", "odom", "camera")] == [True, True, False, False]
    assert len(lines) == 3
    for words in (
        "'map', expected 'base_link'",
        "'odom', expected the sensor's own frame",
        "'camera', expected 'laser'",
    ):
        assert any(words in line for line in lines)


def test_a_robot_whose_lidar_is_in_the_wrong_frame_stops() -> None:
    from robotbrain.pipeline.brain import drive

    lies = WrongFrameId("/scan", "map", during=(2.5, 1e9))
    run = drive(6000, time_limit=5, attach=[lies.install, lambda c: setattr(c, "log_sink", lambda _: None)])
    late = run.trajectory[run.trajectory[:, 0] > 4.0]
    assert np.ptp(late[:, 1]) < 0.01 and np.ptp(late[:, 2]) < 0.01
