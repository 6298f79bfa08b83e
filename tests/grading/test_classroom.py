"""A class graded end to end, with submissions that hang, die, cheat their worker, or are not there."""

from __future__ import annotations

import csv
import json
import os
from pathlib import Path
from typing import Any

import pytest
from nbgrader.api import Gradebook

from robotbrain.errors import InputError
from robotbrain.grading import classroom, course, mutation, sample
from robotbrain.grading.execute import Limits
from robotbrain.grading.marks import Mark, Marks, csv_text, table
from tests.grading import toylab

LIMITS = Limits(cell_s=2.0, graded_s=6.0, grace_s=1.0, wall_s=40.0)
KILLER = "import os, signal\nos.kill(os.getppid(), signal.SIGKILL)\nimport time\ntime.sleep(30)"


@pytest.fixture(scope="module")
def graded(course_root: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, classroom.ClassResult]:
    base = tmp_path_factory.mktemp("class")
    submitted = base / "submitted"
    toylab.submit(submitted, "amara", toylab.solved())
    toylab.submit(submitted, "bilal", toylab.solved(scale="while True: pass"))
    toylab.submit(submitted, "chen", toylab.solved(total=KILLER) if os.name == "posix" else "{broken")
    toylab.submit(submitted, "dagny", None)
    toylab.submit(submitted, "emeka", toylab.solved(mean="def mean(values):\n    return sum(values) / len(values)"))
    home = course.find_course(course_root)
    result = classroom.grade_class(home, "toy", submitted=submitted, out=base / "out", workers=2, limits=LIMITS)
    return base, result


def test_every_submission_ends_in_a_score_with_a_reason(graded: tuple[Path, classroom.ClassResult]) -> None:
    rows = {row.student: row for row in graded[1].rows}
    assert {s: r.earned for s, r in rows.items()} == {
        "amara": 15.0,
        "bilal": 11.0,
        "chen": 4.0 if os.name == "posix" else 0.0,
        "dagny": 0.0,
        "emeka": 13.0,
    }
    assert rows["amara"].reason() == ""
    assert all(row.reason() for name, row in rows.items() if name != "amara")
    assert "no notebook" in rows["dagny"].reason()
    assert rows["emeka"].reason() == "mean: error (empty-mean)"
    assert "interrupted" in rows["bilal"].reason()


def test_nbgraders_gradebook_says_the_same(graded: tuple[Path, classroom.ClassResult]) -> None:
    base, result = graded
    with Gradebook(f"sqlite:///{base / 'out' / 'gradebook.db'}") as gradebook:
        scores = {s.student.id: s.score for s in gradebook.assignment_submissions("toy")}
    assert scores == {row.student: row.earned for row in result.rows}


def test_results_table_and_feedback_are_written(graded: tuple[Path, classroom.ClassResult]) -> None:
    _, result = graded
    stored = json.loads(result.results.read_text())
    assert [s["student"] for s in stored["students"]] == ["amara", "bilal", "chen", "dagny", "emeka"]
    assert stored["students"][4]["exercises"][2]["tests"][1]["hint_key"] == "empty-mean"
    assert "SECRET" not in json.dumps(stored)
    with result.table.open() as file:
        assert next(csv.DictReader(file))["total"] == "15.0"
    for row in result.rows:
        page = classroom.feedback_page(result, row.student)
        assert page is not None
        assert not any(m.tests for m in row.marks) or "robotbrain-report" in page.read_text()


def test_a_second_run_takes_everything_sound_from_the_cache_and_changes_nothing(
    course_root: Path, graded: tuple[Path, classroom.ClassResult]
) -> None:
    base, first = graded
    home = course.find_course(course_root)
    toylab.submit(base / "submitted", "farah", toylab.solved())  # a late one
    again = classroom.grade_class(home, "toy", submitted=base / "submitted", out=base / "out", workers=2, limits=LIMITS)
    before = {r.student: r.earned for r in first.rows}
    assert {r.student: r.earned for r in again.rows} == before | {"farah": 15.0}
    cached = {r.student: r.cached for r in again.rows}
    assert cached == {
        "amara": True,
        "bilal": True,
        "chen": os.name != "posix",
        "dagny": True,
        "emeka": True,
        "farah": False,
    }


def test_a_single_notebook_is_graded_without_a_gradebook(
    course_root: Path, graded: tuple[Path, classroom.ClassResult]
) -> None:
    path = graded[0] / "submitted" / "emeka" / "toy" / "toy.ipynb"
    before = sorted(course_root.rglob("*"))
    marks = classroom.grade_notebook(course.find_course(course_root), path, limits=LIMITS)
    assert marks.earned == 13.0
    assert sorted(p for p in course_root.rglob("*") if "__pycache__" not in p.parts) == [
        p for p in before if "__pycache__" not in p.parts
    ]


def test_wrong_folders_and_labs_are_explained(course_root: Path, tmp_path: Path) -> None:
    home = course.find_course(course_root)
    with pytest.raises(InputError, match="one of toy"):
        classroom.grade_class(home, "toi", out=tmp_path)
    with pytest.raises(InputError, match="--submitted"):
        classroom.grade_class(home, "toy", submitted=tmp_path / "nowhere", out=tmp_path / "out")
    with pytest.raises(InputError, match="--course"):
        course.find_course(tmp_path)


def test_links_in_a_submission_are_not_followed(tmp_path: Path) -> None:
    secret = tmp_path / "secret.txt"
    secret.write_text("x")
    folder = tmp_path / "in" / "amara" / "toy"
    folder.mkdir(parents=True)
    try:
        (folder / "toy.ipynb").symlink_to(secret)
    except OSError:
        pytest.skip("no symbolic links here")
    classroom._copy(folder, tmp_path / "out")
    assert list((tmp_path / "out").iterdir()) == []


def test_the_sample_class_says_what_it_is_and_edits_must_fit(course_root: Path, tmp_path: Path) -> None:
    home = course.find_course(course_root)
    manifest = sample.make_class(home, "toy", tmp_path)
    kinds = [entry["kind"] for entry in manifest.values()]
    assert kinds.count("mutant") == 2 and kinds.count("style") == 1
    assert {"stub", "partly", "reference", "accident"} < set(kinds)
    texts = {s: p.read_text() for s in manifest if (p := tmp_path / s / "toy" / "toy.ipynb").exists()}
    assert all("hidden=True" not in t and "BEGIN SOLUTION" not in t for t in texts.values())
    by_name = {entry["name"]: student for student, entry in manifest.items()}
    assert "x ** 2" in texts[by_name["squares"]]
    assert "2 * x" not in texts[by_name["empty"]]
    assert manifest[by_name["syntax-error"]]["exercise"] == "scale"
    with pytest.raises(InputError, match="occurs once, not 0 times"):
        sample.Reference(home, "toy").edit({"scale": [("3 * x", "x")]}, "mutant")
    with pytest.raises(InputError, match="one of scale, total, mean"):
        sample.Reference(home, "toy").edit({"scael": "x"}, "mutant")


def _result(student: str, losses: dict[str, float], hints: dict[str, str] | None = None) -> dict[str, Any]:
    exercises = [
        {
            "exercise": name,
            "points": 10.0,
            "earned": 10.0 - losses.get(name, 0.0),
            "tests": [
                {
                    "exercise": name,
                    "name": f"test of {name}",
                    "verdict": "failed" if losses.get(name) else "passed",
                    "hint_key": (hints or {}).get(name, ""),
                }
            ],
        }
        for name in ("a", "b")
    ]
    # An essay of 7 points that nobody has read yet changes no verdict.
    exercises.append({"exercise": "essay", "points": 7.0, "earned": None, "tests": []})
    earned = 20.0 - sum(losses.values())
    return {"student": student, "points": 27.0, "pending": 7.0, "earned": earned, "exercises": exercises}


@pytest.mark.parametrize(
    ("entry", "losses", "hints", "problem"),
    [
        ({"expect": "full"}, {}, {}, ""),
        ({"expect": "full"}, {"a": 1.0}, {}, "should have full points"),
        ({"expect": "zero"}, {"a": 10.0, "b": 10.0}, {}, ""),
        ({"expect": "zero"}, {"a": 10.0}, {}, "should have no points"),
        ({"expect": "partial"}, {}, {}, "some of the points"),
        ({"expect": "exercise", "exercise": "a", "hint": "h"}, {"a": 4.0}, {"a": "h"}, ""),
        ({"expect": "exercise", "exercise": "a", "hint": "h", "loses": 4}, {"a": 5.0}, {"a": "h"}, "should lose 4"),
        ({"expect": "exercise", "exercise": "a", "hint": "h"}, {}, {}, "no test finds it"),
        ({"expect": "exercise", "exercise": "a", "hint": "h"}, {"a": 4.0}, {"a": "other"}, "is shown other"),
        ({"expect": "exercise", "exercise": "a", "hint": "h"}, {"a": 4.0, "b": 1.0}, {"a": "h"}, "also loses 1 in b"),
        ({"expect": "exercise", "exercise": "a", "hint": "h", "also": ["b"]}, {"a": 4.0, "b": 1.0}, {"a": "h"}, ""),
    ],
)
def test_mutation_judgement(
    entry: dict[str, Any], losses: dict[str, float], hints: dict[str, str], problem: str
) -> None:
    manifest = {"x": {"kind": "mutant", "name": "m", **entry}}
    rows = mutation.judge({"students": [_result("x", losses, hints)]}, manifest)
    assert (problem in " ".join(rows[0].problems)) if problem else rows[0].problems == ()
    assert ("BAD" in mutation.table(rows)) == bool(problem)


def test_idle_tests_are_named() -> None:
    results = {"students": [_result("x", {"a": 4.0})]}
    rows = mutation.judge(results, {"x": {"kind": "mutant", "name": "m", "expect": "exercise", "exercise": "a"}})
    assert mutation.idle_tests(results, rows) == ["b: test of b"]


def test_tables_are_safe_and_complete() -> None:
    rows = [Marks("=cmd", [Mark("g", "a", 5, 5.0), Mark("h", "essay", 3, None)], seconds=1.0)]
    assert "by hand" in table(rows)
    assert csv_text(rows).splitlines()[1].startswith("'=cmd,5,by hand,5.0")
