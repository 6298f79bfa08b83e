"""The mutation test as a command, on the toy lab, and the table that it makes."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

import pytest

from robotbrain.grading import jobs, kills, mutation, mutation_run
from robotbrain.grading.classroom import Options
from robotbrain.grading.course import Course
from robotbrain.grading.execute import Limits
from tests.grading import toylab

DOUBLES, SECRET_DOUBLES = "scale: doubles a number", "scale: doubles other numbers"


OPTIONS = Options(limits=Limits(cell_s=2.0, graded_s=4.0, grace_s=1.0, wall_s=30.0))


@pytest.fixture(autouse=True, scope="module")
def _one_environment() -> Iterator[None]:
    """The digest of the installed package is none of this test's business."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jobs, "environment_digest", lambda *_: "environment")
        yield


@pytest.fixture(scope="module")
def outcome(course_root: Path, tmp_path_factory: pytest.TempPathFactory) -> mutation_run.Outcome:
    course = Course(course_root, course_root)
    assert mutation_run.with_mutants(course) == [toylab.LAB]
    return mutation_run.run(course, toylab.LAB, tmp_path_factory.mktemp("mutation"), OPTIONS)


def test_the_toy_labs_tests_find_their_mutants(outcome: mutation_run.Outcome) -> None:
    assert outcome.sound, [r for r in outcome.rows if r.problems]
    found = {m.name: m.killers for m in outcome.kills.mutants}
    assert found == {"squares": {DOUBLES, SECRET_DOUBLES}, "mean-of-nothing": {"mean: mean of nothing"}}
    assert outcome.idle == ["total: totals", "total: total of other lists", "mean: mean of some numbers"]
    assert "2 of 2 mutants killed, 6 tests, all graded as they should be" in outcome.text()


def test_the_table_is_written_as_csv_and_as_a_page(outcome: mutation_run.Outcome) -> None:
    with (outcome.page.parent / "kills.csv").open(encoding="utf-8") as file:
        table = {line["test"]: line for line in csv.DictReader(file)}
    assert table[DOUBLES]["squares"] == "1" and table[DOUBLES]["mean-of-nothing"] == "0"
    assert [t for t, line in table.items() if line["finds"] == "0"] == outcome.idle
    page = outcome.page.read_text(encoding="utf-8")
    assert all(m.describe in page for m in outcome.kills.mutants)
    assert page.count("✗</td>") == 3


def test_a_second_run_takes_all_from_the_cache(course_root: Path, outcome: mutation_run.Outcome) -> None:
    seen = []
    again = mutation_run.run(
        Course(course_root, course_root),
        toylab.LAB,
        outcome.page.parents[1],
        OPTIONS,
        lambda done, total, student: seen.append(done),
    )
    assert again.text() == outcome.text()
    assert len(seen) == len(outcome.rows)
    stored = sorted((outcome.page.parent / "graded" / ".executed" / "cache").glob("*.ipynb"))
    assert len(stored) <= len(outcome.rows)  # nothing ran under another key


def _row(name: str, own: float, killers: tuple[str, ...], problems: tuple[str, ...] = ()) -> mutation.Row:
    return mutation.Row(name, "mutant", name, own, own, killers, (), problems)


def test_cheap_mutants_and_idle_tests_are_flagged() -> None:
    tests = [{"exercise": "a", "name": n} for n in ("one", "<two>")]
    results = {"lab": "l", "students": [{"exercises": [{"exercise": "a", "points": 10.0, "tests": tests}]}]}
    rows = [
        _row("cheap", 1.0, ("a: one",)),
        _row("dear", 8.0, ("a: one",)),
        _row("alive", 0.0, (), ("no test finds it",)),
    ]
    manifest = {r.student: {"exercise": "a", "describe": "d"} for r in rows}
    found = kills.kills_of(results, rows, manifest)
    assert found.weak() == [("cheap", 0.1)]
    assert [found.count(t) for t in found.tests] == [2, 0]
    outcome = mutation_run.Outcome("l", rows, found, mutation.idle_tests(results, rows), Path("kills.html"))
    assert not outcome.sound
    assert "a: <two>" in outcome.text() and "1 of 3 submissions are graded wrongly" in outcome.text()


def test_names_cannot_break_the_page(tmp_path: Path) -> None:
    tests = [{"exercise": "a", "name": "<script>"}]
    results = {"lab": "l", "students": [{"exercises": [{"exercise": "a", "points": 1.0, "tests": tests}]}]}
    rows = [_row("m", 1.0, ("a: <script>",))]
    found = kills.kills_of(results, rows, {"m": {"exercise": "a", "describe": "&"}})
    page = kills.write_kills(tmp_path, results, rows, found).read_text(encoding="utf-8")
    assert "<script>" not in page and "a: &lt;script&gt;" in page
