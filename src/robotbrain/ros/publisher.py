"""Publishers (``rclpy.publisher``)."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any

from robotbrain.ros import cdr
from robotbrain.ros.callback_groups import CallbackGroup
from robotbrain.ros.event_handler import EventHandler, PublisherEventCallbacks, adder
from robotbrain.ros.exceptions import InvalidHandle
from robotbrain.ros.matching import join_topic, leave_topic
from robotbrain.ros.messages import typename_of
from robotbrain.ros.packet import Packet
from robotbrain.ros.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, limit_ns
from robotbrain.ros.qos_watch import DeadlineWatch, LeaseWatch

if TYPE_CHECKING:
    from robotbrain.ros.context import MessageRecord
    from robotbrain.ros.node import Node
    from robotbrain.ros.subscription import Subscription


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
            self._deadline = DeadlineWatch(node.context, period, adder(self.handlers.get("deadline")))
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
