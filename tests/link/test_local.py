"""The local transport over real sockets, both ends in this process: graph, data, services, strangers, breakdowns."""

from __future__ import annotations

import socket
import struct
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import Image
from std_msgs.msg import Bool, Int32, String
from std_srvs.srv import SetBool

from robotbrain.errors import InputError
from robotbrain.link import connection, handshake
from robotbrain.link.frames import MAX_FRAME, Message, Note, encode
from robotbrain.link.handshake import LinkError, RefusedError
from robotbrain.link.local import LinkClient, LinkServer, bind, connect
from robotbrain.link.realtime import RealtimeContext, WallClock
from robotbrain.ros.logging import LogRecord
from robotbrain.ros.node import Node


class Pair:
    """A robot's and a brain's graph, joined."""

    def __init__(self, join: bool = True) -> None:
        self.log: list[LogRecord] = []
        # One epoch for both: stamps of the one are ages of the other.
        clock = WallClock(0)
        self.robot, self.brain = RealtimeContext(clock), RealtimeContext(clock)
        for context in (self.robot, self.brain):
            context.log_sink = self.log.append
        self.robot_node = Node("driver", context=self.robot)
        self.brain_node = Node("planner", context=self.brain)
        self.server = LinkServer(self.robot, port=0)
        self.client: LinkClient | None = None
        if join:
            self.join()

    def join(self, token: str | None = None) -> LinkClient:
        self.client = LinkClient(self.brain, "127.0.0.1", self.server.address[1], token)
        return self.client

    def pump(self, until: Callable[[], Any], turns: int = 1500) -> None:
        """Run both graphs until something is so; fail after so many turns (20 ms each at most)."""
        for _ in range(turns):
            if until():
                return
            self.robot.step()
            self.brain.step()
        raise AssertionError(f"it never came; log: {[record.message for record in self.log]}")

    def said(self, text: str) -> bool:
        return any(text in record.message for record in self.log)

    def close(self) -> None:
        if self.client is not None:
            self.client.close()
        self.server.close()


@pytest.fixture
def pair(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Pair]:
    monkeypatch.setenv("ROBOTBRAIN_LINK_DIR", str(tmp_path))
    made = Pair()
    yield made
    made.close()


@pytest.fixture
def lonely(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Pair]:
    monkeypatch.setenv("ROBOTBRAIN_LINK_DIR", str(tmp_path))
    made = Pair(join=False)
    yield made
    made.close()


def test_topics_cross_both_ways_in_order(pair: Pair) -> None:
    down: list[int] = []
    up: list[int] = []
    pair.brain_node.create_subscription(Int32, "sensor", lambda msg: down.append(msg.data), 50)
    pair.robot_node.create_subscription(Int32, "command", lambda msg: up.append(msg.data), 50)
    sensor = pair.robot_node.create_publisher(Int32, "sensor", 50)
    command = pair.brain_node.create_publisher(Int32, "command", 50)
    pair.pump(lambda: sensor.get_subscription_count() and command.get_subscription_count())
    for number in range(20):
        sensor.publish(Int32(data=number))
        command.publish(Int32(data=-number))
    pair.pump(lambda: len(down) == 20 and len(up) == 20)
    assert down == list(range(20)) and up == [-n for n in range(20)]


def test_a_topic_with_ends_on_both_sides_does_not_echo(pair: Pair) -> None:
    got: list[str] = []
    publishers = []

    def listener(name: str) -> Callable[[Any], None]:
        return lambda msg: got.append(f"{name} heard {msg.data}")

    for node in (pair.robot_node, pair.brain_node):
        node.create_subscription(String, "chatter", listener(node.get_name()), 50)
        publishers.append(node.create_publisher(String, "chatter", 50))
    pair.pump(lambda: all(publisher.get_subscription_count() == 2 for publisher in publishers))
    for publisher in publishers:
        publisher.publish(String(data=publisher.node.get_name()))
    pair.pump(lambda: len(got) >= 4)
    for _ in range(30):  # an echo would come now
        pair.robot.step()
        pair.brain.step()
    assert sorted(got) == [
        "driver heard driver",
        "driver heard planner",
        "planner heard driver",
        "planner heard planner",
    ]


def test_the_graph_tells_the_truth_and_hides_the_link(pair: Pair) -> None:
    pair.robot_node.create_publisher(Int32, "sensor", 10)
    pair.robot_node.create_service(SetBool, "stop", lambda request, response: response)
    pair.pump(lambda: "/sensor" in pair.brain.topics and "/stop" in pair.brain.services)
    assert ("/sensor", ["std_msgs/msg/Int32"]) in pair.brain_node.get_topic_names_and_types()
    assert pair.brain_node.count_publishers("sensor") == 1
    # What only the link has is not told back.
    assert pair.robot_node.count_publishers("sensor") == 1


def test_latched_messages_reach_those_who_come_later(pair: Pair) -> None:
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = pair.robot_node.create_publisher(Bool, "state", latched)
    publisher.publish(Bool(data=True))
    pair.pump(lambda: "/state" in pair.brain.topics)
    got: list[bool] = []
    pair.brain_node.create_subscription(Bool, "state", lambda msg: got.append(msg.data), latched)
    pair.pump(lambda: got)
    assert got == [True]


def test_incompatible_qos_is_refused_as_in_one_process(pair: Pair) -> None:
    publisher = pair.robot_node.create_publisher(Int32, "sensor", qos_profile_sensor_data)
    got: list[int] = []
    pair.brain_node.create_subscription(Int32, "sensor", lambda msg: got.append(msg.data), 10)
    pair.pump(lambda: pair.said("QoS is incompatible"))
    publisher.publish(Int32(data=1))
    for _ in range(20):
        pair.robot.step()
        pair.brain.step()
    assert not got


def test_services_cross_and_several_calls_are_out_at_a_time(pair: Pair) -> None:
    seen: list[bool] = []

    def stop(request: Any, response: Any) -> Any:
        seen.append(request.data)
        response.success, response.message = True, f"call {len(seen)}"
        return response

    pair.robot_node.create_service(SetBool, "stop", stop)
    client = pair.brain_node.create_client(SetBool, "stop")
    pair.pump(client.service_is_ready)
    futures = [client.call_async(SetBool.Request(data=bool(k % 2))) for k in range(5)]
    pair.pump(lambda: all(future.done() for future in futures))
    assert [future.result().message for future in futures] == [f"call {k}" for k in range(1, 6)]
    assert seen == [bool(k % 2) for k in range(5)]


def test_other_types_of_the_same_name_are_kept_apart(pair: Pair) -> None:
    pair.brain_node.create_subscription(Int32, "thing", lambda msg: None, 10)
    pair.robot_node.create_publisher(String, "thing", 10)
    pair.pump(lambda: pair.said("/thing of the other process is not available here"))


def test_ages_on_arrival_are_counted(pair: Pair) -> None:
    publisher = pair.robot_node.create_publisher(Int32, "sensor", 10)
    got: list[int] = []
    pair.brain_node.create_subscription(Int32, "sensor", lambda msg: got.append(msg.data), 10)
    pair.pump(lambda: publisher.get_subscription_count())
    publisher.publish(Int32(data=1))
    pair.pump(lambda: got)
    assert pair.client is not None and pair.client.peer is not None
    stats = pair.client.peer.bridge.received["/sensor"]
    assert stats.messages == 1 and stats.worst_ns >= stats.total_ns > 0


def test_old_images_are_dropped_and_counted_when_the_brain_is_busy(pair: Pair) -> None:
    publisher = pair.robot_node.create_publisher(Image, "image", 2)
    got: list[int] = []
    pair.brain_node.create_subscription(Image, "image", lambda msg: got.append(msg.width), 2)
    pair.pump(lambda: publisher.get_subscription_count())
    for width in range(80):
        publisher.publish(Image(width=width, data=bytes(400_000)))
        for _ in range(3):
            pair.robot.step()  # the brain does nothing meanwhile
    pair.pump(lambda: got and got[-1] == 79)
    assert got == sorted(got) and len(got) < 80
    assert pair.client is not None and pair.client.peer is not None
    dropped = pair.client.peer.dropped["/image"] + pair.server.peers[0].dropped["/image"]
    lost_in_graph = sum(s.dropped for s in pair.brain.topics["/image"].subscriptions if s.node is pair.brain_node)
    assert len(got) + dropped + lost_in_graph == 80


def test_wrong_tokens_are_refused_for_good(lonely: Pair) -> None:
    client = lonely.join(token="0" * 32)
    lonely.pump(lambda: client.refusal)
    assert "token is wrong" in str(client.refusal)
    lonely.pump(lambda: lonely.server.refused == 1)
    assert not lonely.server.peers and client.connections == 0


def test_an_end_that_does_not_know_the_token_is_no_robot(lonely: Pair) -> None:
    """Who merely holds the port, and does not know the token, cannot pass for the robot."""
    listener = bind("127.0.0.1", 0)
    listener.listen()

    def impostor() -> None:
        sock, _ = listener.accept()
        with sock:
            sock.sendall(encode(Note({"robotbrain": 1, "nonce": "ab"})))
            sock.recv(4096)
            sock.sendall(encode(Note({"proof": "0" * 64, "offer": {}})))

    threading.Thread(target=impostor, daemon=True).start()
    with pytest.raises(RefusedError, match="does not know"):
        connect("127.0.0.1", listener.getsockname()[1], "secret")
    listener.close()


NONSENSE = [
    b"GET / HTTP/1.1\r\nHost: robot\r\n\r\n",
    bytes(64),
    b"\xff" * 64,
    struct.pack("<I", MAX_FRAME) + b"\x05",
    encode(Note({"robotbrain": 99})),
    encode(Note({"robotbrain": 1, "nonce": 3, "proof": None})),
    encode(Message("/cmd_vel", "geometry_msgs/msg/Twist", 0, bytes(52))),
]


@pytest.mark.parametrize("data", NONSENSE)
def test_strangers_are_turned_away_and_the_robot_goes_on(pair: Pair, data: bytes) -> None:
    with socket.create_connection(pair.server.address) as stranger:
        stranger.sendall(data)
        pair.pump(lambda: pair.server.refused == 1)
    publisher = pair.robot_node.create_publisher(Int32, "sensor", 10)
    got: list[int] = []
    pair.brain_node.create_subscription(Int32, "sensor", lambda msg: got.append(msg.data), 10)
    pair.pump(lambda: publisher.get_subscription_count())
    publisher.publish(Int32(data=5))
    pair.pump(lambda: got == [5])


@pytest.mark.parametrize(
    "data",
    [
        struct.pack("<I", 2**32 - 1),
        struct.pack("<IB", 1, 200),
        encode(Note({"graph": {"publishers": 3}})),
        encode(Note({"hello": 1})),
    ],
)
def test_nonsense_after_the_handshake_ends_the_connection_only(lonely: Pair, data: bytes) -> None:
    sock, _ = connect(*lonely.server.address, lonely.server.token)
    lonely.pump(lambda: lonely.server.peers)
    sock.sendall(data)
    lonely.pump(lambda: not lonely.server.peers)
    assert lonely.said("nonsense")
    sock.close()
    lonely.join()
    lonely.pump(lambda: lonely.server.peers)


def test_a_command_that_cannot_be_decoded_is_the_callback_s_error_not_the_end(lonely: Pair) -> None:
    errors: list[Exception] = []

    def go_on(error: Exception) -> bool:
        errors.append(error)
        return True

    lonely.robot.on_callback_error = go_on
    lonely.robot_node.create_subscription(String, "command", lambda msg: None, 10)
    sock, _ = connect(*lonely.server.address, lonely.server.token)
    graph = {"publishers": {"/command": ["std_msgs/msg/String", [1, 10, 1, 2, 0, 0, 0, 0]]}}
    sock.sendall(encode(Note({"graph": {**graph, "subscriptions": {}, "services": {}}})))
    sock.sendall(encode(Message("/command", "std_msgs/msg/String", 0, b"\0\1\0\0\xff\xff\xff\xff")))
    lonely.pump(lambda: errors)
    assert lonely.server.peers
    sock.close()


def test_the_brain_comes_back_after_the_robot_did(pair: Pair) -> None:
    client = pair.client
    assert client is not None
    pair.pump(lambda: client.peer)
    pair.robot_node.create_publisher(Int32, "sensor", 10)
    pair.pump(lambda: pair.brain_node.count_publishers("sensor"))
    port = pair.server.address[1]
    pair.server.close()
    pair.pump(lambda: client.peer is None)
    assert pair.said("the robot's process ends")
    assert not pair.brain_node.count_publishers("sensor"), "what the robot had is gone from the graph"
    pair.server = LinkServer(pair.robot, port=port)
    pair.pump(lambda: client.peer and pair.brain_node.count_publishers("sensor"))
    assert client.connections == 2


def test_silence_is_noticed(lonely: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    """A peer whose process is frozen sends no signs of life; the socket alone would look alive for ever."""
    monkeypatch.setattr(connection, "SILENCE_S", 0.3)
    sock, _ = connect(*lonely.server.address, lonely.server.token)
    lonely.pump(lambda: lonely.server.peers)
    lonely.pump(lambda: not lonely.server.peers)
    assert lonely.said("nothing was heard")
    sock.close()


def test_signs_of_life_keep_an_idle_connection(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    client = pair.client
    assert client is not None
    pair.pump(lambda: client.peer)
    assert client.peer is not None
    traffic = client.peer.connection.traffic
    pair.pump(lambda: traffic.round_trip_ns is not None)
    assert traffic.round_trip_ns is not None and traffic.round_trip_ns > 0


def test_a_port_in_use_is_said_so(lonely: Pair) -> None:
    with pytest.raises(InputError, match="another --port"):
        LinkServer(RealtimeContext(WallClock(0)), port=lonely.server.address[1])


def test_nobody_there_and_no_token(lonely: Pair) -> None:
    listener = bind("127.0.0.1", 0)
    port = listener.getsockname()[1]
    listener.close()
    with pytest.raises(LinkError, match="robotbrain robot"):
        connect("127.0.0.1", port, "x")
    handshake.token_path(lonely.server.address[1]).unlink()
    with pytest.raises(InputError, match="--token"):
        connect(*lonely.server.address)


def test_token_files_are_private_and_new_each_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import os

    monkeypatch.setenv("ROBOTBRAIN_LINK_DIR", str(tmp_path))
    first, second = handshake.new_token(5), handshake.new_token(5)
    assert first != second == handshake.read_token(5)
    if os.name == "posix":
        assert handshake.token_path(5).stat().st_mode & 0o077 == 0


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("127.0.0.1:5", ("127.0.0.1", 5)),
        (":5", ("127.0.0.1", 5)),
        ("robot.local", ("robot.local", handshake.DEFAULT_PORT)),
    ],
)
def test_addresses(text: str, expected: tuple[str, int]) -> None:
    assert handshake.parse_address(text) == expected


@pytest.mark.parametrize("text", ["a:b", "a:0", "a:65536", "::1:5", "a:٣"])
def test_impossible_addresses(text: str) -> None:
    with pytest.raises(InputError, match="address"):
        handshake.parse_address(text)
