from __future__ import annotations

import argparse
import subprocess
import sys

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


def test_doctor_finds_this_environment_in_order(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["doctor"]) == 0
    assert "alembic" in capsys.readouterr().out


def test_importing_grading_is_cheap() -> None:
    code = (
        "import sys\nimport robotbrain.grading\n"
        "assert not {'numpy', 'nbformat', 'nbgrader', 'torch', 'IPython'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
