"""Runs the tests of one exercise against a student's objects and says how each ended."""

from __future__ import annotations

import builtins
import contextlib
import io
import linecache
import os
import random
import sys
import time
import traceback
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any

from robotbrain.grading import journal
from robotbrain.grading.expect import CheckFailure, show
from robotbrain.grading.limits import TimeLimitError, time_limit
from robotbrain.grading.results import TestResult, Verdict
from robotbrain.grading.student import Student
from robotbrain.grading.suite import Suite, Test

TIME_SCALE_VARIABLE = "ROBOTBRAIN_TIME_SCALE"
_KEPT_OUTPUT = 2_000  # characters of a test's prints that a report may show


class _BrokenTestError(Exception):
    """The test, not the student, is at fault."""


@dataclass
class Interruption:
    """Set once the whole cell was interrupted: the tests that remain do not start."""

    happened: bool = False


@dataclass
class _Outcome:
    verdict: Verdict
    fraction: float = 0.0
    message: str = ""
    failure: CheckFailure | None = None
    fields: dict[str, str] = field(default_factory=dict)


def time_scale() -> float:
    """Factor on every test's time limit, from ``ROBOTBRAIN_TIME_SCALE``; at least 1, for graders may be slow."""
    try:
        return max(1.0, float(os.environ.get(TIME_SCALE_VARIABLE, "1")))
    except ValueError:
        return 1.0


def run_test(
    test: Test, suite: Suite, student: Student, namespace: Mapping[str, Any], interruption: Interruption
) -> TestResult:
    """Run one test; whatever the student's code does short of ending the process becomes a result."""
    if journal.crashed_before(test.exercise, test.name):
        outcome = _Outcome(Verdict.CRASHED, message="your code ended the Python process during this test")
        return _result(test, suite, outcome, "", 0.0)
    if interruption.happened:
        outcome = _Outcome(Verdict.TIMEOUT, message="not run: the time for this cell was used up")
        return _result(test, suite, outcome, "", 0.0)
    journal.begun(test.exercise, test.name)
    limit = test.time_limit_s * time_scale()
    output = _BoundedText(_KEPT_OUTPUT)
    start = time.perf_counter()
    try:
        with _quiet(output), _seeded(suite.name, test.name):
            outcome = _judge(test, student, namespace, limit, interruption)
    finally:
        journal.ended(test.exercise, test.name)
    return _result(test, suite, outcome, output.getvalue(), time.perf_counter() - start)


def _judge(
    test: Test, student: Student, namespace: Mapping[str, Any], limit: float, interruption: Interruption
) -> _Outcome:
    try:
        with time_limit(limit):
            answer = test.function(student)
        return _from_return(answer)
    except CheckFailure as failure:
        fraction = min(1.0, max(0.0, failure.credit))
        return _Outcome(Verdict.FAILED, fraction, failure.message, failure)
    except TimeLimitError:
        return _Outcome(Verdict.TIMEOUT, message=f"did not finish in {limit:g} s: is there a loop that never ends?")
    except KeyboardInterrupt:
        if os.environ.get("NBGRADER_EXECUTION") != "autograde":
            raise  # a person pressed stop
        interruption.happened = True
        return _Outcome(Verdict.TIMEOUT, message="was running when the time for this cell was used up")
    except MemoryError:
        return _Outcome(Verdict.MEMORY, message="needed more memory than there is")
    except NotImplementedError as error:
        frame = _last_student_frame(error.__traceback__, namespace)
        return _Outcome(Verdict.NOT_WRITTEN, message=f"{frame.name if frame else 'this part'} is not written yet")
    except BaseException as error:
        return _from_exception(error, namespace, hidden=test.hidden)


def _from_return(answer: Any) -> _Outcome:
    if answer is None:
        return _Outcome(Verdict.PASSED, 1.0)
    try:
        fraction = float(answer)
    except (TypeError, ValueError):
        fraction = float("nan")
    if not 0.0 <= fraction <= 1.0:
        raise _BrokenTestError(f"it returned {show(answer)}, not a fraction in [0, 1]")
    if fraction > 1.0 - 1e-9:
        return _Outcome(Verdict.PASSED, 1.0)
    return _Outcome(Verdict.FAILED, fraction, f"{fraction:.0%} of this test is fulfilled")


def _from_exception(error: BaseException, namespace: Mapping[str, Any], *, hidden: bool) -> _Outcome:
    name = type(error).__name__
    if hidden and getattr(builtins, name, None) is not type(error):
        name = "an exception"  # a made-up class name could carry out what a hidden test passed in
    frame = _last_student_frame(error.__traceback__, namespace)
    try:
        said = " ".join(str(error).split())
    except Exception:
        said = ""
    detail = "" if hidden or not said else f": {show(said, 200)}"
    if isinstance(error, SystemExit):
        return _Outcome(Verdict.ERROR, message="your code called exit(); return a value instead")
    if isinstance(error, _BrokenTestError):
        return _Outcome(Verdict.ERROR, message=f"this test is broken, please tell the course staff{detail}")
    if frame is None:
        return _Outcome(Verdict.ERROR, message=f"the test could not use what your code gave it ({name}{detail})")
    where = f"line {frame.lineno} of {frame.name}" if frame.name != "<module>" else f"line {frame.lineno}"
    line = "" if hidden or not frame.line else f"\n    {frame.line}"
    return _Outcome(Verdict.ERROR, message=f"your code raised {name} in {where}{detail}{line}")


def _last_student_frame(trace: TracebackType | None, namespace: Mapping[str, Any]) -> traceback.FrameSummary | None:
    """The innermost frame whose code was defined in the notebook."""
    found = None
    while trace is not None:
        frame = trace.tb_frame
        if frame.f_globals is namespace:
            code, line = frame.f_code, trace.tb_lineno
            text = linecache.getline(code.co_filename, line, frame.f_globals).strip()
            found = traceback.FrameSummary(code.co_filename, line, code.co_name, lookup_line=False, line=text)
        trace = trace.tb_next
    return found


def _result(test: Test, suite: Suite, outcome: _Outcome, printed: str, seconds: float) -> TestResult:
    passed = outcome.verdict is Verdict.PASSED
    failure = outcome.failure
    silent = passed or outcome.verdict is Verdict.NOT_WRITTEN  # a hint is for those who tried
    key = "" if silent else (failure.hint if failure and failure.hint else test.hint)
    message = test.success if passed else outcome.message
    shown: dict[str, str] = {}
    if test.hidden:
        if not passed and outcome.verdict is Verdict.FAILED:
            message = "a hidden test found a mistake"
    elif not passed:
        shown["printed"] = printed
        if failure:
            shown |= {
                "given": failure.given,
                "expected": failure.expected,
                "got": failure.got,
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


class _BoundedText(io.StringIO):
    """Keeps the first ``limit`` characters and forgets the rest, so that printing for ever costs no memory."""

    def __init__(self, limit: int) -> None:
        super().__init__()
        self._left = limit

    def write(self, text: str) -> int:
        if self._left > 0:
            super().write(text[: self._left])
            self._left -= len(text)
            if self._left <= 0:
                super().write("…")
        return len(text)


@contextlib.contextmanager
def _quiet(output: io.StringIO) -> Iterator[None]:
    """Keep prints and warnings of the student's code out of the cell: they are no mistakes."""
    with (
        contextlib.redirect_stdout(output),
        contextlib.redirect_stderr(output),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")
        yield


@contextlib.contextmanager
def _seeded(*labels: str) -> Iterator[None]:
    """Give global random generators a fixed state, so that a check repeats exactly, and put the old one back."""
    seed = sum(ord(c) * (i + 1) for i, c in enumerate("/".join(labels))) % 2**32
    numpy = sys.modules.get("numpy")  # not imported here: a lab without numpy stays without
    python_state = random.getstate()
    numpy_state = numpy.random.get_state() if numpy else None
    random.seed(seed)
    if numpy:
        numpy.random.seed(seed)
    try:
        yield
    finally:
        random.setstate(python_state)
        if numpy:
            numpy.random.set_state(numpy_state)
