"""What a probe says: how bad it is, what it is, and what to do, on each system."""

from __future__ import annotations

import shlex
import subprocess
import sys
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path


class Severity(Enum):
    """How much a finding matters.

    ``FAULT`` breaks something that the course needs; ``WARNING`` will sooner or later surprise somebody; ``NOTE`` is
    worth knowing, and nothing is wrong.
    """

    OK = "ok"
    NOTE = "note"
    WARNING = "warning"
    FAULT = "fault"


@dataclass(frozen=True)
class Cure:
    """The step that mends a finding: a command or an exact instruction, for each system."""

    linux: str = ""
    macos: str = ""
    windows: str = ""

    def here(self) -> str:
        """Return the step for the system this runs on."""
        return {"win32": self.windows, "darwin": self.macos}.get(sys.platform, self.linux)


@dataclass(frozen=True)
class Finding:
    """One thing that a probe found.

    Attributes:
        what: the fact, in one sentence.
        cure: what to do about it; empty only if nothing is to be done.
        detail: more of it, such as the last line of an error.
        probe: name of the probe, filled in by whoever runs it.
    """

    severity: Severity
    what: str
    cure: Cure = field(default_factory=Cure)
    detail: str = ""
    probe: str = ""


@dataclass(frozen=True)
class Situation:
    """What every probe may want to know.

    Attributes:
        folder: where the user is.
        course: the folder with ``course/`` and ``labs/``, if there is one.
        limit_s: how long one thing may take, in seconds, before it counts as hanging.
    """

    folder: Path
    course: Path | None
    limit_s: float


def ok(what: str, detail: str = "") -> Finding:
    """Return the finding that something is as it should be."""
    return Finding(Severity.OK, what, detail=detail)


def note(what: str, cure: Cure | None = None, detail: str = "") -> Finding:
    """Return something worth knowing."""
    return Finding(Severity.NOTE, what, cure or Cure(), detail)


def warning(what: str, cure: Cure, detail: str = "") -> Finding:
    """Return something that will surprise somebody."""
    return Finding(Severity.WARNING, what, cure, detail)


def fault(what: str, cure: Cure, detail: str = "") -> Finding:
    """Return something that breaks the course."""
    return Finding(Severity.FAULT, what, cure, detail)


def everywhere(step: str) -> Cure:
    """Return a cure that reads the same on each system."""
    return Cure(step, step, step)


def posix_or_windows(posix: str, windows: str) -> Cure:
    """Return a cure for Linux and macOS, and another one for Windows."""
    return Cure(posix, posix, windows)


def set_variable(name: str, value: str, *, then: str = "") -> Cure:
    """Return how to set an environment variable; ``then``: what to do after it."""
    after = f", then {then}" if then else ""
    return posix_or_windows(
        f"export {name}={shlex.quote(value)}{after} (in ~/.profile to keep it)",
        f'$env:{name} = "{value}"{after} (setx {name} "{value}" keeps it)',
    )


def unset_variable(name: str) -> Cure:
    """Return how to remove an environment variable."""
    return posix_or_windows(
        f"unset {name} (and remove the line that sets it from ~/.bashrc, ~/.zshrc or ~/.profile)",
        f"Remove-Item Env:{name} (and delete it under Settings > System > About > Advanced > Environment Variables)",
    )


def quoted(path: Path) -> str:
    """Return a path as the shells of Linux and macOS take it, spaces and all."""
    return shlex.quote(str(path))


def python(*words: str) -> str:
    """Return a command line for this Python, to be copied into a terminal (PowerShell on Windows)."""
    if sys.platform == "win32":
        line = subprocess.list2cmdline([sys.executable, *words])
        return f"& {line}" if line.startswith('"') else line
    return shlex.join([sys.executable, *words])


def pip_install(*requirements: str, options: tuple[str, ...] = ()) -> Cure:
    """Return the command that installs packages into this very environment."""
    return everywhere(python("-m", "pip", "install", *options, *requirements))


def reinstall(*requirements: str) -> Cure:
    """Return the command that replaces the files of packages that are installed already."""
    return pip_install(*requirements, options=("--force-reinstall", "--no-cache-dir"))
