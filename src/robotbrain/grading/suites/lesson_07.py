"""Checks of the lesson `07_perception_control`. Nothing here is graded: an answer that is still open is no mistake."""

from __future__ import annotations

import math
import numbers
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from robotbrain.grading import Suite, expect, expect_close, fail
from robotbrain.grading.suites.lesson_tools import answered

suite = Suite("lesson_07")

suite.exercise("pace", title="1 Pace", points=3, provides=("pace",))
suite.exercise("wakeup", title="2 When to wake up", points=3, provides=("next_wakeup",))
suite.exercise("stale", title="3 A guard", points=4, provides=("speed_scale",))
suite.exercise("worst", title="4 How old, at worst?", points=2, provides=("worst_age_ms",))
suite.exercise("queue", title="5 Which policy?", points=2, provides=("policy",))
suite.exercise("speed", title="6 How fast may it drive?", points=3, provides=("largest_speed",))

_HINTS = {
    "camera-is-the-limit": "No more images can come out than the camera takes: the period is at least the camera's.",
    "slowest-step": "Each step of a pipeline has a thread of its own and is free for the next image as soon as it is "
    "done: only the slowest one limits the rate.",
    "sum-of-steps": "In one loop the next image is begun when all steps of the last one are done: add the steps up.",
    "latency-is-the-sum": "A single image still passes every step, one after the other, in a pipeline too: latency is "
    "the sum of the steps.",
    "no-wait": "Latency begins when the image is taken, and this image never waits: the camera's period is no part.",
    "per-second": "1 / ms is a rate per millisecond; a second has 1000 of them.",
    "order-of-the-pair": "Return the rate first and the latency second.",
    "grid-not-now": "now + period makes every delay permanent: the loop drifts. Count whole periods from `due`.",
    "skip-missed": "due + period may lie in the past already. Missed calls are skipped: add as many whole periods as "
    "it takes not to lie before `now`.",
    "grid-through-due": "The grid goes through `due`, not through zero: count periods from `due`.",
    "not-too-far": "A time that is exactly `now` does not lie before it and is still good: round up, do not add one.",
    "after-due": "The next call comes after `due`: at least one period later, even if the call began at `due` itself.",
    "whole-nanoseconds": "Times since 1970 in ns do not fit a float. Stay with whole numbers: // rounds down, and "
    "-(-a // b) rounds up.",
    "both-parts": "The stamp is sec and nanosec together: stamp.sec * 10**9 + stamp.nanosec nanoseconds.",
    "seconds-and-nanoseconds": "Ages come out in nanoseconds, limits are in seconds: divide the age by 10**9.",
    "straight-line": "Between the limits the factor falls from 1 to 0: (max_s - age) / (max_s - fresh_s).",
    "between-0-and-1": "The line goes on beyond its ends: the factor is never above 1 and never below 0.",
    "nothing-yet": "None means that nothing has come yet: look for it first, and return 0.",
    "future": "A negative age is younger than fresh, but no good sign. Check for it before you compare with fresh_s.",
    "clock-tolerance": "Clocks never agree to the nanosecond: up to 5 ms in the future is as good as fresh.",
    "every-link-samples": "Each node has a timer of its own and can just have missed its input: every period counts.",
    "worst-not-mean": "Half a period is the mean wait. At worst it is a whole one.",
    "responses-count": "After a node has read its input it computes: add the response times.",
    "periods-count": "A node does not run when its input comes but when its timer says so: add the periods.",
    "read-the-table": "Look up rate, latency and peak age of the policy in the table and compare them with the task.",
    "needs-a-trigger": "Back-pressure means that an image is taken when the detector asks. A camera that runs freely "
    "cannot do that.",
    "nothing-may-be-lost": "Every image counts here: only one policy for a free-running camera loses none.",
    "latency-that-varies": "Here all results must be equally old: look for a latency whose smallest and largest value "
    "are the same.",
    "latency-counts": "The robot rolls on for the age of its data before it brakes: the answer depends on age_s.",
    "brakes-count": "Braking takes way, too: v * v / (2 a).",
    "half-v-squared": "The way of braking is v²/(2a), with the 2.",
    "positive-root": "The quadratic equation has two roots; take the positive one.",
    "seconds": "age_s is in seconds already.",
    "no-way-no-speed": "With no way free the speed is 0. Check for distance_m = 0 first: 0 / 0 is no number.",
}
for _key, _text in _HINTS.items():
    suite.hint(_key, _text)


def _number(value: Any, name: str) -> float:
    """Return a finite number that a student's function gave."""
    found = answered(value, name)
    if isinstance(found, bool) or not isinstance(found, numbers.Real) or not math.isfinite(found):
        fail(f"`{name}` should return a number", got=found)
    return float(found)


def _close(got: float, right: float) -> bool:
    return math.isclose(got, right, rel_tol=1e-6, abs_tol=1e-12)


def _judge(got: float, right: float, wrong: Sequence[tuple[float, str]], message: str) -> None:
    """Fail unless ``got`` is right, with the hint of the mistake that leads to it: (number, hint)."""
    if _close(got, right):
        return
    for value, hint in wrong:
        if not _close(value, right) and _close(got, value):
            fail(message, got=got, expected=right, hint=hint)
    fail(message, got=got, expected=right)


# ---------------------------------------------------------------- 1

_PACE_CASES: tuple[tuple[list[float], float], ...] = (
    ([20.0, 30.0, 10.0, 2.0], 100.0),
    ([20.0, 30.0, 10.0, 2.0], 40.0),
    ([20.0, 30.0, 10.0, 2.0], 25.0),
    ([7.0, 80.0, 13.0], 50.0),
)


def _pair(student: Any, steps: list[float], camera: float, pipelined: bool) -> tuple[float, float]:
    got = answered(student.pace(list(steps), camera, pipelined), "pace")
    if not isinstance(got, tuple | list) or len(got) != 2:
        fail("`pace` should return two numbers: images per second, latency in ms", got=got, hint="order-of-the-pair")
    return _number(got[0], "pace"), _number(got[1], "pace")


def _check_pace(student: Any, pipelined: bool) -> None:
    word = "pipelined" if pipelined else "sequential"
    for steps, camera in _PACE_CASES:
        rate, latency = _pair(student, steps, camera, pipelined)
        total, most = sum(steps), max(steps)
        own, other = (most, total) if pipelined else (total, most)
        right = 1000 / max(camera, own)
        given = f"steps of {', '.join(f'{ms:g}' for ms in steps)} ms, camera every {camera:g} ms, {word}"
        if _close(rate, total) and _close(latency, right):
            fail(f"{given}: the two numbers are the wrong way round", got=(rate, latency), hint="order-of-the-pair")
        confused = "slowest-step" if pipelined else "sum-of-steps"
        wrong = [
            (right / 1000, "per-second"),
            (1000 / own, "camera-is-the-limit"),
            (1000 / max(camera, other), confused),
            (1000 / other, confused),
            (1000 / max(camera, total / len(steps)), confused),
        ]
        _judge(rate, right, wrong, f"{given}: images per second")


def _check_latency(student: Any, pipelined: bool) -> None:
    for steps, camera in _PACE_CASES:
        _, latency = _pair(student, steps, camera, pipelined)
        total, most = sum(steps), max(steps)
        wrong = [
            (max(camera, total), "no-wait"),
            (most, "latency-is-the-sum"),
            (max(camera, most), "latency-is-the-sum"),
            (total / len(steps), "latency-is-the-sum"),
            (most * len(steps), "latency-is-the-sum"),
            (total + camera, "no-wait"),
            (total + camera / 2, "no-wait"),
        ]
        word = "a pipeline" if pipelined else "a loop"
        _judge(latency, total, wrong, f"latency (ms) of {word} with steps {steps} ms and a camera every {camera:g} ms")


@suite.test("pace", points=1, name="rate of a sequential brain", reread="Pipeline parallelisation")
def _pace_sequential(student: Any) -> None:
    _check_pace(student, False)


@suite.test("pace", points=1, name="rate of a pipelined brain", reread="Pipeline parallelisation")
def _pace_pipelined(student: Any) -> None:
    _check_pace(student, True)


@suite.test("pace", points=1, name="latency of both", reread="Pipeline parallelisation")
def _pace_latency(student: Any) -> None:
    _check_latency(student, False)
    _check_latency(student, True)


# ---------------------------------------------------------------- 2


_WAKEUP_MISTAKES: tuple[tuple[str, Callable[[int, int, int], int]], ...] = (
    ("skip-missed", lambda due, now, period: due + period),
    ("grid-not-now", lambda due, now, period: now + period),
    ("grid-not-now", lambda due, now, period: now),
    ("after-due", lambda due, now, period: due - (due - now) // period * period),
    ("not-too-far", lambda due, now, period: due + ((now - due) // period + 1) * period),
    ("grid-through-due", lambda due, now, period: (now // period + 1) * period),
    ("grid-through-due", lambda due, now, period: -(-now // period) * period),
)
"""Hints, and what an answer without that insight returns."""


def _check_wakeup(student: Any, cases: Sequence[tuple[int, int, int]]) -> None:
    answers = []
    for due, now, period in cases:
        got = answered(student.next_wakeup(due, now, period), "next_wakeup")
        if isinstance(got, bool) or not isinstance(got, numbers.Integral):
            kind = f"{got} ({type(got).__name__})"
            fail("`next_wakeup` should return a whole number of ns", got=kind, hint="whole-nanoseconds")
        answers.append(int(got))
    for got, (due, now, period) in zip(answers, cases, strict=True):
        right = due + max(1, -(-(now - due) // period)) * period
        if got == right:
            continue
        # A mistake is one that explains all answers, not just this one.
        found = [hint for hint, mistake in _WAKEUP_MISTAKES if answers == [mistake(*case) for case in cases]]
        if not found and abs(got - right) < 1000 < period:  # what a float rounds away
            found = ["whole-nanoseconds"]
        given = f"due {due}, now {now}, period {period}"
        fail("not the next time on the grid", given=given, got=got, expected=right, hint=found[0] if found else "")


@suite.test("wakeup", points=1, name="calls that begin in time", reread="Fixed frequencies")
def _wakeup_punctual(student: Any) -> None:
    _check_wakeup(student, [(103, 103, 20), (100, 110, 20), (100, 119, 20), (100, 120, 20)])


@suite.test("wakeup", points=1, name="calls that begin too late", reread="Fixed frequencies")
def _wakeup_late(student: Any) -> None:
    _check_wakeup(student, [(103, 146, 20), (103, 124, 20), (100, 140, 20), (100, 141, 20), (7, 1008, 20)])


@suite.test("wakeup", points=1, name="nanoseconds since 1970", reread="Fixed frequencies")
def _wakeup_epoch(student: Any) -> None:
    due, period = 1_760_000_000_123_456_789, 20_000_000
    _check_wakeup(student, [(due, due + late, period) for late in (0, 70_001, period, period + 1, 45_000_003)])


# ---------------------------------------------------------------- 3

_NOW = 12_300_000_000
_FRESH, _MAX = 0.2, 0.5


def _message(age_ms: float) -> Any:
    stamp = _NOW - round(age_ms * 1e6)
    return SimpleNamespace(
        header=SimpleNamespace(stamp=SimpleNamespace(sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id="base_link")
    )


def _scale(student: Any, age_ms: float, fresh: float = _FRESH, most: float = _MAX) -> float:
    return _number(student.speed_scale(_message(age_ms), _NOW, fresh, most), "speed_scale")


_AGES_MS = (0, 50, 150, 250, 290, 350, 420, 700, 1400, 3400)


def _scales(ages: Sequence[float], fresh: float, most: float) -> list[float]:
    return [min(1.0, max(0.0, (most - age) / (most - fresh))) for age in ages]


def _stale_mistakes(fresh: float, most: float) -> list[tuple[str, list[float]]]:
    """Return hints, and the factors for _AGES_MS without that insight."""
    ages = [age_ms / 1000 for age_ms in _AGES_MS]
    stamps = [_NOW - age_ms * 10**6 for age_ms in _AGES_MS]
    line = [(most - age) / (most - fresh) for age in ages]
    return [
        ("between-0-and-1", line),
        ("between-0-and-1", [min(1.0, value) for value in line]),
        ("between-0-and-1", [max(0.0, value) for value in line]),
        ("both-parts", _scales([(_NOW - stamp // 10**9 * 10**9) / 1e9 for stamp in stamps], fresh, most)),
        ("both-parts", _scales([(_NOW - stamp % 10**9) / 1e9 for stamp in stamps], fresh, most)),
        ("seconds-and-nanoseconds", _scales([age * 1e9 for age in ages], fresh, most)),
        ("seconds-and-nanoseconds", _scales([age * 1e3 for age in ages], fresh, most)),
        ("straight-line", [1 - value for value in _scales(ages, fresh, most)]),
        ("straight-line", [float(age < most) for age in ages]),
        ("straight-line", [float(age <= fresh) for age in ages]),
    ]


@suite.test("stale", points=2, name="fresh, ageing, stale", reread="Old news: time stamps and stale data")
def _stale_ages(student: Any) -> None:
    for fresh, most in ((_FRESH, _MAX), (0.1, 1.1)):
        answers = [_scale(student, age_ms, fresh, most) for age_ms in _AGES_MS]
        right = _scales([age_ms / 1000 for age_ms in _AGES_MS], fresh, most)
        for age_ms, got, expected in zip(_AGES_MS, answers, right, strict=True):
            if abs(got - expected) < 1e-6:
                continue
            # A mistake is one that explains all answers, not just this one.
            found = [hint for hint, values in _stale_mistakes(fresh, most) if np.allclose(answers, values, atol=1e-6)]
            fail(
                f"data {age_ms} ms old, fresh up to {fresh:g} s, too old from {most:g} s on",
                got=got,
                expected=round(expected, 6),
                hint=found[0] if found else "",
            )


@suite.test("stale", points=1, name="nothing has come yet", reread="Old news: time stamps and stale data")
def _stale_missing(student: Any) -> None:
    try:
        got = student.speed_scale(None, _NOW, _FRESH, _MAX)
    except NotImplementedError:
        raise
    except Exception as error:
        fail(f"without a message it raised {type(error).__name__}: {error}", hint="nothing-yet")
        raise
    expect(_number(got, "speed_scale") == 0, "without a message the robot may not drive", got=got, hint="nothing-yet")


@suite.test("stale", points=1, name="from the future", reread="Old news: time stamps and stale data")
def _stale_future(student: Any) -> None:
    for age_ms in (-20, -400):
        got = _scale(student, age_ms)
        expect(got == 0, f"stamped {-age_ms} ms in the future: its age means nothing", got=got, hint="future")
    for age_ms in (-1, -4):
        got = _scale(student, age_ms)
        hint = "between-0-and-1" if got > 1 else "clock-tolerance"
        expect(got == 1, f"stamped {-age_ms} ms in the future: as good as fresh", got=got, hint=hint)


# ---------------------------------------------------------------- 4


def _check_worst(student: Any, links: list[tuple[float, float]]) -> None:
    got = _number(student.worst_age_ms(list(links)), "worst_age_ms")
    periods, responses = (sum(values) for values in zip(*links, strict=True))
    wrong = [
        (links[0][0] + responses, "every-link-samples"),
        (max(period for period, _ in links) + responses, "every-link-samples"),
        (periods / 2 + responses, "worst-not-mean"),
        (periods, "responses-count"),
        (responses, "periods-count"),
    ]
    _judge(got, periods + responses, wrong, f"links of (period, response) {links} ms")


@suite.test("worst", points=1, name="three nodes", reread="Timers everywhere?")
def _worst_three(student: Any) -> None:
    _check_worst(student, [(100.0, 5.0), (50.0, 20.0), (20.0, 2.0)])
    _check_worst(student, [(33.0, 12.0)])


@suite.test("worst", points=1, name="chains of any length", reread="Timers everywhere?")
def _worst_any(student: Any) -> None:
    rng = student.rng("worst")
    for count in range(2, 7):
        periods = rng.integers(10, 200, count)
        links = [(float(period), float(rng.integers(1, period))) for period in periods]
        _check_worst(student, links)


# ---------------------------------------------------------------- 5

_PERIOD_NS, _SERVICE_NS = round(1e9 / 30), 45_000_000
_IMAGE_MB = 640 * 480 * 3 / 1e6


def _growing_mb(seconds: float) -> float:
    """Memory of what waits after so long, if nothing is thrown away, MB."""
    return seconds * (1e9 / _PERIOD_NS - 1e9 / _SERVICE_NS) * _IMAGE_MB


_FREE_RUNNING = ("keep_all", "keep_last", "drop_newest", "skip", "throttle")

_TASKS: dict[str, tuple[bool, Callable[[Any], bool], str]] = {
    # task: (camera has a trigger, what the policy's form must fulfil, hint)
    "avoid obstacles": (False, lambda f: f.peak_age_ms <= 125 and f.throughput_hz >= 20, "read-the-table"),
    "avoid obstacles faster": (True, lambda f: f.peak_age_ms <= 100, "read-the-table"),
    "inspect a weld": (False, lambda f: f.lost_share == 0 and _growing_mb(10) <= 100, "nothing-may-be-lost"),
    "track a ball": (False, lambda f: f.latency_ms == f.latency_max_ms < math.inf, "latency-that-varies"),
}


@suite.test("queue", points=2, name="the four tasks", reread="More frames than you can work off")
def _queue(student: Any) -> None:
    from robotbrain.pipeline.patterns.queues import QUEUE_POLICIES, queue_form

    answers = student["policy"]
    expect(isinstance(answers, dict), "`policy` should still be the dictionary of the cell", got=answers)
    if all(answers.get(task) is ... for task in _TASKS):
        raise NotImplementedError("policy")
    for task, (trigger, fulfils, hint) in _TASKS.items():
        got = answers.get(task)
        name = got.strip().lower() if isinstance(got, str) else got
        expect(name in QUEUE_POLICIES, f'for "{task}" choose one of {", ".join(QUEUE_POLICIES)}', got=got)
        if not trigger and name not in _FREE_RUNNING:
            fail(f'"{task}": {name} does not go with a camera that runs freely', hint="needs-a-trigger")
        form = queue_form(name, _PERIOD_NS, _SERVICE_NS)  # type: ignore[arg-type]  # looked up above
        words = f"{form.throughput_hz:.1f} results per second, latency up to {form.latency_max_ms:.0f} ms"
        words += f", peak age {form.peak_age_ms:.0f} ms, {100 * form.lost_share:.0f} % lost"
        expect(fulfils(form), f'"{task}": {name} gives {words}', hint=hint)


# ---------------------------------------------------------------- 6


def _check_speed(student: Any, age: float, distance: float, a_max: float) -> None:
    got = _number(student.largest_speed(age, distance, a_max), "largest_speed")

    def root(t: float, factor: float = 2.0) -> float:
        return 2 * distance / (t + math.sqrt(t * t + 2 * factor * distance / a_max / 2))

    right = root(age)
    wrong = [
        (math.sqrt(2 * a_max * distance), "latency-counts"),
        (distance / age if age else math.inf, "brakes-count"),
        (root(age, 4.0), "half-v-squared"),
        (root(age, 1.0), "half-v-squared"),
        (-a_max * age - math.sqrt((a_max * age) ** 2 + 2 * a_max * distance), "positive-root"),
        (root(age / 1000), "seconds"),
    ]
    message = f"data {age:g} s old, {distance:g} m free, brakes of {a_max:g} m/s²: the speed in m/s"
    _judge(got, right, wrong, message)


@suite.test("speed", points=2, name="ages, distances and brakes", reread="What latency costs: metres")
def _speed(student: Any) -> None:
    for age, distance, a_max in ((0.2, 1.0, 1.0), (0.5, 0.25, 1.0), (0.1, 2.0, 3.0), (1.0, 0.1, 0.5)):
        _check_speed(student, age, distance, a_max)
    rng = student.rng("speed")
    for age, distance, a_max in rng.uniform((0.01, 0.05, 0.3), (1.0, 5.0, 6.0), (10, 3)):
        _check_speed(student, float(age), float(distance), float(a_max))


@suite.test("speed", points=1, name="no way at all, and no age at all", reread="What latency costs: metres")
def _speed_limits(student: Any) -> None:
    for age in (0.3, 0.0):
        try:
            got = student.largest_speed(age, 0.0, 1.0)
        except ZeroDivisionError:
            got = math.nan
        got = float(answered(got, "largest_speed")) if isinstance(got, numbers.Real) else answered(got, "largest_speed")
        expect(got == 0, f"data {age:g} s old, nothing free: the speed is 0", got=got, hint="no-way-no-speed")
    expect_close(
        student.largest_speed(0.0, 2.0, 1.0), np.sqrt(4.0), what="with fresh data: the brakes alone, sqrt(2 a d)"
    )
