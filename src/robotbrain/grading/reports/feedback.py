"""The page a student gets: what counts first, then every test, then the student's own work.

It takes the place of nbgrader's stock page under the same name, so that formgrader, ``nbgrader release_feedback`` and
the students' *Fetch Feedback* all lead to it.
"""

from __future__ import annotations

import contextlib
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import nbformat.v4

from robotbrain.files import write_bytes, write_text
from robotbrain.grading.intake.cells import REPAIRS_ID
from robotbrain.grading.marks import Mark, Marks, marks_of
from robotbrain.grading.report import SCORE_MIME
from robotbrain.grading.reports import cells
from robotbrain.grading.reports.grades import GradedNotebook, graded_notebook, open_gradebook
from robotbrain.grading.reports.model import outcomes_of, unprotected
from robotbrain.grading.reports.page import render
from robotbrain.grading.results import TestResult, Verdict

STEPS = 3
CARRIED = ("timestamp.txt", "submission_secret.txt")
"""What nbgrader's exchange puts beside a submission, and looks for beside its feedback."""
_HEADING = re.compile(r"^#+ (?:Exercise ([\d.]+): )?(.+?)(?: \([^()]*\))?$", re.MULTILINE)
_EMPTY_COMMENT = "No response."  # nbgrader's own, on answers nobody wrote


@dataclass(frozen=True)
class Step:
    """Something worth doing next: where, what went wrong, what helps, and what there is to gain."""

    exercise: str
    anchor: str
    wrong: str
    hint: str
    reread: str
    gain: float


@dataclass(frozen=True)
class ExerciseView:
    """One exercise on the page; ``earned`` is None while a person has yet to grade it."""

    anchor: str
    title: str
    earned: float | None
    points: float
    manual: float | None
    extra: float
    error: str
    substituted: Sequence[str]
    tests: Sequence[TestResult]
    comments: Sequence[str]

    @property
    def full(self) -> bool:
        """Whether it earned all its points."""
        return self.earned is not None and self.earned >= self.points - 1e-9

    @property
    def state(self) -> str:
        """The outcome in words: no colour is needed to read it."""
        if self.earned is None:
            return "to be graded by hand"
        return "full points" if self.full else "some points" if self.earned > 0 else "no points yet"


def feedback_page(
    row: Marks,
    notebook: Mapping[str, Any],
    *,
    lab: str,
    graded: GradedNotebook | None = None,
    only: Sequence[str] | None = None,
) -> str:
    """The page of one notebook of one student, as HTML.

    Args:
        row: the student's marks, as in ``results.json``.
        notebook: the executed notebook.
        graded: the gradebook's entries for it; without them the page says what the tests gave.
        only: grade ids that belong to this notebook, where a lab has several (default: all).
    """
    marks = [mark for mark in row.marks if only is None or mark.grade_id in only]
    titles = _titles(notebook)
    exercises = [_exercise(i, mark, titles, graded) for i, mark in enumerate(marks, 1)]
    placed = {mark.grade_id for mark in marks}
    general = [
        f"{name}: {text}"
        for name, text in (graded.comments if graded else {}).items()
        if name not in placed and not _belongs(name, marks) and text.strip() != _EMPTY_COMMENT
    ]
    return render(
        "feedback.html",
        lab=lab,
        student=row.student,
        earned=graded.points if graded else sum(e.earned or 0.0 for e in exercises),
        most=sum(e.points for e in exercises),
        pending=sum(e.points for e in exercises if e.earned is None),
        penalty=graded.penalty if graded else 0.0,
        exercises=exercises,
        steps=next_steps(exercises),
        passed=sum(t.passed for e in exercises for t in e.tests),
        tests=sum(len(e.tests) for e in exercises),
        incidents=row.incidents or _repairs(notebook),
        layers=row.layers,
        unprotected=unprotected(row),
        comments=general,
        cells=cells.own_cells(notebook["cells"]),
    )


def next_steps(exercises: Sequence[ExerciseView]) -> list[Step]:
    """The most useful things to do next: exercises that others build on first, then by what there is to gain."""
    built_on = {name for e in exercises for name in e.substituted}
    lacking = [e for e in exercises if e.earned is not None and not e.full]
    lacking.sort(key=lambda e: (not built_on & {t.exercise for t in e.tests}, -(e.points - (e.earned or 0.0))))
    return [_step(e) for e in lacking[:STEPS]]


def _step(exercise: ExerciseView) -> Step:
    gain = exercise.points - (exercise.earned or 0.0)
    failed = [t for t in exercise.tests if not t.passed]
    # A visible test with a hint tells most; then a hidden one with a hint; then whatever there is.
    told = sorted(failed, key=lambda t: (not (t.hint or t.misconception), t.hidden))
    if not told and exercise.manual is not None:
        return Step(exercise.title, exercise.anchor, "graded by hand; see the comments there", "", "", gain)
    if not told:
        return Step(exercise.title, exercise.anchor, exercise.error or "it gave no score", "", "", gain)
    first = told[0]
    wrong = f"“{first.name}”: {first.verdict.label}"
    hint = first.hint or ("" if first.verdict is Verdict.NOT_WRITTEN else first.message)
    if hint and hint[-1] not in ".?!:)":
        hint += "."
    return Step(exercise.title, exercise.anchor, wrong, hint, first.reread, gain)


def _exercise(number: int, mark: Mark, titles: Mapping[str, str], graded: GradedNotebook | None) -> ExerciseView:
    given = graded.grades.get(mark.grade_id) if graded else None
    comments = [graded.comments[name] for name in _answers(mark) if name in graded.comments] if graded else []
    return ExerciseView(
        anchor=f"exercise-{number}",
        title=titles.get(mark.grade_id, mark.exercise.replace("_", " ")),
        earned=given.points if given else mark.earned,
        points=given.most if given else mark.points,
        manual=given.manual if given else None,
        extra=given.extra if given else 0.0,
        error=mark.error,
        substituted=mark.substituted,
        tests=outcomes_of(mark),
        comments=[c for c in dict.fromkeys(comments) if c.strip() != _EMPTY_COMMENT],
    )


def _answers(mark: Mark) -> list[str]:
    """Grade ids of the cells whose comments belong to this exercise: the test's own, and the answer's."""
    return list(dict.fromkeys([mark.grade_id, mark.exercise, mark.grade_id.removeprefix("test-").replace("-", "_")]))


def _belongs(name: str, marks: Sequence[Mark]) -> bool:
    return any(name in _answers(mark) for mark in marks)


def _titles(notebook: Mapping[str, Any]) -> dict[str, str]:
    """Titles of the exercises: from the reports in their graded cells, and for answers in words from the heading."""
    found, heading = {}, ""
    for cell in notebook["cells"]:
        label = cell["metadata"].get("nbgrader") or {}
        if label.get("grade") and cell["cell_type"] == "markdown":
            found[str(label.get("grade_id"))] = heading or "Answer in words"
        elif cell["cell_type"] == "markdown" and (lines := _HEADING.findall(cell["source"])):
            number, words = lines[-1]
            heading = f"{number} {words[:1].upper()}{words[1:200]}".strip()
        for output in cell.get("outputs") or []:
            report = (output.get("data") or {}).get(SCORE_MIME)
            if label.get("grade") and isinstance(report, Mapping) and isinstance(report.get("title"), str):
                found[str(label.get("grade_id"))] = report["title"][:200]
    shared = {title for title, uses in Counter(found.values()).items() if uses > 1}  # several answers, one heading
    return {k: f"{title} ({k.rpartition('-')[2]})" if title in shared else title for k, title in found.items()}


def _repairs(notebook: Mapping[str, Any]) -> list[str]:
    """What the intake wrote into the notebook, where there is no other record (stock nbgrader)."""
    first = notebook["cells"][0] if notebook["cells"] else {}
    if first.get("id") != REPAIRS_ID or first.get("cell_type") != "markdown":
        return []
    return [line[2:] for line in str(first["source"]).splitlines() if line.startswith("- ")]


def write_feedback(
    folder: Path,
    lab: str,
    rows: Sequence[Marks],
    notebooks: Callable[[str], Sequence[Path]],
    gradebook_url: str | None = None,
) -> dict[str, list[Path]]:
    """Write ``<folder>/<student>/<lab>/<notebook>.html`` for every student; return the pages by student.

    Args:
        folder: nbgrader's feedback folder, or any other.
        notebooks: the executed (or autograded) notebooks of a student.
        gradebook_url: where manual grades and comments are; None: nowhere.
    """
    written: dict[str, list[Path]] = {}
    with contextlib.ExitStack() as stack:
        gradebook = stack.enter_context(open_gradebook(gradebook_url)) if gradebook_url else None
        for row in rows:
            for path in notebooks(row.student):
                notebook = nbformat.v4.reads(path.read_text(encoding="utf-8"))  # unlike read(), without validation
                graded = graded_notebook(gradebook, lab, row.student, path.stem) if gradebook is not None else None
                own = [mark.grade_id for mark in marks_of(notebook)]
                page = feedback_page(row, notebook, lab=lab, graded=graded, only=own)
                target = folder / row.student / lab / f"{path.stem}.html"
                written.setdefault(row.student, []).append(write_text(target, page))
                for name in CARRIED:  # as nbgrader's own step does: it releases no feedback without them
                    if (path.parent / name).is_file():
                        write_bytes(target.parent / name, (path.parent / name).read_bytes())
    return written
