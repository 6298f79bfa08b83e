"""A class graded into PostgreSQL: a server of its own in a temporary folder, on a Unix socket."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from nbgrader.api import Gradebook

from robotbrain.grading import backups, classroom
from robotbrain.grading.course import Course, driver_url, find_course
from tests.conftest import need
from tests.grading import toylab
from tests.grading.fakebench import FakeBench, answers

SCORES = {"amara": 1.0, "bilal": 0.5, "chen": 0.0}


def _other_user() -> dict[str, Any]:
    """PostgreSQL refuses to run as root."""
    return {"user": "nobody", "group": "nogroup"} if os.name == "posix" and os.getuid() == 0 else {}


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    """Address of an empty database."""
    need(shutil.which("initdb") and shutil.which("pg_ctl"), "no PostgreSQL server (initdb, pg_ctl) on PATH")
    pytest.importorskip("psycopg2", reason="no PostgreSQL driver")
    base = Path(tempfile.mkdtemp(prefix="pg-"))  # a short path: that of a Unix socket is limited
    how: dict[str, Any] = {**_other_user(), "cwd": "/", "stdout": subprocess.DEVNULL, "check": True, "timeout": 120}
    try:
        if "user" in how:
            shutil.chown(base, how["user"], how["group"])
        data = str(base / "data")
        initdb = ["initdb", "-D", data, "-U", "course", "-A", "trust", "--no-sync", "--no-locale", "-E", "UTF8"]
        subprocess.run(initdb, **how)
        options = f"-k {base} -c listen_addresses='' -c fsync=off"
        subprocess.run(["pg_ctl", "-D", data, "-o", options, "-l", str(base / "log"), "-w", "start"], **how)
        try:
            yield f"postgresql://course@/postgres?host={base}"
        finally:
            subprocess.run(["pg_ctl", "-D", data, "-m", "immediate", "-w", "stop"], **how)
    finally:
        shutil.rmtree(base, ignore_errors=True)


@pytest.fixture(scope="module")
def graded(
    server: str, course_root: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Course, Path, str]]:
    """A class graded into SQLite (``lite``) and PostgreSQL (``big``)."""
    base = tmp_path_factory.mktemp("postgres")
    for student, earned in SCORES.items():
        toylab.submit(base / "in", student, answers(earned))
    toylab.submit(base / "in", "dagny", None)
    home = find_course(course_root)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(classroom, "open_bench", lambda *_: FakeBench())
        for name, url in (("lite", None), ("big", server)):
            classroom.grade_class(home, toylab.LAB, submitted=base / "in", out=base / name, db_url=url)
        yield home, base, server


def test_the_gradebook_is_that_of_sqlite(graded: tuple[Course, Path, str]) -> None:
    _, base, url = graded
    assert not (base / "big" / "gradebook.db").exists()
    said = backups.contents(driver_url(url))
    assert said == backups.contents(f"sqlite:///{base / 'lite' / 'gradebook.db'}")
    assert len(said["grade"]) == 3 * 4


def test_a_regrade_keeps_manual_grades_and_backs_up_before(graded: tuple[Course, Path, str]) -> None:
    home, base, url = graded
    copies = base / "big" / "backups"
    assert not copies.exists() or not list(copies.iterdir())  # there was nothing to back up
    for address in (driver_url(url), f"sqlite:///{base / 'lite' / 'gradebook.db'}"):
        with Gradebook(address) as gradebook:
            grade = gradebook.find_grade("score-mean", toylab.LAB, toylab.LAB, "bilal")
            grade.manual_score, grade.extra_credit = 4.0, 0.5
            gradebook.db.commit()
    before = backups.contents(driver_url(url))
    shutil.rmtree(base / "in" / "bilal")
    toylab.submit(base / "in", "bilal", answers(0.25))
    for name, address in (("lite", None), ("big", url)):
        result = classroom.grade_class(home, toylab.LAB, submitted=base / "in", out=base / name, db_url=address)
        assert [(c.student, c.before, c.after) for c in result.changes] == [("bilal", 9.5, 7.0)]
    assert backups.contents(driver_url(url)) == backups.contents(f"sqlite:///{base / 'lite' / 'gradebook.db'}")
    (copy,) = copies.iterdir()
    assert backups.contents(f"sqlite:///{copy}") == before


def test_a_backup_can_be_brought_back(graded: tuple[Course, Path, str], server: str) -> None:
    from sqlalchemy import create_engine, text

    _, base, _ = graded
    copy = base / "copy.db"
    backups.copy_gradebook(driver_url(server), f"sqlite:///{copy}")
    engine = create_engine(driver_url(server), isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        connection.execute(text("CREATE DATABASE again"))
    engine.dispose()
    restored = driver_url(server.replace("/postgres?", "/again?"))
    backups.copy_gradebook(f"sqlite:///{copy}", restored)
    assert backups.contents(restored) == backups.contents(driver_url(server))
    with Gradebook(restored) as gradebook:
        assert gradebook.find_submission(toylab.LAB, "amara").score == 15.0


@pytest.mark.parametrize("given", ["postgres://h/d", "postgresql://h/d"])
def test_a_driver_that_is_installed_is_taken(given: str) -> None:
    pytest.importorskip("psycopg2", reason="no PostgreSQL driver")
    assert driver_url(given) in ("postgresql://h/d", "postgresql+psycopg2://h/d")
    assert driver_url("sqlite:///x.db") == "sqlite:///x.db"
    assert driver_url("postgresql+asyncpg://h/d") == "postgresql+asyncpg://h/d"
