"""Environments to break, and what ``robotbrain doctor`` says in them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import venv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.conftest import REPO

posix = pytest.mark.skipif(sys.platform == "win32", reason="breaks things in a way that Windows does not have")
linux = pytest.mark.skipif(sys.platform != "linux", reason="needs Linux namespaces")

HOST = ("HOME", "USERPROFILE", "SYSTEMROOT", "LANG", "PATH", "LD_LIBRARY_PATH", "APPDATA", "LOCALAPPDATA")


@dataclass
class Answer:
    """What the doctor said."""

    code: int
    findings: list[dict[str, str]]
    errors: str

    def one(self, severity: str, *words: str) -> dict[str, str]:
        """The one finding of this severity that has all these words in what it says."""
        found = [f for f in self.findings if f["severity"] == severity and all(w in f["what"] for w in words)]
        assert len(found) == 1, f"{words} in {json.dumps(self.findings, indent=1)}"
        return found[0]

    def faults(self) -> list[str]:
        return [f["what"] for f in self.findings if f["severity"] == "fault"]


@dataclass
class Patient:
    """An environment to break: its variables, its home, its course, the Python in it."""

    folder: Path
    environment: dict[str, str]
    python: str = sys.executable
    wrapper: Sequence[str] = ()

    @property
    def course(self) -> Path:
        return self.folder / "course folder"

    def path_first(self, name: str) -> Path:
        """Make a folder and put it in front of Python's path."""
        folder = self.folder / name
        folder.mkdir(parents=True, exist_ok=True)
        before = self.environment.get("PYTHONPATH", "")
        self.environment["PYTHONPATH"] = os.pathsep.join(filter(None, (str(folder), before)))
        return folder

    def ask(self, *probes: str, timeout: float = 60.0, words: Sequence[str] = ("--json",)) -> Answer:
        """Run the doctor in this environment."""
        options = [word for probe in probes for word in ("--only", probe)]
        options += ["--directory", str(self.course), "--timeout", str(timeout), *words]
        done = subprocess.run(
            [*self.wrapper, self.python, "-m", "robotbrain.cli", "doctor", *options],
            capture_output=True, env=self.environment, cwd=self.folder, timeout=300, check=False,
        )  # fmt: skip
        errors = done.stderr.decode("utf-8", "replace")
        assert done.returncode in (0, 1), errors
        assert "Traceback" not in errors
        text = done.stdout.decode("utf-8", "replace")
        findings = json.loads(text)["findings"] if "--json" in words else []
        for finding in findings:
            assert finding["severity"] in ("ok", "note") or finding["cure"], f"no cure: {finding}"
        return Answer(done.returncode, findings, errors if findings else text)


def make_environment(folder: Path, *, packages: bool) -> str:
    """Make a virtual environment without any commands; its packages are this one's, or none but the kit."""
    venv.EnvBuilder(with_pip=False, symlinks=sys.platform != "win32").create(folder)
    windows = sys.platform == "win32"
    inside = folder / "Lib" if windows else next((folder / "lib").glob("python3*"))
    lines = [str(REPO / "src")]
    if packages:
        lines += [p for p in sys.path if p.endswith("site-packages")]
    (inside / "site-packages" / "others.pth").write_text("\n".join(lines), encoding="utf-8")
    return str(folder / ("Scripts/python.exe" if windows else "bin/python"))
