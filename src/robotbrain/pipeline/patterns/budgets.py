"""Latency budgets: who may take how long, and proofs that a deadline is kept.

A deadline from sensor to actuator is spent on sampling (something that happens just after a frame waits a period for
the next one), on the stages, and on waiting. A :class:`Budget` hands it out and compares it with a run. Whether tasks
that share a core meet their deadlines at all is a matter of proof, not of measuring: utilisation bounds give a quick
yes, response-time analysis an exact answer.

Sources: Liu and Layland, "Scheduling algorithms for multiprogramming in a hard-real-time environment", J. ACM 20(1),
1973 (utilisation bound, critical instant); Joseph and Pandya, "Finding response times in a real-time system", Computer
Journal 29(5), 1986, and Audsley et al., "Applying new scheduling theory to static priority pre-emptive scheduling",
Software Engineering Journal 8(5), 1993 (response times); Bini, Buttazzo and Buttazzo, "Rate monotonic analysis: the
hyperbolic bound", IEEE Trans. Computers 52(7), 2003; Davis, Burns, Bril and Lukkien, "Controller Area Network (CAN)
schedulability analysis: refuted, revisited and revised", Real-Time Systems 35, 2007 (without preemption).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from robotbrain.errors import InputError
from robotbrain.pipeline.patterns.stages import NS_PER_MS, Stage

if TYPE_CHECKING:
    from robotbrain.pipeline.patterns.results import PatternResult


@dataclass(frozen=True)
class Task:
    """A periodic task.

    Attributes:
        name: of the task.
        period_ns: shortest time between two of its releases.
        wcet_ns: worst-case execution time on an idle core.
        deadline_ns: from its release; the period if None.

    Raises:
        InputError: unless 0 < wcet <= deadline <= period.
    """

    name: str
    period_ns: int
    wcet_ns: int
    deadline_ns: int | None = None

    def __post_init__(self) -> None:
        if not 0 < self.wcet_ns <= self.due_ns <= self.period_ns:
            raise InputError(
                f"task {self.name!r}",
                given=(self.period_ns, self.wcet_ns, self.deadline_ns),
                expected="0 < wcet <= deadline <= period, ns",
                fix="A task that takes longer than its deadline needs a faster core or less to do.",
            )

    @classmethod
    def of(cls, name: str, period_ms: float, wcet_ms: float, deadline_ms: float | None = None) -> Task:
        """Return a task with times in ms."""
        ns = [None if ms is None else round(ms * NS_PER_MS) for ms in (period_ms, wcet_ms, deadline_ms)]
        return cls(name, ns[0] or 0, ns[1] or 0, ns[2])

    @property
    def due_ns(self) -> int:
        """Deadline, ns after the release."""
        return self.period_ns if self.deadline_ns is None else self.deadline_ns

    @property
    def utilisation(self) -> float:
        """Share of a core that it takes."""
        return self.wcet_ns / self.period_ns


def utilisation(tasks: Sequence[Task]) -> float:
    """Return the share of a core that tasks take together; above 1 no scheduler can help."""
    return sum(task.utilisation for task in tasks)


def liu_layland_bound(count: int) -> float:
    """Return n (2^(1/n) - 1): up to that utilisation n tasks with rate-monotonic priorities meet all deadlines."""
    return count * (2 ** (1 / count) - 1) if count else 1.0


def passes_hyperbolic_bound(tasks: Sequence[Task]) -> bool:
    """Tell whether Π (U_i + 1) <= 2: enough for rate-monotonic priorities, and never worse than Liu and Layland's."""
    return math.prod(task.utilisation + 1 for task in tasks) <= 2


def rate_monotonic(tasks: Sequence[Task]) -> tuple[Task, ...]:
    """Return tasks in order of priority: shortest deadline first (the period, where no deadline is given)."""
    return tuple(sorted(tasks, key=lambda task: task.due_ns))


def response_times(tasks: Sequence[Task], *, preemptive: bool = True) -> dict[str, float]:
    """Return the worst response time of each task on one core, ns: from its release to its end.

    With preemption (threads with ``SCHED_FIFO`` priorities) this is exact: the least R with R = C + Σ ⌈R / T_j⌉ C_j
    over tasks of higher priority. Without it (callbacks of one executor, frames on a CAN bus) it is a bound: a task
    also waits for one of lower priority that has begun.

    Args:
        tasks: in order of priority, the most urgent first.
        preemptive: whether a task of higher priority interrupts others.

    Returns:
        By name; infinite for a task that can miss its deadline.
    """
    found = {}
    for place, task in enumerate(tasks):
        higher = tasks[:place]
        if preemptive:
            found[task.name] = _preemptive(task, higher)
        else:
            found[task.name] = _blocking(task, higher, tasks[place + 1 :])
    return found


def _preemptive(task: Task, higher: Sequence[Task]) -> float:
    response, before = task.wcet_ns, 0
    while response != before:
        if response > task.due_ns:
            return math.inf
        before = response
        response = task.wcet_ns + sum(-(-before // other.period_ns) * other.wcet_ns for other in higher)
    return response


def _blocking(task: Task, higher: Sequence[Task], lower: Sequence[Task]) -> float:
    # The task's own last release may block it just as one of lower priority (Davis et al., sufficient test 1).
    blocked = max([task.wcet_ns, *(other.wcet_ns for other in lower)])
    wait, before = blocked, -1
    while wait != before:
        if wait + task.wcet_ns > task.due_ns:
            return math.inf
        before = wait
        wait = blocked + sum((before // other.period_ns + 1) * other.wcet_ns for other in higher)
    return wait + task.wcet_ns


def executor_response_ns(tasks: Sequence[Task]) -> int:
    """Return a bound on the response of timers that share a single-threaded executor of the kit, ns.

    Ready callbacks run in the order in which they became ready, and a timer is in the queue once at most: before a
    callback there may be the rest of the one that runs, and one of every other.

    Args:
        tasks: all timers of the executor; their utilisation does not matter, as missed periods are skipped.
    """
    return sum(task.wcet_ns for task in tasks) + max(task.wcet_ns for task in tasks)


def simulate_fixed_priority(
    tasks: Sequence[Task], horizon_ns: int, offsets_ns: Sequence[int] | None = None, *, preemptive: bool = True
) -> dict[str, int]:
    """Return the longest response time of each task in a simulation of one core, ns.

    Args:
        tasks: in order of priority, the most urgent first; each takes its worst-case time.
        horizon_ns: releases before that are simulated to their ends.
        offsets_ns: of the first releases; 0 for all if None, which with preemption is the worst case.
        preemptive: see :func:`response_times`.
    """
    offsets = offsets_ns or [0] * len(tasks)
    releases = sorted(
        (release, place)
        for place, (task, offset) in enumerate(zip(tasks, offsets, strict=True))
        for release in range(offset, horizon_ns, task.period_ns)
    )
    worst = {task.name: 0 for task in tasks}
    ready: list[list[int]] = []  # [priority, release, left]
    now, upcoming = 0, 0
    while ready or upcoming < len(releases):
        if not ready:
            now = max(now, releases[upcoming][0])
        while upcoming < len(releases) and releases[upcoming][0] <= now:
            release, place = releases[upcoming]
            ready.append([place, release, tasks[place].wcet_ns])
            upcoming += 1
        job = min(ready)
        until = now + job[2]
        if preemptive and upcoming < len(releases):
            until = min(until, releases[upcoming][0])
        job[2] -= until - now
        now = until
        if not job[2]:
            ready.remove(job)
            name = tasks[job[0]].name
            worst[name] = max(worst[name], now - job[1])
    return worst


# ------------------------------------------------------------ from sensor to actuator


@dataclass(frozen=True)
class BudgetLine:
    """One line of a budget.

    Attributes:
        name: stage, ``sampling`` (the camera's period) or ``reserve``.
        budget_ms: what it may take.
        spent_ms: what it took at most; NaN if not known.
    """

    name: str
    budget_ms: float
    spent_ms: float = float("nan")

    @property
    def slack_ms(self) -> float:
        """What is left; negative if it took too long."""
        return self.budget_ms - self.spent_ms


@dataclass(frozen=True)
class Budget:
    """A deadline from something happening to the first command that knows, handed out to who spends it.

    Attributes:
        deadline_ms: in all.
        sampling_ms: the camera's period: what happens just after a frame waits for the next.
        stages_ms: by stage, from release of its input to release of its output: waiting and computing.
    """

    deadline_ms: float
    sampling_ms: float
    stages_ms: Mapping[str, float]

    @property
    def reserve_ms(self) -> float:
        """What nobody may spend: for jitter, transport and bad days."""
        return self.deadline_ms - self.sampling_ms - sum(self.stages_ms.values())

    def check(self, result: PatternResult) -> tuple[BudgetLine, ...]:
        """Return the budget with what a run spent: of each stage the longest from its input's release to its end.

        The lines of a run add up to more than its peak age: not every stage has its worst case on the same frame.
        """
        spent = stage_response_ms(result)
        lines = [BudgetLine("sampling", self.sampling_ms, result.period_ns / NS_PER_MS)]
        lines += [BudgetLine(name, ms, spent.get(name, float("nan"))) for name, ms in self.stages_ms.items()]
        over = result.peak_age_ms - self.deadline_ms
        return (*lines, BudgetLine("reserve", self.reserve_ms, max(0.0, self.reserve_ms + over)))

    def kept_by(self, result: PatternResult) -> bool:
        """Tell whether a run met the deadline: nothing went unseen for longer."""
        return result.peak_age_ms <= self.deadline_ms

    def table(self, result: PatternResult) -> str:
        """Return :meth:`check` as text."""
        rows = [f"{'':<18}{'budget ms':>11}{'spent ms':>11}{'slack ms':>11}"]
        for line in self.check(result):
            mark = "  over budget" if line.slack_ms < 0 else ""
            rows.append(
                f"{line.name:<18}{line.budget_ms:>11.1f}{line.spent_ms:>11.1f}{line.slack_ms:>11.1f}{mark}".rstrip()
            )
        peak, kept = result.peak_age_ms, "kept" if self.kept_by(result) else "missed"
        rows.append(f"{'deadline ' + kept:<18}{self.deadline_ms:>11.1f}{peak:>11.1f}{self.deadline_ms - peak:>11.1f}")
        return "\n".join(rows)


def make_budget(
    deadline_ms: float, stages: Sequence[Stage], camera_hz: float, *, reserve: float = 0.2, how: str = "proportional"
) -> Budget:
    """Return a budget for a brain.

    Args:
        deadline_ms: from something happening to the first command that knows.
        stages: to hand it out to.
        camera_hz: its period is taken off first.
        reserve: share of the deadline that nobody may spend, 0 to 1.
        how: ``proportional`` to the stages' times, or ``equal`` shares.

    Raises:
        InputError: nothing is left for the stages, or for an unknown ``how``.
    """
    sampling = 1000 / camera_hz
    left = deadline_ms * (1 - reserve) - sampling
    if left <= 0 or not 0 <= reserve < 1:
        raise InputError(
            "budget",
            given={"deadline_ms": deadline_ms, "camera_hz": camera_hz, "reserve": reserve},
            expected="a deadline that leaves time for the stages after sampling and reserve",
            fix="Take a faster camera, a smaller reserve, or a later deadline.",
        )
    if how not in ("proportional", "equal"):
        raise InputError("how", given=how, expected="'proportional' or 'equal'", fix="Choose one of the two.")
    weights = [float(stage.ns) if how == "proportional" else 1.0 for stage in stages]
    total = sum(weights)
    shares = {stage.name: left * weight / total for stage, weight in zip(stages, weights, strict=True)}
    return Budget(deadline_ms, sampling, shares)


def stage_response_ms(result: PatternResult) -> dict[str, float]:
    """Return the longest time that each stage of a run took, waiting included, ms.

    In a sequential brain only the first stage waits: for the one callback that does it all.
    """
    found = dict.fromkeys((stage.name for stage in result.stages), 0.0)
    begun: dict[tuple[str, int], int] = {}
    ended: dict[tuple[str, int], int] = {}
    for span in result.spans:
        key = (span.stage, span.frame)
        begun[key] = min(begun.get(key, span.start_ns), span.start_ns)
        ended[key] = max(ended.get(key, 0), span.end_ns)
    names = [stage.name for stage in result.stages]
    for (name, frame), end in ended.items():
        if end < result.warmup_ns:
            continue
        place = names.index(name)
        if result.kind == "parallel" and place == len(names) - 1:
            ready = begun[name, frame]  # its timer, not a message, sets it off
            end = ready + result.stages[place].ns
        else:
            ready = ended.get((names[place - 1], frame), 0) if place else frame * result.period_ns
        found[name] = max(found[name], (end - ready) / NS_PER_MS)
    return {name: float(np.round(ms, 6)) for name, ms in found.items()}
