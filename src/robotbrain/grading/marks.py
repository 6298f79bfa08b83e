"""From an executed notebook to marks: points and verdicts per exercise, and the sentence that explains them."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from nbformat.notebooknode import NotebookNode
from nbgrader.utils import determine_grade, is_grade

from robotbrain.grading.expect import readable
from robotbrain.grading.report import SCORE_MIME

SCORED = re.compile(r"""\.score\(\s*["'](\w+)["']""")


@dataclass
class Mark:
    """The mark of one graded cell.

    Attributes:
        earned: points, or None where a person has to grade.
        tests: results as in :meth:`~robotbrain.grading.results.TestResult.to_dict`.
        error: what kept the tests from running, or ``""``.
    """

    grade_id: str
    exercise: str
    points: float
    earned: float | None
    tests: list[dict[str, Any]] = field(default_factory=list)
    substituted: list[str] = field(default_factory=list)
    error: str = ""

    def reason(self) -> str:
        """Why points are missing, in a few words; ``""`` if none are."""
        if self.earned is None:
            return f"{self.exercise}: to be graded by hand"
        if self.earned >= self.points - 1e-9:
            return ""
        if self.error:
            return f"{self.exercise}: {self.error}"
        failed = [t for t in self.tests if t["verdict"] != "passed"]
        kinds = dict.fromkeys(t["verdict"].replace("_", " ") for t in failed)
        keys = dict.fromkeys(t["hint_key"] for t in failed if t["hint_key"] and " " not in t["hint_key"])
        return f"{self.exercise}: {', '.join(kinds)}" + (f" ({', '.join(keys)})" if keys else "")


@dataclass
class Marks:
    """All marks of one student.

    Attributes:
        incidents: repairs of the file and events while it ran.
        seconds: wall time of the run (s).
        layers: sandbox layers that were active while it ran; empty: none was; None: not known.
    """

    student: str
    marks: list[Mark]
    incidents: list[str] = field(default_factory=list)
    seconds: float = 0.0
    cached: bool = False
    layers: list[str] | None = None

    @property
    def earned(self) -> float:
        """Total of the points given so far."""
        return round(sum(m.earned or 0.0 for m in self.marks), 4)

    @property
    def points(self) -> float:
        """Total of the points there are."""
        return sum(m.points for m in self.marks)

    @property
    def pending(self) -> float:
        """Points that a person has yet to give."""
        return sum(m.points for m in self.marks if m.earned is None)

    @property
    def verdict(self) -> str:
        """``full``, ``partial`` or ``zero``, of the points that the tests give."""
        full = self.earned >= self.points - self.pending - 1e-9
        return "full" if full else "partial" if self.earned > 0 else "zero"

    def reason(self) -> str:
        """Everything that cost points or was repaired, in one line; ``""`` for an undisturbed full score."""
        lost = [r for m in self.marks if m.earned is not None and (r := m.reason())]
        return "; ".join([*self.incidents, *lost])

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready form."""
        return {
            "student": self.student,
            "earned": self.earned,
            "points": self.points,
            "pending": self.pending,
            "verdict": self.verdict,
            "reason": self.reason(),
            "incidents": self.incidents,
            "seconds": round(self.seconds, 2),
            "cached": self.cached,
            "layers": self.layers,
            "exercises": [
                {
                    "grade_id": m.grade_id,
                    "exercise": m.exercise,
                    "points": m.points,
                    "earned": m.earned,
                    "error": m.error,
                    "substituted": m.substituted,
                    "tests": m.tests,
                }
                for m in self.marks
            ],
        }

    @classmethod
    def from_dict(cls, stored: Mapping[str, Any]) -> Marks:
        """The marks that :meth:`to_dict` wrote."""
        fields = ("grade_id", "exercise", "points", "earned", "tests", "substituted", "error")
        marks = [Mark(**{name: exercise[name] for name in fields}) for exercise in stored["exercises"]]
        kept = ("student", "incidents", "seconds", "cached", "layers")
        return cls(marks=marks, **{name: stored[name] for name in kept})


def marks_of(notebook: NotebookNode) -> list[Mark]:
    """The marks in an executed notebook, by the very rule nbgrader applies."""
    marks = []
    for cell in notebook.cells:
        if not is_grade(cell):
            continue
        earned, points = determine_grade(cell)
        grade_id = cell.metadata["nbgrader"]["grade_id"]
        scored = SCORED.search(cell.source)
        mark = Mark(grade_id, scored.group(1) if scored else grade_id, points, earned)
        for output in cell.get("outputs", []):
            if output.output_type == "error":
                mark.error = f"{output.evalue or output.ename}".strip().splitlines()[0][:200]
            elif SCORE_MIME in output.get("data", {}):
                report = output.data[SCORE_MIME]
                mark.tests = list(report.get("tests", []))
                mark.substituted = list(report.get("substituted", []))
        marks.append(mark)
    return marks


def columns(rows: Sequence[Marks]) -> list[str]:
    """Names of the exercises that occur, in order."""
    return list(dict.fromkeys(m.exercise for row in rows for m in row.marks))


def table(rows: Iterable[Marks], *, widest_reason: int = 70) -> str:
    """The class as text: student, points per exercise, total, verdict, seconds, reason."""
    worth: dict[str, float] = {}
    total, cached = 0.0, False
    lists = []
    for row in rows:  # once: the rows of a large class are read from files
        worth |= {m.exercise: m.points for m in row.marks}
        total, cached = max(total, row.points), cached or row.cached
        reason = row.reason()
        reason = reason if len(reason) <= widest_reason else reason[: widest_reason - 1] + "…"
        rest = [f"{row.earned:g}", row.verdict, f"{row.seconds:.1f}{'*' if row.cached else ''}", reason]
        lists.append((row.student, _shown(row), rest))
    names = list(worth)
    head = ["student", *(f"{n}/{worth[n]:g}" for n in names), f"total/{total:g}", "verdict", "s", "reason"]
    body = [[_plain(c) for c in (who, *(points.get(n, "-") for n in names), *rest)] for who, points, rest in lists]
    widths = [max(len(line[i]) for line in [head, *body]) for i in range(len(head))]
    numeric = set(range(1, len(names) + 2)) | {len(names) + 3}
    lines = [head, ["-" * w for w in widths], *body]
    text = "\n".join(
        "  ".join(c.rjust(w) if i in numeric else c.ljust(w) for i, (c, w) in enumerate(zip(line, widths, strict=True)))
        for line in lines
    )
    text = "\n".join(line.rstrip() for line in text.splitlines())
    return text + ("\n* from an earlier run" if cached else "")


def _shown(row: Marks) -> dict[str, str]:
    """Points by exercise, as text."""
    found: dict[str, list[float | None]] = {}
    for mark in row.marks:
        found.setdefault(mark.exercise, []).append(mark.earned)
    return {n: "by hand" if None in e else f"{sum(x or 0.0 for x in e):g}" for n, e in found.items()}


def csv_text(rows: Iterable[Marks]) -> str:
    """The class as CSV."""
    names: dict[str, None] = {}
    lists = []
    for row in rows:
        points = _shown(row)
        names |= dict.fromkeys(points)
        rest = [row.earned, row.points, row.verdict, round(row.seconds, 2), row.reason()]
        lists.append((row.student, points, rest))
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["student", *names, "total", "max", "verdict", "seconds", "reason"])
    for who, points, rest in lists:
        writer.writerow([_harmless(v) for v in (who, *(points.get(n, "-") for n in names), *rest)])
    return out.getvalue()


def _harmless(value: object) -> object:
    """Keep a spreadsheet from reading a text of the student's as a formula."""
    if not isinstance(value, str):
        return value
    text = _plain(value)
    return f"'{text}" if text[:1] in "=+-@" and len(text) > 1 else text


def _plain(text: str) -> str:
    """A text of the student's on one line, without what would steer a terminal."""
    return " ".join(readable(text).split("\n")).replace("\t", " ")
