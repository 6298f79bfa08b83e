"""The parts of ``robotbrain doctor``: running probes, trials in a process of their own, the table, the lists."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from robotbrain.doctor import report, shipped
from robotbrain.doctor.finding import Finding, Situation, everywhere, fault, ok
from robotbrain.doctor.isolated import try_out
from robotbrain.doctor.probes.libraries import MODULES
from robotbrain.doctor.running import run_probes
from tests.conftest import REPO


def situation(limit_s: float = 5.0) -> Situation:
    return Situation(Path.cwd(), None, limit_s)


def test_a_probe_that_raises_leaves_or_hangs_is_a_finding() -> None:
    def leaves(_: Situation) -> list[Finding]:
        raise SystemExit(3)

    def hangs(_: Situation) -> list[Finding]:
        time.sleep(600)
        return []

    probes: dict[str, Callable[[Situation], Sequence[Finding]]] = {
        "raises": lambda s: [][0],
        "leaves": leaves,
        "hangs": hangs,
        "fine": lambda s: [ok("all is well")],
    }
    found = dict(run_probes(probes, situation(0.25)))
    assert list(found) == list(probes)
    assert "the probe itself failed: IndexError" in found["raises"][0].what and found["raises"][0].cure.here()
    assert "SystemExit: 3" in found["leaves"][0].what
    assert "no answer within 2 s" in found["hangs"][0].what and "--only hangs" in found["hangs"][0].cure.here()
    assert found["fine"][0] == Finding(ok("").severity, "all is well", probe="fine")


def test_an_interpreter_that_does_not_start_is_no_endless_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", str(REPO / "no such python"))
    outcomes = try_out(["import:json", "import:queue"], 5.0)
    assert [o.state for o in outcomes.values()] == ["unable", "unable"]


def test_the_table_keeps_commands_whole_and_colours_only_when_asked() -> None:
    command = "python -m pip install " + " ".join(f"package-{n}" for n in range(30))
    findings = [fault("a long story " * 20, everywhere(command), "because")]
    plain = report.rows(findings, colour=False, width=80)
    assert plain.splitlines()[-1].strip() == f"cure: {command}"
    assert all(len(line) <= 80 for line in plain.splitlines()[:-1]) and "\033" not in plain
    assert "because" in plain and "\033[1;31m" in report.rows(findings, colour=True)


def test_every_requirement_is_tried() -> None:
    import tomllib

    from packaging.requirements import Requirement

    project = tomllib.loads((REPO / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert {Requirement(text).name for text in project["dependencies"]} == set(MODULES)


def test_the_list_of_shipped_files_is_that_of_the_files() -> None:
    listed = json.loads(shipped.LIST.read_text(encoding="utf-8"))
    now = {name: list(entry) for name, entry in shipped.current().items()}
    changed = sorted(name for name in listed.keys() | now.keys() if listed.get(name) != now.get(name))
    assert not changed, f"changed on purpose? Run: python -m robotbrain.doctor.shipped ({changed})"


DOCTOR = REPO / "src" / "robotbrain" / "doctor"
LINUX_ONLY = {"opengl", "browsers", "_jetson", "_absent", "_interpreter"}
"""Functions that give a cure for Linux alone, since they get there on Linux alone."""


def test_every_cure_says_what_to_do_on_windows_and_macos() -> None:
    for file in sorted((DOCTOR / "probes").glob("*.py")):
        for function in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if not isinstance(function, ast.FunctionDef) or function.name in LINUX_ONLY:
                continue
            for call in ast.walk(function):
                if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "Cure":
                    assert len(call.args) == 3, f"{file.name}:{call.lineno}"


def test_the_doctor_needs_only_the_standard_library_to_start() -> None:
    code = "import sys, robotbrain.doctor.commands\nprint(*{m.partition('.')[0] for m in sys.modules})"
    done = subprocess.run([sys.executable, "-I", "-c", code], capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) <= {*sys.stdlib_module_names, "robotbrain", "__main__", "_robotbrain"} | {
        m for m in done.stdout.split() if m.startswith(("_distutils", "__editable", "_virtualenv", "distutils"))
    }
