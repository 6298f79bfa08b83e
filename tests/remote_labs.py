"""A lab's tests against its answers, in the notebook's own process and as while grading: through the codec."""

from __future__ import annotations

import contextlib
import io
import socket
import threading
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from robotbrain.grading import Lab, Suite, TestResult, load_hidden_suite, load_suite
from robotbrain.grading.course import find_course
from robotbrain.grading.marks import SCORED
from robotbrain.grading.remote import serve
from robotbrain.grading.runs import Runs
from robotbrain.grading.sample import Mutant, Reference, Replacement, load_mutants
from robotbrain.grading.tester.world import RemoteWorld

Results = dict[str, tuple[TestResult, ...]]
"""By exercise."""


class _NoExecutor:
    """Nobody watches the clock here, and a student's process that ends has ended."""

    def begun(self, exercise: str, test: str, limit_s: float) -> None:
        return

    def ended(self) -> None:
        return

    def lost(self, number: int, why: str) -> tuple[str, socket.socket | None]:
        return "crashed", None


class LabBench:
    """The answers of a lab's notebooks, executed here, and its complete tests, warmed up."""

    def __init__(self, repo: Path, lab: str) -> None:
        course = find_course(repo)
        self.name = lab
        self.reference = Reference(course, lab)
        self.mutants, self.styles = load_mutants(course, lab)
        self.suite = load_hidden_suite(lab, repo / "autograder")
        for warm in self.suite.warmers:
            warm()

    def namespace(self, replace: Mapping[str, Replacement] | None = None, *, stub: bool = False) -> dict[str, Any]:
        """Execute the cells that grading executes, some answers replaced or all missing, and return the globals."""
        notebooks = self.reference.stubs if stub else self.reference.edit(replace or {}, "test")
        names: dict[str, Any] = {"__name__": "__main__"}
        for notebook in notebooks.values():
            for cell in notebook.cells:
                skipped = "skip-grading" in cell.metadata.get("tags", []) or "lab.check" in cell.source
                if cell.cell_type != "code" or skipped or SCORED.search(cell.source):
                    continue
                with contextlib.redirect_stdout(io.StringIO()):
                    exec(compile(cell.source, "<cell>", "exec"), names)
        return names

    def touched_by(self, mutant: Mutant) -> list[str]:
        """The exercises that a mutant can do harm to: its own and all that build on it."""
        suite = self.suite
        return [name for name in suite.exercises if mutant.exercise in (name, *suite.ancestors(name))]

    def local(self, names: dict[str, Any], exercises: Iterable[str] = ()) -> Results:
        """Score in this process, as in the notebook."""
        lab = Lab(self.name, namespace=names)
        lab._runs._complete = self.suite
        return {name: lab.score(name, hidden=True).report.results for name in exercises or self.suite.exercises}

    def remote(self, names: dict[str, Any], exercises: Iterable[str] = (), suite: Suite | None = None) -> Results:
        """Score as while grading."""
        complete = suite or self.suite
        with _served(names) as ours:
            world = RemoteWorld(complete, _NoExecutor(), None)
            world.connected(0, ours)
            world.use(0)
            runs = Runs(load_suite(self.name), world, complete)
            return {name: runs.report(name, hidden=True).results for name in exercises or complete.exercises}


@contextlib.contextmanager
def _served(names: dict[str, Any]) -> Iterator[socket.socket]:
    ours, theirs = socket.socketpair()
    thread = threading.Thread(target=serve, args=(theirs, names), daemon=True)
    thread.start()
    try:
        yield ours
    finally:
        ours.close()
        thread.join(10)
        theirs.close()


def verdicts(results: Results) -> list[tuple[str, str, str, float, str]]:
    """What must be the same in both worlds: exercise, test, verdict, points and hint."""
    return [(r.exercise, r.name, r.verdict.value, r.earned, r.hint_key) for rs in results.values() for r in rs]


def lost(results: Results) -> dict[str, float]:
    """Points lost, by exercise, where there are any."""
    points = {name: sum(r.points - r.earned for r in rs) for name, rs in results.items()}
    return {name: loss for name, loss in points.items() if loss > 1e-6}


def check_mutant(bench: LabBench, mutant: Mutant) -> None:
    """A mutant loses its own exercise with its own hint and nothing else, and the same in both worlds."""
    names, exercises = bench.namespace(mutant.replace), bench.touched_by(mutant)
    results = bench.remote(names, exercises)
    losses = lost(results)
    assert mutant.exercise in losses, "no test finds it"
    assert set(losses) <= {mutant.exercise, *mutant.also}
    assert mutant.loses is None or abs(losses[mutant.exercise] - mutant.loses) < 1e-6
    assert mutant.hint in {r.hint_key for r in results[mutant.exercise] if not r.passed}
    assert verdicts(results) == verdicts(bench.local(names, exercises))


def check_right_answers(bench: LabBench, replace: Mapping[str, Replacement]) -> None:
    """Right answers earn everything, and the same in both worlds."""
    names = bench.namespace(replace)
    results = bench.remote(names)
    assert lost(results) == {}, [r.message for rs in results.values() for r in rs if not r.passed]
    assert verdicts(results) == verdicts(bench.local(names))


# ---------------------------------------------------------------- answers that are none


class Liar:
    """An answer that agrees with everything it is compared to."""

    def __eq__(self, other: object) -> bool:
        return True

    def __ne__(self, other: object) -> bool:
        return False

    __hash__ = None  # type: ignore[assignment]

    def __bool__(self) -> bool:
        return True

    def __float__(self) -> float:
        return 0.0

    def __array__(self, *args: Any, **kwargs: Any) -> Any:
        raise SystemExit

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return self

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self

    def __getitem__(self, key: Any) -> Any:
        return self

    def __iter__(self) -> Iterator[Any]:
        return iter([self])

    def __len__(self) -> int:
        return 1


def earned_by(bench: LabBench, answers: Mapping[str, Any]) -> float:
    """Points that a notebook earns while grading in which the provided names are just these objects."""
    names = bench.namespace()
    for exercise in bench.suite.exercises.values():
        for name in exercise.provides:
            if name in answers:
                names[name] = answers[name]
    results = bench.remote(names)
    return sum(r.earned for rs in results.values() for r in rs)


class Tape:
    """Records what functions answer, and plays it back in the same order whatever is asked."""

    def __init__(self) -> None:
        self._answers: dict[str, list[Any]] = {}

    def recording(self, name: str, function: Any) -> Any:
        """Return ``function``, recorded."""
        answers = self._answers.setdefault(name, [])

        def record(*args: Any, **kwargs: Any) -> Any:
            answers.append(function(*args, **kwargs))
            return answers[-1]

        return record

    def playing(self, name: str) -> Any:
        """Return a function that answers what was recorded."""
        answers = iter(self._answers.get(name, []))
        return lambda *args, **kwargs: next(answers, None)
