"""What a notebook holds: ``lab = Lab("lab_integration")``, then ``lab.check("astar")`` and ``lab.score("astar")``."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator, MutableMapping
from dataclasses import dataclass
from typing import Any

from robotbrain.grading import runner
from robotbrain.grading.forbidden import why_forbidden
from robotbrain.grading.report import Report, Score, ScoreError
from robotbrain.grading.results import TestResult, Verdict
from robotbrain.grading.student import Student
from robotbrain.grading.suite import Exercise, Suite, load_hidden_suite, load_suite

VALIDATING_VARIABLE = "NBGRADER_VALIDATING"  # set by nbgrader while its Validate button runs the notebook


@dataclass(frozen=True)
class _Run:
    """Results of one exercise, and what they depended on (kept so that identities stay unique)."""

    state: dict[str, Any]
    cell: object
    results: list[TestResult]
    substituted: tuple[str, ...]


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
        self._suite = suite or load_suite(name)
        if suite is not None:
            suite.validate(complete=False)
        self._complete: Suite | None = None
        self._runs: dict[str, _Run] = {}
        self._interruption = runner.Interruption()
        self._interrupted_cell: object = None

    def check(self, exercise: str) -> Report:
        """Run the visible tests of ``exercise`` now and return the report."""
        run = self._run(exercise, self._suite, fresh=True)
        return self._report(exercise, self._suite, run)

    def score(self, exercise: str, hidden: bool = False) -> Score:
        """Return the points of ``exercise`` as a :class:`Score`, which nbgrader reads as partial credit.

        Args:
            exercise: its name.
            hidden: also run the hidden tests. Without them the visible tests are scaled to the exercise's points.

        Raises:
            ScoreError: only under nbgrader's Validate, when points are missing: its message is the report.
            InputError: unknown exercise, or hidden tests asked for where there are none.
        """
        if hidden and self._complete is None:
            self._complete = load_hidden_suite(self.name)
        suite = self._complete if hidden and self._complete is not None else self._suite
        run = self._run(exercise, suite, fresh=False)
        report = self._report(exercise, suite, run)
        if os.environ.get(VALIDATING_VARIABLE) and not report.full:
            raise ScoreError(report)
        return Score(report)

    def _report(self, exercise: str, suite: Suite, run: _Run) -> Report:
        entry = suite.exercises[exercise]
        tests = suite.tests_of(exercise, hidden=suite is self._complete)
        return Report(
            lab=self.name,
            exercise=entry.name,
            title=entry.title,
            points=entry.points,
            results=tuple(run.results),
            substituted=run.substituted,
            complete=abs(sum(t.points for t in tests) - entry.points) < 1e-6,
        )

    def _run(self, exercise: str, suite: Suite, *, fresh: bool) -> _Run:
        """Run an exercise's tests after those of everything upstream; results are reused while nothing changed."""
        suite.tests_of(exercise, hidden=False)  # an unknown name fails here, before anything runs
        cell = _current_cell()
        if cell is None or cell != self._interrupted_cell:
            self._interruption.happened = False
        state = _state_of(self._namespace)
        failed: dict[str, dict[str, Any]] = {}  # upstream exercise -> references that stand in for it
        for upstream in suite.ancestors(exercise):
            references = _merge(failed, suite.ancestors(upstream))
            run = self._reuse(upstream, suite, state, references)
            if run is None:
                run = self._run_tests(upstream, suite, references, state, cell)
            if not all(r.passed for r in run.results):
                failed[upstream] = _references_of(suite, suite.exercises[upstream])
        references = _merge(failed, list(failed))
        run = self._reuse(exercise, suite, state, references)
        if run is None or fresh or cell is None or run.cell != cell:
            run = self._run_tests(exercise, suite, references, state, cell)
        if self._interruption.happened:
            self._interrupted_cell = cell
        return run

    def _reuse(self, exercise: str, suite: Suite, state: dict[str, Any], references: dict[str, Any]) -> _Run | None:
        """The last run, if the student's objects are the very same and it ran every test that now counts."""
        run = self._runs.get(exercise)
        if run is None or not _same(run.state, state) or run.substituted != tuple(references):
            return None
        done = {r.name for r in run.results}
        return run if done == {t.name for t in self._tests(suite, exercise)} else None

    def _tests(self, suite: Suite, exercise: str) -> list[Any]:
        return suite.tests_of(exercise, hidden=suite is self._complete)

    def _run_tests(
        self, exercise: str, suite: Suite, references: dict[str, Any], state: dict[str, Any], cell: object
    ) -> _Run:
        tests = self._tests(suite, exercise)
        previous = self._runs.get(exercise)
        known: dict[str, TestResult] = {}
        substituted = tuple(references)
        same_cell = previous is not None and cell is not None and previous.cell == cell
        if previous and same_cell and previous.substituted == substituted and _same(previous.state, state):
            known = {r.name: r for r in previous.results}  # visible tests run once per cell
        with _patched(self._namespace, references):
            student = Student(self._namespace, suite.name, frozenset(references))
            ban = self._why_forbidden(exercise, suite)
            results = [
                _forbidden(test, ban)
                if ban
                else known.get(test.name) or runner.run_test(test, suite, student, self._namespace, self._interruption)
                for test in tests
            ]
        run = _Run(state, cell, results, substituted)
        self._runs[exercise] = run
        return run

    def _why_forbidden(self, exercise: str, suite: Suite) -> str:
        ban = suite.bans.get(exercise)
        if ban is None:
            return ""
        own = suite.exercises[exercise].provides
        others = frozenset(name for entry in suite.exercises.values() for name in entry.provides if name not in own)
        for name in own:
            if name in self._namespace:
                reference = suite.load_reference(name) if name in suite.references else None
                reason = why_forbidden(name, self._namespace[name], reference, ban, self._namespace, others)
                if reason:
                    return reason
        return ""


def _forbidden(test: Any, reason: str) -> TestResult:
    return TestResult(
        exercise=test.exercise,
        name=test.name,
        points=test.points,
        earned=0.0,
        verdict=Verdict.FORBIDDEN,
        message=reason,
        hidden=test.hidden,
    )


def _references_of(suite: Suite, exercise: Exercise) -> dict[str, Any]:
    return {name: suite.load_reference(name) for name in exercise.provides if name in suite.references}


def _merge(parts: dict[str, dict[str, Any]], names: list[str]) -> dict[str, Any]:
    return {key: value for name in names for key, value in parts.get(name, {}).items()}


@contextlib.contextmanager
def _patched(namespace: MutableMapping[str, Any], replacements: dict[str, Any]) -> Iterator[None]:
    """Put ``replacements`` into the notebook's globals for a while, so that the student's functions call them."""
    absent = object()
    before = {name: namespace.get(name, absent) for name in replacements}
    namespace.update(replacements)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is absent:
                namespace.pop(name, None)
            else:
                namespace[name] = value


def _state_of(namespace: MutableMapping[str, Any]) -> dict[str, Any]:
    """What results may depend on: every function and class of the notebook, and its plain constants.

    Data objects are left out: a cell that plots or drives must not make every upstream test run again.
    """
    return {
        name: value
        for name, value in namespace.items()
        if not name.startswith("_")
        and (
            isinstance(value, (bool, int, float, str))
            or (
                (isinstance(value, type) or callable(value))
                and getattr(value, "__module__", None) == namespace.get("__name__", "__main__")
            )
        )
    }


def _same(a: dict[str, Any], b: dict[str, Any]) -> bool:
    plain = (bool, int, float, str)
    return a.keys() == b.keys() and all(
        v is b[k] or (type(v) is type(b[k]) and isinstance(v, plain) and v == b[k]) for k, v in a.items()
    )


def _current_cell() -> object:
    """The number of the notebook cell that is running, or None outside IPython."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython else None
    return None if shell is None else shell.execution_count
