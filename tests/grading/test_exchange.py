"""The exchange on one machine: which folder, and what an instructor is told."""

from __future__ import annotations

import os
import shutil
import stat
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from robotbrain import exchange
from robotbrain.cli import main
from robotbrain.errors import InputError
from robotbrain.exchange import EXCHANGE_VARIABLE, Exchange, find_exchange
from robotbrain.grading.course import Course, find_course
from robotbrain.grading.exchange import collect, overview, release, release_feedback
from robotbrain.grading.reports.feedback import CARRIED

from . import toylab

LAB = toylab.LAB
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="nbgrader has no exchange on Windows")


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A user without any configuration."""
    for name in (EXCHANGE_VARIABLE, "JUPYTER_CONFIG_PATH"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("JUPYTER_CONFIG_DIR", str(tmp_path / "config"))
    monkeypatch.setenv("JUPYTER_DATA_DIR", str(tmp_path / "data"))
    monkeypatch.setenv("JUPYTER_NO_CONFIG", "")
    return tmp_path


@pytest.fixture
def course(home: Path, monkeypatch: pytest.MonkeyPatch) -> Course:
    root = toylab.make_course(home / "course")
    monkeypatch.setenv("ROBOTBRAIN_SUITES", str(root / "suites"))
    return find_course(root)


@pytest.fixture
def place(home: Path) -> Exchange:
    (home / "exchange").mkdir()
    return Exchange(home / "exchange", "the test's")


def hand_in(course: Course, place: Exchange, student: str, when: str) -> Path:
    """What nbgrader's Submit leaves in the exchange."""
    folder = place.path / course_id(course) / "inbound" / f"{student}+{LAB}+{when} UTC+x{when[-1]}"
    shutil.copytree(place.path / course_id(course) / "outbound" / LAB, folder)
    (folder / CARRIED[0]).write_text(f"{when} UTC")
    (folder / CARRIED[1]).write_text(f"secret of {student} {when}")
    return folder


def course_id(course: Course) -> str:
    return next(p.name for p in (course.home.parent / "exchange").iterdir())


# ---------------------------------------------------------------- which folder


def test_the_folder_is_the_named_one_then_the_configured_then_nbgraders_then_ones_own(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nowhere = home / "nowhere"
    own = find_exchange({}, standard=nowhere)
    assert own.own and own.path == home / "data" / "robotbrain" / "exchange"
    nowhere.mkdir()
    assert find_exchange({}, standard=nowhere).path == nowhere
    (home / "config").mkdir()
    (home / "config" / "nbgrader_config.py").write_text('c = get_config()\nc.Exchange.root = "/srv/configured"')
    assert find_exchange({}, standard=nowhere).path == Path("/srv/configured")
    monkeypatch.setenv(EXCHANGE_VARIABLE, str(home / "named"))
    assert find_exchange(standard=nowhere).path == home / "named"


def test_ones_own_is_made_and_nobody_else_can_reach_it(home: Path) -> None:
    folder = find_exchange({}, standard=home / "nowhere").usable()
    assert folder.is_dir() and stat.S_IMODE(folder.parent.stat().st_mode) == 0o700


def test_folder_that_is_missing_closed_or_on_windows_is_refused_with_a_cure(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InputError, match="mkdir -p"):
        Exchange(home / "nowhere", "").usable()
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write everywhere
    with pytest.raises(InputError, match="chmod"):
        Exchange(home, "").usable()
    monkeypatch.setattr(exchange.sys, "platform", "win32")
    with pytest.raises(InputError, match="learning platform"):
        Exchange(home, "").usable()


# ---------------------------------------------------------------- the three errands


def test_release_is_fresh_whatever_was_done_in_labs(course: Course, place: Exchange) -> None:
    mine = course.home / "labs" / LAB / f"{LAB}.ipynb"
    mine.parent.mkdir(parents=True, exist_ok=True)
    mine.write_text("my own answers")
    target = release(course, LAB, place)
    assert "my own answers" not in (target / mine.name).read_text() and "HIDDEN" not in (target / mine.name).read_text()
    assert release(course, LAB, place) == target  # nothing has changed: nothing to ask
    (target / mine.name).write_text("an older version")
    with pytest.raises(InputError, match="--force"):
        release(course, LAB, place)
    release(course, LAB, place, force=True)
    assert "an older version" not in (target / mine.name).read_text()


def test_newest_submission_of_each_student_is_collected(course: Course, place: Exchange) -> None:
    release(course, LAB, place)
    me = place.path.owner()
    hand_in(course, place, me, "2026-11-20 10:00:00")
    assert [(s.student, s.state, s.owner) for s in collect(course, LAB, place)] == [(me, "new", me)]
    assert [s.state for s in collect(course, LAB, place)] == ["unchanged"]
    hand_in(course, place, me, "2026-11-21 09:00:00")
    found = collect(course, LAB, place)
    assert [(s.state, s.handed_in) for s in found] == [("newer than before", "2026-11-21 09:00:00 UTC")]
    assert (course.root / course.submitted / me / LAB / CARRIED[1]).read_text().endswith("21 09:00:00")
    assert overview(course, place) == [(LAB, True, 1, 0)]


def test_nothing_to_collect_is_said_with_the_step_before(course: Course, place: Exchange) -> None:
    with pytest.raises(InputError, match="robotbrain exchange release toy"):
        collect(course, LAB, place)
    release(course, LAB, place)
    with pytest.raises(InputError, match="Submit"):
        collect(course, LAB, place)
    with pytest.raises(InputError, match="Check the name"):
        collect(course, "no_such_lab", place)


def test_feedback_goes_to_those_who_handed_in_there(course: Course, place: Exchange) -> None:
    from nbgrader.utils import notebook_hash

    release(course, LAB, place)
    with pytest.raises(InputError, match="grade-class"):
        release_feedback(course, LAB, place)
    pages = course.root / course.feedback
    for student in ("amara", "by_mail"):
        (pages / student / LAB).mkdir(parents=True)
        (pages / student / LAB / f"{LAB}.html").write_text(f"page of {student}")
    with pytest.raises(InputError, match="from elsewhere"):
        release_feedback(course, LAB, place)
    (pages / "amara" / LAB / CARRIED[0]).write_text("2026-11-20 10:00:00 UTC")
    (pages / "amara" / LAB / CARRIED[1]).write_text("a secret")
    assert release_feedback(course, LAB, place) == (["amara"], ["by_mail"])
    there = place.path / course_id(course) / "feedback"
    expected = notebook_hash(secret="a secret", notebook_id=LAB)
    assert {p.name: p.read_text() for p in there.iterdir()} == {f"{expected}.html": "page of amara"}


def test_trouble_of_nbgraders_is_told_in_words(
    course: Course, place: Exchange, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("nbgrader.exchange.default.exchange.self_owned", lambda path: False)
    (place.path / find_id(course)).mkdir()
    command = ["exchange", "release", LAB, "--exchange", str(place.path), "--course", str(course.home)]
    assert main(command) == 2
    assert "You don't own the directory" in capsys.readouterr().err
    assert main(["exchange", "--course", str(course.home), "--exchange", str(place.path)]) == 0
    assert LAB in capsys.readouterr().out


def find_id(course: Course) -> str:
    from robotbrain.grading.course import nbgrader_config

    return str(nbgrader_config(replace(course)).CourseDirectory.course_id)
