"""What is asked of every lab: its sample class, graded as an instructor grades it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from robotbrain.grading import mutation
from robotbrain.grading.classroom import ClassResult, grade_class
from robotbrain.grading.course import find_course
from robotbrain.grading.sample import make_class
from tests.conftest import graders

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
