"""Room on disks, and folders that must take files."""

from __future__ import annotations

import contextlib
import importlib
import os
import shutil
import stat
import subprocess
import sys
import tempfile
import uuid
from pathlib import Path
from typing import Any

from robotbrain.doctor.finding import (
    Cure,
    Finding,
    Severity,
    Situation,
    everywhere,
    fault,
    note,
    ok,
    posix_or_windows,
    python,
    quoted,
    set_variable,
    warning,
)

_MB = 1e6
_LONG_PATHS = r"SYSTEM\CurrentControlSet\Control\FileSystem"
_SYNCED = ("onedrive", "dropbox", "google drive", "icloud", "com~apple~clouddocs", "nextcloud")


def disk(situation: Situation) -> list[Finding]:
    """Free room where things are written, and free names (inodes)."""
    needs = [
        ("temporary files", _temporary(), 200 * _MB, 1000 * _MB),
        ("the course and its runs", situation.course or situation.folder, 100 * _MB, 1000 * _MB),
        ("the home folder", _home(), 20 * _MB, 200 * _MB),
        ("the environment", Path(sys.prefix), 0, 500 * _MB),
    ]
    rooms = []
    found: list[Finding] = []
    for purpose, folder, least, wanted in needs:
        place = _existing(folder)
        try:
            free = shutil.disk_usage(place).free
        except OSError as error:
            found.append(warning(f"{place} ({purpose}) cannot be measured: {error.strerror}", _make_room(place)))
            continue
        rooms.append(f"{purpose} {free / 1e9:.1f} GB")
        if free < wanted:
            what = f"{free / _MB:.0f} MB are free for {purpose} ({place}); {max(least, wanted) / _MB:.0f} MB are wanted"
            found.append((fault if free < least else warning)(what, _make_room(place)))
        elif hasattr(os, "statvfs"):
            names = os.statvfs(place)
            if names.f_files and names.f_favail < 1000:
                found.append(
                    fault(
                        f"no more files can be made in {place} ({purpose}): its inodes are used up", _make_room(place)
                    )
                )
    return [ok("free: " + ", ".join(rooms)), *found] if rooms else found


def _make_room(place: Path) -> Cure:
    pip = python("-m", "pip", "cache", "purge")
    return Cure(
        f"Make room: {pip}; empty the trash; `du -xh --max-depth=2 {quoted(place)} | sort -h | tail` shows "
        "what is large; or put temporary files elsewhere: export TMPDIR=/path/with/room",
        f"Make room: {pip}; empty the trash; Apple menu > System Settings > General > Storage shows what is large; or "
        "export TMPDIR=/path/with/room",
        f"Make room: {pip}; run cleanmgr; Settings > System > Storage shows what is large; or put temporary files "
        r"elsewhere: setx TEMP D:\temp",
    )


def folders(situation: Situation) -> list[Finding]:
    """Home, temporary, Jupyter's, cache and course folders take files; temporary ones may hold programs."""
    found: list[Finding] = []
    places = {"home": _home(), "temporary": _temporary(), **_jupyter_folders()}
    if situation.course is not None:
        places["course"] = situation.course
        places |= {
            name: situation.course / name for name in ("labs", "autograder") if (situation.course / name).is_dir()
        }
    for purpose, folder in places.items():
        if problem := _unwritable(_existing(folder)):
            found.append(
                fault(f"the {purpose} folder {folder} cannot be written to: {problem}", _cure(purpose, folder))
            )
    if problem := _cannot_execute(_temporary()):
        found.append(
            warning(
                f"programs in {_temporary()} may not run ({problem}; mounted noexec?): builds by pip and torch fail",
                set_variable("TMPDIR", str(_home() / "tmp"), then=f"mkdir -p {quoted(_home() / 'tmp')}"),
            )
        )
    if situation.course is not None and any(name in str(situation.course).lower() for name in _SYNCED):
        found.append(
            warning(
                f"the course lies in a folder that is synchronised ({situation.course}): databases get damaged there",
                posix_or_windows(
                    f"mv {quoted(situation.course)} {quoted(_home() / 'robotbrain-course')}",
                    f'Move-Item "{situation.course}" "{_home() / "robotbrain-course"}"',
                ),
            )
        )
    found += _long_paths(situation)
    if any(f.severity is Severity.FAULT for f in found):
        return found
    return [ok("home, temporary, Jupyter's and course folders can be written to"), *found]


def _cure(purpose: str, folder: Path) -> Cure:
    if purpose == "temporary":
        return posix_or_windows(
            f"mkdir -p {quoted(_home() / 'tmp')}; export TMPDIR={quoted(_home() / 'tmp')}",
            f'mkdir "{_home() / "tmp"}"; $env:TEMP = "{_home() / "tmp"}"',
        )
    if purpose == "home":
        return posix_or_windows(
            f"sudo chown -R $(id -un) {quoted(folder)}; or, in a container: export HOME=/a/folder/of/yours",
            r"$env:USERPROFILE = 'C:\a\folder\of\yours', or ask whoever manages this computer",
        )
    if purpose.startswith("Jupyter"):
        variable = {"Jupyter data": "JUPYTER_DATA_DIR", "Jupyter runtime": "JUPYTER_RUNTIME_DIR"}[purpose]
        return posix_or_windows(
            f"sudo chown -R $(id -un) {quoted(folder)}; or: export {variable}=/a/folder/of/yours",
            f'icacls "{folder}" /grant "$env:USERNAME:(OI)(CI)F"; or: $env:{variable} = "C:\\a\\folder\\of\\yours"',
        )
    return posix_or_windows(
        f"sudo chown -R $(id -un) {quoted(folder)}; or copy it: cp -r {quoted(folder)} ~/robotbrain-course",
        f'icacls "{folder}" /grant "$env:USERNAME:(OI)(CI)F"; or copy it: Copy-Item -Recurse "{folder}" $HOME',
    )


def _home() -> Path:
    try:
        return Path.home()
    except (RuntimeError, KeyError):  # a user without a home, as in some containers
        return Path(os.sep)


def _temporary() -> Path:
    """The temporary folder that is asked for; :func:`tempfile.gettempdir` would pass over one that is broken."""
    for name in ("TMPDIR", "TEMP", "TMP"):
        if value := os.environ.get(name):
            return Path(value)
    try:
        return Path(tempfile.gettempdir())
    except FileNotFoundError:
        return Path(os.sep, "tmp")


def _jupyter_folders() -> dict[str, Path]:
    try:
        from jupyter_core.paths import jupyter_data_dir, jupyter_runtime_dir

        return {"Jupyter data": Path(jupyter_data_dir()), "Jupyter runtime": Path(jupyter_runtime_dir())}
    except Exception:  # missing or broken: another probe says so
        return {}


def _existing(folder: Path) -> Path:
    """The folder, or the nearest one above it that exists (it would be made there)."""
    for place in (folder, *folder.parents):
        try:
            if place.exists():
                return place
        except OSError:
            return place
    return folder


def _unwritable(folder: Path) -> str:
    """Return why no file can be made in ``folder``; empty if one could."""
    # mkstemp would try a hundred names where Windows refuses for lack of permission.
    trial = folder / f".robotbrain-doctor-{uuid.uuid4().hex}"
    try:
        trial.write_bytes(b"x")
        trial.unlink()
    except OSError as error:
        return error.strerror or str(error)
    return ""


def _cannot_execute(folder: Path) -> str:
    """Return what the system says when a program in ``folder`` is started; empty if it runs (or cannot be tried)."""
    if sys.platform == "win32":
        return ""
    program = folder / f".robotbrain-doctor-{uuid.uuid4().hex}.sh"
    try:
        program.write_text("#!/bin/sh\nexit 0\n", encoding="ascii")
        program.chmod(stat.S_IRWXU)
        subprocess.run([str(program)], check=False, timeout=10, stdin=subprocess.DEVNULL)
    except PermissionError as error:
        return error.strerror or str(error)
    except (OSError, subprocess.SubprocessError):
        return ""
    finally:
        with contextlib.suppress(OSError):  # the finding about writing says it
            program.unlink(missing_ok=True)
    return ""


def _long_paths(situation: Situation) -> list[Finding]:
    """Windows refuses paths beyond 260 characters unless it is told otherwise; node and pip make long ones."""
    if os.name != "nt":
        return []
    if _long_paths_enabled():
        return []
    cure = everywhere(
        "In a PowerShell started as administrator: New-ItemProperty -Path HKLM:\\" + _LONG_PATHS + " -Name "
        "LongPathsEnabled -Value 1 -PropertyType DWORD -Force; then sign in again"
    )
    deepest = max(len(str(situation.course or situation.folder)), len(sys.prefix))
    if deepest > 100:
        return [warning(f"Windows allows paths of 260 characters only, and this folder's takes {deepest}", cure)]
    return [note("Windows allows paths of 260 characters only", cure)]


def _long_paths_enabled() -> bool:
    winreg: Any = importlib.import_module("winreg")
    try:
        with winreg.OpenKey(winreg.HKEY_LOCAL_MACHINE, _LONG_PATHS) as key:
            return bool(winreg.QueryValueEx(key, "LongPathsEnabled")[0])
    except OSError:
        return False
