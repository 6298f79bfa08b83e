"""How well this machine keeps a rate: loops of :mod:`~robotbrain.pipeline.patterns.rates` on the wall clock, measured.

Jitter is the machine's, not the loop's: a laptop's scheduler wakes a thread up some 50 μs late on average, and now and
then, when others want the core, by milliseconds. What helps on a robot, in this order: a grid instead of relative
sleeps; nothing in the loop that can block (memory, disk, garbage); a real-time priority (``SCHED_FIFO``), so that other
processes have to wait; a kernel with PREEMPT_RT, so that the kernel itself can be interrupted.
"""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robotbrain.errors import InputError
from robotbrain.pipeline.patterns.rates import METHODS, LoopTimes, next_due

WallMethod = Literal["sleep", "sleep_rest", "until", "timer", "spin"]
WALL_METHODS: tuple[WallMethod, ...] = (*METHODS, "spin")
"""Ways to wait on the wall clock: those of rates, and ``spin``: as timer, but the last SPIN_NS are spent looking at the
clock. It wakes up on time and burns a part of a core for it."""

SPIN_NS = 300_000
"""Longest time that ``spin`` does not sleep, ns."""


@dataclass(frozen=True)
class JitterResult:
    """How a loop kept its rate.

    Attributes:
        method: how it waited.
        hz: that it was meant to have.
        times: of all calls, from the start of the loop.
        cpu_s: processor time that the process used meanwhile, s.
        priority: under which it ran, in words.
    """

    method: str
    hz: float
    times: LoopTimes = field(repr=False)
    cpu_s: float
    priority: str = "normal"

    @property
    def wakeup_us(self) -> NDArray[np.float64]:
        """How late each call started after it was due, μs.

        Due is one period after the last call's end (``sleep``) or start (``sleep_rest``), else a time of the grid: with
        ``timer`` the first one that had not passed when the last call started, otherwise simply the next one.
        """
        starts, ends, period = self.times.starts_ns, self.times.ends_ns, self.times.period_ns
        late = np.empty(len(starts))
        due = period
        for k, (start, end) in enumerate(zip(starts.tolist(), ends.tolist(), strict=True)):
            late[k] = start - due
            due = next_due(_rule(self.method), due, start, end, period)
            if self.method == "sleep_rest":
                due = max(due, end)  # there was no rest to sleep
        return late / 1000

    @property
    def period_error_us(self) -> NDArray[np.float64]:
        """How far each period, from start to start, was from what it should be, μs."""
        return np.asarray((np.diff(self.times.starts_ns) - self.times.period_ns) / 1000, dtype=float)

    @property
    def drift_ppm(self) -> float:
        """How much longer than meant a period was on average, parts per million."""
        return self.times.drift_ppm

    @property
    def skipped(self) -> int:
        """Calls that were left out."""
        return self.times.skipped

    def percentiles_us(self, *percents: float) -> tuple[float, ...]:
        """Return percentiles of :attr:`wakeup_us`, μs."""
        return tuple(float(value) for value in np.percentile(self.wakeup_us, percents))


def measure_jitter(
    hz: float,
    seconds: float,
    method: WallMethod = "timer",
    *,
    work: Callable[[], object] | None = None,
    priority: int | None = None,
    clock: Callable[[], int] = time.monotonic_ns,
    sleep: Callable[[float], object] = time.sleep,
) -> JitterResult:
    """Run a loop on the wall clock and measure when its calls start.

    Args:
        hz: rate, 0.1 to 10000.
        seconds: how long; the number of calls is their product.
        method: how to wait, one of WALL_METHODS.
        work: done in each call; nothing if None.
        priority: try to run under this real-time priority, 1 to 99 (see :func:`realtime_priority`); None: as usual.
        clock: ns that never run backwards.
        sleep: for seconds.

    Raises:
        InputError: for an unknown method or numbers out of range.
    """
    if method not in WALL_METHODS:
        raise InputError(
            "method", given=method, expected="one of " + ", ".join(WALL_METHODS), fix="Choose one of these."
        )
    count = round(hz * seconds) if 0.1 <= hz <= 10_000 and seconds > 0 else 0
    if not 2 <= count <= 10_000_000:
        raise InputError(
            "hz and seconds",
            given=(hz, seconds),
            expected="0.1 <= hz <= 10000, and at least two calls",
            fix="measure_jitter(hz=50, seconds=5) makes 250 calls.",
        )
    period = round(1e9 / hz)
    with realtime_priority(priority) if priority is not None else contextlib.nullcontext() as granted:
        used = time.process_time()
        starts, ends = _run_loop(method, period, count, work, clock, sleep)
        used = time.process_time() - used
    times = LoopTimes(method, period, np.array(starts, dtype=np.int64), np.array(ends, dtype=np.int64))
    return JitterResult(method, hz, times, used, "normal" if granted is None else str(granted))


def _rule(method: str) -> str:
    """Return the rule of ``next_due`` by which a method waits."""
    return "timer" if method == "spin" else method


def _run_loop(
    method: WallMethod,
    period: int,
    count: int,
    work: Callable[[], object] | None,
    clock: Callable[[], int],
    sleep: Callable[[float], object],
) -> tuple[list[int], list[int]]:
    rule = _rule(method)
    starts, ends = [0] * count, [0] * count
    zero = clock()
    now, due = 0, period
    for k in range(count):
        if method == "spin":
            if due - now > SPIN_NS:
                sleep((due - now - SPIN_NS) / 1e9)
            while clock() - zero < due:
                pass
        elif due > now:
            sleep((due - now) / 1e9)
        start = clock() - zero
        if work is not None:
            work()
        now = clock() - zero
        starts[k], ends[k] = start, now
        due = next_due(rule, due, start, now, period)
    return starts, ends


# ------------------------------------------------------------ real-time priority


@dataclass(frozen=True)
class PriorityOutcome:
    """Whether the system gave a real-time priority.

    Attributes:
        granted: whether it did.
        priority: that was asked for, 1 to 99.
        reason: why not, and what to do about it; empty if granted.
        preempt_rt: whether the kernel says that it is a real-time kernel; None where there is no way to tell.
    """

    granted: bool
    priority: int
    reason: str = ""
    preempt_rt: bool | None = None

    def __str__(self) -> str:
        return f"SCHED_FIFO {self.priority}" if self.granted else f"normal ({self.reason})"


def kernel_is_realtime() -> bool | None:
    """Tell whether the kernel is one with PREEMPT_RT; None off Linux, where there is no way to tell."""
    if not sys.platform.startswith("linux"):
        return None
    flag = Path("/sys/kernel/realtime")
    try:
        return flag.read_text(encoding="utf-8").strip() == "1"
    except OSError:
        return "PREEMPT_RT" in os.uname().version


def try_realtime_priority(priority: int = 50) -> PriorityOutcome:
    """Ask for ``SCHED_FIFO``: this process then runs before every normal one, until it blocks.

    A loop that never sleeps would take its core for good (Linux leaves others 5 % of the time). On a robot: keep to
    one core less than there are, and stay below the priorities of the kernel's interrupt threads (50).

    Args:
        priority: 1 to 99, larger is more urgent.

    Returns:
        Whether it was granted; if not, why. Nothing is raised for a refusal: the program works, only less evenly.

    Raises:
        InputError: for a priority out of range.
    """
    if isinstance(priority, bool) or not isinstance(priority, int) or not 1 <= priority <= 99:
        raise InputError("priority", given=priority, expected="a whole number from 1 to 99", fix="50 is a good start.")
    realtime = kernel_is_realtime()
    if not sys.platform.startswith("linux"):
        return PriorityOutcome(False, priority, f"{sys.platform} has no sched_setscheduler; Linux does", realtime)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError:
        return PriorityOutcome(False, priority, _why_refused(priority), realtime)
    except OSError as error:
        return PriorityOutcome(False, priority, f"the kernel refused: {error.strerror}", realtime)
    return PriorityOutcome(True, priority, preempt_rt=realtime)


def _why_refused(priority: int) -> str:
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_RTPRIO)
    if priority <= hard and hard > soft:
        return f"the soft limit is {soft}, the hard one {hard}: run `ulimit -r {priority}` first"
    if hard >= priority:
        return "refused though the limit allows it: a container or cgroup without a real-time budget"
    return (
        f"RLIMIT_RTPRIO is {hard}: add `@realtime - rtprio 98` to /etc/security/limits.conf, join that group and log "
        "in again; in a container add --cap-add=SYS_NICE --ulimit rtprio=98"
    )


@contextlib.contextmanager
def realtime_priority(priority: int = 50) -> Iterator[PriorityOutcome]:
    """Run a block under a real-time priority if the system grants it; the former one is restored afterwards."""
    if not sys.platform.startswith("linux"):
        yield try_realtime_priority(priority)
        return
    policy, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
    outcome = try_realtime_priority(priority)
    try:
        yield outcome
    finally:
        if outcome.granted:
            os.sched_setscheduler(0, policy, parameter)
