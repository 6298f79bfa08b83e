"""What a notebook holds: ``lab = Lab("lab_integration")``, then ``lab.check("astar")`` and ``lab.score("astar")``."""

from __future__ import annotations

import contextlib
import functools
import os
import sys
from collections.abc import Iterator, MutableMapping, Sequence
from typing import Any

from robotbrain.grading import runner
from robotbrain.grading.forbidden import why_exercise_forbidden
from robotbrain.grading.report import Report, Score, ScoreError
from robotbrain.grading.results import TestResult
from robotbrain.grading.runs import Runs
from robotbrain.grading.state import state_of
from robotbrain.grading.student import Student
from robotbrain.grading.suite import Suite, Test, load_suite

VALIDATING_VARIABLE = "NBGRADER_VALIDATING"  # set by nbgrader while its Validate button runs the notebook


class Lab:
    """Checks and scores the exercises of one lab in the notebook that made it.

    Args:
        name: the lab's name, e.g. ``"lab_integration"``.
        namespace: the student's variables; default: the globals of the caller, that is the notebook's.
        suite: its tests; default: the installed suite called ``name``.
    """

    def __init__(
        self, name: str, namespace: MutableMapping[str, Any] | None = None, suite: Suite | None = None
    ) -> None:
        self.name = name
        self._namespace = sys._getframe(1).f_globals if namespace is None else namespace
        if suite is not None:
            suite.validate(complete=False)
        elif not _is_graded():  # a name that is not known is said at once; a graded notebook may not need the tests
            suite = load_suite(name)
        self._suite = suite
        self._world = _Notebook(self._namespace)

    @functools.cached_property
    def _runs(self) -> Runs:
        return Runs(self._suite or load_suite(self.name), self._world)

    def check(self, exercise: str) -> Report | Notice:
        """Run the visible tests of ``exercise`` now and return the report.

        While a submission is graded nothing runs: the score that follows has the same tests.
        """
        if _is_graded():
            return Notice(f"{exercise}: the score below tells.")
        with self._world.interruptions():
            return self._runs.report(exercise, hidden=False, fresh=True)

    def score(self, exercise: str, hidden: bool = False) -> Score:
        """Return the points of ``exercise`` as a :class:`Score`, which nbgrader reads as partial credit.

        Args:
            exercise: its name.
            hidden: also run the hidden tests. Without them the visible tests are scaled to the exercise's points.

        Raises:
            ScoreError: only under nbgrader's Validate, when points are missing: its message is the report.
            InputError: unknown exercise, or hidden tests asked for where there are none.
        """
        with self._world.interruptions():
            report = self._runs.report(exercise, hidden=hidden)
        if os.environ.get(VALIDATING_VARIABLE) and not report.full:
            raise ScoreError(report)
        return Score(report)


def _is_graded() -> bool:
    return os.environ.get("NBGRADER_EXECUTION") == "autograde"


class Notice:
    """A sentence that a cell shows in place of a report."""

    def __init__(self, text: str) -> None:
        self.text = text

    def __repr__(self) -> str:
        return self.text


class _Notebook:
    """The world in which tests run in the student's own process: a :class:`robotbrain.grading.runs.World`."""

    def __init__(self, namespace: MutableMapping[str, Any]) -> None:
        self._namespace = namespace
        self._interruption = runner.Interruption()
        self._interrupted_cell: object = None

    @contextlib.contextmanager
    def interruptions(self) -> Iterator[None]:
        """A cell that was interrupted runs no further tests; the next cell does."""
        cell = _current_cell()
        if cell is None or cell != self._interrupted_cell:
            self._interruption.happened = False
        yield
        if self._interruption.happened:
            self._interrupted_cell = cell

    def cell(self) -> object:
        return _current_cell()

    def state(self) -> dict[str, Any]:
        return state_of(self._namespace)

    @contextlib.contextmanager
    def substituting(self, suite: Suite, names: Sequence[str]) -> Iterator[None]:
        """Put references into the notebook's globals for a while, so that the student's functions call them."""
        absent = object()
        before = {name: self._namespace.get(name, absent) for name in names}
        self._namespace.update({name: suite.load_reference(name) for name in names})
        try:
            yield
        finally:
            for name, value in before.items():
                if value is absent:
                    self._namespace.pop(name, None)
                else:
                    self._namespace[name] = value

    def why_forbidden(self, exercise: str, suite: Suite) -> str:
        return why_exercise_forbidden(exercise, suite, self._namespace)

    def run(self, test: Test, suite: Suite, references: frozenset[str]) -> TestResult:
        student = Student(self._namespace, suite.name, references)
        return runner.run_test(test, suite, student, self._namespace, self._interruption)


def _current_cell() -> object:
    """The number of the notebook cell that is running, or None outside IPython."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython else None
    return None if shell is None else shell.execution_count
