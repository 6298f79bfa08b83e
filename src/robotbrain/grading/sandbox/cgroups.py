"""Bounds on the memory, processes and processor time of a submission as a whole, where the host lets us set them.

Resource limits count per process; a control group counts what all processes of a submission use together. Version 2
is one tree; version 1 has a tree per controller. Making a group needs root or a part of the tree that was handed to
this user (``systemd-run --user --scope -p Delegate=yes robotbrain grade-class …``).
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import os
import threading
from dataclasses import dataclass, field
from pathlib import Path

_ROOT = Path("/sys/fs/cgroup")
_PERIOD_US = 100_000
_numbers = itertools.count()


@dataclass(frozen=True)
class Bounds:
    """What one submission may use."""

    memory_bytes: int
    processes: int
    processors: float = 1.0


@dataclass
class Group:
    """The control group of one submission."""

    folders: list[Path]  # one in version 2; one for each controller in version 1
    unified: bool

    def add(self, pid: int) -> None:
        """Put process ``pid``, and all it will start, under the bounds."""
        for folder in self.folders:
            (folder / "cgroup.procs").write_text(str(pid))

    def out_of_memory(self) -> int:
        """How many processes of the group the kernel has killed because its memory was used up."""
        total = 0
        for path in self._memory_events:
            with contextlib.suppress(OSError, ValueError):
                words = dict(line.split()[:2] for line in path.read_text().splitlines())
                total += int(words.get("oom_kill", 0))
        return total

    @functools.cached_property
    def _memory_events(self) -> list[Path]:
        names = ("memory.events", "memory.oom_control")
        return [path for folder in self.folders for name in names if (path := folder / name).is_file()]

    def peak_bytes(self) -> int:
        """The most memory that the group has used."""
        for folder in self.folders:
            for name in ("memory.peak", "memory.max_usage_in_bytes"):
                with contextlib.suppress(OSError, ValueError):
                    return int((folder / name).read_text())
        return 0

    def remove(self) -> bool:
        """Take the group away; False while a process of it still ends."""
        left = []
        for folder in self.folders:
            with contextlib.suppress(OSError):
                (folder / "cgroup.kill").write_text("1")
            try:
                folder.rmdir()
            except FileNotFoundError:
                pass
            except OSError:
                left.append(folder)
        self.folders = left
        return not left


@dataclass
class Cgroups:
    """Makes groups below one place of the host's tree.

    Attributes:
        bases: where groups are made; empty if the host does not let us.
        note: which version, or why not.
    """

    bases: list[Path] = field(default_factory=list)
    unified: bool = True
    note: str = ""
    _leaving: list[Group] = field(default_factory=list)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    @classmethod
    def find(cls) -> Cgroups:
        """Look for a place where this process may make groups, by making one."""
        tried = "no cgroup file system"
        for unified, bases in _places():
            found = cls(bases, unified, "version 2" if unified else "version 1")
            try:
                found.make(Bounds(1 << 30, 64)).remove()
            except OSError as error:
                tried = f"{error.strerror or error} ({error.filename or bases[0]})"
                continue
            return found
        return cls(note=tried)

    def make(self, bounds: Bounds) -> Group:
        """Make a group with ``bounds``."""
        name = f"robotbrain-{os.getpid()}-{next(_numbers)}"
        group = Group([], self.unified)
        try:
            for base in self.bases:
                folder = base / name
                folder.mkdir()
                group.folders.append(folder)
            for file, text in _settings(bounds, self.unified):
                _write(group.folders, file, text)
        except OSError:
            group.remove()
            raise
        return group

    def discard(self, group: Group) -> None:
        """Remove ``group`` now, or as soon as its last process has ended."""
        with self._lock:
            self._leaving = [g for g in [*self._leaving, group] if not g.remove()]

    def close(self) -> None:
        """Remove what is left."""
        with self._lock:
            self._leaving = [g for g in self._leaving if not g.remove()]


def _settings(bounds: Bounds, unified: bool) -> list[tuple[str, str]]:
    quota = max(1000, int(bounds.processors * _PERIOD_US))
    if unified:
        return [
            ("memory.max", str(bounds.memory_bytes)),
            ("memory.swap.max", "0"),
            ("memory.oom.group", "0"),
            ("pids.max", str(bounds.processes)),
            ("cpu.max", f"{quota} {_PERIOD_US}"),
        ]
    return [
        ("memory.limit_in_bytes", str(bounds.memory_bytes)),
        ("pids.max", str(bounds.processes)),
        ("cpu.cfs_period_us", str(_PERIOD_US)),
        ("cpu.cfs_quota_us", str(quota)),
    ]


_OPTIONAL = {"memory.swap.max", "memory.oom.group", "cpu.max", "cpu.cfs_period_us", "cpu.cfs_quota_us"}


def _write(folders: list[Path], file: str, text: str) -> None:
    for folder in folders:
        if (folder / file).exists():
            try:
                (folder / file).write_text(text)
            except OSError:
                if file not in _OPTIONAL:
                    raise
            return
    if file not in _OPTIONAL:
        raise FileNotFoundError(2, "the controller is not enabled", file)


def _places() -> list[tuple[bool, list[Path]]]:
    """Where groups might be made, the most fitting place first."""
    try:
        lines = [line.split(":", 2) for line in Path("/proc/self/cgroup").read_text(encoding="utf-8").splitlines()]
    except OSError:
        return []
    own = {name: path for _, names, path in lines for name in names.split(",")}
    places: list[tuple[bool, list[Path]]] = []
    if (_ROOT / "cgroup.controllers").is_file():
        here = _ROOT / own.get("", "/").lstrip("/")
        for base in (here, here.parent, _ROOT):
            if base.is_relative_to(_ROOT) and base.is_dir():
                with contextlib.suppress(OSError):
                    (base / "cgroup.subtree_control").write_text("+memory +pids +cpu")
                places.append((True, [base]))
        return places
    controllers = [c for c in ("memory", "pids", "cpu") if (_ROOT / c).is_dir()]
    for root in (False, True):
        bases = [_ROOT / c / ("" if root else own.get(c, "/").lstrip("/")) for c in controllers]
        if bases and all(b.is_dir() for b in bases):
            places.append((False, bases))
    return places
