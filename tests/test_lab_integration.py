"""The lab itself: generated from its solution, and its tests tested by named wrong solutions."""

from __future__ import annotations

from pathlib import Path

import nbformat
import pytest

from robotbrain.grading import Suite, load_hidden_suite, mutation
from robotbrain.grading.classroom import ClassResult, grade_class
from robotbrain.grading.course import find_course, release_differences
from robotbrain.grading.sample import load_mutants, make_class
from tests.conftest import graders

LAB = "lab_integration"


@pytest.fixture(scope="module")
def suite(repo: Path) -> Suite:
    return load_hidden_suite(LAB, repo / "autograder")


def test_labs_is_what_solutions_generates(repo: Path, tmp_path: Path) -> None:
    assert release_differences(find_course(repo), LAB, tmp_path) == []


def test_the_released_lab_holds_no_answer_and_no_hidden_test(repo: Path) -> None:
    text = (repo / "labs" / LAB / f"{LAB}.ipynb").read_text(encoding="utf-8")
    for secret in ("BEGIN SOLUTION", "HIDDEN TESTS", "hidden=True", "heapq.heappush", "ddof=1)"):
        assert secret not in text
    assert text.count("raise NotImplementedError()") >= 10


def test_points_agree_between_notebook_and_tests(repo: Path, suite: Suite) -> None:
    notebook = nbformat.read(repo / "solutions" / LAB / f"{LAB}.ipynb", as_version=4)
    graded = [c for c in notebook.cells if c.metadata.get("nbgrader", {}).get("grade")]
    automatic = sum(c.metadata.nbgrader.points for c in graded if c.cell_type == "code")
    by_hand = sum(c.metadata.nbgrader.points for c in graded if c.cell_type == "markdown")
    assert automatic == sum(e.points for e in suite.exercises.values()) == 90
    assert by_hand == 10


def test_every_hint_and_every_mutant_is_of_use(repo: Path, suite: Suite) -> None:
    mutants, styles = load_mutants(find_course(repo), LAB)
    assert len(mutants) >= 10 and len(styles) == 3
    assert {m.hint for m in mutants} <= set(suite.hints)
    assert {m.exercise for m in mutants} == set(suite.exercises)


@pytest.fixture(scope="module")
def graded(repo: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[ClassResult, dict]:
    out = tmp_path_factory.mktemp("class")
    course = find_course(repo)
    manifest = make_class(course, LAB, out / "class")
    return grade_class(course, LAB, submitted=out / "class", out=out / "graded", workers=graders()), manifest


@pytest.mark.timeout(1200)
def test_every_mutant_loses_its_own_points_only_and_every_style_gets_all(graded: tuple[ClassResult, dict]) -> None:
    result, manifest = graded
    rows = mutation.judge(result.to_dict(), manifest)
    assert len(rows) == len(manifest) >= 35
    assert not [row for row in rows if row.problems], mutation.table(rows)


def test_every_submission_ends_in_a_grade_and_a_feedback_page(graded: tuple[ClassResult, dict]) -> None:
    result, manifest = graded
    assert {row.student for row in result.rows} == set(manifest)
    for row in result.rows:
        pages = list((result.feedback / row.student / LAB).glob("*.html"))
        assert len(pages) == 1, row.student
        if row.verdict != "full":
            assert row.reason(), row.student


def test_hidden_tests_do_not_show_in_feedback(graded: tuple[ClassResult, dict]) -> None:
    result, _ = graded
    for row in result.rows:
        page = next((result.feedback / row.student / LAB).glob("*.html")).read_text(encoding="utf-8")
        for secret in ("student.rng", "_random_cost", "compare_astar", "autograder/hidden"):
            assert secret not in page, f"{row.student}: {secret}"
