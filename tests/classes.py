"""What is asked of every lab: its sample class, graded as an instructor grades it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import nbformat

from robotbrain.grading import Suite, mutation
from robotbrain.grading.classroom import ClassResult, grade_class
from robotbrain.grading.course import find_course
from robotbrain.grading.sample import make_class
from tests.conftest import graders

KINDS = ("code", "markdown")
Manifest = dict[str, dict[str, Any]]
Graded = tuple[ClassResult, Manifest]


def grade_sample(repo: Path, lab: str, out: Path, keep: Callable[[dict[str, Any]], bool] = lambda _: True) -> Graded:
    """Grade those of the sample class whose entry in the manifest ``keep`` wants; it is asked in their order."""
    course = find_course(repo)
    manifest = make_class(course, lab, out / "class", keep)
    return grade_class(course, lab, submitted=out / "class", out=out / "graded", workers=graders()), manifest


def check_losses(graded: Graded, at_least: int) -> None:
    """Every mutant loses its own points only, and every style gets all."""
    result, manifest = graded
    rows = mutation.judge(result.to_dict(), manifest)
    assert len(rows) == len(manifest) >= at_least
    assert not [row for row in rows if row.problems], mutation.table(rows)


def check_pages(graded: Graded, lab: str) -> None:
    """Every submission ends in a grade and a feedback page, and every loss has a reason."""
    result, manifest = graded
    assert {row.student for row in result.rows} == set(manifest)
    for row in result.rows:
        pages = list((result.feedback / row.student / lab).glob("*.html"))
        assert len(pages) == 1, row.student
        if row.verdict != "full":
            assert row.reason(), row.student


def check_secrets(graded: Graded, lab: str, *secrets: str) -> None:
    """Hidden tests do not show in feedback."""
    result, _ = graded
    for row in result.rows:
        page = next((result.feedback / row.student / lab).glob("*.html")).read_text(encoding="utf-8")
        for secret in (*secrets, "student.rng", "autograder/hidden"):
            assert secret not in page, f"{row.student}: {secret}"


def check_points(repo: Path, lab: str, suite: Suite, automatic: int, by_hand: int, titles: bool = True) -> None:
    """Points (and titles) of the exercises are the same in the notebook and in the tests."""
    notebook = nbformat.read(repo / "solutions" / lab / f"{lab}.ipynb", as_version=4)
    graded = [c for c in notebook.cells if c.metadata.get("nbgrader", {}).get("grade")]
    points = {kind: sum(c.metadata.nbgrader.points for c in graded if c.cell_type == kind) for kind in KINDS}
    assert points["code"] == sum(e.points for e in suite.exercises.values()) == automatic
    assert points["markdown"] == by_hand
    text = "\n".join(c.source for c in notebook.cells)
    for exercise in suite.exercises.values() if titles else ():
        number, _, name = exercise.title.partition(" ")
        assert f"### Exercise {number}: {name[0].lower()}{name[1:]} ({exercise.points:g} points)" in text
