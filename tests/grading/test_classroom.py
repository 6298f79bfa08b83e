"""A class graded end to end, with submissions that hang, die, cheat their worker, or are not there."""

from __future__ import annotations

import csv
import io
import json
import os
import re
import shutil
import sqlite3
import threading
from argparse import ArgumentParser
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from nbgrader.api import Gradebook

from robotbrain.errors import InputError
from robotbrain.grading import backups, classroom, commands, course, jobs, mutation, sample
from robotbrain.grading.changes import Change, changes_text
from robotbrain.grading.entry import Entry, Person
from robotbrain.grading.execute import Limits
from robotbrain.grading.gradebook import Standing
from robotbrain.grading.marks import Mark, Marks, csv_text, table
from tests.grading import toylab
from tests.grading.fakebench import FakeBench, answers

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
    earned = {s: r.earned for s, r in rows.items()}
    if os.name == "posix":
        assert earned.pop("chen") <= 15.0  # where its own parent is out of reach, the attempt costs nothing
    assert earned == {"amara": 15.0, "bilal": 11.0, "dagny": 0.0, "emeka": 13.0}
    assert rows["amara"].reason() == ""
    assert all(rows[s].reason() for s in ("bilal", "dagny", "emeka"))
    assert "no notebook" in rows["dagny"].reason()
    assert rows["emeka"].reason() == "mean: error (empty-mean)"


def test_nbgraders_gradebook_says_the_same(graded: tuple[Path, classroom.ClassResult]) -> None:
    base, result = graded
    with Gradebook(f"sqlite:///{base / 'out' / 'gradebook.db'}") as gradebook:
        scores = {s.student.id: s.score for s in gradebook.assignment_submissions("toy")}
    assert scores == {row.student: row.earned for row in result.rows}


def test_results_table_and_feedback_are_written(graded: tuple[Path, classroom.ClassResult]) -> None:
    _, result = graded
    stored = json.loads(result.results.read_text())
    assert stored == result.to_dict()
    assert [s["student"] for s in stored["students"]] == ["amara", "bilal", "chen", "dagny", "emeka"]
    assert stored["students"][4]["exercises"][2]["tests"][1]["hint_key"] == "empty-mean"
    assert "SECRET" not in json.dumps(stored)
    with result.table.open() as file:
        assert next(csv.DictReader(file))["total"] == "15.0"
    for row in result.rows:
        page = classroom.feedback_page(result, row.student)
        assert page is not None and "SECRET" not in page.read_text()


def test_a_single_notebook_is_graded_without_a_gradebook(
    course_root: Path, graded: tuple[Path, classroom.ClassResult]
) -> None:
    path = graded[0] / "submitted" / "emeka" / "toy" / "toy.ipynb"
    before = sorted(course_root.rglob("*"))
    options = classroom.Options(limits=LIMITS)
    marks = classroom.grade_notebook(course.find_course(course_root), path, options=options)
    assert marks.earned == 13.0
    assert sorted(p for p in course_root.rglob("*") if "__pycache__" not in p.parts) == [
        p for p in before if "__pycache__" not in p.parts
    ]


# From here on nothing is executed: what matters is what becomes of the outcomes.


@pytest.fixture(scope="module")
def template(course_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A course whose release and empty gradebook are there: making them takes seconds."""
    root = tmp_path_factory.mktemp("template") / "course"
    shutil.copytree(course_root, root)
    course.generate(course.find_course(root), "toy")
    return root


class Room:
    """A course with submissions of its own, graded in place."""

    def __init__(self, root: Path) -> None:
        self.root, self.bench = root, FakeBench()
        self.course = course.find_course(root)

    def submit(self, student: str, earned: float | str) -> None:
        folder = self.root / "autograder" / "submitted"
        shutil.rmtree(folder / student, ignore_errors=True)
        toylab.submit(folder, student, answers(earned) if isinstance(earned, float) else earned)

    def grade(self, **how: Any) -> classroom.ClassResult:
        self.bench.ran.clear()
        return classroom.grade_class(self.course, "toy", **how)

    def main(self, *arguments: str) -> int:
        parser = ArgumentParser()
        commands.grade_class_arguments(parser)
        return commands.grade_class_main(parser.parse_args(["toy", "--course", str(self.root), *arguments]))

    @property
    def url(self) -> str:
        return self.course.gradebook_url

    def scores(self) -> dict[str, float]:
        with Gradebook(self.url) as gradebook:
            return {s.student.id: s.score for s in gradebook.assignment_submissions("toy")}

    def backups(self) -> list[Path]:
        return sorted((self.root / "autograder" / "backups").glob("*.db"))


@pytest.fixture
def room(template: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Room]:
    root = tmp_path / "course"
    shutil.copytree(template, root)
    room = Room(root)
    monkeypatch.setattr(classroom, "open_bench", lambda *_: room.bench)
    monkeypatch.setattr(jobs, "_PACKAGE", tmp_path / "nothing")  # somebody may be at work on it
    room.submit("amara", 1.0)
    room.submit("bilal", 0.5)
    yield room


def _by_hand(room: Room, student: str, score: float) -> None:
    with Gradebook(room.url) as gradebook:
        grade = gradebook.find_grade("score-mean", "toy", "toy", student)
        grade.manual_score, grade.needs_manual_grade = score, False
        gradebook.find_comment("mean", "toy", "toy", student).manual_comment = "Well argued."
        gradebook.db.commit()


def test_a_run_over_an_unchanged_class_runs_and_writes_nothing(room: Room) -> None:
    room.grade()
    _by_hand(room, "amara", 4.0)
    before = backups.contents(room.url)
    files = {p: p.stat().st_mtime_ns for p in (room.root / "autograder" / "autograded").rglob("*")}
    again = room.grade()
    assert room.bench.ran == [] and again.changes == []
    assert all(row.cached for row in again.rows)
    assert backups.contents(room.url) == before  # the grade given by hand asks for no second look
    assert {p: p.stat().st_mtime_ns for p in (room.root / "autograder" / "autograded").rglob("*")} == files


def test_feedback_is_made_anew_only_for_whom_something_has_changed(room: Room) -> None:
    room.grade()
    pages = {s: classroom.feedback_page(room.grade(), s) for s in ("amara", "bilal")}
    for page in pages.values():
        assert page is not None
        page.write_text("old")
    _by_hand(room, "amara", 4.0)
    room.grade()
    assert [s for s, page in pages.items() if page and page.read_text() == "old"] == ["bilal"]
    assert pages["bilal"] is not None
    pages["bilal"].unlink()
    room.grade()
    assert pages["bilal"].is_file()
    pages["bilal"].write_text("old")
    room.submit("bilal", 0.25)
    room.grade(options=classroom.Options(feedback=False))
    assert pages["bilal"].read_text() == "old"
    room.grade()
    assert pages["bilal"].read_text() != "old"


def test_a_manual_grade_survives_a_regrade(room: Room) -> None:
    room.grade()
    _by_hand(room, "bilal", 4.5)
    room.submit("bilal", 0.0)
    result = room.grade()
    assert result.changes == [Change("bilal", 9.5, 4.5, result.changes[0].why)]
    assert "the submission has changed" in result.changes[0].why and "scale: " in result.changes[0].why
    with Gradebook(room.url) as gradebook:
        grade = gradebook.find_grade("score-mean", "toy", "toy", "bilal")
        assert (grade.auto_score, grade.manual_score, grade.needs_manual_grade) == (0.0, 4.5, True)
        assert gradebook.find_comment("mean", "toy", "toy", "bilal").comment == "Well argued."


def test_changed_tests_are_named_as_the_reason(room: Room) -> None:
    room.grade()
    hidden = room.root / "autograder" / "hidden" / "toy.py"
    hidden.write_text(hidden.read_text() + "\n# another test\n")
    room.bench = FakeBench()
    room.submit("amara", 0.5)
    result = room.grade()
    assert sorted(room.bench.ran) == ["amara", "bilal"]
    assert "tests or the environment have changed" in result.changes[0].why


def test_students_who_handed_in_nothing_have_an_explicit_zero(room: Room) -> None:
    with Gradebook(room.url) as gradebook:
        for student in ("chen", "dagny"):
            gradebook.add_student(student)
        gradebook.add_submission("toy", "dagny")
        grade = gradebook.find_grade("score-mean", "toy", "toy", "dagny")
        grade.manual_score = 3.0  # examined orally, say
        gradebook.db.commit()
    for _ in range(2):  # and the second run sees the zero of the first
        rows = {row.student: row for row in room.grade().rows}
        assert set(rows) == {"amara", "bilal", "chen"}
        assert rows["chen"].earned == 0.0 and "no notebook" in rows["chen"].reason()
        assert room.scores() == {"amara": 15.0, "bilal": 7.5, "chen": 0.0, "dagny": 3.0}
    assert classroom.feedback_page(room.grade(), "chen") is not None
    assert not (room.root / "autograder" / "submitted" / "chen").exists()
    room.submit("chen", 1.0)
    assert room.grade().changes[0].before == 0.0
    assert room.scores()["chen"] == 15.0


def test_a_folder_of_some_students_leaves_the_others_marks_alone(room: Room, tmp_path: Path) -> None:
    room.grade()
    toylab.submit(tmp_path / "late", "chen", answers(1.0))
    room.grade(submitted=tmp_path / "late")
    assert room.scores() == {"amara": 15.0, "bilal": 7.5, "chen": 15.0}


def test_nbgrader_stumbling_over_one_student_costs_the_others_nothing(
    room: Room, monkeypatch: pytest.MonkeyPatch
) -> None:
    room.grade()
    room.submit("amara", 0.5)
    room.submit("bilal", 0.25)
    publish = classroom.Writer._publish

    def fail(self: Any, student: str, *more: Any) -> None:
        if student == "amara":
            raise RuntimeError("inconsistent checksums")
        publish(self, student, *more)

    with monkeypatch.context() as patch:
        patch.setattr(classroom.Writer, "_publish", fail)
        rows = {row.student: row for row in room.grade().rows}
    assert room.scores() == {"amara": 0.0, "bilal": 3.75} == {s: r.earned for s, r in rows.items()}
    assert "could not enter" in rows["amara"].reason()
    assert "inconsistent checksums" in (room.root / "autograder" / "nbgrader.log").read_text()
    room.grade()
    assert room.scores() == {"amara": 7.5, "bilal": 3.75}


def test_a_failure_of_the_machine_writes_over_no_mark(room: Room) -> None:
    room.grade()
    room.submit("chen", 1.0)
    said: list[str] = []

    def fail(student: str) -> None:
        raise OSError("no space left on device")

    room.bench = FakeBench(fail)
    result = room.grade(options=classroom.Options(fresh=True), say=said.append)
    assert said == ["3 submissions could not be run (amara, bilal, chen); the same command tries them again."]
    assert room.scores() == {"amara": 15.0, "bilal": 7.5, "chen": 0.0}
    assert [row.earned for row in result.rows] == [0.0] * 3 and "no fault" in result.rows[2].reason()
    room.bench = FakeBench()
    room.grade(say=said.append)
    assert room.bench.ran == ["chen"] and len(said) == 1
    assert room.scores() == {"amara": 15.0, "bilal": 7.5, "chen": 15.0}


def test_a_run_waits_for_a_locked_gradebook_from_its_first_step(room: Room) -> None:
    file = backups.sqlite_file(room.url)
    assert file is not None
    formgrader = sqlite3.connect(file, isolation_level=None, check_same_thread=False)
    formgrader.execute("BEGIN EXCLUSIVE")
    said: list[str] = []

    def say(text: str) -> None:
        said.append(text)
        formgrader.execute("COMMIT")

    room.grade(say=say)
    assert len(said) == 1 and "formgrader" in said[0]
    assert room.scores() == {"amara": 15.0, "bilal": 7.5}


def test_a_dry_run_says_what_would_change_and_writes_nothing(room: Room, capsys: pytest.CaptureFixture[str]) -> None:
    room.grade()
    room.bench.ran.clear()
    room.submit("amara", 0.5)
    watched = ("gradebook.db", "autograded", "feedback", "results", "backups")

    def state() -> dict[Path, bytes]:
        roots = [room.root / "autograder" / name for name in watched]
        return {p: p.read_bytes() for r in roots for p in (r, *r.rglob("*")) if p.is_file()}

    before = state()
    assert room.main("--dry-run") == 0
    said = capsys.readouterr().err
    assert re.search(r"^amara +15 +7.5 .*scale: failed", said, re.MULTILINE)
    assert state() == before
    assert room.main("--yes") == 0
    assert room.bench.ran == ["amara"]  # what the dry run has done is not done again
    assert room.scores()["amara"] == 7.5


@pytest.mark.parametrize(
    ("terminal", "reply", "earned", "code"),
    [(False, "", 1.0, 0), (False, "", 0.0, 3), (True, "y\n", 0.0, 0), (True, "\n", 0.0, 3), (True, "n\n", 1.0, 3)],
)
def test_marks_go_down_only_if_a_person_agrees(
    room: Room,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    terminal: bool,
    reply: str,
    earned: float,
    code: int,
) -> None:
    room.grade()
    stdin = io.StringIO(reply)
    monkeypatch.setattr(stdin, "isatty", lambda: terminal, raising=False)
    monkeypatch.setattr("sys.stdin", stdin)
    room.submit("bilal", earned)
    room.submit("chen", 1.0)
    assert room.main() == code
    assert re.search(rf"^bilal +7.5 +{15 * earned:g} ", capsys.readouterr().err, re.MULTILINE)
    after = {"amara": 15.0, "bilal": 15.0 * earned, "chen": 15.0}
    assert room.scores() == (after if code == 0 else {"amara": 15.0, "bilal": 7.5})


def test_marks_are_entered_while_others_still_run(room: Room, monkeypatch: pytest.MonkeyPatch) -> None:
    room.submit("chen", 1.0)
    enter, entered, seen = Entry.enter, threading.Event(), dict[str, float]()

    def enter_and_tell(self: Entry, person: Person, standing: Standing) -> bool:
        done = enter(self, person, standing)
        entered.set()
        return done

    def wait_for_marks(student: str) -> None:
        if student == "chen" and entered.wait(60):
            seen.update(room.scores())

    monkeypatch.setattr(Entry, "enter", enter_and_tell)
    room.bench = FakeBench(wait_for_marks)
    room.grade()
    assert seen["amara"] == 15.0 and "chen" not in seen
    assert room.scores() == {"amara": 15.0, "bilal": 7.5, "chen": 15.0}


def test_where_marks_would_change_nothing_is_entered_before_somebody_agrees(room: Room) -> None:
    room.grade()
    room.submit("aaron", 1.0)
    room.submit("bilal", 0.0)
    asked: list[dict[str, float]] = []

    def confirm(changes: list[Change]) -> bool:
        assert [c.student for c in changes] == ["bilal"]
        asked.append(room.scores())
        return True

    result = room.grade(confirm=confirm)
    assert room.bench.ran == ["bilal", "aaron"]  # those who have marks come first
    assert asked == [{"amara": 15.0, "bilal": 7.5}]
    assert room.scores() == {"aaron": 15.0, "amara": 15.0, "bilal": 0.0}
    assert [row.student for row in result.rows] == ["aaron", "amara", "bilal"]


def test_a_gradebook_that_fails_meanwhile_does_not_stop_the_others(room: Room, monkeypatch: pytest.MonkeyPatch) -> None:
    room.submit("chen", 1.0)
    enter, failed = Entry.enter, list[str]()

    def fail_once(self: Entry, person: Person, standing: Standing) -> bool:
        if not failed:
            failed.append(person.student)
            raise OSError("no space left on device")
        return enter(self, person, standing)

    monkeypatch.setattr(Entry, "enter", fail_once)
    room.grade()
    assert failed == ["amara"] and room.bench.ran == ["amara", "bilal", "chen"]
    assert room.scores() == {"amara": 15.0, "bilal": 7.5, "chen": 15.0}


def test_a_mark_that_somebody_gives_meanwhile_is_not_written_over_unasked(room: Room) -> None:
    room.submit("chen", 0.0)
    other = Room(room.root)  # with a bench of its own
    asked: list[list[Change]] = []

    def grade_elsewhere(student: str) -> None:
        if student == "chen":
            with Gradebook(room.url) as gradebook:
                gradebook.update_or_create_student("chen")
                gradebook.update_or_create_submission("toy", "chen")
                gradebook.find_grade("score-mean", "toy", "toy", "chen").manual_score = 4.0
                gradebook.find_grade("score-scale", "toy", "toy", "chen").auto_score = 5.0
                gradebook.db.commit()

    room.bench = FakeBench(grade_elsewhere)
    room.grade(confirm=lambda changes: bool(asked.append(changes)))
    assert [(c.student, c.before, c.after) for c in asked[0]] == [("chen", 9.0, 4.0)]
    assert other.scores()["chen"] == 9.0


def test_limits_in_wall_time_stretch_where_submissions_share_a_core(
    room: Room, monkeypatch: pytest.MonkeyPatch
) -> None:
    scales: list[str] = []
    room.bench = FakeBench(lambda _: scales.append(os.environ["ROBOTBRAIN_TIME_SCALE"]))
    monkeypatch.setattr(classroom.scheduler, "usable_cores", lambda: 2)
    monkeypatch.setenv("ROBOTBRAIN_TIME_SCALE", "2")
    room.grade(workers=3)
    room.grade(options=classroom.Options(workers=1, fresh=True))
    assert scales == ["3.0"] * 2 + ["2.0"] * 2
    assert os.environ["ROBOTBRAIN_TIME_SCALE"] == "2"
    monkeypatch.delenv("ROBOTBRAIN_TIME_SCALE")
    room.grade(options=classroom.Options(workers=2, fresh=True))
    assert scales[4:] == ["1.0"] * 2 and "ROBOTBRAIN_TIME_SCALE" not in os.environ


def test_new_marks_need_no_agreement(room: Room, capsys: pytest.CaptureFixture[str]) -> None:
    assert room.main("--json") == 0
    out, err = capsys.readouterr()
    assert [s["earned"] for s in json.loads(out)["students"]] == [15.0, 7.5]
    assert "from" not in err


def test_the_gradebook_is_backed_up_before_a_run_writes(room: Room) -> None:
    room.grade()
    before = backups.contents(room.url)
    room.submit("amara", 0.5)
    room.grade()
    assert backups.contents(f"sqlite:///{room.backups()[-1]}") == before


def test_changes_are_listed_losses_first_and_on_one_line_each() -> None:
    changes = [Change("amara", 1.0, 2.0, "up"), Change("bilal", 2.0, 1.5, "scale:\x1b[2J failed\n" + "x" * 200)]
    head, first, second = changes_text(changes).splitlines()
    assert head.split() == ["student", "from", "to", "why"]
    assert first.startswith("bilal       2  1.5  scale: [2J failed xxx") and first.endswith("…")
    assert second == "amara       1    2  up"


def test_wrong_folders_and_labs_are_explained(course_root: Path, tmp_path: Path) -> None:
    home = course.find_course(course_root)
    with pytest.raises(InputError, match="one of toy"):
        classroom.grade_class(home, "toi", out=tmp_path)
    with pytest.raises(InputError, match="--submitted"):
        classroom.grade_class(home, "toy", submitted=tmp_path / "nowhere", out=tmp_path / "out")
    with pytest.raises(InputError, match="--course"):
        course.find_course(tmp_path)


def test_links_in_a_submission_are_not_followed(room: Room, tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    toylab.submit(secret, "chen", answers(1.0))
    submitted = room.root / "autograder" / "submitted"
    try:
        (submitted / "chen").symlink_to(secret / "chen")
    except OSError:
        pytest.skip("no symbolic links here")
    row = {row.student: row for row in room.grade().rows}["chen"]
    assert row.earned == 0.0 and "link" in row.reason()


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
