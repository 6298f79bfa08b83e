"""A mutation test from end to end: make the sample class of a lab, grade it, judge the tests by it.

It is graded like any class, so a run that was stopped goes on where it was, and only what has changed runs again.
"""

from __future__ import annotations

import dataclasses
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robotbrain.grading import mutation
from robotbrain.grading.classroom import Options, Progress, grade_class
from robotbrain.grading.course import Course
from robotbrain.grading.kills import Kills, kills_of, write_kills
from robotbrain.grading.sample import load_mutants, make_class


@dataclass(frozen=True)
class Outcome:
    """What a mutation test of one lab found.

    Attributes:
        idle: tests that find no mutant.
        page: the table as a page; a CSV file lies beside it.
    """

    lab: str
    rows: list[mutation.Row]
    kills: Kills
    idle: list[str]
    page: Path

    @property
    def sound(self) -> bool:
        """Whether every sample submission is graded as it should be."""
        return not any(row.problems for row in self.rows)

    def text(self) -> str:
        """The outcome for a terminal; the last line is the verdict."""
        parts = [f"== {self.lab}", mutation.table(self.rows), "", "Which test finds which mutant:", self.kills.text()]
        if self.idle:
            parts += ["", "Tests that find no mutant:", *(f"  {name}" for name in self.idle)]
        if weak := self.kills.weak():
            parts += ["", "Mutants that cost little:", *(f"  {name}: {share:.0%}" for name, share in weak)]
        bad = sum(bool(row.problems) for row in self.rows)
        verdict = f"{bad} of {len(self.rows)} submissions are graded wrongly" if bad else "all graded as they should be"
        killed = sum(bool(m.killers) for m in self.kills.mutants)
        counts = f"{killed} of {len(self.kills.mutants)} mutants killed, {len(self.kills.tests)} tests"
        return "\n".join([*parts, "", f"table {self.page}", f"{self.lab}: {counts}, {verdict}"])


def with_mutants(course: Course) -> list[str]:
    """The labs of ``course`` that have mutants."""
    return [lab for lab in course.labs() if load_mutants(course, lab)[0]]


def run(course: Course, lab: str, out: Path, options: Options, progress: Progress | None = None) -> Outcome:
    """Test the tests of ``lab``, working in ``out/<lab>``."""
    folder = out / lab
    shutil.rmtree(folder / "class", ignore_errors=True)  # with submissions of mutants that are no more
    manifest = make_class(course, lab, folder / "class")
    options = dataclasses.replace(options, feedback=False)
    graded = grade_class(
        course, lab, submitted=folder / "class", out=folder / "graded", options=options, progress=progress
    )
    results: dict[str, Any] = graded.to_dict()
    rows = mutation.judge(results, manifest)
    kills = kills_of(results, rows, manifest)
    page = write_kills(folder, results, rows, kills)
    return Outcome(lab, rows, kills, mutation.idle_tests(results, rows), page)
