"""Which files of a course go to students: those that a rule here names, and no others.

A folder of the course that no rule names (solutions, hidden tests, mutants, references, the bank of the assessment,
gradebook, submissions, draws, papers, tests, benchmarks) cannot get in. Within the folders that are named, a file that
is of no known kind, not under version control, or a link, stops the command: somebody has to say what it is.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.resources import files as package_files
from pathlib import Path, PurePosixPath

from robotbrain.errors import InputError
from robotbrain.grading.course import Course, release_differences

_TEXT = (".py", ".ipynb", ".md", ".toml", ".json", ".csv", ".html", ".css", ".txt", ".sh", ".svg", ".yml", ".typed", "")
_FOLDERS = {
    "course": (".ipynb", ".md", ".toml", ".png", ".svg"),
    "labs": (".ipynb", ".py", ".md", ".txt", ".toml", ".json", ".csv", ".npz", ".onnx", ".png", ".svg"),
    "src/robotbrain": (
        *(".py", ".toml", ".json", ".onnx", ".pt", ".html", ".css", ".js", ".svg", ".md", ".txt", ".sh", ".typed"),
    ),
    "autograder/profiles": (".toml", ".json", ".csv", ".onnx", ".md"),
}
"""Folder: the kinds of files in it that go in. The profiles are the Jetson catalogue: the library reads them there."""
_SINGLE = ("pyproject.toml", "constraints.txt", "environment.yml", "LICENSE")
_OPTIONAL = (
    ".devcontainer/devcontainer.json",
    *(f"binder/{name}" for name in ("requirements.txt", "runtime.txt", "postBuild", "start")),
)
_LEFT_BEHIND = {"__pycache__", ".ipynb_checkpoints", ".DS_Store", "MUJOCO_LOG.TXT", ".mypy_cache", ".ruff_cache"}


@dataclass(frozen=True, slots=True)
class Item:
    """A file of the bundle: its name in there, with ``/``, and its bytes."""

    name: str
    data: bytes


def collect(course: Course, *, tracked: Iterable[str] | None = None) -> list[Item]:
    """All files of the bundle but its list of checksums, sorted by name.

    Args:
        course: where from.
        tracked: names under version control; others are refused. None: the tree is under none, the rules decide.

    Raises:
        InputError: a link, a file that is unknown, one that is missing, or a name that Windows cannot keep.
    """
    known = None if tracked is None else set(tracked)
    paths = [path for folder, kinds in _FOLDERS.items() for path in _walk(course.home, folder, kinds, known)]
    paths += [course.home / name for name in _SINGLE]
    paths += [path for name in _OPTIONAL if (path := course.home / name).is_file()]
    items = [Item(_name(path, course.home), _bytes(path)) for path in paths]
    readme = package_files(__package__).joinpath("STUDENT_README.md").read_bytes()
    items.append(Item("README.md", readme.replace(b"\r\n", b"\n")))
    _check_names(item.name for item in items)
    return sorted(items, key=lambda item: item.name)


def check_labs(course: Course) -> None:
    """Raise :class:`InputError` unless ``labs/`` is exactly what ``solutions/`` gives.

    A lab that was edited by hand, or not generated since its solution changed, may hold what students must not see.
    """
    labs = course.labs()
    released = course.home / "labs"
    without = [p.name for p in sorted(released.iterdir()) if p.name not in labs] if released.is_dir() else []
    problems = [f"labs/{name} has no source in solutions/" for name in without if name not in _LEFT_BEHIND]
    for lab in labs:
        with tempfile.TemporaryDirectory(prefix="robotbrain-") as scratch:
            problems += [f"labs/{lab}: {text}" for text in release_differences(course, lab, Path(scratch))]
    if problems or not labs:
        raise InputError(
            "labs/",
            given="; ".join(problems) or "no solutions/",
            expected="exactly what `robotbrain generate` makes of solutions/",
            fix="Run: robotbrain generate",
        )


def tracked_files(home: Path) -> set[str] | None:
    """Names under version control below ``home``, or None where there is none (or no git to ask)."""
    told = _git(home, "ls-files", "-z", "--cached", "--", ".")
    return {name for name in told.split("\0") if name} if told else None


def last_change(home: Path) -> int | None:
    """Time of the last commit in seconds since 1970, or None where there is none."""
    told = _git(home, "log", "-1", "--format=%ct").strip()
    return int(told) if told.isdecimal() else None


def _git(home: Path, *arguments: str) -> str:
    environment = {k: v for k, v in os.environ.items() if not k.startswith("GIT_")}  # a hook's own repository
    try:
        command = ["git", "-C", str(home), *arguments]
        done = subprocess.run(command, capture_output=True, encoding="utf-8", env=environment, check=False)
    except OSError:
        return ""
    return done.stdout if done.returncode == 0 else ""


def _walk(home: Path, folder: str, kinds: tuple[str, ...], known: set[str] | None) -> list[Path]:
    top = home / folder
    _refuse_links([top, *top.parents][: len(Path(folder).parts)], home)
    if not top.is_dir():
        raise _refused(f"{folder}/", "no such folder", "a complete course", "Run this in the course's repository.")
    found: list[Path] = []
    waiting = [top]
    while waiting:
        inside = [p for p in sorted(waiting.pop().iterdir()) if not (p.name in _LEFT_BEHIND or p.suffix == ".pyc")]
        _refuse_links(inside, home)
        waiting += [p for p in inside if p.is_dir()]
        found += [p for p in inside if not p.is_dir()]
    unknown = [p for p in found if p.suffix not in kinds or not p.is_file() or p.name.startswith(".")]
    if known is not None:
        unknown += [p for p in found if p not in unknown and _name(p, home) not in known]
    if unknown:
        raise _refused(
            f"{folder}/",
            ", ".join(_name(p, home) for p in unknown[:8]) + (" …" if len(unknown) > 8 else ""),
            f"files under version control, of the kinds {' '.join(kinds)}",
            "Remove them, or `git add` what students are to have.",
        )
    return found


def _refuse_links(paths: Iterable[Path], home: Path) -> None:
    for path in paths:
        if path.is_symlink() or getattr(path, "is_junction", bool)():  # Windows has both
            raise _refused(_name(path, home), "a link", "a plain file or folder", "Put the file itself there.")


def _bytes(path: Path) -> bytes:
    if path.is_symlink() or not path.is_file():
        raise _refused(path.name, "no plain file", "a file of the course", "Restore it from version control.")
    data = path.read_bytes()
    # A checkout on Windows may have other line ends; the bundle has the same everywhere.
    return data.replace(b"\r\n", b"\n") if path.suffix in _TEXT else data


def _name(path: Path, home: Path) -> str:
    return path.relative_to(home).as_posix()


_RESERVED = {"con", "prn", "aux", "nul", *(f"{port}{n}" for port in ("com", "lpt") for n in range(1, 10))}
_LONGEST = 150  # below a student's own folder: Windows stops at 260 in all


def _check_names(names: Iterable[str]) -> None:
    seen: dict[str, str] = {}
    for name in names:
        parts = PurePosixPath(name).parts
        portable = name.isascii() and not set(name) & set('<>:"\\|?*') and len(name) <= _LONGEST
        portable = portable and not any(p.split(".")[0].lower() in _RESERVED or p[-1] in ". " for p in parts)
        if not portable or name.lower() in seen:
            raise _refused(
                "name of a file",
                name,
                "a short ASCII name that Windows can keep, different from others in more than capitals",
                "Rename it.",
            )
        seen[name.lower()] = name


def _refused(what: str, given: str, expected: str, fix: str) -> InputError:
    return InputError(what, given=given, expected=expected, fix=fix)
