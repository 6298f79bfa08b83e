"""The scheduler, the journal, and a run that is killed, stopped and resumed."""

from __future__ import annotations

import gc
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import nbformat
import pytest
from nbformat.notebooknode import NotebookNode
from nbgrader.api import Grade, SubmittedAssignment, SubmittedNotebook

from robotbrain.errors import InputError
from robotbrain.grading import backups, classroom, jobs, scheduler
from robotbrain.grading.course import Course, find_course
from robotbrain.grading.execute import Limits
from robotbrain.grading.lock import only_run
from robotbrain.grading.marks import Mark, Marks
from tests.grading import toylab
from tests.grading.fakebench import FakeBench, answers


@pytest.mark.parametrize("workers", [1, 4])
def test_every_task_is_done_once_and_results_come_to_one_thread(workers: int) -> None:
    got: list[int] = []
    threads = set()

    def consume(result: int) -> None:
        got.append(result)
        threads.add(threading.current_thread())

    scheduler.run(range(200), lambda n: n * n, consume, workers=workers)
    assert sorted(got) == [n * n for n in range(200)]
    assert threads == {threading.current_thread()}


def test_workers_run_side_by_side() -> None:
    barrier = threading.Barrier(3, timeout=60)
    scheduler.run(range(3), lambda _: barrier.wait(), lambda _: None, workers=3)


def test_tasks_are_taken_as_they_are_needed() -> None:
    taken, done = 0, 0

    def feed() -> object:
        nonlocal taken
        for number in range(100):
            taken += 1
            assert taken - done <= 2 * 3 + 1
            yield number

    def consume(_: object) -> None:
        nonlocal done
        done += 1

    scheduler.run(feed(), lambda n: n, consume, workers=3)
    assert (taken, done) == (100, 100)


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_an_exception_stops_what_runs_and_begins_nothing_new(error: type[BaseException]) -> None:
    stopped = threading.Event()
    begun = []

    def work(number: int) -> int:
        begun.append(number)
        if number:
            assert stopped.wait(60)
        return number

    def consume(_: int) -> None:
        raise error

    with pytest.raises(error):
        scheduler.run(range(100), work, consume, workers=2, stop=stopped.set)
    assert len(begun) <= 4


def _journal(folder: Path, environment: str = "e") -> jobs.Journal:
    return jobs.Journal(folder, environment)


def _task(course: Course, folder: Path | None, student: str = "amara") -> jobs.Task:
    return jobs.Task(student, toylab.LAB, course.sources(toylab.LAB)[0], folder)


@pytest.fixture
def home(course_root: Path) -> Course:
    return find_course(course_root)


def test_what_has_run_is_not_run_again_until_something_changes(home: Course, tmp_path: Path) -> None:
    bench, journal = FakeBench(), _journal(tmp_path / "journal")
    folder = toylab.submit(tmp_path, "amara", answers())
    task = _task(home, folder)

    def ran(**how: object) -> bool:
        before = len(bench.ran)
        done = jobs.grade(home, how.get("task", task), how.get("journal", journal), bench, fresh=bool(how.get("fresh")))
        assert done.cached == (len(bench.ran) == before)
        return not done.cached

    assert ran() and not ran()
    assert ran(fresh=True)
    assert ran(task=_task(home, folder, "bilal"))  # tests may draw numbers per student
    assert ran(journal=_journal(tmp_path / "journal", "other tests"))
    (folder / "policy.onnx").write_bytes(b"1")
    assert ran() and not ran()
    (folder / "policy.onnx").write_bytes(b"2")
    assert ran()
    (folder / "toy.ipynb").write_text(nbformat.writes(answers(0.5)))
    assert ran() and not ran()


def test_nothing_handed_in_is_the_same_for_everybody(home: Course, tmp_path: Path) -> None:
    bench, journal = FakeBench(), _journal(tmp_path)
    done = [jobs.grade(home, _task(home, None, s), journal, bench) for s in ("amara", "bilal")]
    assert bench.ran == ["amara"]
    assert {d.key for d in done} == {done[0].key}
    assert journal.marks("bilal", done[1].key).student == "bilal"
    assert "no notebook" in journal.marks("bilal", done[1].key).reason()


@pytest.mark.parametrize("damage", ["", "{", "[]", '{"version": 0}', '{"version": 1, "marks": {}}'])
def test_a_damaged_record_is_run_again(home: Course, tmp_path: Path, damage: str) -> None:
    bench, journal = FakeBench(), _journal(tmp_path / "journal")
    task = _task(home, toylab.submit(tmp_path, "amara", answers()))
    first = jobs.grade(home, task, journal, bench)
    (journal.folder / f"{first.key}.json").write_text(damage)
    assert not jobs.grade(home, task, journal, bench).cached
    journal.executed(first.key).unlink()
    assert not jobs.grade(home, task, journal, bench).cached
    assert jobs.grade(home, task, journal, bench).cached


def test_a_failure_of_the_grader_is_a_zero_with_a_reason_and_not_kept(home: Course, tmp_path: Path) -> None:
    def fail(student: str) -> None:
        raise OSError("no space left")

    journal = _journal(tmp_path / "journal")
    task = _task(home, toylab.submit(tmp_path, "amara", answers()))
    done = jobs.grade(home, task, journal, FakeBench(fail))
    marks = journal.marks("amara", done.key)
    assert not done.sound and marks.earned == 0 and "no fault of the submission" in marks.reason()
    assert jobs.grade(home, task, journal, FakeBench()).scores == {
        "score-scale": 4.0,
        "score-total": 6.0,
        "score-mean": 5.0,
    }


def test_marks_come_back_from_the_journal_as_they_were(home: Course, tmp_path: Path) -> None:
    journal = _journal(tmp_path / "journal")
    done = jobs.grade(home, _task(home, toylab.submit(tmp_path, "amara", answers(0.5))), journal, FakeBench())
    marks = journal.marks("amara", done.key)
    assert marks.earned == 7.5 and marks.layers == ["fake"]
    assert type(marks).from_dict(marks.to_dict()) == marks


def test_the_environment_digest_notices_what_matters(tmp_path: Path) -> None:
    (tmp_path / "hidden").mkdir()
    test = tmp_path / "hidden" / "a.py"
    test.write_text("1")
    seen = [jobs.environment_digest([tmp_path], Limits(), ["x"]) for _ in range(2)]
    test.write_text("2")
    seen.append(jobs.environment_digest([tmp_path], Limits(), ["x"]))
    seen.append(jobs.environment_digest([tmp_path], Limits(cell_s=1.0), ["x"]))
    seen.append(jobs.environment_digest([tmp_path], Limits(), []))
    test.rename(tmp_path / "hidden" / "b.py")
    seen.append(jobs.environment_digest([tmp_path], Limits(), []))
    assert seen[0] == seen[1] and len(set(seen)) == 5


def _class(base: Path, students: int) -> None:
    toylab.make_course(base / "course")
    for number in range(students):
        toylab.submit(base / "in", f"s{number:03}", answers(number % 5 / 4) if number % 7 else "{broken")


def _grade(base: Path, pause_s: float) -> classroom.ClassResult:
    """Grade the class and note in a file who ran."""

    def note(student: str) -> None:
        with (base / "ran").open("a") as file:
            file.write(f"{student}\n")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(classroom, "open_bench", lambda *_: FakeBench(note, pause_s))
        patch.setattr(jobs, "_PACKAGE", base / "nothing")  # somebody may be at work on it
        home = find_course(base / "course")
        return classroom.grade_class(home, toylab.LAB, submitted=base / "in", out=base / "out", workers=3)


def _start(base: Path, pause_s: float) -> multiprocessing.process.BaseProcess:
    """The same in a process of its own; forked, because it has imported everything by now."""
    process = multiprocessing.get_context("fork").Process(target=_grade_for_a_person, args=(base, pause_s))
    process.start()
    return process


def _grade_for_a_person(base: Path, pause_s: float) -> None:
    """Heed Ctrl-C, which a shell's background job ignores, and what that starts, such as these tests."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    _grade(base, pause_s)


def _wait(process: multiprocessing.process.BaseProcess, moment: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 120
    while not moment() and process.is_alive() and time.monotonic() < deadline:
        time.sleep(0.002)
    assert process.is_alive() and moment(), "it ended too early"


def _files(folder: Path) -> dict[str, bytes]:
    paths = [p for kept in ("autograded", "feedback") for p in (folder / kept).rglob("*") if p.is_file()]
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in paths}


posix = pytest.mark.skipif(os.name != "posix", reason="needs fork and signals")


@posix
def test_a_run_killed_at_any_moment_is_completed_by_the_next(tmp_path: Path) -> None:
    """Killed twice while executing and entering, then while writing feedback; small benchmarks/grading_thousand.py."""
    _class(tmp_path, 24)
    out = tmp_path / "out"
    moments = [
        lambda: len(list(out.glob(".executed/cache/*.json"))) >= 5,
        lambda: len(list(out.glob(".executed/entered/toy/*.json"))) >= 12,
        lambda: len(list(out.glob("feedback/*/toy/*.html"))) >= 3,
    ]
    for moment in moments:
        process = _start(tmp_path, 0.05)
        _wait(process, moment)
        process.kill()
        process.join()
    _grade(tmp_path, 0.0)
    ran = (tmp_path / "ran").read_text().split()
    assert set(ran) == {f"s{n:03}" for n in range(24)}
    assert len(ran) <= 24 + 2 * 3  # what was running when it was killed
    killed = backups.contents(f"sqlite:///{out / 'gradebook.db'}"), _files(out)
    assert not list(out.rglob("*.tmp"))
    out.rename(tmp_path / "killed")
    _grade(tmp_path, 0.0)
    assert (backups.contents(f"sqlite:///{out / 'gradebook.db'}"), _files(out)) == killed


@posix
def test_ctrl_c_ends_with_what_is_done_kept(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    _class(tmp_path, 30)
    records = tmp_path / "out" / ".executed" / "cache"
    process = _start(tmp_path, 0.3)
    _wait(process, lambda: len(list(records.glob("*.json"))) >= 4)
    os.kill(process.pid or 0, signal.SIGINT)
    process.join(60)
    assert process.exitcode == 1 and "of 30 submissions are done and kept" in capfd.readouterr().err
    assert 4 <= len(list(records.glob("*.json"))) < 30
    assert not list(records.glob(".*"))


def test_only_one_run_at_a_time(tmp_path: Path) -> None:
    with only_run(tmp_path), pytest.raises(InputError, match="no other run"), only_run(tmp_path):
        pass
    with only_run(tmp_path):
        pass


def test_no_notebook_and_no_marks_of_a_submission_stay_in_memory(tmp_path: Path) -> None:
    """Counted in objects; benchmarks/grading_thousand.py measures the process."""
    kept, counts = [], []
    for students in (2, 32):
        _class(tmp_path / str(students), students)
        kept.append(_grade(tmp_path / str(students), 0.0))
        gc.collect()
        large = (NotebookNode, Mark, Marks, SubmittedAssignment, SubmittedNotebook, Grade)
        counts.append(sum(isinstance(o, large) for o in gc.get_objects()))
    assert counts[1] - counts[0] < 60  # the course's own notebook is kept; 30 submissions have 30 times as much
    assert [len(result.rows) for result in kept] == [2, 32]
    assert sum(row.earned for row in kept[1].rows) > 0


@pytest.mark.parametrize(("cores", "free", "fitting"), [(1, 64, 1), (2, 64, 3), (4, 64, 5), (4, 3, 3), (2, 0, 1)])
def test_one_submission_more_than_cores_runs_if_memory_allows(
    cores: int, free: int, fitting: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)), raising=False)
    memory = SimpleNamespace(available=free << 30)
    monkeypatch.setattr(scheduler.psutil, "virtual_memory", lambda: memory)
    assert scheduler.fitting_workers() == fitting
