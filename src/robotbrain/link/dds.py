"""The kit's nodes on a DDS network, beside genuine ROS 2 programs: topics through Cyclone DDS (an optional extra).

For every topic that a node of the kit publishes there is a DDS writer, for every one that it subscribes to a reader;
CDR goes in and out as it is. Services stay in the process: how a ROS 2 request names its sender depends on the
middleware at the other end, and Fast DDS, the default of ROS 2, does it in a way that Cyclone's Python cannot.
"""

from __future__ import annotations

import copy
import os
import threading
from typing import Any

from robotbrain.errors import InputError, RobotBrainError
from robotbrain.link.bridge import PREFIX, TopicStats, inject, is_link
from robotbrain.link.frames import Message
from robotbrain.link.graph import End, local_graph, signature
from robotbrain.link.idl import dds_topic, idl_class, require_cyclone, ros_topic, ros_type
from robotbrain.link.queues import FrameQueue
from robotbrain.link.realtime import RealtimeContext
from robotbrain.ros.messages import message_class
from robotbrain.ros.node import Node
from robotbrain.ros.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from robotbrain.ros.topics import Publisher, Subscription

REFRESH_S = 0.1
LARGEST_DOMAIN = 101
"""Above this the ports that RTPS derives from the domain collide with others on some systems."""

ENDLESS_NS = 1 << 62
"""A deadline this long is none."""

LOOPBACK = """\
<CycloneDDS><Domain>
<General><Interfaces><NetworkInterface address="127.0.0.1" multicast="false"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>
<Peers><Peer address="localhost"/></Peers></Discovery>
<Compatibility><IgnoreTypeInformation>1.15,1.16</IgnoreTypeInformation></Compatibility>
</Domain></CycloneDDS>
"""
"""Configuration without CYCLONEDDS_URI: this computer only, other participants found by unicast. Type information of
Fast DDS and Cyclone DDS (vendors 1.15 and 1.16) is ignored: ROS 2 makes other hashes of its types; names count."""


class DdsBridge:
    """Readers and writers for what the nodes of ``context`` subscribe to and publish.

    Args:
        context: the kit's graph in wall-clock time.
        domain: DDS domain, ``ROS_DOMAIN_ID`` at the other end.

    The environment variable CYCLONEDDS_URI replaces the configuration, which keeps to this computer.

    Attributes:
        received: statistics of what came, by topic.

    Raises:
        MissingDependencyError: no Cyclone DDS.
        InputError: no such domain.
    """

    def __init__(self, context: RealtimeContext, domain: int = 0) -> None:
        require_cyclone()
        from cyclonedds.core import WaitSet
        from cyclonedds.domain import Domain, DomainParticipant

        if isinstance(domain, bool) or not isinstance(domain, int) or not 0 <= domain <= LARGEST_DOMAIN:
            raise InputError(
                "DDS domain", given=domain, expected=f"0 to {LARGEST_DOMAIN}", fix="As ROS_DOMAIN_ID of the robot."
            )
        self.context = context
        self.received: dict[str, TopicStats] = {}
        # Kept alive: a domain ends with its object.
        self._domain = None if os.environ.get("CYCLONEDDS_URI") else Domain(domain, LOOPBACK)
        self._participant = DomainParticipant(domain)
        self._waitset = WaitSet(self._participant)
        self.node = Node(f"{PREFIX}_dds", context=context, use_global_arguments=False, start_parameter_services=False)
        self._signature: tuple[int, ...] = ()
        self._writers: dict[str, tuple[End, Any]] = {}
        self._readers: dict[str, tuple[End, Any, Publisher]] = {}
        self._heard: dict[str, Subscription] = {}
        self._refused: set[str] = set()
        self._incoming = FrameQueue()
        self._posted = threading.Lock()
        self._access = threading.Lock()  # of self._readers, which the reading thread walks through
        self._closed = False
        self._remove_tap = context.add_tap(self._on_publication)
        self._publications: Any = None
        self.refresh()
        self.node.create_timer(REFRESH_S, self.refresh)
        self._thread = threading.Thread(target=self._read, name="dds-read", daemon=True)
        self._thread.start()

    # ------------------------------------------------------------ the graph

    def refresh(self) -> None:
        """Make readers and writers of new topics and remove those that nobody needs."""
        now = signature(self.context)
        if now != self._signature:
            graph = local_graph(self.context, is_link)
            for name in [n for n, (end, _) in self._writers.items() if graph.publishers.get(n) != end]:
                del self._writers[name]
            for name in [n for n, (end, *_) in self._readers.items() if graph.subscriptions.get(n) != end]:
                with self._access:
                    _, reader, publisher = self._readers.pop(name)
                self._waitset.detach(reader[1])
                publisher.destroy()
            for name, end in graph.publishers.items():
                if name not in self._writers:
                    self._try(name, end, self._make_writer)
            for name, end in graph.subscriptions.items():
                if name not in self._readers:
                    self._try(name, end, self._make_reader)
        self._note_listeners()
        self._signature = signature(self.context)

    def _try(self, name: str, end: End, make: Any) -> None:
        try:
            make(name, end)
        except RobotBrainError as error:
            if name not in self._refused:
                self._refused.add(name)
                self.node.get_logger().warning(f"{name} is not on DDS: {error}")

    def _topic(self, name: str, end: End) -> Any:
        from cyclonedds.topic import Topic

        return Topic(self._participant, dds_topic(name), idl_class(end.type_name))

    def _make_writer(self, name: str, end: End) -> None:
        from cyclonedds.pub import DataWriter

        qos = dds_qos(end.qos)
        writer = DataWriter(self._participant, self._topic(name, end), qos=qos)
        self._writers[name] = (end, writer)
        if end.qos.durability == DurabilityPolicy.TRANSIENT_LOCAL:
            for publisher in self.context.topics[name].publishers:
                for packet in () if is_link(publisher.node) else publisher.latched:
                    self._write(writer, packet[0])

    def _make_reader(self, name: str, end: End) -> None:
        from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState
        from cyclonedds.sub import DataReader

        reader = DataReader(self._participant, self._topic(name, end), qos=dds_qos(end.qos))
        condition = ReadCondition(reader, SampleState.Any | ViewState.Any | InstanceState.Any)
        # Within this process everything arrives; a subscription that asks for more makes another reader soon.
        offered = copy.copy(end.qos)
        offered.reliability = ReliabilityPolicy.RELIABLE
        publisher = self.node.create_publisher(message_class(end.type_name), name, offered)
        self._incoming.set_depth(name, end.qos.queue_limit)
        with self._access:
            self._readers[name] = (end, (reader, condition), publisher)
        self._waitset.attach(condition)

    def _note_listeners(self) -> None:
        """Let the graph show that somebody out there listens."""
        for name, (end, writer) in self._writers.items():
            listened = bool(writer.get_matched_subscriptions())
            if listened and name not in self._heard:
                self._heard[name] = self.node.create_subscription(
                    message_class(end.type_name), name, _ignore, end.qos, raw=True
                )
            elif not listened and name in self._heard:
                self._heard.pop(name).destroy()
        for name in [n for n in self._heard if n not in self._writers]:
            self._heard.pop(name).destroy()

    def offered(self) -> dict[str, list[str]]:
        """Return the types of the topics that other participants publish."""
        from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication

        if self._publications is None:
            self._publications = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
        found: dict[str, list[str]] = {}
        for sample in self._publications.read(N=1000):
            name = ros_topic(sample.topic_name)
            if name is not None and sample.participant_key != self._participant.guid:
                found.setdefault(name, []).append(ros_type(sample.type_name))
        return found

    # ------------------------------------------------------------ out

    def _on_publication(self, _ns: int, topic: str, _type: str, node: str, data: bytes) -> None:
        known = self._writers.get(topic)
        if known is None and not is_link(node):
            self.refresh()  # a publisher's first message must not wait for the next look at the graph
            known = self._writers.get(topic)
        if known is not None and not is_link(node):
            self._write(known[1], data)

    def _write(self, writer: Any, data: bytes) -> None:
        from cyclonedds._clayer import ddspy_write

        # Serialized data come in units of four bytes.
        status = ddspy_write(writer._ref, data + bytes(-len(data) % 4))
        if status < 0:
            self.node.get_logger().warning(f"DDS: a message was not sent (code {status})", throttle_duration_sec=1.0)

    # ------------------------------------------------------------ in

    def _read(self) -> None:
        from cyclonedds.util import duration

        while not self._closed:
            self._waitset.wait(timeout=duration(milliseconds=100))
            with self._access:
                readers = list(self._readers.items())
            for name, (end, (reader, _), _) in readers:
                self._take(name, end, reader)
            if len(self._incoming) and self._posted.acquire(blocking=False):
                self.context.post(self._drain)

    def _take(self, name: str, end: End, reader: Any) -> None:
        from cyclonedds._clayer import ddspy_take
        from cyclonedds.core import InstanceState, SampleState, ViewState

        samples = ddspy_take(reader._ref, SampleState.Any | ViewState.Any | InstanceState.Any, 100)
        for data, info in samples if isinstance(samples, list) else ():
            if info.valid_data:
                self._incoming.put(Message(name, end.type_name, info.source_timestamp, bytes(data)))

    def _drain(self, _: Any) -> None:
        self._posted.release()
        while (frame := self._incoming.get()) is not None:
            if isinstance(frame, Message) and frame.topic in self._readers:
                self.received.setdefault(frame.topic, TopicStats()).add(self.context.now_ns - frame.stamp_ns)
                inject(self._readers[frame.topic][2], frame.data)

    def close(self) -> None:
        """Leave the network."""
        if self._closed:
            return
        self._closed = True
        self._thread.join(2.0)
        self._remove_tap()
        self.node.destroy_node()
        with self._access:
            self._readers.clear()
        self._writers.clear()


def _ignore(_: bytes) -> None:
    pass


def dds_qos(qos: QoSProfile) -> Any:
    """Return a QoS profile as that of Cyclone DDS, in the old encoding (XCDR1) that ROS 2 uses."""
    from cyclonedds.core import Policy, Qos
    from cyclonedds.util import duration

    reliable = qos.reliability != ReliabilityPolicy.BEST_EFFORT
    latched = qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
    policies = [
        # Should the other end not keep up, a writer gives up soon: this thread runs the whole graph.
        Policy.Reliability.Reliable(duration(milliseconds=20)) if reliable else Policy.Reliability.BestEffort,
        Policy.History.KeepAll if qos.queue_limit is None else Policy.History.KeepLast(qos.queue_limit),
        Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
        Policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False),
        # A process must not hear its own messages twice.
        Policy.IgnoreLocal.Participant,
    ]
    if 0 < qos.deadline.nanoseconds < ENDLESS_NS:
        policies.append(Policy.Deadline(duration(nanoseconds=qos.deadline.nanoseconds)))
    return Qos(*policies)
