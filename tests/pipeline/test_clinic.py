"""Recording, replaying and comparing: what the troubleshooting lesson looks for faults with."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import robotbrain.ros  # makes rclpy importable
from robotbrain.errors import InputError
from robotbrain.monitoring.faults import SensorBias
from robotbrain.pipeline import clinic
from robotbrain.pipeline.brain import RunResult, drive
from robotbrain.pipeline.nodes.estimator import EstimatorNode
from robotbrain.ros import SimContext

assert robotbrain.ros.BACKEND == "kit"

SENSORS = ["/imu", "/joint_states", "/scan"]
ODOMETRY = "/odometry/filtered"


class Drive(SimpleNamespace):
    run: RunResult
    bag: Path
    live: list[bytes]


@pytest.fixture(scope="module")
def short(tmp_path_factory: Any) -> Drive:
    """A drive of five seconds, its recording, and what the estimator said while it happened."""
    bag = tmp_path_factory.mktemp("clinic") / "bag"
    live: list[bytes] = []

    def listen(context: SimContext) -> None:
        context.add_message_tap(lambda record, data: live.append(data) if record.name == ODOMETRY else None)

    run = drive(4, difficulty=0.2, time_limit=5.0, attach=[clinic.recording(bag, SENSORS), listen])
    return Drive(run=run, bag=bag, live=live)


def test_a_replay_gives_the_estimator_what_the_drive_gave_it(short: Drive) -> None:
    """The same node with the same messages comes to the same poses; only callback costs are missing."""
    from robotbrain.ros.cdr import from_cdr
    from robotbrain.ros.conversions import msg_class

    heard = clinic.replay_into(short.bag, [ODOMETRY], node=EstimatorNode)
    again = clinic.poses_of(heard[ODOMETRY])
    kind = msg_class("nav_msgs/msg/Odometry")
    before = clinic.poses_of([from_cdr(data, kind) for data in short.live])
    times, first, second = np.intersect1d(before[:, 0], again[:, 0], return_indices=True)
    assert len(times) > 0.95 * len(before)
    assert np.abs(before[first, 1:3] - again[second, 1:3]).max() < 0.01


def test_the_recording_holds_what_was_sent_and_faults_only_befall_the_replay(short: Drive) -> None:
    plain = clinic.gyro_turn_rate(clinic.replay_into(short.bag, ["/imu"], topics=["/imu"])["/imu"])
    fault = SensorBias("/imu", scale=-2.0)
    turned = clinic.gyro_turn_rate(clinic.replay_into(short.bag, ["/imu"], topics=["/imu"], faults=[fault])["/imu"])
    assert len(plain) == len(turned) and len(plain) > 200
    assert np.allclose(turned[:, 1], -2 * plain[:, 1])
    assert np.array_equal(turned[:, 0], plain[:, 0])


def test_wheels_and_gyro_of_a_healthy_robot_agree_with_the_truth(short: Drive) -> None:
    heard = clinic.replay_into(short.bag, ["/imu", "/joint_states"])
    wheels = clinic.wheel_turn_rate(heard["/joint_states"])
    gyro = clinic.gyro_turn_rate(heard["/imu"])
    truth = clinic.truth_in_map(short.run)
    turned = np.unwrap(truth[:, 3])
    inside = (wheels[:, 0] > truth[0, 0]) & (wheels[:, 0] < truth[-1, 0])
    for rates in (wheels, gyro):
        total = float(rates[inside, 1].sum()) * 0.02
        assert total == pytest.approx(turned[-1] - turned[0], abs=0.05)


def test_the_truth_in_the_map_begins_at_its_origin_and_keeps_distances(short: Drive) -> None:
    truth = clinic.truth_in_map(short.run)
    world = short.run.trajectory
    assert np.hypot(*truth[0, 1:3]) < 0.02 and abs(truth[0, 3]) < 0.05
    assert np.allclose(np.hypot(*np.diff(truth[:, 1:3], axis=0).T), np.hypot(*np.diff(world[:, 1:3], axis=0).T))
    assert np.all(np.abs(truth[:, 3]) <= math.pi)


def test_the_estimator_is_near_the_truth_and_a_wrong_one_is_not(short: Drive) -> None:
    truth = clinic.truth_in_map(short.run)
    estimate = clinic.poses_of(clinic.replay_into(short.bag, [ODOMETRY], node=EstimatorNode)[ODOMETRY])
    assert clinic.distance_from_truth(estimate, truth).max() < 0.05
    shifted = estimate + np.array([0.0, 0.3, 0.4, 0.0])
    assert clinic.distance_from_truth(shifted, truth).mean() == pytest.approx(0.5, abs=0.05)


def test_a_topic_that_nobody_publishes_is_named(short: Drive) -> None:
    with pytest.raises(InputError, match="/imu"):
        clinic.replay_into(short.bag, ["/imo"])


def arrivals(link: clinic.Link, sizes: list[int], gap: float) -> list[float]:
    """Return when messages of these sizes arrive, ms; one is sent every ``gap`` s."""
    import rclpy
    from std_msgs.msg import ByteMultiArray

    found: list[float] = []
    with SimContext().as_default() as context:
        link.attach(context)
        sender, receiver = rclpy.create_node("sender"), rclpy.create_node("receiver")
        publishers = [sender.create_publisher(ByteMultiArray, f"t{k}", 10) for k in range(len(sizes))]
        for k in range(len(sizes)):
            receiver.create_subscription(ByteMultiArray, f"t{k}", lambda _: found.append(context.now_ns / 1e6), 10)
        for publisher, size in zip(publishers, sizes, strict=True):
            publisher.publish(ByteMultiArray(data=[b"\0"] * size))
            context.run_for(gap)
        context.run_for(10.0)
    return found


def test_a_link_carries_one_message_after_the_other() -> None:
    link = clinic.Link(8e5, overhead_ms=2.0)  # 100 bytes a millisecond
    found = arrivals(link, [5000, 100, 100], 0.001)
    expected, free, left = [], 0.0, link.sent_bytes
    overhead = (left - 5200) / 3  # bytes of a message besides its data
    for k, size in enumerate([5000, 100, 100]):
        free = max(free, float(k)) + (size + overhead) / 100 + 2.0
        expected.append(free)
    assert found == pytest.approx(expected, abs=0.2)  # alignment differs by a few bytes between messages


def test_a_free_link_delays_by_the_message_alone() -> None:
    link = clinic.Link(8e5, overhead_ms=0.0)
    found = arrivals(link, [1000, 1000], 1.0)
    assert found[1] - found[0] == pytest.approx(1000.0) and 10.0 < found[0] < 10.6


@pytest.mark.parametrize(("rate", "overhead"), [(0.0, 1.0), (-1.0, 1.0), (1e6, -1.0), (math.inf, 1.0)])
def test_a_link_without_capacity_is_refused(rate: float, overhead: float) -> None:
    with pytest.raises(InputError):
        clinic.Link(rate, overhead)
