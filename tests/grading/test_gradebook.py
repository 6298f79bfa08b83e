"""The gradebook's writer against nbgrader itself, on the same executed notebooks."""

from __future__ import annotations

import json
import shutil
import sqlite3
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbformat.notebooknode import NotebookNode
from nbgrader.api import Gradebook
from nbgrader.preprocessors import NbGraderPreprocessor

from robotbrain.errors import InputError
from robotbrain.grading import backups, intake
from robotbrain.grading.course import Course, find_course, generate, run_nbgrader
from robotbrain.grading.writer import Writer, submitted_at
from tests.grading import gradebooks, toylab

LAB = toylab.LAB
FULL = {"score-scale": 4.0, "score-total": 6.0, "score-mean": 5.0}
_EXECUTED: dict[str, Path] = {}


class TakeOutputs(NbGraderPreprocessor):  # type: ignore[misc]
    """Stands where nbgrader executes a notebook, and brings the outputs of a run."""

    def preprocess(self, nb: NotebookNode, resources: dict[str, Any]) -> tuple[NotebookNode, dict[str, Any]]:
        path = _EXECUTED[resources["nbgrader"]["student"]]
        for cell, done in zip(nb.cells, nbformat.read(path, as_version=4).cells, strict=True):
            assert cell.source == done.source
            if cell.cell_type == "code":
                cell.outputs, cell.execution_count = done.outputs, done.execution_count
        return nb, resources


def _class(submitted: Path) -> dict[str, dict[str, object]]:
    """Submissions of every kind; returns what their cells gave."""
    toylab.submit(submitted, "amara", _edited(essay="Because.", program="plot(1)"))
    folder = toylab.submit(submitted, "bilal", _edited())
    (folder / "timestamp.txt").write_text("2026-11-20 10:00:00 UTC\n")
    (folder / "own").mkdir()
    (folder / "own" / "helper.py").write_text("x = 1\n")
    (folder / "given.py").write_text("VALUE = 2\n")
    (folder / "other.ipynb").write_text("{}")
    deleted = _edited(essay="Perhaps.")
    deleted.cells = [c for c in deleted.cells if c["id"] not in ("toy-3", "task")]
    folder = toylab.submit(submitted, "chen", deleted)
    (folder / "timestamp.txt").write_text("2026-11-01 10:00:00 UTC\n")
    toylab.submit(submitted, "dagny", "{broken")
    return {
        "amara": dict(FULL),
        "bilal": {"score-scale": 4.0, "score-total": 2.5, "score-mean": 0.0},
        "chen": {"score-scale": "a warning", "score-mean": 5.0},
        "dagny": {},
    }


def _edited(**answers: str) -> NotebookNode:
    master = gradebooks.solved_with_extras()
    for cell in master.cells:
        cell.source = answers.get(cell["id"], cell.source)
    return master


def _write(course: Course, executed: dict[str, Path]) -> None:
    with Writer(course, LAB, log=None, on_wait=pytest.fail) as writer:
        for student, path in executed.items():
            writer.enter(student, course.root / course.submitted / student / LAB, {LAB: path})


def _stock(course: Course) -> None:
    name = f"{__name__}.TakeOutputs"
    steps = ["IgnorePattern", "LimitOutput", "SaveAutoGrades", "AssignLatePenalties", "CheckCellMetadata"]
    error = run_nbgrader(
        course,
        "Autograde",
        LAB,
        Autograde__autograde_preprocessors=[name, *(f"nbgrader.preprocessors.{s}" for s in steps)],
    )
    assert error == ""


def _files(course: Course) -> dict[str, tuple[bytes, int]]:
    folder = course.root / course.autograded
    paths = [p for p in sorted(folder.rglob("*")) if p.is_file()]
    return {p.relative_to(folder).as_posix(): (p.read_bytes(), p.stat().st_mode & 0o777) for p in paths}


@pytest.fixture(scope="module")
def released(tmp_path_factory: pytest.TempPathFactory) -> Course:
    """An isolated run of the wide course with its release, a due date and a class."""
    base = tmp_path_factory.mktemp("gradebook")
    course = find_course(gradebooks.make_course(base / "course")).isolated(base / "run", LAB)
    generate(course, LAB)
    with Gradebook(course.gradebook_url) as gradebook:
        gradebook.update_or_create_assignment(LAB, duedate=datetime(2026, 11, 10))
    for student, scores in _class(course.root / course.submitted).items():
        path = course.root / course.submitted / student / LAB / f"{LAB}.ipynb"
        notebook = gradebooks.executed(path, course.sources(LAB)[0], scores)
        nbformat.write(notebook, course.root / f"{student}.ipynb")
    return course


@pytest.fixture
def pair(released: Course, tmp_path: Path) -> tuple[Course, Course, dict[str, Path]]:
    """The same class in two courses, and its executed notebooks."""
    stock, ours = (replace(released, root=tmp_path / name) for name in ("stock", "ours"))
    for course in (stock, ours):
        shutil.copytree(released.root, course.root)
    executed = {p.stem: p for p in sorted(ours.root.glob("*.ipynb"))}
    _EXECUTED.clear()
    _EXECUTED.update(executed)
    return stock, ours, executed


def _grade_by_hand(course: Course) -> None:
    with Gradebook(course.gradebook_url) as gradebook:
        essay = gradebook.find_grade("essay", LAB, LAB, "amara")
        essay.manual_score, essay.needs_manual_grade = 2.0, False
        total = gradebook.find_grade("score-total", LAB, LAB, "bilal")
        total.manual_score, total.extra_credit, total.needs_manual_grade = 5.0, 1.5, False
        gradebook.find_comment("scale", LAB, LAB, "bilal").manual_comment = "Nicely done."
        gradebook.db.commit()


def test_tables_and_files_are_those_of_nbgrader(pair: tuple[Course, Course, dict[str, Path]]) -> None:
    stock, ours, executed = pair
    _stock(stock)
    _write(ours, executed)
    said = backups.contents(stock.gradebook_url)
    assert said == backups.contents(ours.gradebook_url)
    assert _files(stock) == _files(ours)
    # The comparison is about something: every kind of row is there, late penalties too.
    assert all(said[t] for t in ("grade", "comment", "submitted_notebook", "task_cells", "solution_cells"))
    assert sorted(row[-1] for row in said["submitted_notebook"] if row[-1]) == [6.5]
    assert "bilal/toy/own/helper.py" in _files(ours) and "bilal/toy/other.ipynb" not in _files(ours)


def test_a_regrade_is_that_of_nbgrader_and_keeps_what_people_gave(pair: tuple[Course, Course, dict[str, Path]]) -> None:
    stock, ours, executed = pair
    _stock(stock)
    _write(ours, executed)
    for course in (stock, ours):
        _grade_by_hand(course)
        (course.root / course.submitted / "bilal" / LAB / "own" / "helper.py").unlink()
    notebook = nbformat.read(executed["bilal"], as_version=4)
    text = nbformat.writes(notebook).replace('"2.5"', '"3.5"')
    executed["bilal"].write_text(text)
    _stock(stock)
    _write(ours, executed)
    assert backups.contents(stock.gradebook_url) == backups.contents(ours.gradebook_url)
    assert _files(stock) == _files(ours)
    with Gradebook(ours.gradebook_url) as gradebook:
        total = gradebook.find_grade("score-total", LAB, LAB, "bilal")
        assert (total.auto_score, total.manual_score, total.extra_credit, total.score) == (3.5, 5.0, 1.5, 6.5)
        assert gradebook.find_comment("scale", LAB, LAB, "bilal").comment == "Nicely done."


def test_writing_twice_changes_nothing_and_removes_leftovers(pair: tuple[Course, Course, dict[str, Path]]) -> None:
    _, ours, executed = pair
    _write(ours, executed)
    before = backups.contents(ours.gradebook_url), _files(ours)
    leftover = ours.root / ours.autograded / "chen" / LAB / "old" / ".toy.ipynb.x1.tmp"
    leftover.parent.mkdir()
    leftover.write_text("half")
    _write(ours, executed)
    assert (backups.contents(ours.gradebook_url), _files(ours)) == before
    assert not leftover.parent.exists()


def test_a_failure_leaves_a_student_as_before(pair: tuple[Course, Course, dict[str, Path]]) -> None:
    _, ours, executed = pair
    _write(ours, {"amara": executed["amara"]})
    before = backups.contents(ours.gradebook_url)
    bad = nbformat.read(executed["amara"], as_version=4)
    scores = [c for c in bad.cells if c["metadata"].get("nbgrader", {}).get("grade_id", "").startswith("score")]
    scores[0].outputs[-1].data["text/plain"] = "3.0"
    scores[-1].outputs[-1].data["text/plain"] = "99"  # nbgrader refuses more than the points there are
    nbformat.write(bad, executed["amara"])
    with pytest.raises(ValueError, match="greater than maximum"):
        _write(ours, {"amara": executed["amara"]})
    assert backups.contents(ours.gradebook_url) == before


def test_a_locked_gradebook_is_waited_for(pair: tuple[Course, Course, dict[str, Path]]) -> None:
    _, ours, executed = pair
    said: list[str] = []
    locked = threading.Event()
    file = backups.sqlite_file(ours.gradebook_url)
    assert file is not None

    def formgrader() -> None:
        connection = sqlite3.connect(file, isolation_level=None)
        connection.execute("BEGIN IMMEDIATE")
        locked.set()
        _until(lambda: bool(said))
        connection.execute("COMMIT")
        connection.close()

    with Writer(ours, LAB, log=None, on_wait=said.append) as writer:
        other = threading.Thread(target=formgrader)
        other.start()
        locked.wait()
        writer.enter("amara", None, {LAB: executed["amara"]})
        other.join()
    assert len(said) == 1 and "formgrader" in said[0]
    with Gradebook(ours.gradebook_url) as gradebook:
        assert gradebook.find_submission(LAB, "amara").score == 15.0


def _until(done: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60
    while not done() and time.monotonic() < deadline:
        time.sleep(0.01)


@pytest.mark.parametrize("text", ["", "yesterday-ish", "\x00", "9" * 5000, "2026-99-99 10:00:00 UTC"])
def test_an_unreadable_timestamp_is_none(text: str) -> None:
    assert submitted_at(intake.Received({"timestamp.txt": text.encode()})) is None
    assert submitted_at(intake.Received({"timestamp.txt": b"\xff"})) is None
    assert submitted_at(intake.Received({"timestamp.txt": b"2026-11-20 10:00 UTC\n"})) == datetime(2026, 11, 20, 10)


def test_backups_are_whole_few_and_only_made_of_changes(
    pair: tuple[Course, Course, dict[str, Path]], tmp_path: Path
) -> None:
    _, ours, executed = pair
    url, folder = ours.gradebook_url, tmp_path / "backups"
    assert backups.backup(f"sqlite:///{tmp_path / 'none.db'}", folder) is None
    made = []
    for student, path in executed.items():
        _write(ours, {student: path})
        made.append(backups.backup(url, folder, keep=2))
        assert backups.contents(f"sqlite:///{made[-1]}") == backups.contents(url)
    assert backups.backup(url, folder, keep=2) == made[-1]
    assert sorted(folder.iterdir()) == made[-2:]


def test_a_gradebook_can_be_copied_to_another_database(
    pair: tuple[Course, Course, dict[str, Path]], tmp_path: Path
) -> None:
    _, ours, executed = pair
    _write(ours, executed)
    target = f"sqlite:///{tmp_path / 'copy.db'}"
    backups.copy_gradebook(ours.gradebook_url, target)
    assert backups.contents(target) == backups.contents(ours.gradebook_url)
    with Gradebook(target) as gradebook:
        assert gradebook.find_submission(LAB, "amara").score == 15.0
    with pytest.raises(InputError, match="an empty database"):
        backups.copy_gradebook(ours.gradebook_url, target)


def test_what_a_gradebook_says_does_not_hide_a_difference(
    pair: tuple[Course, Course, dict[str, Path]], tmp_path: Path
) -> None:
    _, ours, executed = pair
    _write(ours, executed)
    before = json.dumps(backups.contents(ours.gradebook_url), default=str)
    _grade_by_hand(ours)
    assert json.dumps(backups.contents(ours.gradebook_url), default=str) != before
