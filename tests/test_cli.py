from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

import pytest

from robotbrain import cli
from robotbrain.errors import InputError


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_every_command_in_the_table_exists_and_explains_itself(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        cli.main([name, "--help"])
    assert left.value.code == 0
    assert f"robotbrain {name}" in capsys.readouterr().out


def test_help_lists_the_commands_without_loading_them() -> None:
    code = (
        "import sys, contextlib\nfrom robotbrain import cli\n"
        "with contextlib.suppress(SystemExit): cli.main(['--help'])\n"
        "assert not {'nbformat', 'nbgrader', 'torch', 'mujoco', 'tqdm'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert all(name in done.stdout for name in cli.COMMANDS)


def test_the_kits_own_errors_are_one_line_and_exit_2(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def arguments(parser: argparse.ArgumentParser) -> None:
        del parser

    def main(parsed: argparse.Namespace) -> int:
        raise InputError("world", given=-1, expected="a positive size", fix="Use 4.")

    monkeypatch.setattr(cli, "_load", lambda target: (arguments, main))
    assert cli.main(["doctor"]) == 2
    assert capsys.readouterr().err == "robotbrain doctor: world: got -1; expected a positive size. Use 4.\n"


def test_an_unknown_command_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        cli.main(["no-such-command"])
    assert left.value.code == 2
    assert "grade-class" in capsys.readouterr().err


def test_the_doctor_can_be_called_in_this_process(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["doctor", "--only", "python"]) == 0
    assert "Nothing is wrong here." in capsys.readouterr().out


def test_importing_grading_is_cheap() -> None:
    code = (
        "import sys\nimport robotbrain.grading\n"
        "assert not {'numpy', 'nbformat', 'nbgrader', 'torch', 'IPython'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["drive", "--seeds", "1", "--bag", "zz"], "--bag"),
        (["drive", "--decisions", "d.jsonl"], "--decisions"),
        (["drive", "--robot", "ros", "--html", "x.html"], "--html"),
        (["drive", "--robot", "ros", "--seeds", "0:3"], "--seeds"),
        (["drive", "--robot", "ros", "--time-limit", "-2"], "seconds > 0"),
        (["robot", "--token", ""], "--token"),
        (["robot", "--lockstep", "-4"], "--lockstep"),
    ],
)
def test_options_that_would_be_ignored_are_refused(
    words: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(words) == 2
    assert says in capsys.readouterr().err


def test_a_place_that_cannot_be_written_to_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "no such folder" / "log"
    assert cli.main(["robot", "--port", "0", "--log", str(target)]) == 2
    error = capsys.readouterr().err
    assert "no such folder" in error and "Traceback" not in error


def test_a_file_that_is_no_bag_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "notes.txt").write_text("hello")
    assert cli.main(["bag", "info", str(tmp_path / "notes.txt")]) == 2
    assert "expected a rosbag2 bag" in capsys.readouterr().err


def test_a_reader_that_has_had_enough_is_no_error(tmp_path: Path) -> None:
    code = "import sys; from robotbrain import cli; sys.exit(cli.main(['jetson', 'list']))"
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout is not None and process.stderr is not None
    process.stdout.close()
    assert b"Traceback" not in process.stderr.read()
    process.wait()
    process.stderr.close()
