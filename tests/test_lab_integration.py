"""The lab itself: generated from its solution, and its tests tested by named wrong solutions."""

from __future__ import annotations

from pathlib import Path

import pytest

from robotbrain.grading import Suite, load_hidden_suite
from robotbrain.grading.course import find_course, release_differences
from robotbrain.grading.sample import load_mutants
from tests import classes

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
    classes.check_points(repo, LAB, suite, automatic=90, by_hand=10, titles=False)


def test_every_hint_and_every_mutant_is_of_use(repo: Path, suite: Suite) -> None:
    mutants, styles = load_mutants(find_course(repo), LAB)
    assert len(mutants) >= 10 and len(styles) == 3
    assert {m.hint for m in mutants} <= set(suite.hints)
    assert {m.exercise for m in mutants} == set(suite.exercises)


@pytest.fixture(scope="module")
def graded(repo: Path, tmp_path_factory: pytest.TempPathFactory) -> classes.Graded:
    return classes.grade_sample(repo, LAB, tmp_path_factory.mktemp("class"))


@pytest.mark.timeout(1200)
def test_every_mutant_loses_its_own_points_only_and_every_style_gets_all(graded: classes.Graded) -> None:
    classes.check_losses(graded, at_least=35)


def test_every_submission_ends_in_a_grade_and_a_feedback_page(graded: classes.Graded) -> None:
    classes.check_pages(graded, LAB)


def test_hidden_tests_do_not_show_in_feedback(graded: classes.Graded) -> None:
    classes.check_secrets(graded, LAB, "weighted_maze", "compare_astar")
