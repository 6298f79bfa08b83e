"""The stock nbgrader commands, as an instructor types them."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import nbformat
import pytest

from robotbrain.grading import course as courses
from robotbrain.grading import intake
from robotbrain.grading.marks import marks_of
from tests.grading import toylab


@pytest.fixture(scope="module")
def graded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A course in which `nbgrader` generated, autograded, gave feedback and exported, from the autograder folder."""
    root = toylab.make_course(tmp_path_factory.mktemp("nbgrader"))
    submitted = root / "autograder" / "submitted"
    deleted = toylab.solved(scale="def scale(x):\n    return x ** 2")
    deleted.cells = [c for c in deleted.cells if intake.grade_id(c) != "score-mean"]
    toylab.submit(submitted, "amara", toylab.solved())
    toylab.submit(submitted, "bilal", deleted)
    toylab.submit(submitted, "chen", "{broken")
    env = {k: v for k, v in os.environ.items() if k != "ROBOTBRAIN_AUTOGRADER"}
    env |= {"ROBOTBRAIN_SUITES": str(root / "suites"), "PATH": os.defpath}  # alembic is not on this PATH
    for step in (["generate_assignment", "toy"], ["autograde", "toy"], ["generate_feedback", "toy"], ["export"]):
        done = subprocess.run(
            [sys.executable, "-m", "nbgrader", *step],
            cwd=root / "autograder",
            env=env,
            capture_output=True,
            text=True,
            timeout=120,
        )
        assert done.returncode == 0, done.stderr
    return root


def test_the_release_lies_in_labs_without_solutions_or_hidden_tests(graded: Path) -> None:
    text = (graded / "labs" / "toy" / "toy.ipynb").read_text()
    assert "2 * x" not in text and "hidden" not in text.lower()
    assert "raise NotImplementedError()" in text


def test_scores_reach_the_gradebook(graded: Path) -> None:
    with (graded / "autograder" / "grades.csv").open() as file:
        scores = {row["student_id"]: (float(row["score"]), float(row["max_score"])) for row in csv.DictReader(file)}
    assert scores == {"amara": (15.0, 15.0), "bilal": (11.0, 15.0), "chen": (0.0, 15.0)}


def test_feedback_shows_the_report_and_nothing_hidden(graded: Path) -> None:
    pages = {p.parts[-3]: p.read_text() for p in (graded / "autograder" / "feedback").glob("*/toy/toy.html")}
    assert set(pages) == {"amara", "bilal", "chen"}
    assert all("robotbrain-report" in page and "SECRET" not in page for page in pages.values())
    assert "Doubling is multiplying by two" in pages["bilal"]
    assert "score-mean was missing" in pages["bilal"]
    assert "cannot be read" in pages["chen"]


def test_the_release_is_in_canonical_form_and_generation_repeats(graded: Path, tmp_path: Path) -> None:
    course = courses.find_course(graded)
    assert courses.release_differences(course, "toy", tmp_path) == []
    path = graded / "labs" / "toy" / "toy.ipynb"
    text = path.read_text()
    path.write_text(text.replace("raise NotImplementedError()", "pass"))
    (graded / "labs" / "toy" / "extra.txt").write_text("x")
    try:
        differences = courses.release_differences(course, "toy", tmp_path)
        assert differences == ["extra.txt is not generated from anything", "toy.ipynb differs"]
    finally:
        path.write_text(text)
        (graded / "labs" / "toy" / "extra.txt").unlink()


def _validated(path: Path) -> dict[str, Any]:
    from nbgrader.validator import Validator

    return dict(Validator().validate(str(path)))


def test_validate_tells_the_student_what_is_missing(graded: Path, tmp_path: Path) -> None:
    stub = _validated(graded / "labs" / "toy" / "toy.ipynb")
    errors = {f["source"]: f["raw_error"] for f in stub["failed"]}
    assert set(errors) == {f'lab.score("{name}")' for name in ("scale", "total", "mean")}
    assert "scale is not written yet" in errors['lab.score("scale")']
    notebook = nbformat.read(graded / "labs" / "toy" / "toy.ipynb", as_version=4)
    for cell in notebook.cells:
        if (name := intake.grade_id(cell)) in toylab.SOLUTIONS:
            cell.source = toylab.SOLUTIONS[name].replace("2 * x", "x ** 2")
    nbformat.write(notebook, tmp_path / "toy.ipynb")
    failed = _validated(tmp_path / "toy.ipynb")["failed"]
    assert [f["source"] for f in failed] == ['lab.score("scale")']
    assert "given:     x = 3.0" in failed[0]["raw_error"]
    assert "Doubling is multiplying by two" in failed[0]["error"]


def test_autograded_notebooks_keep_the_verdicts(graded: Path) -> None:
    path = graded / "autograder" / "autograded" / "bilal" / "toy" / "toy.ipynb"
    marks = {m.exercise: m for m in marks_of(nbformat.read(path, as_version=4))}
    assert [t["verdict"] for t in marks["scale"].tests] == ["failed", "failed"]
    assert marks["total"].substituted == ["scale"]
