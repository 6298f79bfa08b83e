"""Loops that keep a rate, in exact time: which ways of waiting drift, which catch up, and which skip.

Four ways to write "every 20 ms":

- ``sleep``: ``while True: work(); sleep(period)``. The period becomes period + work + wake-up delay: it drifts.
- ``sleep_rest``: sleep for what the work has left of the period. Only the wake-up delays (and overruns) add up: it
  still drifts, more slowly.
- ``until``: sleep until the next time on a grid that is fixed at the start. Delays do not add up. After an overrun the
  missed periods are made up in a burst (``clock_nanosleep`` with TIMER_ABSTIME behaves so).
- ``timer``: the grid, but whole periods that were missed are skipped: the rule of ROS 2's timers (``rcl_timer_call``)
  and of ``rclpy``'s ``Rate``. One late call, then back on the grid.

A robot's controller wants ``timer``; one that counts its calls to tell the time wants ``until``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robotbrain.errors import InputError

Method = Literal["sleep", "sleep_rest", "until", "timer"]
METHODS: tuple[Method, ...] = ("sleep", "sleep_rest", "until", "timer")
"""Ways to wait."""


@dataclass(frozen=True)
class LoopTimes:
    """When a loop's calls started and ended.

    Attributes:
        method: how it waited.
        period_ns: that it was meant to have.
        starts_ns, ends_ns: of each call; the loop begins at 0 and its first call is due at one period.
    """

    method: str
    period_ns: int
    starts_ns: NDArray[np.int64]
    ends_ns: NDArray[np.int64]

    @property
    def mean_period_ns(self) -> float:
        """Time from call to call on average, ns."""
        return float(self.starts_ns[-1] - self.starts_ns[0]) / (len(self.starts_ns) - 1)

    @property
    def drift_ppm(self) -> float:
        """How much longer a period is than it should be on average, parts per million."""
        return (self.mean_period_ns / self.period_ns - 1) * 1e6

    @property
    def lateness_ns(self) -> NDArray[np.int64]:
        """How late the k-th call is on the grid on which it should be the k-th, ns."""
        return self.starts_ns - self.period_ns * np.arange(1, len(self.starts_ns) + 1)

    @property
    def phase_ns(self) -> NDArray[np.int64]:
        """How long after the last point of the grid each call starts, ns: 0 for a call on the grid."""
        return self.starts_ns % self.period_ns

    @property
    def skipped(self) -> int:
        """Points of the grid between the first and the last call at which no call was due any more."""
        spanned = self.starts_ns[-1] // self.period_ns - self.starts_ns[0] // self.period_ns
        return max(0, int(spanned) - (len(self.starts_ns) - 1))


def loop_times(method: Method, period_ns: int, work_ns: Sequence[int], wakeup_ns: int | Sequence[int] = 0) -> LoopTimes:
    """Return when the calls of a loop start and end, in exact arithmetic.

    Args:
        method: one of METHODS.
        period_ns: >= 1.
        work_ns: what each call takes; as many calls as there are numbers, >= 1.
        wakeup_ns: how much later than asked a sleep ends; one number, or one for each call. A loop that has no time to
            sleep is not delayed.

    Raises:
        InputError: for an unknown method or negative times.
    """
    delays = [wakeup_ns] * len(work_ns) if isinstance(wakeup_ns, int) else list(wakeup_ns)
    if method not in METHODS:
        raise InputError("method", given=method, expected="one of " + ", ".join(METHODS), fix="Choose one of these.")
    if period_ns < 1 or not work_ns or len(delays) != len(work_ns) or min(*work_ns, *delays, 0) < 0:
        raise InputError(
            "loop",
            given={"period_ns": period_ns, "calls": len(work_ns), "delays": len(delays)},
            expected="period >= 1 ns, at least one call, no negative time, and a delay for each call",
            fix="Give times in whole ns.",
        )
    now, due = 0, period_ns
    starts, ends = [], []
    for work, delay in zip(work_ns, delays, strict=True):
        start = max(now, due + delay if due > now else now)
        now = start + work
        starts.append(start)
        ends.append(now)
        due = next_due(method, due, start, now, period_ns)
    return LoopTimes(method, period_ns, np.array(starts, dtype=np.int64), np.array(ends, dtype=np.int64))


def next_due(method: str, due: int, start: int, end: int, period: int) -> int:
    """Return when a loop's next call is due, given when the last one was due, started and ended, ns."""
    if method == "sleep":
        return end + period
    if method == "sleep_rest":
        return start + period
    due += period
    if method == "timer" and due < start:
        due = next_on_grid(due, start, period)
    return due


def next_on_grid(due_ns: int, now_ns: int, period_ns: int) -> int:
    """Return the first time of the grid through ``due_ns`` that is not before ``now_ns``.

    This is how ``rcl_timer_call`` skips missed periods (ros2/rcl, timer.c): the next call is one period after the last
    due time, and then as many whole periods later as it takes not to lie in the past.
    """
    return due_ns if due_ns >= now_ns else due_ns + -(-(now_ns - due_ns) // period_ns) * period_ns


def drift_ppm(method: Method, period_ns: int, work_ns: float, wakeup_ns: float) -> float:
    """Return how much longer than meant a loop's period is, in parts per million, when no call overruns.

    Args:
        method: one of METHODS.
        period_ns: meant.
        work_ns, wakeup_ns: of each call, on average.
    """
    extra = {"sleep": work_ns + wakeup_ns, "sleep_rest": wakeup_ns}.get(method, 0.0)
    return extra / period_ns * 1e6
