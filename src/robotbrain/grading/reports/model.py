"""A graded class as the reports read it: from ``results.json``, whatever may have been written into it."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robotbrain.errors import InputError
from robotbrain.grading.marks import Mark, Marks
from robotbrain.grading.results import TestResult, Verdict
from robotbrain.grading.sandbox.layers import warning_of

_LONGEST = 4000  # characters of one field of a test


@dataclass(frozen=True)
class GradedClass:
    """All students of a lab, in the order of the file."""

    lab: str
    rows: tuple[Marks, ...]


def outcomes_of(mark: Mark) -> list[TestResult]:
    """The tests of ``mark``, fit to be shown: a hidden one has no more than name, verdict, points and hint.

    Entries that are none (a forged report may hold anything) are left out.
    """
    return [_outcome(test) for test in mark.tests if isinstance(test, Mapping)]


def _outcome(test: Mapping[str, Any]) -> TestResult:
    hidden = test.get("hidden") is not False  # only what says that it may be shown is shown
    shown = ["hint_key", "hint", "reread"]
    if not hidden:
        shown += ["message", "given", "expected", "got", "misconception", "printed"]
    try:
        verdict = Verdict(str(test.get("verdict")))
    except ValueError:
        verdict = Verdict.ERROR
    words: dict[str, Any] = {key: _text(test.get(key)) for key in shown}
    return TestResult(
        exercise=_text(test.get("exercise")),
        name=_text(test.get("name"))[:200],
        verdict=verdict,
        points=_number(test.get("points")) or 0.0,
        earned=_number(test.get("earned")) or 0.0,
        hidden=hidden,
        **words,
    )


def read_results(path: Path) -> GradedClass:
    """Read a ``results.json`` of ``robotbrain grade-class``; raises :class:`InputError` if it is none."""
    try:
        return graded_class(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError, AttributeError, KeyError, TypeError) as error:
        raise InputError(
            str(path),
            given=f"{type(error).__name__}: {error}",
            expected="the results.json of a graded class",
            fix="Run `robotbrain grade-class LAB` first.",
        ) from None


def graded_class(stored: Mapping[str, Any]) -> GradedClass:
    """The class in the form of ``ClassResult.to_dict()``."""
    return GradedClass(str(stored["lab"]), tuple(marks_from(entry) for entry in stored["students"]))


def marks_from(entry: Mapping[str, Any]) -> Marks:
    """The inverse of :meth:`Marks.to_dict`."""
    layers, student = entry.get("layers"), str(entry["student"])
    if student in ("", ".", "..") or any(c in student for c in "/\\\0"):
        raise InputError("student", given=student, expected="the name of a folder", fix="Who wrote this results.json?")
    return Marks(
        student=student,
        marks=[_mark(exercise) for exercise in entry["exercises"]],
        incidents=[_text(i) for i in entry.get("incidents", [])],
        seconds=_number(entry.get("seconds")) or 0.0,
        cached=bool(entry.get("cached")),
        layers=None if layers is None else [_text(layer) for layer in layers],
    )


def _mark(exercise: Mapping[str, Any]) -> Mark:
    return Mark(
        grade_id=_text(exercise["grade_id"]),
        exercise=_text(exercise["exercise"]),
        points=_number(exercise["points"]) or 0.0,
        earned=_number(exercise["earned"]),
        tests=[t for t in exercise.get("tests", []) if isinstance(t, dict)],
        substituted=[_text(s) for s in exercise.get("substituted", [])],
        error=_text(exercise.get("error", "")),
    )


def unprotected(row: Marks) -> str:
    """What was missing of the sandbox when this submission ran, in words; "" where nothing was, or nothing is known."""
    return "" if row.layers is None else warning_of(row.layers)


def ran(row: Marks) -> bool:
    """Whether there was something to test: points were earned, or most tests met code that was written."""
    verdicts = [o.verdict for mark in row.marks for o in outcomes_of(mark)]
    if not verdicts:
        return row.earned > 0 or any(mark.error for mark in row.marks)
    return row.earned > 0 or verdicts.count(Verdict.NOT_WRITTEN) < 0.5 * len(verdicts)


def worths(rows: Sequence[Marks]) -> dict[str, float]:
    """Points of each exercise, in order of appearance."""
    return {mark.exercise: mark.points for row in rows for mark in row.marks}


def _text(value: object) -> str:
    text = value if isinstance(value, str) else "" if value is None else str(value)
    return text if len(text) <= _LONGEST else text[:_LONGEST] + "…"


def _number(value: object) -> float | None:
    """A finite number, else None."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return float(value)
