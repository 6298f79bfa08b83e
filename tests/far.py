"""A lab's tests on a notebook's answers in this process, near (as in the notebook) and far (as while grading)."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from robotbrain.grading import Suite, remote, runner
from robotbrain.grading.results import TestResult
from robotbrain.grading.sample import Mutant
from robotbrain.grading.student import STUDENT_VARIABLE, Student

Notebooks = Mapping[str, Any]


@dataclass
class Trials:
    """Answers that are graded, and what is wrong with the grades.

    Attributes:
        preamble: what the notebook defines besides the answers.
        folder: with the files that are handed in.
        near: also grade in the notebook's own process, and ask for the same verdicts.
    """

    suite: Suite
    preamble: str
    folder: Path
    near: bool = True
    problems: list[str] = field(default_factory=list)

    def expect_full(self, notebooks: Notebooks, name: str, exercises: Iterable[str]) -> None:
        """Every point of the exercises is earned."""
        for exercise in exercises:
            found = self._graded(notebooks, name, exercise)
            self.problems += [
                f"{name} loses {r.points - r.earned:g} in {exercise}: {r.message}" for r in found if not r.passed
            ]

    def expect_nothing(self, notebooks: Notebooks, name: str, exercises: Iterable[str]) -> None:
        """No point of the exercises is earned, also with our own answers for what is upstream."""
        for exercise in exercises:
            found = self._graded(notebooks, name, exercise, substituted=True)
            self.problems += [f"{name} earns {r.earned:g} in {exercise}: {r.name}" for r in found if r.earned]

    def expect_loss(self, notebooks: Notebooks, mutant: Mutant) -> None:
        """Points of the mutant's own exercise are lost, with its own hint."""
        found = self._graded(notebooks, mutant.name, mutant.exercise)
        lost = sum(r.points - r.earned for r in found)
        hints = {r.hint_key for r in found}
        as_said = mutant.loses is None or abs(lost - mutant.loses) < 1e-6
        if lost <= 0 or mutant.hint not in hints or not as_said:
            self.problems.append(f"{mutant.name} loses {lost:g} of {mutant.loses}; hints {hints}, not {mutant.hint}")

    def _graded(self, notebooks: Notebooks, name: str, exercise: str, *, substituted: bool = False) -> list[TestResult]:
        (notebook,) = notebooks.values()
        upstream = self.suite.ancestors(exercise) if substituted else []
        names = [n for e in upstream for n in self.suite.exercises[e].provides if n in self.suite.references]
        outcomes: list[Mapping[str, Any]] = []
        with graded_as(name, self.folder):
            for away in (False, True) if self.near else (True,):
                namespace = answers(notebook, self.preamble)
                if away:
                    student: Student = remote.loopback(namespace, self.suite, references=names, files=self.folder)
                else:
                    namespace.update((n, self.suite.load_reference(n)) for n in names)
                    student = Student(namespace, self.suite.name, frozenset(names))
                tests = self.suite.tests_of(exercise, hidden=True)
                found = [runner.run_test(t, self.suite, student, namespace, runner.Interruption()) for t in tests]
                outcomes.append({r.name: (r.verdict.value, r.earned, r.hint_key) for r in found})
        if outcomes[0] != outcomes[-1]:
            self.problems.append(f"{name}, {exercise}: near {outcomes[0]}, far {outcomes[-1]}")
        return found


def answers(notebook: Any, preamble: str) -> dict[str, Any]:
    """Run a notebook's answers after ``preamble``, and nothing else of it; return its globals."""
    namespace: dict[str, Any] = {"__name__": "__main__"}
    exec(preamble, namespace)
    for cell in notebook.cells:
        if cell.metadata.get("nbgrader", {}).get("solution") and cell.cell_type == "code":
            with contextlib.suppress(NotImplementedError):  # a cell without an answer
                exec(compile(cell.source, cell.id, "exec"), namespace)
    return namespace


@contextlib.contextmanager
def graded_as(name: str, folder: Path) -> Iterator[None]:
    """Let tests draw their numbers as for this student, with ``folder`` as working directory."""
    before, here = os.environ.get(STUDENT_VARIABLE), Path.cwd()
    os.environ[STUDENT_VARIABLE] = name
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(here)
        os.environ.pop(STUDENT_VARIABLE)
        if before is not None:
            os.environ[STUDENT_VARIABLE] = before


def with_files(handed_in: Path, mutant: Mutant, folder: Path) -> Path:
    """Copy what is handed in to ``folder``, with the mutant's files instead of ours."""
    for path in handed_in.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    for name, make in mutant.files.items():
        content = make(handed_in)
        (folder / name).unlink()
        if content is not None:
            (folder / name).write_bytes(content)
    return folder
