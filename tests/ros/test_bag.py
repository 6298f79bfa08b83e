"""Bags against peers (rosbags, mcap-ros2-support), against kill -9, cut files and a full disk."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import textwrap
import time
from array import array
from pathlib import Path

import pytest
from geometry_msgs.msg import PoseStamped, Twist
from hypothesis import given, settings
from hypothesis import strategies as st
from nav_msgs.msg import OccupancyGrid
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rclpy.time import Duration
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String

from robotbrain.errors import InputError, RobotBrainError
from robotbrain.ros import SimContext
from robotbrain.ros.bag import BagMessage, BagReader, BagRecorder, BagWriter, open_bag, recover, replay, replay_wall
from robotbrain.ros.bag.mcap_in import MAGIC, McapIn
from robotbrain.ros.record import DecisionLog

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
SENSOR = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT, deadline=Duration(seconds=0.2))
KEEP_ALL = QoSProfile(history=HistoryPolicy.KEEP_ALL, lifespan=Duration(nanoseconds=1_500_000_001))


def text(number):
    return serialize_message(String(data=f"message {number}"))


def write_some(path, count=200, **options):
    """``count`` strings and scans, 10 ms apart, and one latched grid."""
    options.setdefault("flush_interval_s", None)
    with BagWriter(path, **options) as bag:
        bag.write("/map", "nav_msgs/msg/OccupancyGrid", serialize_message(OccupancyGrid()), 5, LATCHED)
        for number in range(count):
            stamp = 10 + number * 10_000_000
            bag.write("/chat", "std_msgs/msg/String", text(number), stamp)
            scan = LaserScan(ranges=[float(number)] * 30)
            bag.write("/scan", "sensor_msgs/msg/LaserScan", serialize_message(scan), stamp, SENSOR)
    return path


def decoded_by_peer(path):
    """Topic, stamp and message of everything in a bag, by mcap-ros2-support."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with next(path.glob("*.mcap")).open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        return [(channel.topic, raw.log_time, message) for _, channel, raw, message in reader.iter_decoded_messages()]


# ---------------------------------------------------------------- peers


def test_rosbags_reads_it(tmp_path, context):
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_typestore

    path = write_some(tmp_path / "bag", compression="zstd", chunk_bytes=5000)
    store = get_typestore(Stores.ROS2_KILTED)
    with Reader(path) as reader, open_bag(path) as mine:
        theirs = [(link.topic, link.msgtype, stamp, bytes(data)) for link, stamp, data in reader.messages()]
        assert theirs == [tuple(message) for message in mine] and len(theirs) == 401
        assert (reader.start_time, reader.end_time - 1) == (mine.start_ns, mine.end_ns) == (5, 10 + 199 * 10_000_000)
        assert reader.message_count == mine.message_count == 401 and reader.ros_distro == "kilted"
        for link in reader.connections:
            assert link.msgcount == mine.topics[link.topic].count
            assert link.digest == mine.topics[link.topic].type_hash == store.hash_rihs01(link.msgtype)
            assert link.msgdef.data == mine.topics[link.topic].definition
        scans = [store.deserialize_cdr(data, kind) for topic, kind, _, data in theirs if topic == "/scan"]
        assert [scan.ranges[29] for scan in scans] == [float(number) for number in range(200)]


def test_mcap_ros2_support_reads_it(tmp_path, context):
    """Decoded from the definitions in the file, by a library that knows no ROS type."""
    pose = PoseStamped()
    pose.header.frame_id, pose.pose.position.x, pose.pose.orientation.w = "map", 1.25, 0.5
    path = write_some(tmp_path / "bag", count=20)
    with BagWriter(tmp_path / "pose") as bag:
        bag.write("/pose", "geometry_msgs/msg/PoseStamped", serialize_message(pose), 7)
    [(topic, stamp, found)] = decoded_by_peer(tmp_path / "pose")
    assert (topic, stamp, found.header.frame_id, found.pose.orientation.w) == ("/pose", 7, "map", 0.5)
    with open_bag(path) as reader:
        decoded = [(message.topic, message.stamp_ns, reader.decode(message)) for message in reader]
    theirs = decoded_by_peer(path)
    assert [one[:2] for one in theirs] == [one[:2] for one in decoded] and len(theirs) == 41
    for (topic, _, other), (_, _, message) in zip(theirs, decoded, strict=True):
        if topic == "/chat":
            assert other.data == message.data
        elif topic == "/scan":
            assert list(other.ranges) == list(message.ranges)


def test_qos_of_every_profile_is_read_back(tmp_path, context):
    from rosbags.rosbag2 import Reader

    profiles = {"/a": (LATCHED,), "/b": (SENSOR, KEEP_ALL), "/c": ()}
    with BagWriter(tmp_path / "bag") as bag:
        for topic, qos in profiles.items():
            bag.write(topic, "std_msgs/msg/String", text(0), 1, qos)
    with open_bag(tmp_path / "bag") as reader:
        assert {topic: reader.qos(topic) for topic in reader.topics} == profiles
    with Reader(tmp_path / "bag") as reader:
        found = {link.topic: link.ext.offered_qos_profiles for link in reader.connections}
    [latched], (sensor, keep_all) = found["/a"], found["/b"]
    assert (latched.durability.name, latched.depth, latched.deadline) == ("TRANSIENT_LOCAL", 1, (9223372036, 854775807))
    assert (sensor.reliability.name, tuple(sensor.deadline)) == ("BEST_EFFORT", (0, 200_000_000))
    assert (keep_all.history.name, tuple(keep_all.lifespan)) == ("KEEP_ALL", (1, 500_000_001))


@pytest.mark.parametrize("storage", ["sqlite3", "mcap", "mcap-message", "mcap-file", "mcap-storage"])
def test_bags_of_other_tools(tmp_path, context, storage):
    """Written by rosbags, in the older metadata version and with each compression of rosbag2."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    kind, _, compression = storage.partition("-")
    plugin = StoragePlugin.SQLITE3 if kind == "sqlite3" else StoragePlugin.MCAP
    offered = Qos(
        QosHistory.KEEP_LAST, 7, QosReliability.BEST_EFFORT, QosDurability.VOLATILE, QosTime(2147483647, 4294967295),
        QosTime(0, 0), QosLiveliness.AUTOMATIC, QosTime(0, 0), False,
    )  # fmt: skip
    writer = Writer(tmp_path / "bag", version=8, storage_plugin=plugin)
    if compression:
        writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    with writer:
        store = get_typestore(Stores.ROS2_KILTED)
        link = writer.add_connection("/chat", "std_msgs/msg/String", typestore=store, offered_qos_profiles=[offered])
        for number in range(50):
            writer.write(link, 100 * number, text(number))
    with open_bag(tmp_path / "bag") as reader:
        assert [message.stamp_ns for message in reader] == [100 * number for number in range(50)]
        assert [reader.decode(message).data for message in reader][49] == "message 49"
        [qos] = reader.qos("/chat")
        assert (qos.depth, qos.reliability, qos.history) == (7, ReliabilityPolicy.BEST_EFFORT, HistoryPolicy.KEEP_LAST)
        assert [message.stamp_ns for message in reader.messages(["/chat"], 100, 300)] == [100, 200]
        assert (reader.start_ns, reader.end_ns, reader.unfinished, reader.notes) == (0, 4900, False, [])


def test_a_file_without_chunks_and_one_with_a_foreign_type(tmp_path, context):
    from mcap.writer import Writer

    path = tmp_path / "plain.mcap"
    with path.open("wb") as file:
        writer = Writer(file, use_chunking=False)
        writer.start("ros2")
        schema = writer.register_schema("my_msgs/msg/Level", "ros2msg", b"std_msgs/Header header\nfloat32 level\n"
                                        + b"=" * 80 + b"\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\n"
                                        b"string frame_id\n" + b"=" * 80
                                        + b"\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n")  # fmt: skip
        channel = writer.register_channel("/level", "cdr", schema)
        data = bytes.fromhex("00010000 07000000 08000000 02000000 6100 0000 0000 c03f".replace(" ", ""))
        for stamp in (30, 10, 20):
            writer.add_message(channel, stamp, data, stamp)
        writer.finish()
    with open_bag(path) as reader:
        assert not reader.unfinished and reader.notes == [] and reader.message_count == 3
        messages = list(reader)
        assert [message.stamp_ns for message in messages] == [10, 20, 30]
        level = reader.decode(messages[0])
        assert (level.level, level.header.stamp.sec, level.header.frame_id) == (1.5, 7, "a")


def test_a_type_whose_definition_has_changed_is_decoded_as_the_bag_says(tmp_path, context):
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("/old", "std_msgs/msg/String", definition="uint16 data\n", type_hash="RIHS01_another")
        bag.write("/old", "std_msgs/msg/String", b"\x00\x01\x00\x00\x05\x01", 1)
    with open_bag(tmp_path / "bag") as reader:
        assert reader.decode(next(iter(reader))).data == 261


# ---------------------------------------------------------------- order and times

stamps = st.lists(st.tuples(st.integers(0, 2**63 - 2), st.sampled_from("abc")), max_size=60)


@given(stamps, st.sampled_from([200, 1000, 10**6]))
@settings(max_examples=40, deadline=None)
def test_any_times_come_back_sorted_and_stable(tmp_path_factory, times, chunk):
    path = tmp_path_factory.mktemp("bags") / "bag"
    with BagWriter(path, flush_interval_s=None, chunk_bytes=chunk) as bag:
        for number, (stamp, topic) in enumerate(times):
            bag.write(f"/{topic}", "std_msgs/msg/String", text(number), stamp)
    expected = sorted(
        ((stamp, number, topic) for number, (stamp, topic) in enumerate(times)), key=lambda item: item[:2]
    )
    with open_bag(path) as reader:
        assert [(m.stamp_ns, m.data, m.topic) for m in reader] == [(s, text(n), f"/{t}") for s, n, t in expected]
        if times:
            assert (reader.start_ns, reader.end_ns) == (expected[0][0], expected[-1][0])
            middle = expected[len(expected) // 2][0]
            after = [m.stamp_ns for m in reader.messages(start_ns=middle)]
            before = [m.stamp_ns for m in reader.messages(stop_ns=middle)]
            assert before + after == [item[0] for item in expected]


def test_equal_recordings_are_equal_bytes_without_the_wall_clock(tmp_path, context):
    a, b = write_some(tmp_path / "a" / "bag"), write_some(tmp_path / "b" / "bag")
    for name in ("bag_0.mcap", "metadata.yaml"):
        assert (a / name).read_bytes() == (b / name).read_bytes()
    c = write_some(tmp_path / "c" / "bag", flush_interval_s=0.001)
    with open_bag(a) as one, open_bag(c) as other:
        assert one.digest() == other.digest()
    d = write_some(tmp_path / "d" / "bag", count=199)
    with open_bag(a) as one, open_bag(d) as other:
        assert one.digest() != other.digest()


# ---------------------------------------------------------------- refusals


def test_refusals(tmp_path, context):
    path = write_some(tmp_path / "bag", count=1)
    with pytest.raises(InputError, match=r"expected a new path.*overwrite=True"):
        BagWriter(path)
    (path / "thesis.txt").write_text("years of work")
    with pytest.raises(InputError, match="It holds other files"):
        BagWriter(path, overwrite=True)
    assert (path / "thesis.txt").exists()
    (path / "thesis.txt").unlink()
    write_some(path, count=3, overwrite=True)
    with open_bag(path) as reader:
        assert reader.message_count == 7
        with pytest.raises(InputError, match="one of: /chat, /map, /scan"):
            reader.messages(["/scam"])
        with pytest.raises(InputError):
            reader.decode(BagMessage("/chat", "std_msgs/msg/String", 0, b"junk"))
    with BagWriter(tmp_path / "other") as bag:
        bag.write("/a", "std_msgs/msg/String", text(0), 0)
        with pytest.raises(InputError, match="type of topic /a"):
            bag.write("/a", "geometry_msgs/msg/Twist", serialize_message(Twist()), 0)
        with pytest.raises(InputError, match="message type"):
            bag.write("/b", "my_msgs/msg/Unknown", b"", 0)
        for stamp in (-1, 2**63 - 1):
            with pytest.raises(InputError, match="stamp_ns"):
                bag.write("/a", "std_msgs/msg/String", text(0), stamp)
    with pytest.raises(RobotBrainError, match="closed"):
        bag.write("/a", "std_msgs/msg/String", text(0), 0)
    for options in ({"compression": "rar"}, {"flush_interval_s": 0.6}, {"flush_interval_s": 0.0}):
        with pytest.raises(InputError):
            BagWriter(tmp_path / "bad", **options)
        assert not (tmp_path / "bad").exists()
    for nothing in ("absent", "empty"):
        (tmp_path / "empty").mkdir(exist_ok=True)
        with pytest.raises(InputError):
            open_bag(tmp_path / nothing)
        with pytest.raises(InputError):
            recover(tmp_path / nothing)
    (tmp_path / "text.mcap").write_text("this is no bag at all")
    with pytest.raises(InputError, match="an MCAP file"):
        open_bag(tmp_path / "text.mcap")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="a folder that can be made"):
        BagWriter(tmp_path / "file" / "bag")


# ---------------------------------------------------------------- kill -9


CHILD = """
    import sys, time
    import robotbrain.ros
    from rclpy.serialization import serialize_message
    from std_msgs.msg import String
    from robotbrain.ros.bag import BagWriter
    bag = BagWriter(sys.argv[1])
    number = 0
    last = int(sys.argv[2])
    while True:
        bag.write("/chat", "std_msgs/msg/String", serialize_message(String(data=str(number))), time.monotonic_ns())
        number += 1
        print(time.monotonic(), number, flush=True)
        time.sleep(0.004 if number != last else 3600)
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no SIGKILL on this system")
@pytest.mark.parametrize("silent", [False, True])
def test_kill_9_loses_no_more_than_the_last_second(tmp_path, context, silent):
    """``silent``: the writer has stopped writing before it dies, so no later message pushes the last ones out."""
    path = tmp_path / "bag"
    child = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(CHILD), str(path), "150" if silent else "0"],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert child.stdout is not None
    said = []
    for line in child.stdout:
        when, number = line.split()
        said.append((float(when), int(number)))
        if len(said) == 150 if silent else said[-1][0] - said[0][0] > 1.7:
            break
    if silent:
        time.sleep(1.01)
    child.send_signal(signal.SIGKILL)
    killed = time.monotonic()
    said += [(float(when), int(number)) for when, number in (line.split() for line in child.stdout)]
    child.wait()
    owed = max((number for when, number in said if when <= killed - 1.0), default=0)
    with open_bag(path) as reader:
        assert reader.unfinished and "not finished" in reader.notes[0]
        saved = [int(reader.decode(message).data) for message in reader]
    assert saved == list(range(len(saved))) and len(saved) >= owed
    assert owed == 150 if silent else owed > 20, "the test itself: something was written long enough before"
    assert recover(path).messages == len(saved)
    check_whole(path, len(saved))


def check_whole(path, count):
    """A bag that peers open as well."""
    from rosbags.rosbag2 import Reader

    with Reader(path) as reader:
        assert reader.message_count == count == sum(1 for _ in reader.messages())
    assert len(decoded_by_peer(path)) == count
    with open_bag(path) as mine:
        assert (mine.unfinished, mine.notes, mine.message_count) == (False, [], count)
    assert sorted(entry.suffix for entry in path.iterdir()) == [".mcap", ".yaml"]


# ---------------------------------------------------------------- cut files


def test_cut_at_every_byte_of_the_last_chunk_and_behind(tmp_path, context):
    """Whole chunks survive; no cut makes a bag that cannot be opened."""
    with BagWriter(tmp_path / "whole", flush_interval_s=None, chunk_bytes=500) as bag:
        for number in range(40):
            bag.write("/chat", "std_msgs/msg/String", text(number), number)
    data = (tmp_path / "whole" / "whole_0.mcap").read_bytes()
    file = McapIn(tmp_path / "whole" / "whole_0.mcap")
    per_chunk, ends = [], []
    for span in file.spans:
        per_chunk.append(len(file._load(span, set(file.channels), 0, 2**63)))
        ends.append(span.offset + span.length)
    file.close()
    assert len(ends) > 3 and sum(per_chunk) == 40
    path = tmp_path / "cut.mcap"
    last = file.spans[-1].offset
    for cut in [*range(40), *range(last, len(data))]:
        path.write_bytes(data[:cut])
        with open_bag(path) as reader:
            expected = sum(count for count, end in zip(per_chunk, ends, strict=True) if end <= cut)
            assert reader.message_count == expected, cut
            assert sum(1 for _ in reader) == expected
            assert reader.unfinished
    path.write_bytes(data)
    with open_bag(path) as reader:
        assert not reader.unfinished


def test_recovery_is_whole_and_keeps_everything(tmp_path, context):
    path = write_some(tmp_path / "bag", chunk_bytes=3000)
    storage = path / "bag_0.mcap"
    data = storage.read_bytes()
    storage.write_bytes(data[: int(len(data) * 0.6)])
    (path / "metadata.yaml").unlink()
    with open_bag(path) as reader:
        digest, count, qos = reader.digest(), reader.message_count, reader.qos("/scan")
        topics = reader.topics
    done = recover(path)
    assert done.rewritten == ("bag_0.mcap",) and done.messages == count and done.lost_bytes > 0 and done.notes
    check_whole(path, count)
    with open_bag(path) as reader:
        assert (reader.digest(), reader.qos("/scan"), reader.topics) == (digest, qos, topics)
    before = storage.read_bytes()
    assert recover(path).rewritten == () and storage.read_bytes() == before
    (path / "metadata.yaml").unlink()
    assert recover(path).rewritten == ()
    check_whole(path, count)


def test_a_failed_recovery_leaves_the_bag_as_it_was(tmp_path, context, monkeypatch):
    path = write_some(tmp_path / "bag")
    storage = path / "bag_0.mcap"
    cut = storage.read_bytes()[:-100]
    storage.write_bytes(cut)
    monkeypatch.setattr(os, "fsync", raise_full)
    with pytest.raises(OSError, match="No space"):
        recover(path)
    assert storage.read_bytes() == cut
    assert sorted(entry.name for entry in path.iterdir()) == ["bag_0.mcap", "metadata.yaml"]


def test_a_damaged_chunk_is_found_by_its_checksum(tmp_path, context):
    path = write_some(tmp_path / "bag", chunk_bytes=3000)
    storage = path / "bag_0.mcap"
    data = bytearray(storage.read_bytes())
    file = McapIn(storage)
    victim = file.spans[1]
    lost = len(file._load(victim, set(file.channels), 0, 2**63))
    file.close()
    data[victim.offset + victim.length // 2] ^= 0xFF
    storage.write_bytes(data)
    with open_bag(path) as reader, pytest.raises(InputError, match="undamaged chunk"):
        list(reader)
    storage.write_bytes(data[:-50])
    with open_bag(path) as reader:
        assert any("damaged" in note for note in reader.notes)
        assert sum(1 for _ in reader) == reader.message_count == 401 - lost


def test_a_file_that_says_nothing_yet(tmp_path, context):
    """Killed before the first message: the writer has written what the file is."""
    bag = BagWriter(tmp_path / "bag")
    assert (tmp_path / "bag" / "bag_0.mcap").read_bytes().startswith(MAGIC)
    with open_bag(tmp_path / "bag") as reader:
        assert (reader.message_count, reader.topics, list(reader), reader.unfinished) == (0, {}, [], True)
    bag.close()
    with open_bag(tmp_path / "bag") as reader:
        assert (reader.message_count, reader.duration_ns, reader.unfinished) == (0, 0, False)
    bag.close()


# ---------------------------------------------------------------- full disk


def raise_full(*_):
    raise OSError(errno.ENOSPC, "No space left on device")


class SmallDisk:
    """A raw file on a disk with room for so many bytes."""

    def __init__(self, file, room):
        self.file, self.room = file, room

    def write(self, data):
        if not self.room:
            raise_full()
        taken = self.file.write(data[: self.room])
        self.room -= taken
        return taken

    def __getattr__(self, name):
        return getattr(self.file, name)


@pytest.mark.parametrize("interval", [None, 0.005])
def test_a_full_disk_is_said_once_and_what_is_stored_is_kept(tmp_path, context, interval):
    said = []
    bag = BagWriter(tmp_path / "bag", flush_interval_s=interval, chunk_bytes=2000, on_failure=said.append)
    bag._out._file = SmallDisk(bag._out._file, 20_000)
    taken = 0
    for number in range(3000):
        taken += bag.write("/chat", "std_msgs/msg/String", text(number), number)
        if interval and number % 40 == 0:
            bag.flush()  # at the latest: the thread does so too
    bag.flush()
    bag.close()
    assert len(said) == 1 and "the disk is full" in said[0] and bag.failure == said[0] and taken < 3000
    with open_bag(tmp_path / "bag") as reader:
        kept = [message.stamp_ns for message in reader]
        assert reader.unfinished and reader.notes[0].endswith(" 0 bytes are not"), (
            "the half-written chunk was taken back"
        )
    assert kept == list(range(len(kept))) and len(kept) > 100
    assert bag.lost == 3000 - len(kept)
    assert recover(tmp_path / "bag").messages == len(kept)
    check_whole(tmp_path / "bag", len(kept))


def test_a_simulation_goes_on_when_the_disk_is_full(tmp_path, context):
    node = Node("talker")
    publisher = node.create_publisher(String, "chat", 10)
    node.create_timer(0.01, lambda: publisher.publish(String(data="x" * 500)))
    with BagRecorder(tmp_path / "bag", context, flush_interval_s=None, chunk_bytes=2000) as recorder:
        recorder.writer._out._file = SmallDisk(recorder.writer._out._file, 10_000)
        context.run_for(1.0)
    assert publisher.published == 100 and "disk is full" in recorder.failure
    assert [line.severity.name for line in context.log_lines] == ["ERROR"]


def test_a_disk_that_is_full_at_the_very_end(tmp_path, context, monkeypatch):
    said = []
    bag = BagWriter(tmp_path / "bag", flush_interval_s=None, on_failure=said.append)
    bag.write("/chat", "std_msgs/msg/String", text(0), 0)
    bag.flush()
    monkeypatch.setattr("robotbrain.ros.bag.writer.write_text", raise_full)
    bag.close()
    assert "disk is full" in said[0] and bag.lost == 0
    with open_bag(tmp_path / "bag") as reader:
        assert reader.message_count == 1 and not reader.unfinished


def test_memory_is_bounded_when_the_disk_is_slow(tmp_path, context):
    """With the disk blocked, write() waits instead of piling up: the backlog never exceeds its bound by much."""
    bag = BagWriter(tmp_path / "bag", chunk_bytes=1000, max_pending_bytes=5000)
    worst = 0
    for number in range(3000):
        bag.write("/chat", "std_msgs/msg/String", text(number), number)
        worst = max(worst, bag._out.staged_bytes)
    bag.close()
    assert worst <= 5000 + 2000
    with open_bag(tmp_path / "bag") as reader:
        assert reader.message_count == 3000


# ---------------------------------------------------------------- record and replay


def robot_run(start_ns=0):
    context = SimContext(start_ns=start_ns, latency_ns=2_000_000)
    context.log_sink = lambda record: None
    node, other = Node("robot", context=context), Node("mapper", context=context)
    scans = node.create_publisher(LaserScan, "scan", SENSOR)
    speeds = node.create_publisher(Twist, "cmd_vel", 10)
    grid = other.create_publisher(OccupancyGrid, "map", LATCHED)
    grid.publish(OccupancyGrid(data=array("b", [0, 100, -1])))
    node.create_timer(0.03, lambda: scans.publish(LaserScan(ranges=[context.now_ns / 1e9])))
    node.create_timer(0.05, lambda: speeds.publish(Twist()))
    other.create_timer(0.05, lambda: grid.publish(OccupancyGrid()))
    return context


def contents(path):
    with open_bag(path) as reader:
        return list(reader), {topic: reader.qos(topic) for topic in reader.topics}


@pytest.mark.parametrize("start_ns", [0, 1_700_000_000 * 10**9 + 123])
def test_record_replay_record_is_the_identity(tmp_path, start_ns):
    context = robot_run(start_ns)
    with BagRecorder(tmp_path / "first", context):
        context.run_for(1.0)
    first, qos = contents(tmp_path / "first")
    assert len(first) == 33 + 20 + 21 and qos["/scan"] == (SENSOR,) and qos["/map"] == (LATCHED,)
    with open_bag(tmp_path / "first") as reader:
        again = SimContext(start_ns=reader.start_ns)
        with BagRecorder(tmp_path / "second", again):
            running = replay(reader, again)
            again.run_for(2.0)
    assert running.done and running.published == len(first)
    second, again_qos = contents(tmp_path / "second")
    assert second == first
    assert {topic: one[0].durability for topic, one in again_qos.items()} == {
        topic: one[0].durability for topic, one in qos.items()
    }


def test_recording_changes_nothing(tmp_path):
    def decisions(record):
        context = robot_run()
        with DecisionLog(context) as log:
            if record:
                with BagRecorder(tmp_path / "bag", context):
                    context.run_for(1.0)
            else:
                context.run_for(1.0)
        return log.sha256()

    assert decisions(record=True) == decisions(record=False)


def test_replay_options(tmp_path, context):
    source = robot_run()
    with BagRecorder(tmp_path / "bag", source, ["/scan", "/cmd_vel"]):
        source.run_for(1.0)
    heard = []

    def hear(scan):
        heard.append((context.now_ns, scan.ranges[0]))

    Node("listener").create_subscription(LaserScan, "lidar", hear, SENSOR)
    context.run_until(5 * 10**9)
    with open_bag(tmp_path / "bag") as reader:
        assert set(reader.topics) == {"/scan", "/cmd_vel"}
        running = replay(reader, context, rate=2.0, topics=["/scan"], start_s=0.27, remap={"/scan": "/lidar"})
        context.run_for(0.1)
        assert not running.done
        running.cancel()
        context.run_for(1.0)
    # The bag begins at 0.03 s; 0.3 s is published at once, then every 15 ms.
    assert [when for when, _ in heard] == [5 * 10**9 + number * 15_000_000 for number in range(7)]
    assert [round(value, 2) for _, value in heard] == [round(0.3 + 0.03 * number, 2) for number in range(7)]
    assert "/cmd_vel" not in context.topics


def test_replayed_clock(tmp_path, context):
    from rosgraph_msgs.msg import Clock

    start = 1_000 * 10**9
    with BagWriter(tmp_path / "bag") as bag:
        for number in range(3):
            bag.write("/chat", "std_msgs/msg/String", text(number), start + number * 10**9)
        bag.write("/clock", "rosgraph_msgs/msg/Clock", serialize_message(Clock()), start)
        bag.add_topic("/odd", "my_msgs/msg/Odd", definition="int32 x\n", type_hash="")
        bag.write("/odd", "my_msgs/msg/Odd", b"\x00\x01\x00\x00\x01\x00\x00\x00", start)
    times = []
    Node("listener").create_subscription(Clock, "/clock", lambda m: times.append((context.now_ns, m.clock.sec)), 10)
    with open_bag(tmp_path / "bag") as reader:
        running = replay(reader, context, clock_hz=2.0, rate=0.5)
        context.run_for(10.0)
        assert running.skipped == ("/odd",) and "/odd" in context.log_lines[0].message
        with pytest.raises(InputError, match="type of topic /odd"):
            replay(reader, context, topics=["/odd"])
        for bad in ({"rate": 0.0}, {"start_s": -1.0}, {"topics": ["/nothing"]}, {"clock_hz": 0.0}):
            with pytest.raises(InputError):
                replay(reader, context, **bad)
    assert times == [(number * 500_000_000, 1000 + number // 4) for number in range(9)]


def test_latched_messages_from_before_are_recorded(tmp_path, context):
    node = Node("mapper")
    grid = node.create_publisher(OccupancyGrid, "map", LATCHED)
    grid.publish(OccupancyGrid())
    context.run_until(3 * 10**9)
    with BagRecorder(tmp_path / "bag", node, exclude=["/chat"]):
        talker = node.create_publisher(String, "chat", 10)
        talker.publish(String())
        context.run_for(0.1)
    talker.publish(String())
    context.run_for(0.1)
    first, _ = contents(tmp_path / "bag")
    assert [(message.topic, message.stamp_ns) for message in first] == [("/map", 3 * 10**9)]
    with pytest.raises(InputError, match="Write /chat"):
        BagRecorder(tmp_path / "bad", context, ["chat"])
    with pytest.raises(InputError, match="a SimContext"):
        BagRecorder(tmp_path / "bad", object())


def test_replay_in_real_time_does_not_drift(tmp_path, context):
    """A clock of the test's own: every sleep overshoots, and every message is still on its own time or late by one."""
    path = write_some(tmp_path / "bag", count=50)
    clock = [100.0]
    sent = []

    def sleep(seconds):
        clock[0] += seconds + 0.001

    with BagReader(path) as reader:
        count = replay_wall(
            reader, lambda m: sent.append((clock[0], m)), rate=0.5, topics=["/chat"], remap={"/chat": "/talk"},
            now=lambda: clock[0], sleep=sleep,
        )  # fmt: skip
    assert count == 50 and {message.topic for _, message in sent} == {"/talk"}
    for when, message in sent:
        assert 0 <= when - 100.0 - (message.stamp_ns - 5) / 1e9 / 0.5 <= 0.0011


# ---------------------------------------------------------------- command


def command(capsys, *words):
    from argparse import ArgumentParser

    from robotbrain.ros.bag_command import bag_arguments, bag_main

    parser = ArgumentParser()
    bag_arguments(parser)
    code = bag_main(parser.parse_args([str(word) for word in words]))
    captured = capsys.readouterr()
    return code, captured.out + captured.err


def test_command(tmp_path, context, capsys):
    path = write_some(tmp_path / "bag", count=101)
    code, out = command(capsys, "info", path)
    assert code == 0 and "203 messages, 3 topics" in out
    scan = next(line.split() for line in out.splitlines() if line.startswith("/scan"))
    assert scan[1:5] == ["sensor_msgs/msg/LaserScan", "101", "100.00", "0.010"]
    assert "best_effort, volatile, depth 5" in out
    assert command(capsys, "check", path) == (0, f"{path}: 203 messages read and decoded, nothing wrong\n")
    assert command(capsys, "recover", path) == (0, f"{path}: 203 messages; it was whole already\n")

    storage = path / "bag_0.mcap"
    storage.write_bytes(storage.read_bytes()[:-1])
    code, out = command(capsys, "check", path)
    assert code == 1 and "not finished" in out and "bag recover" in out
    code, out = command(capsys, "recover", path)
    assert code == 0 and "written again: bag_0.mcap" in out
    assert command(capsys, "check", path)[0] == 0

    (tmp_path / "empty.mcap").touch()
    code, out = command(capsys, "recover", tmp_path / "empty.mcap")
    assert code == 1 and "no message to save" in out


def test_check_finds_what_cannot_be_decoded(tmp_path, context, capsys):
    with BagWriter(tmp_path / "bag") as bag:
        bag.write("/chat", "std_msgs/msg/String", text(0), 0)
        bag.write("/chat", "std_msgs/msg/String", text(0)[:10], 1)
    code, out = command(capsys, "check", tmp_path / "bag")
    assert code == 1 and "/chat: 1 of 2 not decoded" in out


def test_csv(tmp_path, context, capsys):
    import csv
    import io

    with BagWriter(tmp_path / "bag") as bag:
        for number in range(3):
            scan = LaserScan(ranges=[float(index) for index in range(number)])
            scan.header.frame_id = 'a "frame", with a comma'
            bag.write("/scan", "sensor_msgs/msg/LaserScan", serialize_message(scan), number)
    _, out = command(capsys, "csv", tmp_path / "bag", "/scan")
    found = list(csv.DictReader(io.StringIO(out)))
    assert [row["stamp_ns"] for row in found] == ["0", "1", "2"]
    assert [row["ranges.1"] for row in found] == ["", "", "1.0"]
    assert found[0]["header.frame_id"] == 'a "frame", with a comma'
    target = tmp_path / "scan.csv"
    assert command(capsys, "csv", tmp_path / "bag", "/scan", "-o", target)[0] == 0
    assert target.read_text(encoding="utf-8") == out


def test_imports_are_cheap():
    code = "import sys, robotbrain.ros.bag; print([n for n in ('mcap', 'rosbags', 'ruamel') if n in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
    assert Path(sys.executable).exists()
