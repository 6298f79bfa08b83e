"""A recording holds what happened, and nothing that had not ended."""

from __future__ import annotations

import struct

import pytest
from rclpy.node import Node
from sensor_msgs.msg import Image
from std_msgs.msg import String

from robotbrain.monitoring.trace import Recorder, is_stamped, stamp_of
from robotbrain.ros import SimContext, charge
from robotbrain.ros.cdr import to_cdr
from tests.monitoring.sample_runs import trace_of


def test_messages_callbacks_and_senders_belong_together() -> None:
    trace = trace_of(False)
    for callback in trace.callbacks:
        assert callback.ready_ns <= callback.start_ns <= callback.end_ns <= trace.end_ns
        for message in callback.published:
            sent = trace.message_by_id.get(message)
            if sent is not None:
                assert sent.released_ns == callback.end_ns and sent.node == callback.node
                assert trace.sender[message] is callback
    for message, takers in trace.takers.items():
        assert all(taker.message == message for taker in takers)
        assert all(taker.ready_ns >= trace.message_by_id[message].released_ns for taker in takers)


def test_what_was_not_over_is_missing_and_recording_can_end() -> None:
    context = SimContext()
    recorder = Recorder(context)
    with context.as_default():
        node = Node("slow")
        publisher = node.create_publisher(String, "out", 3)

        def work() -> None:
            charge(400_000_000)
            publisher.publish(String(data="x"))

        node.create_timer(0.5, work)
        node.create_subscription(String, "out", lambda _: None, 7)
        context.run_for(1.2)
        trace = recorder.trace(roles={"/slow": "planner"})
        assert [c.start_ns for c in trace.callbacks if c.kind == "timer"] == [500_000_000]
        assert trace.roles == {"/slow": "planner"}
        assert trace.queue_limits == {("/slow", "/out"): 7}
        assert trace.periods_ns == {("/slow", "work"): 500_000_000}
        recorder.close()
        context.run_for(3.0)
    assert len(recorder.trace().messages) == len(trace.messages)


@pytest.mark.parametrize("big", [False, True])
def test_stamps_are_read_from_the_wire(big: bool) -> None:
    message = Image()
    message.header.stamp.sec, message.header.stamp.nanosec = 12, 345
    data = to_cdr(message)
    if big:
        data = b"\x00\x00\x00\x00" + struct.pack(">iI", 12, 345)
    assert stamp_of(data) == 12 * 10**9 + 345


def test_only_messages_with_a_header_are_stamped() -> None:
    assert is_stamped("sensor_msgs/msg/Image") and is_stamped("nav_msgs/msg/Odometry")
    assert not any(is_stamped(name) for name in ("geometry_msgs/msg/Twist", "std_msgs/msg/Header", "no/such/Type"))
