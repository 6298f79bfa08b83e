"""Queues of subscriptions over time: how many messages waited, and how many were pushed out."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from robotbrain.monitoring.trace import Trace
    from robotbrain.ros.context import MessageRecord

Place = tuple[str, str]
"""A queue: (fully qualified node, topic)."""


@dataclass(frozen=True)
class QueueTimeline:
    """How many messages waited in one queue; those that were taken at once never waited.

    Attributes:
        node, topic: which queue.
        limit: how many may wait, None for no limit.
        arrived: messages that came, as far as the trace tells.
        dropped, expired: messages that left without meeting their callback.
        time_ns: (E,) int64, when the depth changed; begins with the recording.
        depth: (E,) int64, from this time to the next.
        end_ns: of the recording.
        drop_ns: int64, when a message was pushed out.
    """

    node: str
    topic: str
    limit: int | None
    arrived: int
    dropped: int
    expired: int
    time_ns: NDArray[np.int64]
    depth: NDArray[np.int64]
    end_ns: int
    drop_ns: NDArray[np.int64]

    @property
    def max_depth(self) -> int:
        """The most messages that waited at a time."""
        return int(self.depth.max())

    @property
    def mean_depth(self) -> float:
        """Messages that waited, averaged over time."""
        spans = np.diff(self.time_ns, append=self.end_ns)
        total = int(spans.sum())
        return float(self.depth @ spans) / total if total else 0.0


def depth_over_time(
    waits: list[tuple[int, int]], start_ns: int, end_ns: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return when a queue's depth changes and what it then is.

    Args:
        waits: (arrival, departure) of each message, ns.
        start_ns, end_ns: of the recording; waiting outside is cut off.

    Returns:
        times (E,) from ``start_ns`` on, and depths (E,). Who leaves at the time at which another comes leaves first.
    """
    changes: dict[int, int] = defaultdict(int)
    for arrival, departure in waits:
        begin, end = max(arrival, start_ns), min(departure, end_ns)
        if begin < end:
            changes[begin] += 1
            changes[end] -= 1
    changes.setdefault(start_ns, 0)
    times = np.array(sorted(changes), dtype=np.int64)
    return times, np.cumsum([changes[int(time)] for time in times]).astype(np.int64)


def queue_timelines(trace: Trace) -> list[QueueTimeline]:
    """Return the queues of all subscriptions of a run, by node and topic.

    A message that was taken waited from when its callback was ready to when it started. One that was pushed out of a
    queue of D waited until the D-th message after it came, since a queue loses its oldest. When a message that nobody
    took came is not recorded: it is taken to have been on its way as long as the others on that topic.
    """
    taken: dict[Place, dict[int, tuple[int, int]]] = defaultdict(dict)
    for callback in trace.callbacks:
        if callback.kind == "subscription":
            message = trace.message_by_id.get(callback.message)
            if message is not None and message.name == callback.name:
                taken[callback.node, callback.name][message.id] = (callback.ready_ns, callback.start_ns)
    by_topic: dict[str, list[MessageRecord]] = defaultdict(list)
    for message in trace.messages:
        if message.kind == "topic":
            by_topic[message.name].append(message)
    places = sorted({*taken, *trace.dropped, *trace.queue_limits})
    return [_timeline(trace, place, taken[place], by_topic[place[1]]) for place in places]


def _timeline(
    trace: Trace, place: Place, taken: dict[int, tuple[int, int]], messages: list[MessageRecord]
) -> QueueTimeline:
    limit = trace.queue_limits.get(place)
    dropped, expired = trace.dropped.get(place, 0), trace.expired.get(place, 0)
    travel = [taken[m.id][0] - m.released_ns for m in messages if m.id in taken]
    usual = int(np.median(travel)) if travel else 0
    last_taken = max(taken, default=0)
    # Without drops, a message that was never taken was lost on its way (by a fault), unless it still waits.
    came = [m for m in messages if m.id in taken or dropped or m.id > last_taken]
    arrivals = [taken[m.id][0] if m.id in taken else m.released_ns + usual for m in came]
    waits, drops = [], []
    for index, message in enumerate(came):
        if message.id in taken:
            waits.append(taken[message.id])
        else:
            pushed = index + limit if limit is not None else len(came)
            waits.append((arrivals[index], arrivals[pushed] if pushed < len(came) else trace.end_ns))
            if dropped and pushed < len(came):
                drops.append(arrivals[pushed])
    times, depth = depth_over_time(waits, trace.start_ns, trace.end_ns)
    return QueueTimeline(
        *place, limit, len(came), dropped, expired, times, depth, trace.end_ns, np.array(drops, np.int64)
    )
