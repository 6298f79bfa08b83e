"""Checks, scores and class grading.

What a lab author uses: :class:`Suite`, :func:`expect`, :func:`expect_close`, :func:`fail`.
What a notebook uses: :class:`Lab`. Both import nothing heavy; nbgrader and Jupyter load only where they are used.
"""

from __future__ import annotations

from robotbrain.grading.expect import CheckFailure, expect, expect_close, fail, type_name
from robotbrain.grading.lab import Lab
from robotbrain.grading.report import Report, Score, ScoreError
from robotbrain.grading.results import TestResult, Verdict
from robotbrain.grading.student import Student
from robotbrain.grading.suite import Exercise, Suite, Test, load_hidden_suite, load_suite

__all__ = [
    "CheckFailure",
    "Exercise",
    "Lab",
    "Report",
    "Score",
    "ScoreError",
    "Student",
    "Suite",
    "Test",
    "TestResult",
    "Verdict",
    "expect",
    "expect_close",
    "fail",
    "load_hidden_suite",
    "load_suite",
    "type_name",
]
