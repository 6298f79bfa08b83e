"""Subscriptions (``rclpy.subscription``)."""

from __future__ import annotations

import inspect
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from robotbrain.errors import InputError
from robotbrain.ros import cdr
from robotbrain.ros.callback_groups import CallbackGroup
from robotbrain.ros.entity import Entity
from robotbrain.ros.event_handler import EventHandler, SubscriptionEventCallbacks, adder
from robotbrain.ros.executors import Work
from robotbrain.ros.matching import join_topic, leave_topic
from robotbrain.ros.packet import Packet
from robotbrain.ros.qos import DurabilityPolicy, QoSProfile, limit_ns
from robotbrain.ros.qos_watch import DeadlineWatch

if TYPE_CHECKING:
    from robotbrain.ros.node import Node


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
            self._deadline = DeadlineWatch(context, period, adder(self.handlers.get("deadline")))
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


def takes_info(topic: str, callback: Any) -> bool:
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
