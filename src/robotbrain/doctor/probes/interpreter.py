"""The Python that runs this: its version, its processor, its environment, its text encodings."""

from __future__ import annotations

import os
import platform
import shutil
import sys
from pathlib import Path

from robotbrain.doctor.finding import (
    Cure,
    Finding,
    Situation,
    everywhere,
    fault,
    note,
    ok,
    posix_or_windows,
    quoted,
    set_variable,
    unset_variable,
    warning,
)

OLDEST = (3, 11)
NEWEST_TRIED = (3, 14)
OLDEST_GLIBC = (2, 28)
_ARM = ("arm64", "aarch64")
_X86 = ("x86_64", "amd64")

_NEW_PYTHON = Cure(
    "Install Python 3.11 or newer (Debian, Ubuntu: sudo apt install python3 python3-venv; or https://www.python.org), "
    "then make a new environment: python3 -m venv .venv",
    "Install Python 3.11 or newer (brew install python, or https://www.python.org), then make a new environment: "
    "python3 -m venv .venv",
    "Install the 64-bit Python 3.11 or newer (winget install Python.Python.3.12), then make a new environment: "
    "py -3.12 -m venv .venv",
)


def interpreter(_: Situation) -> list[Finding]:
    """Version, bits and processor of the interpreter, and the C library that packages are built for."""
    version, machine = platform.python_version(), platform.machine().lower()
    found = []
    if sys.version_info < OLDEST:
        found.append(fault(f"Python {version} is too old: the kit needs 3.11 or newer", _NEW_PYTHON))
    elif sys.version_info[:2] > NEWEST_TRIED:
        found.append(note(f"Python {version} is newer than the kit has been tried with (3.11 to 3.14)", _NEW_PYTHON))
    if sys.maxsize < 2**32:
        found.append(fault("this is a 32-bit Python: torch, MuJoCo and ONNX Runtime are 64-bit only", _NEW_PYTHON))
    if platform.python_implementation() != "CPython":
        found.append(fault(f"this is {platform.python_implementation()}; the packages are for CPython", _NEW_PYTHON))
    if machine not in _ARM + _X86:
        found.append(
            warning(
                f"few packages are built for the processor {machine or '(unknown)'}",
                everywhere("Use a computer with an x86-64 or 64-bit ARM processor."),
            )
        )
    found += _foreign_processor(machine) + _c_library()
    return found or [ok(f"Python {version}, 64 bit, {machine}")]


def _foreign_processor(machine: str) -> list[Finding]:
    """An interpreter for x86 that is translated on an ARM processor."""
    if sys.platform == "darwin" and machine in _X86:
        return [
            warning(
                "Python is for Intel processors; torch is no longer made for Intel Macs",
                everywhere(
                    "On a Mac with Apple silicon install a native Python (brew install python, in a terminal without "
                    "Rosetta) and make a new environment. On an Intel Mac use Binder or a Linux computer."
                ),
            )
        ]
    if sys.platform == "win32" and machine in _ARM:
        return [
            warning(
                "few packages are made for Windows on ARM",
                everywhere("Install the 64-bit Intel Python (it is translated), or use WSL: wsl --install"),
            )
        ]
    return []


def _c_library() -> list[Finding]:
    if sys.platform != "linux":
        return []
    name, version = platform.libc_ver()
    numbers = tuple(int(part) for part in version.split(".")[:2] if part.isdigit())
    if name == "glibc" and len(numbers) == 2 and numbers < OLDEST_GLIBC:
        return [
            fault(
                f"this system's C library, glibc {version}, is older than what torch is built for (2.28)",
                everywhere("Use a newer system (Ubuntu 20.04, Debian 10, RHEL 8 or later), or the Dev Container."),
            )
        ]
    if name != "glibc":
        return [
            warning(
                "this Linux does not use glibc (Alpine?); torch and MuJoCo are built for glibc",
                everywhere("Use a system with glibc, such as Debian or Ubuntu, or the Dev Container."),
            )
        ]
    return []


def environment(_: Situation) -> list[Finding]:
    """The virtual environment: whole, where it was made, and the one that a terminal's commands belong to."""
    prefix = Path(sys.prefix)
    found = _moved(prefix)
    scripts = Path(sys.executable).parent
    for name in ("python", "jupyter", "robotbrain"):
        path = shutil.which(name)
        if path and _other_environment(Path(path), scripts) and (scripts / Path(path).name).exists():
            found.append(
                warning(
                    f"`{name}` in this terminal is {path}, which is not of this environment ({prefix})",
                    _activation(prefix),
                )
            )
    if "PYTHONHOME" in os.environ:
        found.append(
            fault(
                "PYTHONHOME is set: Python looks for its own library in another installation",
                unset_variable("PYTHONHOME"),
            )
        )
    if sys.prefix == sys.base_prefix and "CONDA_PREFIX" not in os.environ:
        found.append(
            note(
                "the kit is installed outside of any virtual environment; other programs' packages may change its own",
                posix_or_windows(
                    "python3 -m venv .venv && source .venv/bin/activate, then install the kit again",
                    r"py -m venv .venv; .venv\Scripts\activate, then install the kit again",
                ),
            )
        )
    return found or [ok(f"environment {prefix}")]


def _moved(prefix: Path) -> list[Finding]:
    """An environment that was moved or copied, or whose Python is gone, has commands that lead nowhere."""
    scripts = Path(sys.executable).parent
    for name in ("jupyter", "robotbrain", "nbgrader"):
        try:
            with (scripts / name).open("rb") as file:
                first = file.readline(4096)
        except OSError:
            continue
        if not first.startswith(b"#!/"):
            continue
        named = first[2:].decode("utf-8", "replace").strip()
        if named.endswith("/env python3") or " " in named:
            continue
        if not Path(named).exists():
            return [
                fault(
                    f"the command `{name}` asks for {named}, which does not exist: the environment was moved or copied",
                    everywhere(
                        f"Make it again where it shall stay: delete {prefix}, then "
                        f"{quoted(python_of_base())} -m venv {quoted(prefix)} "
                        "and install the kit again."
                    ),
                )
            ]
    return []


def python_of_base() -> Path:
    """Return the Python that virtual environments are made with."""
    return Path(sys.base_prefix) / ("python.exe" if sys.platform == "win32" else "bin/python3")


def _other_environment(path: Path, scripts: Path) -> bool:
    return os.path.normcase(path.parent.absolute()) != os.path.normcase(scripts.absolute())


def _activation(prefix: Path) -> Cure:
    if "CONDA_PREFIX" in os.environ:
        return everywhere("conda activate robotbrain")
    if sys.prefix == sys.base_prefix:
        scripts = Path(sys.executable).parent
        return posix_or_windows(f"export PATH={quoted(scripts)}:$PATH", f'$env:PATH = "{scripts};$env:PATH"')
    return posix_or_windows(f"source {quoted(prefix / 'bin' / 'activate')}", str(prefix / "Scripts" / "Activate.ps1"))


def encoding(_: Situation) -> list[Finding]:
    """Whether names of files and printed text may hold more than ASCII."""
    import locale

    files, text = sys.getfilesystemencoding(), locale.getpreferredencoding(False)
    utf8 = Cure(
        "export LC_ALL=C.UTF-8 (or en_GB.UTF-8; `locale -a` lists what there is; in ~/.profile to keep it)",
        "export LC_ALL=en_GB.UTF-8 (in ~/.zprofile to keep it)",
        "setx PYTHONUTF8 1, then open a new terminal",
    )
    if not _is_utf8(files):
        return [fault(f"file names are read as {files}: a folder called Übung breaks the course", utf8)]
    if not _is_utf8(text):
        # Windows' own code pages can write most of what its user writes; the kit itself names UTF-8 everywhere.
        what = f"text files and terminals default to {text}, not to UTF-8"
        return [note(what, utf8) if sys.platform == "win32" else fault(what, utf8)]
    printed = getattr(sys.stdout, "encoding", None) or "ascii"
    forced = os.environ.get("PYTHONIOENCODING", "")
    if forced and not _is_utf8(printed):
        return [
            warning(
                f"PYTHONIOENCODING={forced} lets programs print {printed} only",
                set_variable("PYTHONIOENCODING", "utf-8"),
            )
        ]
    return [ok("text and file names are UTF-8")]


def _is_utf8(name: str) -> bool:
    return name.lower().replace("-", "").replace("_", "") in ("utf8", "utf8mb4", "cp65001")
