"""What happened in a run, in full: every callback, every message and how they set each other off.

A :class:`Recorder` listens to a simulation while it runs; the :class:`Trace` that it gives is plain data. Everything
that is computed afterwards (latencies, the critical path, a Perfetto file) starts from a trace.
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from robotbrain.ros.context import CallbackRecord, MessageRecord

if TYPE_CHECKING:
    from robotbrain.ros.context import SimContext

HEADER = "std_msgs/msg/Header"


@functools.cache
def is_stamped(type_name: str) -> bool:
    """Tell whether messages of this type begin with a header, so that they carry the time of what they describe."""
    from robotbrain.ros.typedefs import struct_def, typenames

    if type_name not in typenames():
        return False
    fields = struct_def(type_name).fields
    return bool(fields) and fields[0][1].message == HEADER


def stamp_of(data: bytes) -> int:
    """Return the header stamp of a stamped message, ns: it follows the four bytes of encapsulation."""
    seconds, nanoseconds = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


@dataclass(frozen=True)
class QueueCounts:
    """How a node's subscriptions to one topic stand.

    Attributes:
        dropped: messages that a full queue pushed out.
        expired: messages that outlived their lifespan.
        limit: how many may wait; None for no limit.
    """

    dropped: int
    expired: int
    limit: int | None


def read_queues(context: SimContext) -> dict[tuple[str, str], QueueCounts]:
    """Return how the subscriptions of a simulation stand, by (node, topic)."""
    found: dict[tuple[str, str], QueueCounts] = {}
    for topic in context.topics.values():
        for subscription in topic.subscriptions:
            place = (subscription.node.get_fully_qualified_name(), topic.name)
            limit = subscription.qos_profile.queue_limit
            expired = int(getattr(subscription, "expired", 0))
            before = found.get(place, QueueCounts(0, 0, 0))
            found[place] = QueueCounts(
                before.dropped + subscription.dropped,
                before.expired + expired,
                None if limit is None or before.limit is None else before.limit + limit,
            )
    return found


@dataclass(frozen=True)
class Trace:
    """A run as plain data.

    Attributes:
        start_ns, end_ns: of the recording.
        callbacks: in the order of their ``id``, which is that of starting; those not over at the end are missing.
        messages: in the order of leaving.
        stamps: header stamp in ns by message id, of the stamped ones.
        capacity: how many of each resource the device has, e.g. ``{"cpu": 6, "gpu": 1}``; empty without a device.
        dropped: messages that a full queue pushed out, by (node, topic).
        expired: (node, topic) of messages that outlived their lifespan before they were taken.
        roles: what part of the brain each node plays, by its fully qualified name.
        title: what was run.
        queue_limits: how many messages may wait in the subscription of (node, topic); without limit: missing.
        periods_ns: of the timers, by (node, name of the callback).
    """

    start_ns: int
    end_ns: int
    callbacks: tuple[CallbackRecord, ...] = field(repr=False)
    messages: tuple[MessageRecord, ...] = field(repr=False)
    stamps: Mapping[int, int] = field(repr=False, default_factory=dict)
    capacity: Mapping[str, int] = field(default_factory=dict)
    dropped: Mapping[tuple[str, str], int] = field(default_factory=dict)
    expired: Mapping[tuple[str, str], int] = field(default_factory=dict)
    roles: Mapping[str, str] = field(default_factory=dict)
    title: str = ""
    queue_limits: Mapping[tuple[str, str], int] = field(repr=False, default_factory=dict)
    periods_ns: Mapping[tuple[str, str], int] = field(repr=False, default_factory=dict)

    @property
    def seconds(self) -> float:
        """Length of the recording, s."""
        return (self.end_ns - self.start_ns) * 1e-9

    @functools.cached_property
    def message_by_id(self) -> Mapping[int, MessageRecord]:
        """Messages by id."""
        return {message.id: message for message in self.messages}

    @functools.cached_property
    def sender(self) -> Mapping[int, CallbackRecord]:
        """The callback that sent a message, by the message's id; messages sent outside callbacks are missing."""
        return {message: callback for callback in self.callbacks for message in callback.published}

    @functools.cached_property
    def takers(self) -> Mapping[int, tuple[CallbackRecord, ...]]:
        """The callbacks that a message set off, by the message's id; those that nobody took are missing."""
        found: dict[int, list[CallbackRecord]] = {}
        for callback in self.callbacks:
            if callback.message:
                found.setdefault(callback.message, []).append(callback)
        return {message: tuple(callbacks) for message, callbacks in found.items()}


class Recorder:
    """Records a simulation from now on.

    Args:
        context: to listen to.
        title: of the trace.

    Memory grows by roughly 0.5 kB a callback: some 15 MB for a minute of the kit's brain.
    """

    def __init__(self, context: SimContext, *, title: str = "") -> None:
        self._context = context
        self._title = title
        self._start_ns = context.now_ns
        self._callbacks: list[CallbackRecord] = []
        self._messages: list[MessageRecord] = []
        self._stamps: dict[int, int] = {}
        self._removers: list[Callable[[], None]] = [
            context.add_callback_tap(self._callbacks.append),
            context.add_message_tap(self._on_message),
        ]

    def _on_message(self, record: MessageRecord, data: bytes) -> None:
        self._messages.append(record)
        if record.kind == "topic" and is_stamped(record.type_name):
            self._stamps[record.id] = stamp_of(data)

    def close(self) -> None:
        """Stop listening; what was recorded stays."""
        while self._removers:
            self._removers.pop()()

    def trace(self, *, roles: Mapping[str, str] | None = None) -> Trace:
        """Return what was recorded so far.

        Args:
            roles: what part of the brain each node plays, by its fully qualified name.
        """
        context = self._context
        now = context.now_ns
        queues = read_queues(context)
        capacity: dict[str, int] = {}
        if context.resources is not None:
            capacity = {n: context.resources.cpu_cores if n == "cpu" else 1 for n in context.resources.names}
        return Trace(
            start_ns=self._start_ns,
            end_ns=now,
            # Without a device a callback's record comes when it starts, so it may not be over yet.
            callbacks=tuple(sorted((c for c in self._callbacks if c.end_ns <= now), key=lambda record: record.id)),
            messages=tuple(self._messages),
            stamps=dict(self._stamps),
            capacity=capacity,
            dropped={place: found.dropped for place, found in queues.items() if found.dropped},
            expired={place: found.expired for place, found in queues.items() if found.expired},
            roles=dict(roles or {}),
            title=self._title,
            queue_limits={place: found.limit for place, found in queues.items() if found.limit is not None},
            periods_ns={
                (node.get_fully_qualified_name(), timer.name): timer.timer_period_ns
                for node in context.nodes
                for timer in node.timers
            },
        )
