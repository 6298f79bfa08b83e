"""Runs the tests of one exercise against a student's objects and says how each ended."""

from __future__ import annotations

import builtins
import linecache
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import Any

from robotbrain.grading.expect import CannotCrossError, CheckFailure, readable, show
from robotbrain.grading.limits import EndedFromOutsideError, TimeLimitError, time_limit
from robotbrain.grading.quiet import BoundedText, quiet, seeded
from robotbrain.grading.results import TestResult, Verdict
from robotbrain.grading.student import Student
from robotbrain.grading.suite import Suite, Test

TIME_SCALE_VARIABLE = "ROBOTBRAIN_TIME_SCALE"


class _BrokenTestError(Exception):
    """The test, not the student, is at fault."""


@dataclass
class Interruption:
    """Set once the whole cell was interrupted: the tests that remain do not start."""

    happened: bool = False


@dataclass
class Outcome:
    """How one test ended.

    Attributes:
        fraction: of the test's points.
        failure: what the test raised, where it found a mistake.
    """

    verdict: Verdict
    fraction: float = 0.0
    message: str = ""
    failure: CheckFailure | None = None


@dataclass(frozen=True)
class Place:
    """Where in the notebook's code an exception arose: ``function``, its ``line`` and that line's ``text``."""

    function: str
    line: int
    text: str


def time_scale() -> float:
    """Factor on every test's time limit, from ``ROBOTBRAIN_TIME_SCALE``; at least 1, for graders may be slow."""
    try:
        return max(1.0, float(os.environ.get(TIME_SCALE_VARIABLE, "1")))
    except ValueError:
        return 1.0


def run_test(
    test: Test, suite: Suite, student: Student, namespace: Mapping[str, Any], interruption: Interruption
) -> TestResult:
    """Run one test in this process; whatever the student's code does short of ending it becomes a result."""
    if interruption.happened:
        return result_of(test, suite, Outcome(Verdict.TIMEOUT, message="not run: the time for this cell was used up"))
    limit = test.time_limit_s * time_scale()
    output = BoundedText()
    start = time.perf_counter()
    with quiet(output), seeded(suite.name, test.name):
        outcome = _judge_here(test, student, namespace, limit, interruption)
    return result_of(test, suite, outcome, output.getvalue(), time.perf_counter() - start)


def _judge_here(
    test: Test, student: Student, namespace: Mapping[str, Any], limit: float, interruption: Interruption
) -> Outcome:
    try:
        with time_limit(limit):
            return judge(test, student, lambda error: _last_student_place(error.__traceback__, namespace))
    except TimeLimitError:
        return timed_out(limit)
    except KeyboardInterrupt:
        if os.environ.get("NBGRADER_EXECUTION") != "autograde":
            raise  # a person pressed stop
        interruption.happened = True
        return Outcome(Verdict.TIMEOUT, message="was running when the time for this cell was used up")


def timed_out(limit: float) -> Outcome:
    """The outcome of a test that took longer than ``limit`` (s)."""
    return Outcome(Verdict.TIMEOUT, message=f"did not finish in {limit:g} s: is there a loop that never ends?")


def judge(test: Test, student: Student, place_of: Callable[[BaseException], Place | None]) -> Outcome:
    """Call a test and say how it ended.

    Only what ends a test from outside (a time limit, a keyboard interrupt, the end of the student's process) is raised.

    Args:
        place_of: where in the notebook's code an exception arose, if it arose there.
    """
    try:
        return _from_return(test.function(student))
    except (EndedFromOutsideError, KeyboardInterrupt):
        raise
    except CheckFailure as failure:
        return Outcome(Verdict.FAILED, min(1.0, max(0.0, failure.credit)), failure.message, failure)
    except MemoryError:
        return Outcome(Verdict.MEMORY, message="needed more memory than there is")
    except NotImplementedError as error:
        place = None if test.hidden else place_of(error)
        return Outcome(Verdict.NOT_WRITTEN, message=f"{place.function if place else 'this part'} is not written yet")
    except BaseException as error:
        return _from_exception(error, place_of(error), hidden=test.hidden)


def _from_return(answer: Any) -> Outcome:
    if answer is None:
        return Outcome(Verdict.PASSED, 1.0)
    try:
        fraction = float(answer)
    except (TypeError, ValueError):
        fraction = float("nan")
    if not 0.0 <= fraction <= 1.0:
        raise _BrokenTestError(f"it returned {show(answer)}, not a fraction in [0, 1]")
    if fraction > 1.0 - 1e-9:
        return Outcome(Verdict.PASSED, 1.0)
    return Outcome(Verdict.FAILED, fraction, f"{fraction:.0%} of this test is fulfilled")


def _from_exception(error: BaseException, place: Place | None, *, hidden: bool) -> Outcome:
    if isinstance(error, SystemExit):
        return Outcome(Verdict.ERROR, message="your code called exit(); return a value instead")
    # All that a hidden test says of it is the builtin type: names, texts and lines of the student's choice could
    # carry out what the test passed in.
    name = builtin_name(error) if hidden else str(getattr(error, "type_name", "") or type(error).__name__)
    try:
        said = " ".join(str(error).split())
    except Exception:
        said = ""
    detail = "" if hidden or not said else f": {show(said, 200)}"
    if isinstance(error, (_BrokenTestError, CannotCrossError)):
        return Outcome(Verdict.ERROR, message=f"this test is broken, please tell the course staff{detail}")
    if place is None:
        return Outcome(Verdict.ERROR, message=f"the test could not use what your code gave it ({name}{detail})")
    if hidden:
        return Outcome(Verdict.ERROR, message=f"your code raised {name}")
    where = f"line {place.line} of {place.function}" if place.function != "<module>" else f"line {place.line}"
    line = f"\n    {place.text}" if place.text else ""
    return Outcome(Verdict.ERROR, message=f"your code raised {name} in {where}{detail}{line}")


def builtin_name(error: BaseException) -> str:
    """The builtin exception that ``error`` is, or ``"an exception"``."""
    kinds = (kind.__name__ for kind in type(error).__mro__ if getattr(builtins, kind.__name__, None) is kind)
    name = next(kinds, "Exception")
    return "an exception" if name in ("Exception", "BaseException") else name


def _last_student_place(trace: TracebackType | None, namespace: Mapping[str, Any]) -> Place | None:
    """The innermost frame whose code was defined in the notebook."""
    found = None
    while trace is not None:
        frame = trace.tb_frame
        if frame.f_globals is namespace:
            code, line = frame.f_code, trace.tb_lineno
            found = Place(code.co_name, line, linecache.getline(code.co_filename, line, frame.f_globals).strip())
        trace = trace.tb_next
    return found


def result_of(test: Test, suite: Suite, outcome: Outcome, printed: str = "", seconds: float = 0.0) -> TestResult:
    """What a report shows of an outcome; of a hidden test as little as helps."""
    passed = outcome.verdict is Verdict.PASSED
    failure = outcome.failure
    silent = passed or outcome.verdict is Verdict.NOT_WRITTEN  # a hint is for those who tried
    key = "" if silent else (failure.hint if failure and failure.hint else test.hint)
    message = test.success if passed else readable(outcome.message)
    shown: dict[str, str] = {}
    if test.hidden:
        if not passed and outcome.verdict is Verdict.FAILED:
            message = "a hidden test found a mistake"
    elif not passed:
        shown["printed"] = readable(printed)
        if failure:
            shown |= {
                "given": readable(failure.given),
                "expected": readable(failure.expected),
                "got": readable(failure.got),
                "misconception": failure.misconception,
            }
    return TestResult(
        exercise=test.exercise,
        name=test.name,
        points=test.points,
        earned=test.points * outcome.fraction,
        verdict=outcome.verdict,
        message=message,
        hint_key=key,
        hint=suite.hint_text(key),
        reread="" if passed else test.reread,
        hidden=test.hidden,
        seconds=seconds,
        **shown,
    )
