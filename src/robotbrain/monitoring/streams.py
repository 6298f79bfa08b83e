"""What a monitor keeps of each callback, topic, queue and chain: bounded memory, however long it watches."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from robotbrain.monitoring.deadlines import Jitter
from robotbrain.monitoring.distribution import Distribution
from robotbrain.monitoring.sketch import WindowedSketch
from robotbrain.monitoring.summary import CallbackSummary, QueueSummary, TopicSummary

_LEARNING = 9  # intervals from which an undeclared period is taken
_PENDING = 64  # calls, or messages, that are noted together
_ARRIVALS = 1024  # arrivals remembered per queue, for the waiting of messages that were dropped

Call = tuple[int, float, float | None, float | None, float | None, float | None, Sequence[tuple[str, int]]]
"""Start (ns), latency, response, queueing, contention and age (ms), and what it wanted of each resource."""


class RhythmStream:
    """How regular something starts; the streaming form of :func:`~robotbrain.monitoring.deadlines.jitter_of`.

    An undeclared period is the median of the first intervals. The grid's offset needs all starts at once: only a
    trace gives it.

    Args:
        period_ns: if somebody declared it.
    """

    __slots__ = (
        "_early",
        "_kk",
        "_kt",
        "_place",
        "_sum_k",
        "_sum_t",
        "count",
        "declared",
        "deviation",
        "first_ns",
        "last_ns",
        "missed",
        "period_ns",
    )

    def __init__(self, period_ns: float | None = None) -> None:
        self.period_ns, self.declared = period_ns, period_ns is not None
        self.deviation = WindowedSketch()
        self.count = self.missed = 0
        self.first_ns = self.last_ns = 0
        self._early: list[int] = []
        self._place = 0
        self._sum_k = self._sum_t = self._kk = self._kt = 0.0

    def extend(self, times_ns: Sequence[int]) -> None:
        """Note starts, later than those before; among themselves they may be in any order."""
        if not times_ns:
            return
        times = np.sort(np.asarray(times_ns, dtype=np.int64))
        if not self.count:
            self.first_ns = self.last_ns = int(times[0])
            self.count, times = 1, times[1:]
        self.count += len(times)
        intervals = np.maximum(0, np.diff(times, prepend=self.last_ns))
        if not len(times):
            return
        self.last_ns = max(self.last_ns, int(times[-1]))
        if self.period_ns is None:
            self._early += intervals.tolist()
            if len(self._early) >= _LEARNING:
                early, self._early = np.array(self._early, dtype=np.int64), []
                self.period_ns = float(max(1, int(np.sort(early)[len(early) // 2])))
                self._note(early)
            return
        self._note(intervals)

    def _note(self, intervals_ns: NDArray[np.int64]) -> None:
        period = self.period_ns or 1.0
        self.deviation.extend((np.abs(intervals_ns - period) * 1e-6).tolist())
        steps = np.rint(intervals_ns / period)
        self.missed += int(np.maximum(0, steps - 1).sum())
        places = self._place + np.cumsum(steps)
        if self.declared:
            elapsed = (self.last_ns - self.first_ns) - (intervals_ns.sum() - np.cumsum(intervals_ns)).astype(float)
            self._sum_k += float(places.sum())
            self._sum_t += float(elapsed.sum())
            self._kk += float(places @ places)
            self._kt += float(places @ elapsed)
        self._place = int(places[-1])

    @property
    def rate_hz(self) -> float:
        """Starts per second from the first to the last; NaN for fewer than two."""
        span = self.last_ns - self.first_ns
        return (self.count - 1) * 1e9 / span if span > 0 else math.nan

    def jitter(self) -> Jitter:
        """Return the figures."""
        if self.period_ns is None:
            if len(self._early) < 2:
                return Jitter()
            period = sorted(self._early)[len(self._early) // 2]
            deviation = Distribution.of([abs(interval - period) * 1e-6 for interval in self._early])
            return Jitter(period * 1e-6, False, deviation=deviation)
        drift = math.nan
        spread = self.count * self._kk - self._sum_k**2
        if self.declared and spread > 0:
            slope = (self.count * self._kt - self._sum_k * self._sum_t) / spread
            drift = (slope / self.period_ns - 1) * 1e6
        deviation = Distribution.from_sketch(self.deviation.total())
        return Jitter(self.period_ns * 1e-6, self.declared, Distribution(), deviation, drift, self.missed)


class CallbackStream:
    """One callback of one node.

    Args:
        node, role, kind, name: which.
        deadline_ms: None without one.
        period_ns: of a timer.
        accuracy: relative, of percentiles.
    """

    def __init__(
        self,
        node: str,
        role: str,
        kind: str,
        name: str,
        deadline_ms: float | None,
        period_ns: float | None = None,
        accuracy: float = 0.01,
    ) -> None:
        self.node, self.role, self.kind, self.name = node, role, kind, name
        self.label = f"{node} {kind} {name}"
        self.deadline_ms = deadline_ms
        self._accuracy = accuracy
        self.latency, self.response, self.queueing, self.contention, self.age = (
            WindowedSketch(accuracy) for _ in range(5)
        )
        self.demand: dict[str, WindowedSketch] = {}
        self.rhythm = RhythmStream(period_ns)
        self.calls = self.misses = self.failures = 0
        self._pending: list[Call] = []

    def add(
        self,
        start_ns: int,
        latency_ms: float,
        response_ms: float | None = None,
        queueing_ms: float | None = None,
        contention_ms: float | None = None,
        segments: Sequence[tuple[str, int]] = (),
        age_ms: float | None = None,
    ) -> bool:
        """Note a call; return whether it missed its deadline.

        Without a response time (in wall-clock time nobody knows when a callback became ready) the latency counts.
        """
        self.calls += 1
        # This runs for every callback of a brain: what can wait is done later, for many calls at once.
        pending = self._pending
        pending.append((start_ns, latency_ms, response_ms, queueing_ms, contention_ms, age_ms, segments))
        if len(pending) >= _PENDING:
            self.flush()
        if self.deadline_ms is None:
            return False
        missed = (latency_ms if response_ms is None else response_ms) > self.deadline_ms
        self.misses += missed
        return missed

    def flush(self) -> None:
        """Bring the figures up to date."""
        if not self._pending:
            return
        starts, latency, response, queueing, contention, age, segments = zip(*self._pending, strict=True)
        self._pending.clear()
        self.rhythm.extend(starts)
        self.latency.extend(latency)
        for sketch, column in (
            (self.response, response),
            (self.queueing, queueing),
            (self.contention, contention),
            (self.age, age),
        ):
            sketch.extend([value for value in column if value is not None])
        demands: dict[str, list[float]] = {}
        for pieces in segments:
            sums: dict[str, int] = {}
            for resource, length in pieces:
                sums[resource] = sums.get(resource, 0) + length
            for resource, total in sums.items():
                demands.setdefault(resource, []).append(total * 1e-6)
        for resource, values in demands.items():
            found = self.demand.get(resource)
            if found is None:
                found = self.demand[resource] = WindowedSketch(self._accuracy)
            found.extend(values)

    def roll(self) -> None:
        """Begin a new window."""
        self.flush()
        for sketch in (self.latency, self.response, self.queueing, self.contention, self.age, *self.demand.values()):
            sketch.roll()
        self.rhythm.deviation.roll()

    @property
    def negative_ages(self) -> int:
        """Messages stamped later than the clock said when their callback started."""
        self.flush()
        return self.age.total().negative

    def summary(self, lost: int = 0) -> CallbackSummary:
        """Return the figures so far.

        Args:
            lost: messages that never met the callback; they missed its deadline.
        """
        self.flush()
        figures = {
            name: Distribution.from_sketch(getattr(self, name).total())
            for name in ("latency", "response", "queueing", "contention", "age")
        }
        periodic = self.kind in ("timer", "subscription")
        return CallbackSummary(
            node=self.node,
            role=self.role,
            kind=self.kind,
            name=self.name,
            calls=self.calls,
            rate_hz=self.rhythm.rate_hz,
            demand={name: Distribution.from_sketch(sketch.total()) for name, sketch in self.demand.items()},
            jitter=self.rhythm.jitter() if periodic else Jitter(),
            deadline_ms=self.deadline_ms,
            misses=self.misses + (lost if self.deadline_ms is not None else 0),
            failures=self.failures,
            **figures,
        )


class TopicStream:
    """Messages of one topic."""

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.rhythm = RhythmStream()
        self.messages = self.bytes = self.sized = 0
        self._pending: list[int] = []
        self._recent: deque[int] = deque(maxlen=11)

    def add(self, time_ns: int, size: int | None) -> None:
        """Note a message of so many bytes, if known."""
        self.messages += 1
        self._pending.append(time_ns)
        if len(self._pending) >= _PENDING:
            self._flush()
        self._recent.append(time_ns)
        if size is not None:
            self.bytes += size
            self.sized += 1

    def _flush(self) -> None:
        self.rhythm.extend(self._pending)
        self._pending.clear()

    def recent_hz(self, now_ns: int) -> float:
        """Return messages per second over the last few; it falls while none comes."""
        if len(self._recent) < 2:
            return 0.0
        intervals = len(self._recent) - 1
        silent = now_ns - self._recent[-1]
        span = self._recent[-1] - self._recent[0]
        # Silence counts once it is longer than what was usual.
        if silent * intervals > 2 * span:
            span += silent
            intervals += 1
        return intervals * 1e9 / span if span > 0 else 0.0

    def summary(self) -> TopicSummary:
        """Return the figures so far."""
        self._flush()
        mean = self.bytes / self.sized if self.sized else math.nan
        return TopicSummary(self.topic, self.messages, self.rhythm.rate_hz, mean, self.rhythm.jitter())


class QueueStream:
    """The queue of one subscription in a simulation.

    By Little's law the mean depth is the waiting of all messages over the time. A message that a queue of D pushed out
    waited until the D-th message after it came.
    """

    def __init__(self, node: str, topic: str, limit: int | None) -> None:
        self.node, self.topic, self.limit = node, topic, limit
        self.waited_ns = 0
        self.max_depth = 0
        self.dropped = 0
        self._arrivals: deque[int] = deque(maxlen=min(limit or 1, _ARRIVALS) + 1)
        self._waiting: deque[int] = deque()

    def arrive(self, time_ns: int, dropped: int) -> None:
        """Note that a message is sent to the queue.

        Args:
            time_ns: when.
            dropped: messages that the queue lost so far, as far as known: a loss may be noticed a few messages late.
        """
        if dropped > self.dropped:
            self.dropped += 1
            self.max_depth = max(self.max_depth, self.limit or 0)
            if self.limit is not None and len(self._arrivals) == self.limit + 1:
                self.waited_ns += self._arrivals[-1] - self._arrivals[0]
        self._arrivals.append(time_ns)

    def taken(self, ready_ns: int, start_ns: int) -> None:
        """Note that a message left for its callback; messages leave in the order in which they came."""
        self.waited_ns += start_ns - ready_ns
        waiting = self._waiting
        while waiting and waiting[0] <= ready_ns:
            waiting.popleft()
        if start_ns > ready_ns:
            waiting.append(start_ns)
            if len(waiting) > self.max_depth:
                self.max_depth = len(waiting)

    def summary(self, span_ns: int, dropped: int, expired: int) -> QueueSummary:
        """Return the figures so far, over so long a time."""
        if dropped and self.limit is not None:
            self.max_depth = self.limit
        mean = self.waited_ns / span_ns if span_ns > 0 else 0.0
        return QueueSummary(self.node, self.topic, self.limit, self.max_depth, mean, dropped, expired)
