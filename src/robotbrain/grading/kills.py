"""Which test finds which mistake: the table of a mutation test as text, CSV and a page."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robotbrain.files import write_text
from robotbrain.grading.mutation import Row, idle_tests, test_names

WEAK_SHARE = 0.2  # of the points of its exercise: a mistake that costs less hardly shows in a mark


@dataclass(frozen=True)
class Mutated:
    """A mistake and the tests of its exercise that find it.

    Attributes:
        share: part of the exercise's points that it costs.
    """

    name: str
    exercise: str
    describe: str
    lost: float
    share: float
    killers: frozenset[str]


@dataclass(frozen=True)
class Kills:
    """Tests against mistakes; ``tests`` are named ``exercise: name``."""

    lab: str
    tests: list[str]
    mutants: list[Mutated]

    def finds(self, test: str, mutant: Mutated) -> bool:
        """Whether ``test`` finds ``mutant``."""
        return test in mutant.killers

    def count(self, test: str) -> int:
        """How many mistakes ``test`` finds."""
        return sum(test in m.killers for m in self.mutants)

    def tests_of(self, exercise: str) -> list[str]:
        """The tests of an exercise."""
        return [t for t in self.tests if t.startswith(f"{exercise}: ")]

    def weak(self) -> list[tuple[str, float]]:
        """Mistakes that cost less than :data:`WEAK_SHARE` of their exercise, with what they cost."""
        return [(m.name, m.share) for m in self.mutants if 0 < m.share < WEAK_SHARE]

    def text(self) -> str:
        """One line per test, one column per mistake, and the mistakes by number."""
        width = max((len(t) for t in self.tests), default=0)
        numbers = [str(i) for i in range(1, len(self.mutants) + 1)]
        lines = [f"{'':<{width}}  {' '.join(n.rjust(2) for n in numbers)}"]
        for test in self.tests:
            marks = " ".join(" x" if test in m.killers else " ." for m in self.mutants)
            lines.append(f"{test:<{width}}  {marks}")
        for number, m in zip(numbers, self.mutants, strict=True):
            tests = len(self.tests_of(m.exercise))
            lines.append(f"{number:>4}  {m.name}: {len(m.killers)} of {tests} tests, {m.share:.0%} of {m.exercise}")
        return "\n".join(lines)

    def csv_text(self) -> str:
        """One row per test, one column per mistake; 1 where the test finds it."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(["test", *(m.name for m in self.mutants), "finds"])
        for test in self.tests:
            writer.writerow([test, *(int(test in m.killers) for m in self.mutants), self.count(test)])
        return out.getvalue()


def kills_of(results: Mapping[str, Any], rows: Sequence[Row], manifest: Mapping[str, Mapping[str, Any]]) -> Kills:
    """The table out of ``results.json``, what :func:`~robotbrain.grading.mutation.judge` found, and the class."""
    worth = {e["exercise"]: e["points"] for s in results["students"] for e in s["exercises"]}
    mutants = []
    for row in rows:
        if row.kind == "mutant":
            entry = manifest[row.student]
            exercise = entry["exercise"]
            share = row.own / worth[exercise] if worth.get(exercise) else 0.0
            mutants.append(
                Mutated(row.name, exercise, entry.get("describe", ""), row.own, share, frozenset(row.killers))
            )
    return Kills(str(results.get("lab", "")), test_names(results), mutants)


def write_kills(folder: Path, results: Mapping[str, Any], rows: Sequence[Row], kills: Kills) -> Path:
    """Write ``kills.csv`` and ``kills.html`` into ``folder``; return the page."""
    from robotbrain.grading.reports.page import render

    write_text(folder / "kills.csv", kills.csv_text())
    page = render(
        "kills.html",
        lab=kills.lab,
        kills=kills,
        problems=[r for r in rows if r.problems],
        idle=idle_tests(results, rows),
        weak=kills.weak(),
    )
    return write_text(folder / "kills.html", page)
