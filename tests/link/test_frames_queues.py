"""Frames survive the wire and nonsense does not; queues drop what they should."""

from __future__ import annotations

import contextlib
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robotbrain.link import frames
from robotbrain.link.frames import FrameError, Message, Note, Ping, Request, Response, Window
from robotbrain.link.graph import End, Graph
from robotbrain.link.queues import MOST_CONTROL, FrameQueue
from robotbrain.ros.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from robotbrain.ros.time import Duration

TIMES = st.integers(-(2**62), 2**62)
NAMES = st.text(max_size=40)
DATA = st.binary(max_size=200)
CALLS = st.integers(0, 2**32 - 1)
FRAMES = st.one_of(
    st.builds(Message, NAMES, NAMES, TIMES, DATA),
    st.builds(Request, CALLS, NAMES, DATA),
    st.builds(Response, CALLS, NAMES, DATA),
    st.builds(Ping, TIMES, st.booleans()),
    st.builds(Note, st.dictionaries(NAMES, st.integers(), max_size=3)),
    st.builds(Window, TIMES),
)


@given(FRAMES)
def test_frames_survive_the_wire(frame: frames.Frame) -> None:
    data = frames.encode(frame)
    assert frames.frame_length(data[:4]) == len(data) - 4
    assert frames.decode(data[4:]) == frame


@settings(max_examples=300)
@given(st.binary(max_size=80))
def test_nonsense_is_refused_or_harmless(data: bytes) -> None:
    try:
        frame = frames.decode(data)
    except FrameError:
        return
    # What was accepted is a frame of the kind it claims to be.
    assert frame.kind == data[0]


@given(FRAMES, st.integers(0, 30))
def test_cut_frames_never_raise_anything_else(frame: frames.Frame, cut: int) -> None:
    body = frames.encode(frame)[4:]
    with contextlib.suppress(FrameError):
        frames.decode(body[: max(0, len(body) - cut)])


@pytest.mark.parametrize("length", [0, frames.MAX_FRAME + 1, 2**32 - 1])
def test_impossible_lengths(length: int) -> None:
    with pytest.raises(FrameError, match="length"):
        frames.frame_length(struct.pack("<I", length))


def test_a_frame_too_long_to_send() -> None:
    with pytest.raises(FrameError, match="longer than a frame may be"):
        frames.encode(Message("/x", "y", 0, bytes(frames.MAX_FRAME)))


def test_graph_survives_json() -> None:
    qos = QoSProfile(
        depth=7,
        reliability=ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
        deadline=Duration(nanoseconds=5_000_000),
    )
    graph = Graph({"/scan": End("sensor_msgs/msg/LaserScan", qos)}, {}, {"/a/b": "std_srvs/srv/SetBool"})
    assert Graph.from_json(graph.to_json()) == graph


@pytest.mark.parametrize(
    "content",
    [
        None,
        {},
        {"publishers": {}, "subscriptions": [], "services": {}},
        {"publishers": {"scan": ["t", [1] * 8]}, "subscriptions": {}, "services": {}},
        {"publishers": {"/sc an": ["t", [1, 1, 1, 1, 0, 0, 0, 0]]}, "subscriptions": {}, "services": {}},
        {"publishers": {"/scan": ["t", [1, -5, 1, 1, 0, 0, 0, 0]]}, "subscriptions": {}, "services": {}},
        {"publishers": {"/scan": ["t", ["x"] * 8]}, "subscriptions": {}, "services": {}},
        {"publishers": {}, "subscriptions": {}, "services": {f"/s{i}": "t" for i in range(3000)}},
    ],
)
def test_bad_graphs_are_refused(content: object) -> None:
    with pytest.raises(FrameError):
        Graph.from_json(content)


def message(topic: str, number: int, size: int = 4) -> Message:
    return Message(topic, "t", number, bytes(size))


def drain(queue: FrameQueue) -> list[frames.Frame]:
    out = []
    while (frame := queue.get()) is not None:
        out.append(frame)
    return out


def test_keep_last_per_topic() -> None:
    queue = FrameQueue()
    queue.set_depth("/image", 2)
    for number in range(5):
        queue.put(message("/image", number))
        queue.put(message("/imu", number))
    kept = [f.stamp_ns for f in drain(queue) if isinstance(f, Message) and f.topic == "/image"]
    assert kept == [3, 4]
    assert queue.dropped == {"/image": 3}


def test_commands_overtake_images_and_topics_keep_their_order() -> None:
    queue = FrameQueue(by_urgency=True)
    for number in range(3):
        queue.put(message("/image", number, 100_000))
    queue.put(message("/scan", 7, 10_000))
    queue.put(message("/cmd_vel", 8, 52))
    queue.put(message("/cmd_vel", 9, 52))
    queue.put(Request(1, "/emergency_stop", b""))
    order = [(f.topic, f.stamp_ns) if isinstance(f, Message) else "request" for f in drain(queue)]
    assert order == ["request", ("/cmd_vel", 8), ("/cmd_vel", 9), ("/scan", 7), *(("/image", n) for n in range(3))]


def test_arrival_order_without_urgency() -> None:
    queue = FrameQueue()
    queue.put(message("/image", 0, 100_000))
    queue.put(message("/cmd_vel", 1, 52))
    assert [f.stamp_ns for f in drain(queue) if isinstance(f, Message)] == [0, 1]


def test_a_peer_that_does_not_read_is_noticed() -> None:
    queue = FrameQueue()
    for _ in range(MOST_CONTROL):
        queue.put(Ping(0))
    with pytest.raises(FrameError, match="does not read"):
        queue.put(Ping(0))


def test_a_closed_queue_neither_takes_nor_gives() -> None:
    queue = FrameQueue()
    queue.put(message("/x", 0))
    queue.close()
    queue.put(message("/x", 1))
    assert queue.get(None) is None and len(queue) == 0
