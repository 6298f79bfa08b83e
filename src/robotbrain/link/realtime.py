"""The kit's nodes in wall-clock time: callbacks run when they are due and really take their time.

A :class:`RealtimeContext` is a :class:`~robotbrain.ros.SimContext` whose clock is real. ``rclpy.spin``, timers, rates
and services of the kit work on it unchanged; what other threads received from the wire enters through :meth:`post`.
"""

from __future__ import annotations

import dataclasses
import heapq
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

from robotbrain.ros.context import CallbackRecord, CallbackTap, Event, Execution, SimContext

POLL_NS = 10_000_000
"""A wait for data looks up at least this often."""

LATE_NS = 5_000_000
"""An event that starts this long after it was due counts as late."""

# Locks wait in whole ticks of 15.6 ms on Windows; sleeping is exact there (CPython 3.11 and later).
_COARSE_LOCKS = sys.platform == "win32"
_TICK_S = 0.016


class TimeSource(Protocol):
    """What paces a :class:`RealtimeContext`."""

    def now_ns(self) -> int:
        """Return the time, ns; it never runs backwards."""
        ...

    def seconds_until(self, time_ns: int) -> float | None:
        """Return how long to sleep until ``time_ns``, s; None when only arriving data can tell."""
        ...


class WallClock:
    """The computer's monotonic clock, counted from the Unix epoch as ROS 2 does.

    It is set by the system's clock once, at its creation, and is deaf to changes of that clock afterwards.

    Args:
        start_ns: what it reads at its creation; the system's time by default.
    """

    def __init__(self, start_ns: int | None = None) -> None:
        self._offset_ns = (time.time_ns() if start_ns is None else start_ns) - time.monotonic_ns()

    def now_ns(self) -> int:
        """Return the time, ns."""
        return time.monotonic_ns() + self._offset_ns

    def seconds_until(self, time_ns: int) -> float | None:
        """Return how long it is until ``time_ns``, s; not negative."""
        return max(0.0, (time_ns - self.now_ns()) * 1e-9)


class FollowedClock:
    """A clock that others set, as ``/clock`` sets that of a node with ``use_sim_time``. It stands still in between.

    Attributes:
        jumps_back: how often it was told a time before its own; it then stays where it is.
    """

    def __init__(self, start_ns: int = 0) -> None:
        self._now_ns = start_ns
        self.jumps_back = 0

    def set(self, time_ns: int) -> None:
        """Advance to ``time_ns``."""
        if time_ns < self._now_ns:
            self.jumps_back += 1
        else:
            self._now_ns = time_ns

    def now_ns(self) -> int:
        """Return the time last set, ns."""
        return self._now_ns

    def seconds_until(self, time_ns: int) -> float | None:
        """Return None: nobody knows when the next time comes."""
        return None if time_ns > self._now_ns else 0.0


@dataclass(slots=True)
class Lag:
    """How late events started.

    Attributes:
        events: all of them.
        late: those that started LATE_NS or more after they were due.
        worst_ns, total_ns: over all events.
        buckets: events by lag: below 1 µs, below 2 µs, below 4 µs and so on.
    """

    events: int = 0
    late: int = 0
    worst_ns: int = 0
    total_ns: int = 0
    buckets: list[int] = field(default_factory=lambda: [0] * 40)

    def add(self, lag_ns: int) -> None:
        """Count one event."""
        self.events += 1
        self.total_ns += lag_ns
        self.late += lag_ns >= LATE_NS
        self.worst_ns = max(self.worst_ns, lag_ns)
        self.buckets[min((lag_ns // 1000).bit_length(), 39)] += 1

    def percentile_ms(self, percent: float) -> float:
        """Return an upper bound, at most twice too high, of the lag that ``percent`` of events do not exceed, ms."""
        wanted, seen = self.events * percent / 100, 0
        for place, count in enumerate(self.buckets):
            seen += count
            if seen >= wanted:
                return min(float(1 << place) * 1e-3, self.worst_ns * 1e-6)
        return self.worst_ns * 1e-6

    def __str__(self) -> str:
        if not self.events:
            return "no events"
        return (
            f"{self.events} events, {self.late} late by {LATE_NS / 1e6:g} ms or more, "
            f"99 % within {self.percentile_ms(99):.1f} ms, worst {self.worst_ns / 1e6:.1f} ms"
        )


class RealtimeContext(SimContext):
    """A graph of the kit's nodes in real time. All callbacks run in the thread that spins.

    The clock runs on while a callback does, and what the callback publishes leaves when it returns. ``charge`` does
    nothing: time is what passes. Under overload nothing piles up: late timers skip the periods that they have missed,
    subscriptions keep as many messages as their QoS says; :attr:`lag` tells.

    Args:
        clock: paces it; a WallClock by default.

    Attributes:
        lag: how late events started.
    """

    def __init__(self, clock: TimeSource | None = None) -> None:
        self.clock: TimeSource = clock or WallClock()
        self.lag = Lag()
        self._posted: deque[tuple[Event, Any]] = deque()
        self._wake = threading.Event()
        self._running: Execution | None = None
        self._began_ns = 0
        super().__init__()

    # The clock and the running callback are attributes of SimContext; here reading and setting them does something.

    @property
    def now_ns(self) -> int:
        """The time of the clock, ns."""
        return self.clock.now_ns()

    @now_ns.setter
    def now_ns(self, value: int) -> None:
        pass  # the clock sets itself

    @property
    def running(self) -> Execution | None:
        """The callback that is running now."""
        return self._running

    @running.setter
    def running(self, execution: Execution | None) -> None:
        self._running = execution
        if execution is not None:
            self._began_ns = self.clock.now_ns()

    def add_callback_tap(self, tap: CallbackTap) -> Callable[[], None]:
        """Call ``tap(record)`` for every executed callback, with its real start, end and demand."""

        def real(record: CallbackRecord) -> None:
            took = record.end_ns - self._began_ns
            tap(
                dataclasses.replace(
                    record, start_ns=self._began_ns, demand_ns=took, segments=(("cpu", took),) if took else ()
                )
            )

        return super().add_callback_tap(real)

    def charge(self, nanoseconds: int, resource: str = "cpu") -> bool:
        """Do nothing and return False: callbacks really take their time."""
        return False

    def charge_work(self, kind: str, units: float) -> bool:
        """Do nothing and return False: callbacks really take their time."""
        return False

    def sleep(self, nanoseconds: int) -> bool:
        """Sleep: the thread inside a callback, the graph going on outside; return ``ok()``."""
        if self.running is not None:
            time.sleep(max(0, nanoseconds) * 1e-9)
        else:
            self.run_until(self.now_ns + nanoseconds)
        return self._ok

    # ------------------------------------------------------------ from other threads

    def post(self, event: Event, argument: Any = None) -> None:
        """Run ``event(argument)`` in the spinning thread as soon as it is free. Callable from any thread."""
        self._posted.append((event, argument))
        self._wake.set()

    # ------------------------------------------------------------ running

    def next_event_ns(self) -> int | None:
        """Return when to look up next: something may always arrive."""
        soon = self.now_ns + POLL_NS
        return min(self._heap[0][0], soon) if self._heap else soon

    def step(self) -> bool:
        """Wait for the next event, or for data, and process it; return False after shutdown only."""
        self.check_not_in_callback("step")
        return self._step(self.now_ns + POLL_NS)

    def run_until(self, time_ns: int) -> None:
        """Process events as they become due, and data as they come, until the clock reads ``time_ns``.

        Raises:
            ReentrancyError: called inside a callback.
            CallbackError: a callback raised; the context can go on from there.
        """
        self.check_not_in_callback("run_until")
        while self._ok and self.now_ns < time_ns:
            self._step(time_ns)
        while self._ok and (self._posted or (self._heap and self._heap[0][0] <= time_ns)):
            self._step(time_ns)

    def _step(self, limit_ns: int) -> bool:
        if not self._ok:
            return False
        if self._posted:
            event, argument = self._posted.popleft()
            event(argument)
        else:
            due = self._heap[0][0] if self._heap else limit_ns
            now = self.now_ns
            if due > now:
                self._sleep_until(min(due, limit_ns))
                return True
            if not self._heap:
                return True
            due, _, event, argument = heapq.heappop(self._heap)
            self.lag.add(now - due)
            event(argument)
        if self._failures:
            raise self._failures.popleft()
        return True

    def _sleep_until(self, time_ns: int) -> None:
        """Sleep until then or until something is posted, but no longer than a wait for data may take."""
        seconds = self.clock.seconds_until(time_ns)
        seconds = POLL_NS * 1e-9 if seconds is None else seconds
        # Short enough for Ctrl-C and for a shutdown in another thread to be noticed.
        seconds = min(seconds, 0.1)
        if _COARSE_LOCKS and seconds < 2 * _TICK_S:
            if not self._wake.is_set():
                time.sleep(min(seconds, 0.001))
        else:
            self._wake.wait(seconds - _TICK_S if _COARSE_LOCKS else seconds)
        self._wake.clear()
