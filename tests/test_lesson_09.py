"""The lesson on monitoring: it runs, what it says of its figures is so, and its checks know right from wrong."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robotbrain.grading import load_suite
from robotbrain.grading.suites import lesson_09
from tests import lessons
from tests.lessons import hints

CLAIMS = """
assert run.control_hz < 10 and response.mean() > 50
control = summary.callback("/controller", "timer", "_control")
assert 0.4 < control.latency.p50 < 0.8  # "half a millisecond"
assert control.misses > 0.5 * control.calls
assert 0.13 < 0.5 * 1e-3 * np.median(run.e2e_ms) < 0.155  # 14 cm at 0.5 m/s
assert queue.dropped == 0
assert abs(1000 * queue.mean_depth / wheels.rate_hz / wheels.queueing.mean - 1) < 0.05
assert diagnosis.bottleneck.kind.startswith("serial") and "own" in str(diagnosis.best.change)
assert abs(made.p50_ms / predicted.p50_ms - 1) < 0.1 and abs(made.fresh_hz / predicted.fresh_hz - 1) < 0.1
share = next(c.share for c in diagnosis.causes if c.name == "slow node /perception")
assert 0.2 < share < 0.3  # "about a quarter"
faster = next(p for p in diagnosis.proposals if "/camera/image 2 times faster on the CPU" in str(p.change))
assert 0.6 < faster.gain < 0.72  # "two thirds"
assert any("/perception/points" in str(p.change) and p.gain_ms < 0 for p in diagnosis.useless)
assert [a.active for a in monitor.alarms][:3] == [True] * 3
assert report.is_file() and perfetto.is_file() and accuracy.compared > 50
"""


class TestLesson(lessons.LessonTests):
    notebook = "09_monitoring.ipynb"
    exercises = "12345"
    figures = 6
    tables = 5
    claims = CLAIMS
    timeout = 240


# ---------------------------------------------------------------- the checks


check = partial(lessons.check, "lesson_09")


def late(times_ms: Any, deadline_ms: float) -> Any:
    times = np.asarray(times_ms, float)
    if not len(times):
        return math.nan, math.nan
    return float((times > deadline_ms).mean()), float(np.percentile(times, 99))


def mean_wait_ms(depth: float, rate: float) -> float:
    return 1000 * depth / rate if rate else math.nan


def psi(before: Any, now: Any, floor: float = 1e-4, shares: bool = True, log: Any = math.log) -> float:
    total = 0.0
    for was, seen in zip(before, now, strict=True):
        p, q = (was / sum(before), seen / sum(now)) if shares else (was, seen)
        p, q = max(p, floor), max(q, floor)
        total += (q - p) * log(q / p)
    return total


def after_ms(total: float, part: float, factor: float) -> float:
    return total - part * (1 - 1 / factor)


INSTRUMENTS = {line: right for line, (right, _) in lesson_09._RIGHT.items()}


def test_right_answers_pass() -> None:
    assert check("late", late=late).full
    assert check("late", late=lambda t, d: np.array(late(t, d))).full
    assert check("little", mean_wait_ms=mean_wait_ms).full
    assert check("psi", psi=psi).full
    assert check("amdahl", after_ms=after_ms, best_ms=260).full
    assert check("instruments", instruments=INSTRUMENTS).full


def _late(share: Any = None, p99: Any = None, empty: float = math.nan) -> Any:
    def answer(times: Any, deadline: float) -> Any:
        if not len(times):
            return empty, empty
        return share(times, deadline) if share else late(times, deadline)[0], p99(times) if p99 else late(times, 1)[1]

    return answer


@pytest.mark.parametrize(
    ("exercise", "answers", "hint"),
    [
        ("late", {"late": _late(share=lambda t, d: float((t >= d).mean()))}, "on-time-is-in-time"),
        ("late", {"late": _late(share=lambda t, d: int((t > d).sum()))}, "share-not-count"),
        ("late", {"late": _late(p99=np.mean)}, "not-the-mean"),
        ("late", {"late": _late(p99=np.max)}, "not-the-mean"),
        ("late", {"late": _late(empty=0.0)}, "unknown-is-not-zero"),
        ("little", {"mean_wait_ms": lambda n, r: n / r if r else math.nan}, "milliseconds"),
        ("little", {"mean_wait_ms": lambda n, r: n * r * 1000 if r else math.nan}, "wait-is-depth-over-rate"),
        ("little", {"mean_wait_ms": lambda n, r: 1000 * n / r if r else 0.0}, "unknown-is-not-zero"),
        ("psi", {"psi": lambda p, q: psi(p, q, shares=False)}, "counts-to-shares"),
        ("psi", {"psi": lambda p, q: psi(p, q, log=math.log2)}, "natural-logarithm"),
        ("psi", {"psi": lambda p, q: psi(p, q, log=math.log10)}, "natural-logarithm"),
        ("psi", {"psi": lambda p, q: psi(p, q, log=lambda r: -math.log(r))}, "both-factors"),
        ("psi", {"psi": lambda p, q: psi(p, q, floor=1e-2)}, "floor-the-shares"),
        ("amdahl", {"after_ms": lambda t, p, f: t / f, "best_ms": 260}, "rest-stays"),
        ("amdahl", {"after_ms": lambda t, p, f: t - p + p * f, "best_ms": 260}, "factor-divides"),
        ("amdahl", {"after_ms": after_ms, "best_ms": 0}, "infinitely-fast"),
    ],
)
def test_wrong_answers_get_their_hint(exercise: str, answers: dict[str, Any], hint: str) -> None:
    report = check(exercise, **answers)
    assert not report.full and hint in hints(report), (hints(report), report)


@pytest.mark.parametrize("line", list(INSTRUMENTS))
def test_each_instrument_is_asked_for(line: str) -> None:
    other = "jitter" if INSTRUMENTS[line] != "jitter" else "queue depth"
    report = check("instruments", instruments={**INSTRUMENTS, line: other})
    assert hints(report) == {lesson_09._RIGHT[line][1]}


@pytest.mark.parametrize("value", [None, "85", [85], True, print])
def test_nonsense_gets_an_answer_and_no_points(value: Any) -> None:
    for exercise, entry in load_suite("lesson_09").exercises.items():
        assert not check(exercise, **{entry.provides[0]: value}).full
        assert not check(exercise, **{entry.provides[0]: lambda *_: value}).full


def test_every_hint_is_of_use() -> None:
    source = Path(lesson_09.__file__).read_text(encoding="utf-8")
    for key in load_suite("lesson_09").hints:
        assert source.count(f'"{key}"') >= 2, key
