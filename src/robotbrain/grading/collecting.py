"""Takes submissions out of nbgrader's exchange, into which anybody may have written anything.

Every account may make folders there, and owns what it made. nbgrader's own collect copies a folder whose name says that
somebody else handed it in (it warns), and follows links in it with the instructor's rights: a link to the key would
bring it into the submission, and so to the student. Here a folder counts only if it belongs to the student that it
names; what is copied are plain files of the same owner, within bounds, opened by descriptors so that nothing can be
exchanged between the look and the copy.
"""

from __future__ import annotations

import os
import re
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

from robotbrain.grading.intake.gate import CHECKPOINTS, LARGEST_FILE, LARGEST_NOTEBOOK, LARGEST_TOTAL, MOST_FILES

_DEEPEST = 6
_STUDENT = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._@+-]*")
_LEFT_OUT = frozenset({CHECKPOINTS, "__pycache__", ".git"})
_FOLDER = os.O_RDONLY | getattr(os, "O_DIRECTORY", 0) | getattr(os, "O_NOFOLLOW", 0)
_FILE = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)  # a pipe must not hold us up


@dataclass(frozen=True, slots=True)
class Entry:
    """A folder in the exchange that says it is a submission.

    Attributes:
        stamp: when, as its name says and nbgrader writes it.
        owner: the account that it belongs to.
    """

    path: Path
    student: str
    stamp: str
    owner: str

    @property
    def own(self) -> bool:
        """Whether it belongs to the student that it names."""
        return self.owner == self.student


@dataclass
class _Budget:
    files: int = MOST_FILES
    size: int = LARGEST_TOTAL
    refused: list[str] = field(default_factory=list)


def entries(inbound: Path, lab: str) -> list[Entry]:
    """Everything in the exchange that calls itself a submission of ``lab``, oldest first."""
    from nbgrader.utils import parse_utc

    found: list[tuple[datetime, Entry]] = []
    for path in sorted(inbound.glob(f"*+{lab}+*")):
        student, _, rest = path.name.partition(f"+{lab}+")
        stamp = rest.partition("+")[0]
        try:
            if _STUDENT.fullmatch(student):
                found.append((parse_utc(stamp), Entry(path, student, stamp, _owner(path))))
        except (ValueError, OverflowError, OSError):  # no time, or gone again
            continue
    return [entry for _, entry in sorted(found, key=lambda pair: pair[0])]


def take(entry: Entry, target: Path) -> list[str]:
    """Copy a submission to ``target``, in the place of an earlier one; return what was left out, in sentences.

    Raises:
        OSError: the folder is no folder, or cannot be read; what was at ``target`` is still there.
    """
    budget = _Budget()
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=f".{target.name}.") as scratch:
        made = Path(scratch, "new")
        made.mkdir()
        with _opened(entry.path, _FOLDER) as handle:
            _copy(handle, os.fstat(handle).st_uid, made, "", budget)
        if target.exists():
            target.rename(Path(scratch, "old"))
        made.rename(target)
    return budget.refused


def _copy(handle: int, owner: int, target: Path, inside: str, budget: _Budget) -> None:
    for name in sorted(os.listdir(handle)):
        shown = f"{inside}{name}"
        if name in _LEFT_OUT:
            continue
        try:
            kind = os.stat(name, dir_fd=handle, follow_symlinks=False).st_mode
            if stat.S_ISDIR(kind) and shown.count("/") < _DEEPEST:
                with _opened(name, _FOLDER, handle) as folder:
                    (target / name).mkdir()
                    _copy(folder, owner, target / name, f"{shown}/", budget)
            elif stat.S_ISREG(kind):
                _copy_file(handle, name, owner, target, shown, budget)
            else:
                budget.refused.append(f"{shown} is {'a link' if stat.S_ISLNK(kind) else 'no plain file'}")
        except OSError as error:
            budget.refused.append(f"{shown} cannot be read ({error.strerror})")


def _copy_file(handle: int, name: str, owner: int, target: Path, shown: str, budget: _Budget) -> None:
    with _opened(name, _FILE, handle) as source:
        info = os.fstat(source)
        bound = LARGEST_NOTEBOOK if name.endswith(".ipynb") else LARGEST_FILE
        if not stat.S_ISREG(info.st_mode) or info.st_uid != owner:
            budget.refused.append(f"{shown} belongs to somebody else")
        elif info.st_size > min(bound, budget.size) or not budget.files:
            budget.refused.append(f"{shown} is too large, or one too many")
        else:
            budget.files -= 1
            budget.size -= info.st_size
            # A file that grows meanwhile is cut off where it ended when it was looked at.
            with (target / name).open("wb") as copy, os.fdopen(os.dup(source), "rb") as content:
                copy.write(content.read(info.st_size))


@contextmanager
def _opened(path: str | Path, flags: int, inside: int | None = None) -> Iterator[int]:
    handle = os.open(path, flags, dir_fd=inside)
    try:
        yield handle
    finally:
        os.close(handle)


def _owner(path: Path) -> str:
    number = path.lstat().st_uid
    try:
        import pwd

        return pwd.getpwuid(number).pw_name
    except (ImportError, KeyError):  # not on Windows; a user who is gone
        return f"user {number}"
