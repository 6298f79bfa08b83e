"""Messages that belong together: a subset of ROS 2's ``message_filters`` for Python, under the same names.

``Subscriber``, ``Cache``, ``TimeSynchronizer`` and ``ApproximateTimeSynchronizer`` take the same arguments and call
back with the same sets of messages as the genuine package, so that a student's file carries over.
"""

# ruff: noqa: N802 - the names are those of message_filters

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

from robotbrain.errors import InputError
from robotbrain.ros.conversions import time_ns
from robotbrain.ros.time import Duration, Time, seconds_to_ns

__all__ = ["ApproximateTimeSynchronizer", "Cache", "SimpleFilter", "Subscriber", "TimeSynchronizer"]


class SimpleFilter:
    """Something that passes messages on to those who registered."""

    def __init__(self) -> None:
        self.callbacks: dict[int, tuple[Callable[..., Any], tuple[Any, ...]]] = {}

    def registerCallback(self, cb: Callable[..., Any], *args: Any) -> int:
        """Call ``cb(*messages, *args)`` for each output; return a number for the connection."""
        number = len(self.callbacks)
        self.callbacks[number] = (cb, args)
        return number

    def signalMessage(self, *msg: Any) -> None:
        """Pass messages on."""
        for callback, args in list(self.callbacks.values()):
            callback(*msg, *args)


class Subscriber(SimpleFilter):
    """A subscription as a source of messages.

    Args:
        node: that subscribes.
        msg_type, topic: as for ``create_subscription``.
        qos_profile: likewise; a depth of 10 if omitted.
        kwargs: likewise, e.g. ``callback_group``.
    """

    def __init__(self, node: Any, msg_type: Any, topic: str, qos_profile: Any = 10, **kwargs: Any) -> None:
        super().__init__()
        self.node, self.topic = node, topic
        self.sub = node.create_subscription(msg_type, topic, self.callback, qos_profile, **kwargs)

    def callback(self, msg: Any) -> None:
        """Pass a message on."""
        self.signalMessage(msg)

    def getTopic(self) -> str:
        """Return the topic as it was given."""
        return self.topic

    def __getattr__(self, key: str) -> Any:
        if key == "sub":
            raise AttributeError(key)
        return getattr(self.sub, key)


def _stamp_ns(msg: Any, owner: str, headerless: Callable[[], int] | None) -> int | None:
    stamp = getattr(getattr(msg, "header", None), "stamp", None)
    if stamp is not None:
        return time_ns(stamp)
    if headerless is not None:
        return headerless()
    # The genuine package warns each time and drops the message; so does this one.
    from robotbrain.ros.context import active_context, peek_default_context
    from robotbrain.ros.logging import get_logger

    if active_context() is not None or peek_default_context() is not None:
        get_logger(f"message_filters_{owner}").warning(
            f"{type(msg).__name__} has no header and is dropped; allow_headerless=True takes the time of its arrival"
        )
    return None


def _now_ns() -> int:
    from robotbrain.ros.clock import ROSClock
    from robotbrain.ros.context import active_context

    return int(ROSClock(context=active_context()).now().nanoseconds)


class Cache(SimpleFilter):
    """The last messages, to be looked up by time.

    Args:
        f: filter whose output is cached.
        cache_size: messages kept.
        allow_headerless: take messages without a header under the time of their arrival.
    """

    def __init__(self, f: SimpleFilter, cache_size: int = 1, allow_headerless: bool = False) -> None:
        super().__init__()
        self.cache_size, self.allow_headerless = cache_size, allow_headerless
        self.cache_msgs: list[Any] = []
        self.cache_times: list[Time] = []
        self.connectInput(f)

    def connectInput(self, f: SimpleFilter) -> None:
        """Take messages from ``f``, too."""
        self.incoming_connection = f.registerCallback(self.add)

    def add(self, msg: Any) -> None:
        """Store a message and pass it on."""
        stamp = _stamp_ns(msg, "cache", _now_ns if self.allow_headerless else None)
        if stamp is None:
            return
        self.cache_msgs.append(msg)
        self.cache_times.append(_ros_time(stamp))
        if len(self.cache_msgs) > self.cache_size:
            del self.cache_msgs[0], self.cache_times[0]
        self.signalMessage(msg)

    def getInterval(self, from_stamp: Time, to_stamp: Time) -> list[Any]:
        """Return the messages of a span of time, both ends included."""
        first, last = from_stamp.nanoseconds, to_stamp.nanoseconds
        return [msg for msg, ns in self._pairs() if first <= ns <= last]

    def getElemAfterTime(self, stamp: Time) -> Any:
        """Return the first message at or after a time, or None."""
        return next((msg for msg, ns in self._pairs() if ns >= stamp.nanoseconds), None)

    def getElemBeforeTime(self, stamp: Time) -> Any:
        """Return the last message at or before a time, or None."""
        return next((msg for msg, ns in reversed(self._pairs()) if ns <= stamp.nanoseconds), None)

    def getLastestTime(self) -> Time | None:
        """Return the time of the newest message, or None (the name is spelt as in the genuine package)."""
        return self.cache_times[-1] if self.cache_times else None

    def getOldestTime(self) -> Time | None:
        """Return the time of the oldest message, or None."""
        return self.cache_times[0] if self.cache_times else None

    def getLast(self) -> Any:
        """Return the newest message, or None."""
        newest = self.getLastestTime()
        return None if newest is None else self.getElemAfterTime(newest)

    def _pairs(self) -> list[tuple[Any, int]]:
        return [(msg, time.nanoseconds) for msg, time in zip(self.cache_msgs, self.cache_times, strict=True)]


def _ros_time(ns: int) -> Time:
    from robotbrain.ros.time import ClockType

    return Time(nanoseconds=ns, clock_type=ClockType.ROS_TIME)


class TimeSynchronizer(SimpleFilter):
    """Passes on sets of messages, one from each filter, that carry the very same stamp.

    Args:
        fs: filters.
        queue_size: messages of each that wait for the others.

    Raises:
        InputError: no filters, or a queue_size below 1.
    """

    def __init__(self, fs: Sequence[SimpleFilter], queue_size: int) -> None:
        super().__init__()
        if not fs or queue_size < 1:
            raise InputError(
                "synchronizer",
                given={"filters": len(fs), "queue_size": queue_size},
                expected="at least one filter and a queue_size >= 1",
                fix="TimeSynchronizer([Subscriber(...), Subscriber(...)], queue_size=10).",
            )
        self.queue_size = queue_size
        self.connectInput(fs)

    def connectInput(self, fs: Sequence[SimpleFilter]) -> None:
        """Take messages from these filters."""
        self.queues: list[dict[int, Any]] = [{} for _ in fs]
        self.input_connections = [
            f.registerCallback(self.add, queue, place)
            for place, (f, queue) in enumerate(zip(fs, self.queues, strict=True))
        ]

    def _store(self, queue: dict[int, Any], stamp: int, msg: Any) -> None:
        queue[stamp] = msg
        while len(queue) > self.queue_size:
            del queue[min(queue)]

    def _pass_on(self, stamps: Sequence[int]) -> None:
        self.signalMessage(*(queue[stamp] for queue, stamp in zip(self.queues, stamps, strict=True)))
        for queue, stamp in zip(self.queues, stamps, strict=True):
            del queue[stamp]

    def add(self, msg: Any, my_queue: dict[int, Any], my_queue_index: int | None = None) -> None:
        """Take a message; pass on every set that is complete now."""
        stamp = _stamp_ns(msg, "exact", None)
        if stamp is None:
            return
        self._store(my_queue, stamp, msg)
        for common in sorted(set.intersection(*(set(queue) for queue in self.queues))):
            self._pass_on([common] * len(self.queues))


class ApproximateTimeSynchronizer(TimeSynchronizer):
    """Passes on sets of messages whose stamps lie less than ``slop`` apart.

    Each message that arrives is matched at once with those that wait, the nearest in time first. The set is then
    complete: what would have fitted even better may not have arrived yet. (The C++ package's ApproximateTime policy
    waits until it can prove that no better set is possible; this is the Python one's rule.)

    Args:
        fs, queue_size: as for TimeSynchronizer.
        slop: s.
        allow_headerless: take messages without a header under the time of their arrival.
    """

    def __init__(
        self, fs: Sequence[SimpleFilter], queue_size: int, slop: float, allow_headerless: bool = False
    ) -> None:
        super().__init__(fs, queue_size)
        self.slop = Duration(nanoseconds=seconds_to_ns(slop))
        self.allow_headerless = allow_headerless

    def add(self, msg: Any, my_queue: dict[int, Any], my_queue_index: int | None = None) -> None:
        """Take a message; pass on the best set that it completes, if any."""
        stamp = _stamp_ns(msg, "approx", _now_ns if self.allow_headerless else None)
        if stamp is None:
            return
        self._store(my_queue, stamp, msg)
        if stamp not in my_queue:
            return  # older than all that wait, and the queue is full
        slop = self.slop.nanoseconds
        candidates = [
            [stamp] if queue is my_queue else sorted((s for s in queue if abs(s - stamp) <= slop), key=_distance(stamp))
            for queue in self.queues
        ]
        for stamps in itertools.product(*candidates):
            if max(stamps) - min(stamps) < slop:
                self._pass_on(stamps)
                return


def _distance(stamp: int) -> Callable[[int], int]:
    return lambda other: abs(other - stamp)
