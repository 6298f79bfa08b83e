"""Statistics against closed forms, and the pages and exports of a small class."""

from __future__ import annotations

import csv
import io
import itertools
import json
import math
import zipfile
from pathlib import Path

import nbformat
import numpy as np
import pytest
from nbgrader.api import Gradebook

from robotbrain.cli import main as cli
from robotbrain.errors import InputError
from robotbrain.grading.course import find_course
from robotbrain.grading.marks import Marks
from robotbrain.grading.reports import export, feedback, gradescope, statistics
from robotbrain.grading.reports.classpage import class_page, histogram, items_text
from robotbrain.grading.reports.grades import graded_notebook, open_gradebook
from robotbrain.grading.reports.items import analyse
from robotbrain.grading.reports.model import graded_class, marks_from

from . import reportclass as made

GUTTMAN = [[int(j < i) for j in range(4)] for i in range(5)]  # a perfect scale: totals 0..4


def test_alpha_is_kr20_for_binary_items() -> None:
    # The Guttman scale of 4 items by hand: p = 4/5, 3/5, 2/5, 1/5, sum of pq = 0.8, variance of totals = 2.
    assert statistics.cronbach_alpha(np.array(GUTTMAN, float)) == pytest.approx(4 / 3 * (1 - 0.8 / 2))
    scores = np.random.default_rng(0).integers(0, 2, (40, 7)).astype(float)
    p = scores.mean(axis=0)
    kr20 = 7 / 6 * (1 - (p * (1 - p)).sum() / scores.sum(axis=1).var())
    assert statistics.cronbach_alpha(scores) == pytest.approx(kr20)


def test_alpha_at_its_limits() -> None:
    rng = np.random.default_rng(1)
    same = np.repeat(rng.normal(size=(30, 1)), 5, axis=1)
    assert statistics.cronbach_alpha(same) == pytest.approx(1.0)
    scores = rng.normal(size=(30, 5)) + same
    assert statistics.cronbach_alpha(10 * scores + 3) == pytest.approx(statistics.cronbach_alpha(scores))
    # Equal variances v and covariances c: alpha is Spearman and Brown's k r / (1 + (k - 1) r) with r = c / v.
    x = np.array(list(itertools.product((-1, 1), repeat=3)), float)
    tau = np.column_stack([x[:, 0] + x[:, 1], x[:, 0] + x[:, 2]])
    assert statistics.cronbach_alpha(tau) == pytest.approx(2 * 0.5 / 1.5)
    assert math.isnan(statistics.cronbach_alpha(np.ones((5, 3))))
    assert math.isnan(statistics.cronbach_alpha(np.ones((5, 1))))


def test_point_biserial_is_the_textbook_formula_on_the_other_items() -> None:
    scores = np.random.default_rng(2).integers(0, 2, (50, 6)).astype(float)
    for j in range(6):
        rest = scores.sum(axis=1) - scores[:, j]
        right, wrong, p = rest[scores[:, j] == 1], rest[scores[:, j] == 0], scores[:, j].mean()
        expected = (right.mean() - wrong.mean()) / rest.std() * math.sqrt(p * (1 - p))
        assert statistics.discrimination(scores, j) == pytest.approx(expected)
        assert statistics.difficulty(scores[:, j], 1.0) == p


def test_discrimination_without_variation_is_not_a_number() -> None:
    scores = np.column_stack([np.full(9, 0.1), np.arange(9.0)])
    assert math.isnan(statistics.discrimination(scores, 0)) and math.isnan(statistics.discrimination(scores, 1))
    mirrored = np.column_stack([np.arange(9.0), -np.arange(9.0)])
    assert statistics.discrimination(mirrored, 0) == pytest.approx(-1.0)


def test_upper_lower_groups() -> None:
    totals = np.arange(100.0)
    assert statistics.upper_lower((totals >= 73).astype(float), totals, 1.0) == pytest.approx(1.0)
    assert statistics.upper_lower((totals < 27) * 2.0, totals, 2.0) == pytest.approx(-1.0)
    assert statistics.upper_lower((totals >= 50).astype(float), np.zeros(100), 1.0) == pytest.approx(0.0)  # all tie
    # 10 students, 2.7 places: one has the highest total, two of the four who tie next share 1.7 places, none the rest.
    totals = np.array([9.0] + [5.0] * 4 + [1.0] * 5)
    item = np.array([1.0, 1, 1, 0, 0, 0, 0, 0, 0, 0])
    assert statistics.upper_lower(item, totals, 1.0) == pytest.approx((1 + 1.7 * 2 / 4) / 2.7)
    rng = np.random.default_rng(4)
    item, tied = rng.random(37), rng.integers(0, 4, 37).astype(float)
    order = rng.permutation(37)
    there = statistics.upper_lower(item, tied, 1.0)
    assert statistics.upper_lower(item[order], tied[order], 1.0) == pytest.approx(there)


def test_least_notable_correlation() -> None:
    assert [round(statistics.least_notable(n), 2) for n in (10, 30, 103)] == [0.63, 0.36, 0.19]
    assert statistics.least_notable(4) == 1.0


def test_items_of_a_guttman_class() -> None:
    found = analyse(graded_class(made.binary_class([*GUTTMAN[1:], *GUTTMAN[1:]])).rows)
    assert [e.difficulty for e in found.exercises] == [1.0, 0.75, 0.5, 0.25]
    assert found.exercises[0].flags == ("everybody passes",) and math.isnan(found.exercises[0].discrimination)
    assert found.dichotomous and found.small and found.students == 8
    assert found.alpha_exercises == pytest.approx(4 / 3 * (1 - (0.1875 + 0.25 + 0.1875) / 1.25))
    text = items_text(found)
    assert "everybody passes" in text and "KR-20" in text and "mean little" in text


def test_flags_and_who_is_left_out() -> None:
    weak_only = [[0, 0, 0, 1]] * 4 + [[1, 1, 0, 0]] * 4
    stored = made.binary_class(weak_only)
    unwritten = made.test_entry("t", share=0.0, verdict="not_written", exercise="e0")
    stored["students"].append(made.student("empty", [made.exercise("e0", [unwritten])]))
    found = analyse(graded_class(stored).rows)
    assert (found.students, found.left_out) == (8, 1)
    flags = {e.exercise: e.flags for e in found.exercises}
    assert flags["e2"] == ("nobody passes",) and flags["e3"] == ("negative discrimination",) and flags["e0"] == ()


def test_mistakes_count_students_and_absent_tests_count_as_lost() -> None:
    wrong = [made.test_entry(n, share=0.0, hint="Count from zero.", misconception="off by one") for n in "ab"]
    rows = [made.student(s, [made.exercise("scale", wrong)]) for s in ("x", "y")]
    rows.append(made.student("z", [made.exercise("scale", [], points=4.0, earned=0.0, error="it hung")]))
    rows.append(made.student("w", [made.exercise("scale", [made.test_entry(n) for n in "ab"])]))
    found = analyse(graded_class({"lab": "toy", "students": [*rows, rows[0] | {"student": "v"}]}).rows)
    assert [(m.text, m.students) for m in found.exercises[0].mistakes] == [("off by one", 3)]
    assert found.tests[0].verdicts == {"failed": 3, "did not run": 1, "passed": 1}
    assert found.tests[0].difficulty == pytest.approx(0.2)
    assert analyse([]).students == 0 and items_text(analyse([]))


def small_class() -> dict[str, object]:
    """Four students: full, some, crashed and repaired, and one with an essay to be read."""
    good, bad = made.test_entry("small numbers"), made.test_entry("large numbers", share=0.0, hint="Use `2 * x`.")
    crash = made.test_entry("large numbers", share=0.0, verdict="crashed")
    essay = made.exercise("essay", [], points=3.0, earned=None)
    read = made.exercise("essay", [], points=3.0, earned=3.0)
    students = [
        made.student("amara", [made.exercise("scale", [good, good | {"name": "n"}]), read]),
        made.student("bilal", [made.exercise("scale", [good, bad]), read]),
        made.student("chen", [made.exercise("scale", [good, crash]), read], incidents=["a cell was lost"], layers=[]),
        made.student("=dagny", [made.exercise("scale", [good, bad]), essay]),
    ]  # fmt: skip
    return {"version": 1, "lab": "toy", "students": students}


def test_class_page_is_complete_and_its_filters_have_targets() -> None:
    text = class_page(
        graded_class(small_class()), {"bilal": "feedback/bilal/toy/toy.html"}, similar=frozenset({"chen"})
    )
    read = made.Page(text)
    assert read.problems == [] and read.headings[0] == 1
    assert all(b - a <= 1 for a, b in itertools.pairwise(read.headings))
    assert all(link[1:] in read.ids for link in read.links if link.startswith("#"))
    assert "feedback/bilal/toy/toy.html" in read.links
    rows = {v.strip() for tag, name, v in read.attributes if tag == "tr" and name == "class"}
    assert rows == {"full", "lost", "trouble lost similar", "lost hand"}
    assert {v for tag, n, v in read.attributes if tag == "th" and n == "scope"} == {"row", "col"}
    assert "ended the kernel, repaired or disturbed" in read.text and "1 of 4 submissions ran without" in read.text


def test_histogram_counts_everybody_once() -> None:
    plot = str(histogram([0.0, 0.1, 0.3, 0.3, 0.999, 1.0, 1.2]))
    assert "0 to 10 %: 1; 10 to 20 %: 1; 30 to 40 %: 2; 90 to 100 %: 3" in plot
    assert "Nobody" in str(histogram([]))


def test_feedback_page_says_what_counts_first() -> None:
    row = graded_class(small_class()).rows[1]
    text = feedback.feedback_page(row, made.notebook(made.answer("x = 1"), report={"title": "1 Scale"}), lab="toy")
    read = made.Page(text)
    assert read.problems == [] and read.headings[:2] == [1, 2]
    assert all(b - a <= 1 for a, b in itertools.pairwise(read.headings))
    order = ["5 of 7 points", "1 of 2 tests passed", "What to do next", "up to 2 points", "large numbers", "Your own"]
    places = [read.text.index(words) for words in order]
    assert places == sorted(places)
    assert ("html", "lang", "en") in read.attributes and read.links[0] == "#main" and "main" in read.ids
    assert "script" not in read.tags and "1 Scale" in read.text
    missing = [a for tag, a, _ in read.attributes if tag == "img" and a == "alt"]
    assert len(missing) == read.tags.count("img")


@pytest.mark.parametrize(
    ("layers", "told"),
    [
        (made.LAYERS, "in a sandbox (bubblewrap, namespaces, seccomp, limits)"),
        (("bubblewrap",), "without sandbox: namespaces, seccomp, limits missing"),
        ((), "without sandbox"),
        (None, ""),
    ],
)
def test_feedback_says_whether_there_was_a_sandbox(layers: tuple[str, ...] | None, told: str) -> None:
    row = graded_class(small_class()).rows[0]
    row.layers = None if layers is None else list(layers)
    text = made.Page(feedback.feedback_page(row, made.notebook(), lab="toy")).text
    assert told in text and ("sandbox" in text) == bool(told)


def test_steps_begin_with_what_others_build_on_and_with_most_to_gain() -> None:
    def failed(name: str, points: float, **more: object) -> dict[str, object]:
        return made.exercise(name, [made.test_entry("t", share=0.0, points=points, exercise=name)], **more)

    exercises = [failed("a", 1.0), failed("b", 9.0), failed("c", 5.0, substituted=["a"]), failed("d", 2.0)]
    row = graded_class({"lab": "toy", "students": [made.student("x", exercises)]}).rows[0]
    text = made.Page(feedback.feedback_page(row, made.notebook(), lab="toy")).text
    steps = text[text.index("What to do next") : text.index("Points per exercise")]
    assert [steps.count(f"{n} (up to") for n in "abcd"] == [1, 1, 1, 0]
    assert steps.index("a (up to") < steps.index("b (up to") < steps.index("c (up to")


@pytest.fixture
def gradebook(tmp_path: Path) -> str:
    url = f"sqlite:///{tmp_path / 'gradebook.db'}"
    with Gradebook(url) as book:
        book.add_assignment("toy")
        book.add_notebook("toy", "toy")
        book.add_grade_cell("score-scale", "toy", "toy", max_score=4, cell_type="code")
        book.add_solution_cell("scale", "toy", "toy")
        book.add_student("bilal")
        submission = book.add_submission("toy", "bilal")
        (grade,) = submission.notebooks[0].grades
        grade.auto_score, grade.manual_score, grade.extra_credit = 2.0, 3.0, 0.5
        submission.notebooks[0].comments[0].manual_comment = "Nice <b>idea</b>."
        book.db.commit()
    return url


def test_manual_grades_and_comments_come_from_the_gradebook(gradebook: str, tmp_path: Path) -> None:
    with open_gradebook(gradebook) as book:
        graded = graded_notebook(book, "toy", "bilal", "toy")
        assert graded_notebook(book, "toy", "nobody", "toy") is None
    assert graded is not None and graded.points == 3.5 and graded.comments == {"scale": "Nice <b>idea</b>."}
    folder = tmp_path / "autograded"
    folder.mkdir()
    (folder / "toy.ipynb").write_text(json.dumps(made.notebook(made.answer("x = 1"))))
    for name in feedback.CARRIED:  # nbgrader's exchange releases no feedback without these beside it
        (folder / name).write_text(name)
    rows = graded_class(small_class()).rows[1:2]
    pages = feedback.write_feedback(tmp_path / "feedback", "toy", rows, lambda _: [folder / "toy.ipynb"], gradebook)
    assert pages == {"bilal": [tmp_path / "feedback" / "bilal" / "toy" / "toy.html"]}
    assert [(pages["bilal"][0].parent / name).read_text() for name in feedback.CARRIED] == list(feedback.CARRIED)
    text = made.Page(pages["bilal"][0].read_text()).text
    assert "3.5 of 4 points" in text and "Graded by hand: 3 points" in text and "Nice <b>idea</b>." in text


def test_answers_in_words_are_called_as_the_heading_above_them() -> None:
    def words(name: str) -> nbformat.NotebookNode:
        cell = nbformat.v4.new_markdown_cell("# my own heading")
        cell.metadata["nbgrader"] = {"grade": True, "grade_id": name}
        return cell

    heading = nbformat.v4.new_markdown_cell("# Lab\ntext\n### Exercise 5.2: report (10 points, by hand)\nmore")
    other = nbformat.v4.new_markdown_cell("## Part 6: the end")
    cells = [words("early"), heading, words("one"), other, words("last-a"), words("last-b")]
    titles = {"early": "Answer in words", "one": "5.2 Report"}
    titles |= {"last-a": "Part 6: the end (a)", "last-b": "Part 6: the end (b)"}
    assert feedback._titles({"cells": cells}) == titles


NAMES = {"amara": "Diop, Amara", "bilal": "=cmd()", "chen": "Wei Chen", "=dagny": "D"}
ROSTER = "student,name,email,id,sis_id,login,section\n" + "\n".join(
    f"{s},\"{n}\",{s.strip('=')}@uni.example,{i},S{i},{s.strip('=')},A"
    for i, (s, n) in enumerate(NAMES.items(), 100)
)  # fmt: skip


@pytest.fixture
def roster(tmp_path: Path) -> Path:
    path = tmp_path / "roster.csv"
    path.write_text(ROSTER, encoding="utf-8-sig")
    return path


def read_csv(text: str, delimiter: str = ",") -> list[list[str]]:
    return list(csv.reader(io.StringIO(text, newline=""), delimiter=delimiter))


def test_lms_exports_read_back_what_was_graded(roster: Path) -> None:
    rows, people = graded_class(small_class()).rows, export.read_roster(roster)
    table = read_csv(export.canvas(rows, "Toy lab", "4711", people))
    assert table[0] == ["Student", "ID", "SIS User ID", "SIS Login ID", "Section", "Toy lab (4711)"]
    assert table[1] == ["    Points Possible", "", "", "", "", "7"]
    assert [r[1:] for r in table[2:]] == [
        ["100", "S100", "amara", "A", "7"],
        ["101", "S101", "bilal", "A", "5"],
        ["102", "S102", "chen", "A", "5"],
        ["103", "S103", "dagny", "A", ""],  # half graded is not graded
    ]
    assert [r[0] for r in table[2:4]] == ["Diop, Amara", "'=cmd()"]
    moodle = read_csv(export.moodle(rows, "Toy lab", people))
    assert [r[:2] + r[3:4] for r in moodle[1:3]] == [
        ["S100", "amara@uni.example", "7"],
        ["S101", "bilal@uni.example", "5"],
    ]
    board = read_csv(export.blackboard(rows, "Toy lab", "99", people), "\t")
    assert board[0] == ["Last Name", "First Name", "Username", "Student ID", "Toy lab [Total Pts: 7 Score] |99"]
    assert [r[:3] for r in board[1:4:2]] == [["Diop", "Amara", "amara"], ["Chen", "Wei", "chen"]]
    assert {len(r) for r in board} == {5}


def test_ids_are_exact_or_refused(roster: Path) -> None:
    rows = graded_class(small_class()).rows
    with pytest.raises(InputError, match="=dagny"):
        export.canvas(rows, "Toy lab")
    roster.write_text("student,name\namara,x\namara,y\n", encoding="utf-8")
    with pytest.raises(InputError, match="each student once"):
        export.read_roster(roster)
    roster.write_text("student,name\namara,x\n", encoding="utf-8")
    with pytest.raises(InputError, match="bilal"):
        export.canvas(rows, "Toy lab", roster=export.read_roster(roster))
    with pytest.raises(InputError, match="folder"):
        marks_from(made.student("../x", []))


def test_gradescope_results_follow_the_specification() -> None:
    hidden = made.test_entry("others", share=0.0, hidden=True, given="SECRET", hint="Think.")
    tests = [made.test_entry("t"), hidden]
    entries = [
        made.exercise("scale", tests, points=8.0, earned=4.0),
        made.exercise("essay", [], points=3.0, earned=None),
    ]
    entries.append(made.exercise("lost", [], points=2.0, earned=0.0, error="it hung"))
    row = marks_from(made.student("x", entries, layers=[]))
    results = json.loads(json.dumps(gradescope.gradescope_results(row)))
    assert results["score"] == sum(t["score"] for t in results["tests"]) == 4.0
    assert [t["max_score"] for t in results["tests"]] == [
        4.0,
        4.0,
        2.0,
    ]  # points as they count, not as the tests are weighed
    assert [t["visibility"] for t in results["tests"]] == ["visible", "after_published", "visible"]
    assert [t["status"] for t in results["tests"]] == ["passed", "failed", "failed"]
    assert results["stdout_visibility"] == "hidden" and "without sandbox" in results["output"]
    assert "SECRET" not in json.dumps(results) and "Think." in results["tests"][1]["output"]
    assert all(isinstance(t["name"], str) and t["number"] for t in results["tests"])
    with pytest.raises(InputError, match="after_due_date"):
        gradescope.gradescope_results(row, hidden="never")


def test_gradescope_autograder_has_its_scripts_at_the_root(course_root: Path, tmp_path: Path) -> None:
    archive = gradescope.write_autograder(tmp_path / "autograder", find_course(course_root), "toy", "1.0")
    with zipfile.ZipFile(archive) as file:
        modes = {i.filename: (i.external_attr >> 16) & 0o777 for i in file.infolist()}
        scripts = [file.read(name).decode() for name in ("setup.sh", "run_autograder")]
    assert modes["setup.sh"] & 0o111 and modes["run_autograder"] & 0o111
    assert {"course/solutions/toy/toy.ipynb", "course/autograder/hidden/toy.py"} <= set(modes)
    assert all(s.startswith("#!/usr/bin/env bash\n") for s in scripts)
    assert "--lab toy" in scripts[1] and "/autograder/results/results.json" in scripts[1]


def test_gradescope_run_always_leaves_results(
    course_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "results.json"
    (tmp_path / "metadata.json").write_text('{"users": [{"email": "amara@uni.example"}]}')
    arguments = ["--course", str(course_root), "--lab", "toy", "--submission", str(tmp_path / "submission")]
    arguments += ["--metadata", str(tmp_path / "metadata.json"), "--out", str(out)]
    assert gradescope.main(arguments) == 0
    assert json.loads(out.read_text())["score"] == 0 and "notebook" in json.loads(out.read_text())["output"]
    (tmp_path / "submission").mkdir()
    (tmp_path / "submission" / "toy.ipynb").write_text("{}")
    seen: list[str] = []

    def grade(course: object, path: Path, *, lab: str, student: str) -> Marks:
        seen.append(f"{path.name} {lab} {student}")
        return graded_class(small_class()).rows[0]

    monkeypatch.setattr("robotbrain.grading.classroom.grade_notebook", grade)
    assert gradescope.main(arguments) == 0
    assert seen == ["toy.ipynb toy amara@uni.example"] and json.loads(out.read_text())["score"] == 7.0


def test_report_command_writes_everything(tmp_path: Path, roster: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stored = small_class()
    base = tmp_path / "graded"
    (base / "results" / "toy").mkdir(parents=True)
    results = base / "results" / "toy" / "results.json"
    results.write_text(json.dumps(stored))
    for entry in stored["students"]:  # type: ignore[attr-defined]
        folder = base / "autograded" / entry["student"] / "toy"
        folder.mkdir(parents=True)
        (folder / "toy.ipynb").write_text(json.dumps(made.notebook(made.answer(f"x = {entry['student']!r}"))))
    formats = [word for name in ("csv", "canvas", "moodle", "blackboard", "gradescope") for word in ("--export", name)]
    assert cli(["report", str(results), "--similarity", "--roster", str(roster), *formats]) == 0
    out = results.parent / "report"
    made_files = {p.relative_to(out).as_posix() for p in out.rglob("*") if p.is_file()}
    assert {"class.html", "items.txt", "grades.csv", "canvas.csv", "moodle.csv", "blackboard.txt"} < made_files
    assert {"similarity/index.html", "feedback/bilal/toy/toy.html", "gradescope/results/bilal.json"} < made_files
    links = [link for link in made.Page((out / "class.html").read_text()).links if not link.startswith("#")]
    assert len(links) == 5 and all((out / link.replace("%3D", "=")).is_file() for link in links)
    assert "scale" in capsys.readouterr().out
    assert cli(["report", str(tmp_path / "none.json")]) == 2
    assert "grade-class" in capsys.readouterr().err
