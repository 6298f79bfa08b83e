"""A class graded by a real Dask scheduler and workers on this machine, one of which is lost on the way."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from robotbrain.errors import InputError, RobotBrainError
from robotbrain.grading import backups, classroom
from robotbrain.grading.cluster import ClusterBench
from robotbrain.grading.course import Course, find_course
from robotbrain.grading.execute import Limits
from tests.conftest import need
from tests.grading import toylab
from tests.grading.fakebench import FakeBench, answers

STUDENTS = 16
FAKE = ("--preload", "tests.grading.fakeworker")


def _spawn(*arguments: str) -> subprocess.Popen[bytes]:
    env = {**os.environ, "PYTHONPATH": str(toylab.REPOSITORY)}
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    return subprocess.Popen([sys.executable, "-m", *arguments], env=env, **quiet)  # type: ignore[call-overload, no-any-return]


@contextlib.contextmanager
def _scheduler(folder: Path) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    file = folder / "scheduler.json"
    where = ("--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file))
    process = _spawn("distributed.cli.dask_scheduler", *where)
    try:
        deadline = time.monotonic() + 60
        while not file.is_file() and time.monotonic() < deadline:
            time.sleep(0.05)
        yield json.loads(file.read_text())["address"], process
    finally:
        process.kill()
        process.wait()


@contextlib.contextmanager
def _workers(address: str, folder: Path, number: int, *more: str) -> Iterator[list[subprocess.Popen[bytes]]]:
    how = ("--nthreads", "1", "--no-nanny", "--no-dashboard", "--local-directory", str(folder))
    workers = [_spawn("distributed.cli.dask_worker", address, *how, *more) for _ in range(number)]
    try:
        yield workers
    finally:
        for worker in workers:
            worker.kill()
            worker.wait()


@pytest.fixture(scope="module")
def home(course_root: Path) -> Course:
    pytest.importorskip("distributed", reason="Dask is not installed")
    return find_course(course_root)


@pytest.fixture(scope="module")
def submitted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("submitted")
    for number in range(STUDENTS):
        (toylab.submit(folder, f"s{number:02}", answers(number % 3 / 2)) / "data.bin").write_bytes(bytes([number]))
    return folder


def test_the_gradebook_is_that_of_this_machine_even_if_a_worker_is_lost(
    home: Course, submitted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with _scheduler(tmp_path) as (address, scheduler):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("robotbrain.grading.cluster._CONNECT_S", 1.0)
            with pytest.raises(InputError, match="dask worker"):
                ClusterBench(address, home, toylab.LAB)
        with _workers(address, tmp_path, 2, *FAKE) as workers:
            result = _grade_and_lose(workers[0], home, submitted, tmp_path / "cluster", address)
            assert workers[0].wait(60) != 0 and workers[1].poll() is None
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr("robotbrain.grading.cluster.tests_digest", lambda _: "of an older course")
                with pytest.raises(InputError, match="up to date"):
                    ClusterBench(address, home, toylab.LAB)
            with ClusterBench(address, home, toylab.LAB) as bench:
                assert bench.slots == 1
                scheduler.kill()
                with pytest.raises(RobotBrainError, match="what is done is kept"):
                    bench.execute(answers(), lab=toylab.LAB, student="s", files={})
    assert [row.layers for row in result.rows] == [["fake"]] * STUDENTS
    monkeypatch.setattr(classroom, "open_bench", lambda *_: FakeBench())
    classroom.grade_class(home, toylab.LAB, submitted=submitted, out=tmp_path / "here")
    there, here = (backups.contents(f"sqlite:///{tmp_path / name / 'gradebook.db'}") for name in ("cluster", "here"))
    assert there == here
    assert len(here["submitted_assignment"]) == STUDENTS


def _grade_and_lose(
    worker: subprocess.Popen[bytes], home: Course, submitted: Path, out: Path, address: str
) -> classroom.ClassResult:
    def lose(done: int, total: int, student: str) -> None:
        if done == 3:
            worker.kill()

    options = classroom.Options(cluster=address)
    return classroom.grade_class(home, toylab.LAB, submitted=submitted, out=out, options=options, progress=lose)


def test_an_address_without_a_scheduler_is_explained(home: Course, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("robotbrain.grading.cluster._CONNECT_S", 0.5)
    for address in ("tcp://127.0.0.1:1", "nonsense://x"):
        with pytest.raises(InputError, match="dask scheduler"):
            ClusterBench(address, home, toylab.LAB)


@pytest.mark.slow
def test_real_benches_on_two_workers_give_the_same_gradebook(home: Course, tmp_path: Path) -> None:
    need(os.name == "posix", "the workers need the sandbox")
    for number, answer in enumerate(
        ["def scale(x):\n    return x ** 2", toylab.SOLUTIONS["scale"], "while True: pass"]
    ):
        toylab.submit(tmp_path / "in", f"s{number}", toylab.solved(scale=answer))
    with _scheduler(tmp_path) as (address, _), _workers(address, tmp_path, 2):
        options = classroom.Options(cluster=address, limits=Limits(cell_s=2.0))
        classroom.grade_class(home, toylab.LAB, submitted=tmp_path / "in", out=tmp_path / "cluster", options=options)
    options = classroom.Options(limits=options.limits)
    classroom.grade_class(home, toylab.LAB, submitted=tmp_path / "in", out=tmp_path / "here", options=options)
    there, here = (backups.contents(f"sqlite:///{tmp_path / name / 'gradebook.db'}") for name in ("cluster", "here"))
    assert there == here
