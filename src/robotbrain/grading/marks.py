"""From an executed notebook to marks: points and verdicts per exercise, and the sentence that explains them."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from nbformat.notebooknode import NotebookNode
from nbgrader.utils import determine_grade, is_grade

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
    """

    student: str
    marks: list[Mark]
    incidents: list[str] = field(default_factory=list)
    seconds: float = 0.0
    cached: bool = False

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


def table(rows: Sequence[Marks], *, widest_reason: int = 70) -> str:
    """The class as text: student, points per exercise, total, verdict, seconds, reason."""
    names = columns(rows)
    worth = {m.exercise: m.points for row in rows for m in row.marks}
    total = max((row.points for row in rows), default=0.0)
    head = ["student", *(f"{n}/{worth[n]:g}" for n in names), f"total/{total:g}", "verdict", "s", "reason"]
    body = []
    for row in rows:
        reason = row.reason()
        reason = reason if len(reason) <= widest_reason else reason[: widest_reason - 1] + "…"
        points = [_shown(row, name) for name in names]
        seconds = f"{row.seconds:.1f}{'*' if row.cached else ''}"
        body.append([row.student, *points, f"{row.earned:g}", row.verdict, seconds, reason])
    widths = [max(len(line[i]) for line in [head, *body]) for i in range(len(head))]
    numeric = set(range(1, len(names) + 2)) | {len(names) + 3}
    lines = [head, ["-" * w for w in widths], *body]
    text = "\n".join(
        "  ".join(c.rjust(w) if i in numeric else c.ljust(w) for i, (c, w) in enumerate(zip(line, widths, strict=True)))
        for line in lines
    )
    text = "\n".join(line.rstrip() for line in text.splitlines())
    return text + ("\n* from an earlier run" if any(row.cached for row in rows) else "")


def _shown(row: Marks, exercise: str) -> str:
    found = [m.earned for m in row.marks if m.exercise == exercise]
    return "by hand" if None in found else f"{sum(e or 0.0 for e in found):g}" if found else "-"


def csv_text(rows: Sequence[Marks]) -> str:
    """The class as CSV."""
    names = columns(rows)
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["student", *names, "total", "max", "verdict", "seconds", "reason"])
    for row in rows:
        points = [_shown(row, name) for name in names]
        values = [row.student, *points, row.earned, row.points, row.verdict, round(row.seconds, 2), row.reason()]
        writer.writerow([_harmless(v) for v in values])
    return out.getvalue()


def _harmless(value: object) -> object:
    """Keep a spreadsheet from reading a text of the student's as a formula."""
    return f"'{value}" if isinstance(value, str) and value[:1] in "=+-@\t\r" and len(value) > 1 else value
