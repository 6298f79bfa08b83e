"""Checks of the lesson `09_monitoring`. Nothing here is graded: an answer that is still open is no mistake."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from robotbrain.grading import Suite, expect, fail
from robotbrain.grading.suites.lesson_tools import answered, equals

suite = Suite("lesson_09")

suite.exercise("late", title="1 Late", points=3, provides=("late",))
suite.exercise("little", title="2 How long did it wait?", points=2, provides=("mean_wait_ms",))
suite.exercise("psi", title="3 Has the world changed?", points=3, provides=("psi",))
suite.exercise("amdahl", title="4 How much can it bring?", points=2, provides=("after_ms",))
suite.exercise("instruments", title="5 Which instrument?", points=1, provides=("instruments",))

_HINTS = {
    "on-time-is-in-time": "A call exactly on the deadline is in time: compare with >, not >=.",
    "share-not-count": "A share is a number from 0 to 1: divide by the number of calls.",
    "not-the-mean": "The 99th percentile is np.percentile(times, 99); neither the mean nor the largest value.",
    "unknown-is-not-zero": "Without data the answer is unknown: float('nan'), not 0, and no exception.",
    "wait-is-depth-over-rate": "From L = λ W follows W = L / λ.",
    "milliseconds": "Depth over messages per second gives seconds; a second has 1000 ms.",
    "counts-to-shares": "Divide the counts by their sum first: twice as many images of the same world are no change.",
    "natural-logarithm": "ln is the natural logarithm: np.log.",
    "both-factors": "Each term is (q - p) times ln(q / p), so it is never negative.",
    "floor-the-shares": "Raise every share to at least 1e-4 before the logarithm: np.maximum(share, 1e-4).",
    "rest-stays": "Only the part gets faster; the rest, total - part, stays as it is.",
    "factor-divides": "`factor` times as fast means that the part takes part / factor.",
    "infinitely-fast": "Infinitely fast, the part takes nothing: what is left is the rest.",
    "age-not-latency": "Every callback is fast, so neither latency nor response shows it: the measurement is old.",
    "queues-eat-memory": "What grows without end is a queue without a limit.",
    "averages-hide-jitter": "The rate is right on average; what varies is the time between calls.",
    "heat-throttles": "A module that gets too hot lowers its clocks, and says so.",
    "classes-drift": "The network sees other classes than before: compare the shares of the classes.",
    "waiting-counts": "The function is quick; it waits for its thread. Response time includes the wait.",
}
for _key, _text in _HINTS.items():
    suite.hint(_key, _text)


# ---------------------------------------------------------------- 1


def _pair(student: Any, times: Any, deadline: float) -> tuple[Any, Any]:
    got = answered(student.late(times, deadline), "late")
    if not (isinstance(got, tuple | list | np.ndarray) and len(got) == 2):
        fail("`late` should return two numbers: the share of late calls, and the 99th percentile", got=got)
    return got[0], got[1]


@suite.test("late", points=2, name="calls counted by hand", reread="Why not the average")
def _late_counted(student: Any) -> None:
    for times, deadline in (([10.0, 50.0, 51.0, 90.0], 50.0), ([5.0] * 8 + [200.0] * 2, 100.0), ([3.0], 5.0)):
        share, p99 = _pair(student, np.array(times), deadline)
        right = sum(t > deadline for t in times) / len(times)
        if not equals(share, right):
            hint = "share-not-count" if equals(share, right * len(times)) else ""
            if equals(share, sum(t >= deadline for t in times) / len(times)):
                hint = "on-time-is-in-time"
            fail(f"of {times} ms with a deadline of {deadline:g} ms the share {right:g} is late", got=share, hint=hint)
        wanted = float(np.percentile(times, 99))
        expect(equals(p99, wanted), f"the 99th percentile of {times} is {wanted:g} ms, not {p99}", hint="not-the-mean")


@suite.test("late", points=1, name="no calls at all", reread="Exercise 1, last sentence")
def _late_empty(student: Any) -> None:
    share, p99 = _pair(student, np.array([]), 50.0)
    expect(
        equals(share, math.nan) and equals(p99, math.nan),
        "without any calls both numbers are unknown",
        got=(share, p99),
        hint="unknown-is-not-zero",
    )


# ---------------------------------------------------------------- 2


@suite.test("little", points=1, name="queues worked out by hand", reread="Queues")
def _little(student: Any) -> None:
    for depth, rate in ((2.0, 10.0), (0.5, 50.0), (5.4, 49.9)):
        got = answered(student.mean_wait_ms(depth, rate), "mean_wait_ms")
        right = 1000 * depth / rate
        if equals(got, right):
            continue
        hint = "milliseconds" if equals(got, right / 1000) else "wait-is-depth-over-rate"
        fail(f"{depth:g} messages on average at {rate:g} a second wait {right:g} ms", got=got, hint=hint)


@suite.test("little", points=1, name="a queue that nothing passes through", reread="Exercise 2")
def _little_zero(student: Any) -> None:
    got = answered(student.mean_wait_ms(3.0, 0.0), "mean_wait_ms")
    expect(equals(got, math.nan), "at a rate of 0 there is no waiting time", got=got, hint="unknown-is-not-zero")


# ---------------------------------------------------------------- 3


def _psi(before: Any, now: Any, floor: float = 1e-4) -> float:
    p = np.maximum(np.asarray(before, float) / np.sum(before), floor)
    q = np.maximum(np.asarray(now, float) / np.sum(now), floor)
    return float(((q - p) * np.log(q / p)).sum())


@suite.test("psi", points=2, name="classes that shifted", reread="Is the model still right?")
def _psi_values(student: Any) -> None:
    rng = student.rng("psi")
    cases = [([50, 30, 20], [50, 30, 20]), ([50, 30, 20], [100, 60, 40]), ([50, 30, 20], [20, 30, 50])]
    cases += [(rng.integers(1, 900, 4).tolist(), rng.integers(1, 900, 4).tolist()) for _ in range(4)]
    for before, now in cases:
        got = answered(student.psi(before, now), "psi")
        right = _psi(before, now)
        if equals(got, right):
            continue
        hint = "both-factors"
        if sum(before) != sum(now):
            hint = "counts-to-shares"
        if isinstance(got, float) and right and math.isclose(got * math.log(2), right, rel_tol=1e-6):
            hint = "natural-logarithm"
        if isinstance(got, float) and right and math.isclose(got * math.log(10), right, rel_tol=1e-6):
            hint = "natural-logarithm"
        fail(f"the index of {before} and {now} is {right:.4f}", got=got, hint=hint)


@suite.test("psi", points=1, name="a class that was never seen", reread="Exercise 3")
def _psi_floor(student: Any) -> None:
    for before, now in (([90, 10, 0], [80, 10, 10]), ([0, 50, 50], [0, 60, 40])):
        got = answered(student.psi(before, now), "psi")
        right = _psi(before, now)
        expect(equals(got, right), f"the index of {before} and {now} is {right:.4f}", got=got, hint="floor-the-shares")


# ---------------------------------------------------------------- 4


@suite.test("amdahl", points=1, name="chains worked out by hand", reread="Exercise 4")
def _amdahl(student: Any) -> None:
    for total, part, factor in ((100.0, 50.0, 2.0), (280.0, 20.0, 4.0), (60.0, 60.0, 3.0)):
        got = answered(student.after_ms(total, part, factor), "after_ms")
        right = total - part + part / factor
        if equals(got, right):
            continue
        hint = "factor-divides" if equals(got, total - part + part * factor) else "rest-stays"
        fail(f"of {total:g} ms, {part:g} ms made {factor:g} times as fast leave {right:g} ms", got=got, hint=hint)


@suite.test("amdahl", points=1, name="at most", reread="Exercise 4")
def _amdahl_limit(student: Any) -> None:
    got = answered(student["best_ms"], "best_ms")
    expect(equals(got, 260.0), "a chain of 280 ms whose part of 20 ms vanishes", got=got, hint="infinitely-fast")


# ---------------------------------------------------------------- 5

_RIGHT = {
    "each callback is fast, but the robot reacts to where things were a second ago": (
        "end-to-end age",
        "age-not-latency",
    ),
    "memory grows until the process is killed": ("queue depth", "queues-eat-memory"),
    "the wheels twitch although the plan is smooth and the loop runs at 20 Hz on average": (
        "jitter",
        "averages-hide-jitter",
    ),
    "after ten minutes in the sun everything takes twice as long": ("throttling flag", "heat-throttles"),
    "since the lamps were changed it sees obstacles everywhere": ("class shares", "classes-drift"),
    "a callback of 1 ms misses its deadline of 50 ms": ("response time", "waiting-counts"),
}


@suite.test("instruments", points=1, name="the six complaints", reread="the sections of this lesson")
def _instruments(student: Any) -> None:
    answers = student["instruments"]
    expect(isinstance(answers, dict), "`instruments` should still be the dictionary of the cell", got=answers)
    if all(answers.get(line) is ... for line in _RIGHT):
        raise NotImplementedError("instruments")
    known = {instrument for instrument, _ in _RIGHT.values()}
    for line, (right, hint) in _RIGHT.items():
        got = answers.get(line)
        got = got.strip().lower() if isinstance(got, str) else got
        expect(got in known, f'for "{line}" choose one of: ' + ", ".join(sorted(known)), got=got)
        expect(got == right, f'"{line}": {got} does not show it most directly', hint=hint)
