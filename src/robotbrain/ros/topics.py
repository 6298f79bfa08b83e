"""Publishers and subscriptions (``rclpy.publisher``, ``rclpy.subscription``)."""

from __future__ import annotations

import inspect
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

from robotbrain.errors import InputError
from robotbrain.ros import cdr
from robotbrain.ros.callback_groups import CallbackGroup
from robotbrain.ros.entity import Entity
from robotbrain.ros.event_handler import EventHandler, PublisherEventCallbacks, SubscriptionEventCallbacks
from robotbrain.ros.exceptions import InvalidHandle
from robotbrain.ros.executors import Work
from robotbrain.ros.matching import join_topic, leave_topic
from robotbrain.ros.messages import typename_of
from robotbrain.ros.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, limit_ns
from robotbrain.ros.qos_watch import DeadlineWatch, LeaseWatch

if TYPE_CHECKING:
    from robotbrain.ros.context import MessageRecord
    from robotbrain.ros.node import Node


class Packet(NamedTuple):
    """A message on its way.

    Attributes:
        data: CDR.
        id: of the message, see :class:`~robotbrain.ros.context.MessageRecord`.
        source_ns: when it left; 0 before.
        expires_ns: when its lifespan ends; 0: never.
        number: counted from 1 by its publisher.
    """

    data: bytes
    id: int
    source_ns: int = 0
    expires_ns: int = 0
    number: int = 0


class Publisher:
    """Sends messages of one type on one topic.

    Attributes:
        published: messages published so far.
        matched: the subscriptions it reaches.
        latched: what a late subscriber gets, with TRANSIENT_LOCAL durability.
    """

    def __init__(
        self,
        node: Node,
        msg_type: Any,
        topic: str,
        qos: QoSProfile,
        group: CallbackGroup | None = None,
        event_callbacks: PublisherEventCallbacks | None = None,
    ) -> None:
        self.node, self.msg_type, self.qos_profile = node, msg_type, qos
        self.topic = topic
        self.published = 0
        self.destroyed = False
        self.matched: list[Subscription] = []
        self.latched: deque[Packet] = deque(
            maxlen=qos.queue_limit if qos.durability == DurabilityPolicy.TRANSIENT_LOCAL else 0
        )
        self.event_callbacks = event_callbacks
        self._last_arrival_ns = 0
        self._topic = join_topic(node.context, topic, msg_type)
        self.handlers: dict[str, EventHandler] = (
            event_callbacks.handlers(node, topic, group) if event_callbacks is not None else {}
        )
        self._lifespan_ns = limit_ns(qos.lifespan) or 0
        self._deadline: DeadlineWatch | None = None
        if (period := limit_ns(qos.deadline)) is not None:
            self._deadline = DeadlineWatch(node.context, period, _adder(self.handlers.get("deadline")))
        self.lease: LeaseWatch | None = None
        lease = limit_ns(qos.liveliness_lease_duration)
        if qos.liveliness == LivelinessPolicy.MANUAL_BY_TOPIC and lease is not None:
            self.lease = LeaseWatch(node.context, lease, self._on_liveliness)
        self._watched = self._deadline is not None or self.lease is not None
        self._topic.add_publisher(self)

    @property
    def topic_name(self) -> str:
        """Absolute topic name."""
        return self.topic

    @property
    def event_handlers(self) -> list[EventHandler]:
        """What calls back on events."""
        return list(self.handlers.values())

    @property
    def logger_name(self) -> str:
        """Name of the node's logger."""
        return self.node.get_logger().name

    @property
    def deadline_missed(self) -> int:
        """Deadline periods in which nothing was published."""
        return self._deadline.missed if self._deadline is not None else 0

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
        running = context.running
        packet = (data, context.new_message_id())
        if running is not None:
            running.outbox.append((self._release, packet))
        else:
            self._send(packet, outside=True)

    def _release(self, packet: tuple[bytes, int]) -> None:
        self._send(packet, outside=False)

    def _send(self, packet: tuple[bytes, int], outside: bool) -> None:
        context, topic = self.node.context, self._topic
        data, message_id = packet
        now = context.now_ns
        for tap in context.taps:
            tap(now, topic.name, topic.typename, self.node.get_fully_qualified_name(), data)
        if self._watched:
            self._show_life()
        lifespan = self._lifespan_ns
        whole = Packet(data, message_id, now, now + lifespan if lifespan else 0, self.published)
        if self.latched.maxlen != 0:
            self.latched.append(whole)
        record = None
        if context.message_taps or context.filters:
            record = context.announce(message_id, "topic", topic.name, topic.typename, self.node, data)
        if not self.matched:
            return
        if record is not None and context.filters:
            self._deliver_filtered(record, whole)
            return
        latency = context.transport_ns(topic.name, len(data))
        # A later message never overtakes an earlier one of this publisher, whatever their sizes.
        arrival = self._last_arrival_ns = max(now + latency, self._last_arrival_ns)
        if arrival != now:
            for subscription in self.matched:
                context.schedule(arrival, subscription.receive, whole)
        elif outside:
            # What is published between two spins arrives together, before any callback starts.
            context.arrive_together([(subscription.receive, whole) for subscription in self.matched])
        else:
            for subscription in self.matched:
                subscription.receive(whole)

    def _deliver_filtered(self, record: MessageRecord, packet: Packet) -> None:
        context = self.node.context
        copies = context.filtered(record, packet.data)
        for copy, delay in copies:
            arrival = context.now_ns + context.transport_ns(record.name, len(copy)) + delay
            if not delay:
                arrival = self._last_arrival_ns = max(arrival, self._last_arrival_ns)
            for subscription in self.matched:
                context.schedule(arrival, subscription.receive, packet._replace(data=copy))
        if not copies:
            for subscription in self.matched:
                subscription.lose()

    def _show_life(self) -> None:
        if self._deadline is not None:
            self._deadline.touch()
        if self.lease is not None:
            self.lease.touch()

    def _on_liveliness(self, alive: bool) -> None:
        changes = {"alive_count": 1 if alive else -1}
        if not alive or (self.lease is not None and self.lease.was_alive):
            changes["not_alive_count"] = -changes["alive_count"]
        for subscription in self.matched:
            if (handler := subscription.handlers.get("liveliness")) is not None:
                handler.add(**changes)
        if not alive and (lost := self.handlers.get("liveliness")) is not None:
            lost.add()

    def get_subscription_count(self) -> int:
        """Return how many subscriptions this publisher reaches."""
        return len(self.matched)

    def assert_liveliness(self) -> None:
        """Show that the publisher is alive, with MANUAL_BY_TOPIC liveliness; publishing does so too."""
        if self.lease is not None and not self.destroyed:
            self.lease.touch()

    def wait_for_all_acked(self, timeout: Any = None) -> bool:
        """Return True: what was released has arrived or will."""
        return True

    def destroy(self) -> None:
        """Stop publishing."""
        if not self.destroyed:
            self.destroyed = True
            self._topic.remove_publisher(self)
            leave_topic(self.node.context, self._topic)
            for watch in (self._deadline, self.lease):
                if watch is not None:
                    watch.close()
            for handler in self.handlers.values():
                handler.destroyed = True
            self.node._forget(self)

    def __enter__(self) -> Publisher:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.destroy()


class Subscription(Entity):
    """Receives messages of one type from one topic.

    The callback takes the message, or the message and its info (a dict with ``source_timestamp`` and
    ``received_timestamp`` in ns, ``publication_sequence_number``, ``reception_sequence_number`` and ``publisher_gid``).

    Attributes:
        received: messages that arrived.
        dropped: messages that a full queue pushed out before the callback could take them.
        expired: messages whose lifespan ended before the callback could take them.
        lost: messages that a filter dropped on the way.
    """

    kind = "subscription"

    def __init__(
        self,
        node: Node,
        msg_type: Any,
        topic: str,
        callback: Callable[..., Any],
        qos: QoSProfile,
        group: CallbackGroup | None = None,
        raw: bool = False,
        event_callbacks: SubscriptionEventCallbacks | None = None,
    ) -> None:
        super().__init__(node, topic, callback, group)
        self.msg_type, self.qos_profile, self.raw = msg_type, qos, raw
        self.topic = topic
        self.received = self.dropped = self.expired = self.lost = 0
        self.event_callbacks = event_callbacks
        self._with_info = takes_info(topic, callback)
        self._limit = qos.queue_limit
        self._queue: deque[Work] = deque()
        context = node.context
        self._topic = join_topic(context, topic, msg_type)
        self.handlers: dict[str, EventHandler] = (
            event_callbacks.handlers(node, topic, group) if event_callbacks is not None else {}
        )
        self._deadline: DeadlineWatch | None = None
        if (period := limit_ns(qos.deadline)) is not None:
            self._deadline = DeadlineWatch(context, period, _adder(self.handlers.get("deadline")))
        self._topic.add_subscription(self)
        if qos.durability == DurabilityPolicy.TRANSIENT_LOCAL:
            self._catch_up()

    def _catch_up(self) -> None:
        """Get what the publishers keep for late subscribers."""
        context = self.node.context
        arrivals: dict[int, list[Packet]] = {}
        for publisher in self._topic.publishers:
            if self in publisher.matched:
                for packet in publisher.latched:
                    if not packet.expires_ns or packet.expires_ns > context.now_ns:
                        latency = context.transport_ns(self.topic, len(packet.data))
                        arrivals.setdefault(context.now_ns + latency, []).append(packet)
        for time_ns, packets in arrivals.items():
            context.arrive_together([(self.receive, packet) for packet in packets], time_ns)

    @property
    def topic_name(self) -> str:
        """Absolute topic name."""
        return self.topic

    @property
    def event_handlers(self) -> list[EventHandler]:
        """What calls back on events."""
        return list(self.handlers.values())

    @property
    def logger_name(self) -> str:
        """Name of the node's logger."""
        return self.node.get_logger().name

    @property
    def deadline_missed(self) -> int:
        """Deadline periods in which nothing arrived."""
        return self._deadline.missed if self._deadline is not None else 0

    def receive(self, packet: Packet) -> None:
        """Queue a message that has arrived; a full KEEP_LAST queue loses its oldest."""
        if self.destroyed:
            return
        node = self.node
        now = node.context.now_ns
        if self._deadline is not None:
            self._deadline.touch()
        expires = packet[3]
        if expires and now >= expires:
            self.expired += 1
            return
        self.received += 1
        work = Work(self, packet, now, packet[1])
        queue = self._queue
        if self._limit is not None and len(queue) >= self._limit:
            queue.popleft().alive = False
            self.dropped += 1
        queue.append(work)
        if expires:
            node.context.schedule(expires, self._expire, work)
        node._enqueue(work)

    def _expire(self, work: Work) -> None:
        if work.alive and work in self._queue:
            work.alive = False
            self._queue.remove(work)
            self.expired += 1

    def lose(self) -> None:
        """Note that a message was lost on the way."""
        self.lost += 1
        if (handler := self.handlers.get("message_lost")) is not None:
            handler.add()

    def execute(self, work: Work) -> Any:
        """Decode the message and call back."""
        queue = self._queue
        if queue[0] is work:
            queue.popleft()
        else:
            queue.remove(work)
        data = work.payload[0]
        message = data if self.raw else cdr.from_cdr(data, self.msg_type)
        assert self.callback is not None
        if self._with_info:
            return self.callback(message, self._info(work))
        return self.callback(message)

    def _info(self, work: Work) -> dict[str, Any]:
        packet = work.payload
        return {
            "source_timestamp": packet.source_ns,
            "received_timestamp": work.ready_ns,
            "publication_sequence_number": packet.number,
            "reception_sequence_number": None,
            "publisher_gid": None,
        }

    def queue_depth(self) -> int:
        """Return how many messages wait."""
        return len(self._queue)

    def get_publisher_count(self) -> int:
        """Return how many publishers reach this subscription."""
        return sum(self in publisher.matched for publisher in self._topic.publishers)

    def destroy(self) -> None:
        """Stop receiving; waiting messages are discarded."""
        if not self.destroyed:
            super().destroy()
            for work in self._queue:
                work.alive = False
            self._queue.clear()
            self._topic.remove_subscription(self)
            leave_topic(self.node.context, self._topic)
            if self._deadline is not None:
                self._deadline.close()
            for handler in self.handlers.values():
                handler.destroyed = True


def _adder(handler: EventHandler | None) -> Callable[[], None] | None:
    return handler.add if handler is not None else None


def takes_info(topic: str, callback: Callable[..., Any]) -> bool:
    """Tell whether a subscription's callback wants ``(message, info)`` rather than ``(message)``.

    Raises:
        InputError: it can be called with neither.
    """
    if not callable(callback):
        return False  # Entity says what is wrong
    try:
        signature = inspect.signature(callback)
    except (TypeError, ValueError):  # some built-in functions have none
        return False
    for count in (1, 2):
        try:
            signature.bind(*[None] * count)
        except TypeError:
            continue
        return count == 2
    raise InputError(
        f"callback of {topic}",
        given=f"{getattr(callback, '__qualname__', callback)}{signature}",
        expected="one argument, the message, or two: message and info",
        fix="Write def on_message(self, message).",
    )
