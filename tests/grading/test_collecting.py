"""What may come out of an exchange into which anybody can write."""

from __future__ import annotations

import os
import sys
from datetime import datetime
from pathlib import Path

import pytest

from robotbrain.grading import collecting
from robotbrain.grading.collecting import entries, take
from robotbrain.grading.intake.gate import LARGEST_FILE, MOST_FILES

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="nbgrader has no exchange on Windows")
EARLY, LATE = "2026-11-01 09:00:00.000000 UTC", "2026-11-02 09:00:00.5 UTC"


def handed_in(inbound: Path, student: str, stamp: str, **files: str) -> Path:
    folder = inbound / f"{student}+lab+{stamp}+random"
    folder.mkdir(parents=True)
    for name, text in {"lab.ipynb": "{}", "timestamp.txt": stamp, **files}.items():
        (folder / name).write_text(text, encoding="utf-8")
    return folder


@pytest.fixture
def owners(monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """Who owns which folder; everybody their own by default."""
    told: dict[str, str] = {}
    monkeypatch.setattr(collecting, "_owner", lambda path: told.get(path.name, path.name.split("+")[0]))
    return told


def test_entries_are_read_by_time_and_know_whose_they_are(tmp_path: Path, owners: dict[str, str]) -> None:
    late, early = handed_in(tmp_path, "ada", LATE), handed_in(tmp_path, "ada", EARLY)
    forged = handed_in(tmp_path, "alan", EARLY)
    owners[forged.name] = "ada"
    for nonsense in (
        "..+lab+2026-11-01 09:00:00 UTC+x",
        "+lab+2026-11-01 09:00:00 UTC",
        "eve+lab+soon+x",
        "eve+lab2+x",
    ):
        (tmp_path / nonsense).mkdir()
    found = entries(tmp_path, "lab")
    assert [e.path for e in found if e.student == "ada"] == [early, late]
    assert {e.student: e.own for e in found} == {"ada": True, "alan": False}
    assert next(e.stamp for e in found if e.path == late) == LATE


def test_plain_files_come_and_nothing_else(tmp_path: Path) -> None:
    key = tmp_path / "key.toml"
    key.write_text("the key", encoding="utf-8")
    folder = handed_in(tmp_path / "in", "ada", EARLY, **{"policy.onnx": "x"})
    (folder / "data").mkdir()
    (folder / "data" / "a.csv").write_text("1", encoding="utf-8")
    (folder / "data" / "link.csv").symlink_to(key)
    (folder / "shortcut").symlink_to(tmp_path)
    os.mkfifo(folder / "pipe")
    (folder / ".ipynb_checkpoints").mkdir()
    (folder / ".ipynb_checkpoints" / "old.ipynb").write_text("{}", encoding="utf-8")
    target = tmp_path / "submitted" / "ada" / "lab"
    left_out = take(entries(tmp_path / "in", "lab")[0], target)
    there = {p.relative_to(target).as_posix() for p in target.rglob("*") if p.is_file()}
    assert there == {"lab.ipynb", "timestamp.txt", "policy.onnx", "data/a.csv"}
    assert left_out == ["data/link.csv is a link", "pipe is no plain file", "shortcut is a link"]
    assert [p.name for p in target.parent.iterdir()] == ["lab"]


def test_a_newer_submission_takes_the_place_of_an_older_one(tmp_path: Path) -> None:
    target = tmp_path / "submitted" / "ada" / "lab"
    handed_in(tmp_path / "in", "ada", EARLY, **{"only_early.txt": "x"})
    handed_in(tmp_path / "in", "ada", LATE)
    for entry in entries(tmp_path / "in", "lab"):
        take(entry, target)
    assert {p.name for p in target.iterdir()} == {"lab.ipynb", "timestamp.txt"}
    assert (target / "timestamp.txt").read_text(encoding="utf-8") == LATE


def test_a_folder_that_is_a_link_takes_nothing_and_costs_nothing(tmp_path: Path) -> None:
    target = tmp_path / "submitted" / "ada" / "lab"
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / f"ada+lab+{LATE}+x").symlink_to(handed_in(tmp_path / "elsewhere", "ada", EARLY))
    target.mkdir(parents=True)
    (target / "lab.ipynb").write_text("before", encoding="utf-8")
    (entry,) = entries(tmp_path / "in", "lab")
    with pytest.raises(OSError):
        take(entry, target)
    assert (target / "lab.ipynb").read_text(encoding="utf-8") == "before"


def test_what_is_too_much_is_left_out(tmp_path: Path) -> None:
    folder = handed_in(tmp_path / "in", "ada", EARLY)
    with (folder / "huge.bin").open("wb") as file:
        file.truncate(LARGEST_FILE + 1)  # takes no room on the disk
    for number in range(MOST_FILES):
        (folder / f"z{number:04d}.txt").touch()
    left_out = take(entries(tmp_path / "in", "lab")[0], tmp_path / "out" / "lab")
    assert left_out[0] == "huge.bin is too large, or one too many" and len(left_out) == 3
    assert len(list((tmp_path / "out" / "lab").iterdir())) == MOST_FILES


def collect_by_nbgrader(tmp_path: Path, **settings: object) -> Path:
    """Press formgrader's button, so to speak; return the folder of submissions."""
    from nbgrader.coursedir import CourseDirectory
    from traitlets.config import Config

    from robotbrain.grading.nbgrader_plugins import GuardedCollect

    config = Config({"CourseDirectory": {"root": str(tmp_path), "course_id": "course", "assignment_id": "lab"}})
    errand = GuardedCollect(coursedir=CourseDirectory(config=config), config=config)
    errand.inbound_path, errand.duedate = str(tmp_path / "in"), None
    for name, value in settings.items():
        setattr(errand, name, value)
    errand.copy_files()
    return tmp_path / "submitted"


def test_nbgraders_own_ways_to_collect_are_guarded(tmp_path: Path, owners: dict[str, str]) -> None:
    inbound = tmp_path / "in"
    own = handed_in(inbound, "ada", EARLY)
    (own / "link").symlink_to(tmp_path)
    forged = handed_in(inbound, "ada", LATE, **{"forged.txt": "x"})
    owners[forged.name] = "eve"
    submitted = collect_by_nbgrader(tmp_path)
    assert {p.name for p in (submitted / "ada" / "lab").iterdir()} == {"lab.ipynb", "timestamp.txt"}
    stamp = submitted / "ada" / "lab" / "timestamp.txt"
    assert stamp.read_text(encoding="utf-8") == EARLY
    # Newer work is taken when it is asked for; the owner of folders does not matter where nbgrader was told so.
    collect_by_nbgrader(tmp_path, check_owner=False)
    assert stamp.read_text(encoding="utf-8") == EARLY
    collect_by_nbgrader(tmp_path, check_owner=False, update=True)
    assert stamp.read_text(encoding="utf-8") == LATE


def test_before_the_due_date_the_last_in_time_counts(tmp_path: Path, owners: dict[str, str]) -> None:
    del owners
    for stamp in (EARLY, LATE):
        handed_in(tmp_path / "in", "ada", stamp)
    handed_in(tmp_path / "in", "alan", LATE)
    due = datetime(2026, 11, 2)
    submitted = collect_by_nbgrader(tmp_path, before_duedate=True, duedate=due)
    stamps = {s: (submitted / s / "lab" / "timestamp.txt").read_text(encoding="utf-8") for s in ("ada", "alan")}
    assert stamps == {"ada": EARLY, "alan": LATE}


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root can give files away")
def test_a_file_of_somebody_else_is_left_out(tmp_path: Path) -> None:
    folder = handed_in(tmp_path / "in", "ada", EARLY)
    secret = tmp_path / "secret.toml"
    secret.write_text("the key", encoding="utf-8")
    os.link(secret, folder / "mine.toml")
    for path in (folder, folder / "lab.ipynb", folder / "timestamp.txt"):
        os.chown(path, 12345, 12345)
    left_out = take(entries(tmp_path / "in", "lab")[0], tmp_path / "out" / "lab")
    assert left_out == ["mine.toml belongs to somebody else"]
