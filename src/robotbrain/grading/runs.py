"""Which tests of a lab run when, and what stands in for parts that are not right yet.

The same rules hold in the notebook, where student and tests share a process, and in grading, where they do not: what
differs between the two is a :class:`World`.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import Any, Protocol

from robotbrain.grading.report import Report
from robotbrain.grading.results import TestResult, Verdict
from robotbrain.grading.runner import Outcome, result_of
from robotbrain.grading.state import unchanged
from robotbrain.grading.suite import Suite, Test, load_hidden_suite


class World(Protocol):
    """Where the student's objects are and tests run."""

    def cell(self) -> object:
        """What tells the graded cells apart; None outside of a notebook."""

    def state(self) -> dict[str, Any]:
        """What results depend on: see :mod:`robotbrain.grading.state`."""

    def substituting(self, suite: Suite, names: Sequence[str]) -> AbstractContextManager[None]:
        """Let references stand in for ``names``, also for the student's functions that use them."""

    def why_forbidden(self, exercise: str, suite: Suite) -> str:
        """Why the answer to ``exercise`` is refused, or ``""``."""

    def run(self, test: Test, suite: Suite, references: frozenset[str]) -> TestResult:
        """Run one test; whatever the student's code does becomes a result."""


@dataclass(frozen=True)
class _Run:
    """Results of one exercise, and what they depended on (kept so that identities stay unique)."""

    state: dict[str, Any]
    cell: object
    results: list[TestResult]
    substituted: tuple[str, ...]

    @property
    def passed(self) -> bool:
        return all(r.passed for r in self.results)


class Runs:
    """Runs exercises' tests after those of everything upstream; results are reused while nothing changed.

    Args:
        suite: the visible tests.
        complete: with the hidden ones; default: loaded when they are first asked for.
    """

    def __init__(self, suite: Suite, world: World, complete: Suite | None = None) -> None:
        self._suite, self._world, self._complete = suite, world, complete
        self._runs: dict[str, _Run] = {}

    def report(self, exercise: str, *, hidden: bool, fresh: bool = False) -> Report:
        """Run an exercise's tests.

        Args:
            hidden: with the hidden tests.
            fresh: run all of them, also those that have just run on the same objects.
        """
        if hidden and self._complete is None:
            self._complete = load_hidden_suite(self._suite.name)
        suite = self._complete if hidden and self._complete is not None else self._suite
        tests = suite.tests_of(exercise, hidden=hidden)  # an unknown name fails here, before anything runs
        entry = suite.exercises[exercise]
        run = self._run(exercise, suite, fresh=fresh)
        return Report(
            lab=suite.name,
            exercise=entry.name,
            title=entry.title,
            points=entry.points,
            results=tuple(run.results),
            substituted=run.substituted,
            complete=abs(sum(t.points for t in tests) - entry.points) < 1e-6,
        )

    def _run(self, exercise: str, suite: Suite, *, fresh: bool) -> _Run:
        cell, state = self._world.cell(), self._world.state()
        failed: set[str] = set()  # upstream exercises for which the reference stands in
        for upstream in suite.ancestors(exercise):
            references = _references_of(suite, failed.intersection(suite.ancestors(upstream)))
            run = self._reuse(upstream, suite, state, references)
            if run is None:
                run = self._run_tests(upstream, suite, references, state, cell)
            if not run.passed:
                failed.add(upstream)
        references = _references_of(suite, failed)
        run = self._reuse(exercise, suite, state, references)
        if run is None or fresh or cell is None or run.cell != cell:
            run = self._run_tests(exercise, suite, references, state, cell)
        return run

    def _reuse(self, exercise: str, suite: Suite, state: dict[str, Any], references: tuple[str, ...]) -> _Run | None:
        """The last run, if the student's objects are the very same and it ran every test that now counts."""
        names = {test.name for test in self._tests(suite, exercise)}
        run = self._runs.get(exercise)
        if run is None or run.substituted != references or not unchanged(run.state, state, grown=run.passed):
            return None
        counting = [result for result in run.results if result.name in names]
        return replace(run, results=counting) if len(counting) == len(names) else None

    def _tests(self, suite: Suite, exercise: str) -> list[Test]:
        return suite.tests_of(exercise, hidden=suite is self._complete)

    def _run_tests(
        self, exercise: str, suite: Suite, references: tuple[str, ...], state: dict[str, Any], cell: object
    ) -> _Run:
        previous = self._runs.get(exercise)
        known: dict[str, TestResult] = {}
        same_cell = previous is not None and cell is not None and previous.cell == cell
        if previous and same_cell and previous.substituted == references and unchanged(previous.state, state):
            known = {r.name: r for r in previous.results}  # visible tests run once per cell
        with self._world.substituting(suite, references):
            ban = self._world.why_forbidden(exercise, suite)
            results = [
                result_of(test, suite, Outcome(Verdict.FORBIDDEN, message=ban))
                if ban
                else known.get(test.name) or self._world.run(test, suite, frozenset(references))
                for test in self._tests(suite, exercise)
            ]
        run = _Run(state, cell, results, references)
        self._runs[exercise] = run
        return run


def _references_of(suite: Suite, exercises: set[str]) -> tuple[str, ...]:
    """Names provided by ``exercises`` for which there is a reference, in order of declaration."""
    entries = (entry for name, entry in suite.exercises.items() if name in exercises)
    return tuple(name for entry in entries for name in entry.provides if name in suite.references)
