"""Atomic writes survive failures; errors say what was given, expected, and what to do."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest

from robotbrain.errors import InputError, MissingDependencyError
from robotbrain.files import atomic_path, write_bytes, write_text


def test_a_failed_write_leaves_the_old_content_and_no_litter(tmp_path: Path) -> None:
    target = tmp_path / "grades.csv"
    write_text(target, "old\n")
    with pytest.raises(RuntimeError), atomic_path(target) as temporary:
        temporary.write_text("half of the new")
        raise RuntimeError
    assert target.read_text() == "old\n"
    assert [p.name for p in tmp_path.iterdir()] == ["grades.csv"]


def test_text_is_utf8_with_unix_line_ends_and_folders_are_made(tmp_path: Path) -> None:
    path = write_text(tmp_path / "a" / "b.txt", "ä\n")
    assert path.read_bytes() == "ä\n".encode()
    assert write_bytes(tmp_path / "c", b"\x00\r\n").read_bytes() == b"\x00\r\n"


def test_an_input_error_names_all_three_parts_and_survives_pickling() -> None:
    error = InputError("scan.ranges", given=[1.0] * 500, expected="120 numbers", fix="Check the lidar.")
    assert str(error).startswith("scan.ranges: got [1.0, 1.0")
    assert "120 numbers" in str(error) and str(error).endswith("Check the lidar.")
    assert len(str(error)) < 300
    assert str(pickle.loads(pickle.dumps(error))) == str(error)
    assert isinstance(error, ValueError)


def test_a_missing_dependency_says_how_to_install_it() -> None:
    error = MissingDependencyError("jtop", needed_for="power readings", install="pip install jetson-stats")
    assert "pip install jetson-stats" in str(error)
    assert isinstance(error, ImportError)
