"""Publishers, subscriptions and the topics that join them (``rclpy.publisher``, ``rclpy.subscription``)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from robotbrain.ros import cdr
from robotbrain.ros.callback_groups import CallbackGroup
from robotbrain.ros.entity import Entity
from robotbrain.ros.exceptions import InvalidHandle, TypeConflictError
from robotbrain.ros.executors import Work
from robotbrain.ros.messages import typename_of
from robotbrain.ros.qos import DurabilityPolicy, QoSProfile, incompatibility

if TYPE_CHECKING:
    from robotbrain.ros.context import MessageRecord, SimContext
    from robotbrain.ros.node import Node


Packet = tuple[bytes, int]
"""A message on its way: CDR, and its id."""


class Topic:
    """A topic: its type, publishers and subscriptions, in order of creation."""

    def __init__(self, name: str, typename: str) -> None:
        self.name, self.typename = name, typename
        self.publishers: list[Publisher] = []
        self.subscriptions: list[Subscription] = []

    def rematch(self) -> None:
        """Recompute which subscriptions each publisher reaches."""
        for publisher in self.publishers:
            publisher.matched = [
                sub for sub in self.subscriptions if not incompatibility(publisher.qos_profile, sub.qos_profile)
            ]


def join_topic(context: SimContext, name: str, msg_type: Any) -> Topic:
    """Return the topic of that name, made if new.

    Raises:
        TypeConflictError: it exists with another type.
    """
    typename = typename_of(msg_type)
    topic = context.topics.get(name)
    if topic is None:
        topic = context.topics[name] = Topic(name, typename)
    if topic.typename != typename:
        nodes = [publisher.node for publisher in topic.publishers] + [sub.node for sub in topic.subscriptions]
        users = sorted({node.get_fully_qualified_name() for node in nodes})
        raise TypeConflictError(
            f"type of topic {name}",
            given=typename,
            expected=f"{topic.typename}, as {', '.join(users)} use it",
            fix="Use one type per topic, or another topic name.",
        )
    return topic


def leave_topic(context: SimContext, topic: Topic) -> None:
    """Update matches after an end was removed; forget a topic without ends."""
    topic.rematch()
    if not topic.publishers and not topic.subscriptions:
        context.topics.pop(topic.name, None)


def _warn_mismatch(topic: Topic, publisher: Publisher, subscription: Subscription, reason: str) -> None:
    subscription.node.get_logger().warning(
        f"topic {topic.name}: nothing from {publisher.node.get_fully_qualified_name()} reaches "
        f"{subscription.node.get_fully_qualified_name()}, QoS is incompatible ({reason})"
    )


class Publisher:
    """Sends messages of one type on one topic.

    Attributes:
        published: messages published so far.
    """

    def __init__(self, node: Node, msg_type: Any, topic: str, qos: QoSProfile) -> None:
        self.node, self.msg_type, self.qos_profile = node, msg_type, qos
        self.topic = topic
        self.published = 0
        self.destroyed = False
        self.matched: list[Subscription] = []
        self.latched: deque[Packet] = deque(
            maxlen=qos.queue_limit if qos.durability == DurabilityPolicy.TRANSIENT_LOCAL else 0
        )
        self._last_arrival_ns = 0
        self._topic = join_topic(node.context, topic, msg_type)
        self._topic.publishers.append(self)
        self._topic.rematch()
        for sub in self._topic.subscriptions:
            if reason := incompatibility(qos, sub.qos_profile):
                _warn_mismatch(self._topic, self, sub, reason)

    @property
    def topic_name(self) -> str:
        """Absolute topic name."""
        return self.topic

    def publish(self, msg: Any) -> None:
        """Send a message; it is serialized now, and released when the running callback's cost is over.

        Args:
            msg: a message of the publisher's type, or its CDR bytes.

        Raises:
            TypeError: another type.
            InvalidHandle: the publisher was destroyed.
        """
        if isinstance(msg, self.msg_type):
            data = cdr.to_cdr(msg)
        elif isinstance(msg, (bytes, bytearray)):
            data = bytes(msg)
        else:
            hint = " (an instance, not the class)" if isinstance(msg, type) else ""
            given = getattr(msg, "__msgtype__", type(msg).__name__)
            raise TypeError(f"publish on {self.topic}: expected {typename_of(self.msg_type)}{hint}, got {given}")
        if self.destroyed:
            raise InvalidHandle(f"publisher {self.topic} was destroyed and cannot publish")
        self.published += 1
        context = self.node.context
        context.release(self._release, (data, context.new_message_id()))

    def _release(self, packet: Packet) -> None:
        context, topic = self.node.context, self._topic
        data, message_id = packet
        now = context.now_ns
        for tap in context.taps:
            tap(now, topic.name, topic.typename, self.node.get_fully_qualified_name(), data)
        if self.latched.maxlen != 0:
            self.latched.append(packet)
        record = None
        if context.message_taps or context.filters:
            record = context.announce(message_id, "topic", topic.name, topic.typename, self.node, data)
        if not self.matched:
            return
        if record is not None and context.filters:
            self._deliver_filtered(record, data)
            return
        latency = context.transport_ns(topic.name, len(data))
        # A later message never overtakes an earlier one of this publisher, whatever their sizes.
        arrival = self._last_arrival_ns = max(now + latency, self._last_arrival_ns)
        if arrival == now:
            for subscription in self.matched:
                subscription.receive(packet)
        else:
            for subscription in self.matched:
                context.schedule(arrival, subscription.receive, packet)

    def _deliver_filtered(self, record: MessageRecord, data: bytes) -> None:
        context = self.node.context
        for copy, delay in context.filtered(record, data):
            arrival = context.now_ns + context.transport_ns(record.name, len(copy)) + delay
            if not delay:
                arrival = self._last_arrival_ns = max(arrival, self._last_arrival_ns)
            for subscription in self.matched:
                context.schedule(arrival, subscription.receive, (copy, record.id))

    def get_subscription_count(self) -> int:
        """Return how many subscriptions this publisher reaches."""
        return len(self.matched)

    def assert_liveliness(self) -> None:
        """Do nothing: liveliness is stored, not enforced."""

    def destroy(self) -> None:
        """Stop publishing."""
        if not self.destroyed:
            self.destroyed = True
            self._topic.publishers.remove(self)
            leave_topic(self.node.context, self._topic)
            self.node._forget(self)


class Subscription(Entity):
    """Receives messages of one type from one topic.

    Attributes:
        received: messages that arrived.
        dropped: messages that a full queue pushed out before the callback could take them.
    """

    kind = "subscription"

    def __init__(
        self,
        node: Node,
        msg_type: Any,
        topic: str,
        callback: Callable[[Any], Any],
        qos: QoSProfile,
        group: CallbackGroup | None = None,
        raw: bool = False,
    ) -> None:
        super().__init__(node, topic, callback, group)
        self.msg_type, self.qos_profile, self.raw = msg_type, qos, raw
        self.topic = topic
        self.received = 0
        self.dropped = 0
        self._limit = qos.queue_limit
        self._queue: deque[Work] = deque()
        context = node.context
        self._topic = join_topic(context, topic, msg_type)
        self._topic.subscriptions.append(self)
        self._topic.rematch()
        for publisher in self._topic.publishers:
            if reason := incompatibility(publisher.qos_profile, qos):
                _warn_mismatch(self._topic, publisher, self, reason)
            elif qos.durability == DurabilityPolicy.TRANSIENT_LOCAL:
                for packet in publisher.latched:
                    latency = context.transport_ns(topic, len(packet[0]))
                    context.schedule(context.now_ns + latency, self.receive, packet)

    @property
    def topic_name(self) -> str:
        """Absolute topic name."""
        return self.topic

    def receive(self, packet: Packet) -> None:
        """Queue a message that has arrived; a full KEEP_LAST queue loses its oldest."""
        if self.destroyed:
            return
        self.received += 1
        work = Work(self, packet, self.node.context.now_ns, packet[1])
        queue = self._queue
        if self._limit is not None and len(queue) >= self._limit:
            queue.popleft().alive = False
            self.dropped += 1
        queue.append(work)
        self.node._enqueue(work)

    def execute(self, work: Work) -> Any:
        """Decode the message and call back."""
        self._queue.remove(work)
        data = work.payload[0]
        message = data if self.raw else cdr.from_cdr(data, self.msg_type)
        assert self.callback is not None
        return self.callback(message)

    def queue_depth(self) -> int:
        """Return how many messages wait."""
        return len(self._queue)

    def get_publisher_count(self) -> int:
        """Return how many publishers reach this subscription."""
        return sum(self in publisher.matched for publisher in self._topic.publishers)

    def destroy(self) -> None:
        """Stop receiving; waiting messages are discarded."""
        if not self.destroyed:
            for work in self._queue:
                work.alive = False
            self._queue.clear()
            self._topic.subscriptions.remove(self)
            leave_topic(self.node.context, self._topic)
            super().destroy()
