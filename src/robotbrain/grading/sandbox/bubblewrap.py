"""The view of the host that student code gets: a read-only root with Python and the kit in it, and no network."""

from __future__ import annotations

import os
import shutil
import site
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

HOME = "/home/student"
NOBODY = 65534

_SYSTEM = ("/usr", "/bin", "/sbin", "/lib", "/lib32", "/lib64", "/libx32")
_ETC = ("ld.so.cache", "ld.so.conf", "ld.so.conf.d", "alternatives", "localtime", "fonts")
_HUGE_PAGES = Path("/sys/kernel/mm/transparent_hugepage")  # the C library asks there before it uses them
_SCRATCH_BYTES = 256 << 20  # for the fork server itself; each submission has its own


def program() -> str | None:
    """The path of bubblewrap, or None."""
    return shutil.which("bwrap") if sys.platform == "linux" else None


def command(bwrap: str, *, readable: Sequence[Path], hidden: Sequence[Path] = ()) -> list[str]:
    """The bubblewrap command that a Python command line is to be appended to.

    Args:
        bwrap: the program.
        readable: folders beyond Python's own that are visible where they are, read-only.
        hidden: folders that must not be visible even if they lie inside something that is.

    Inside, the process may be root's own (bubblewrap started by root keeps the user): the fork server then becomes
    :data:`NOBODY` before it does anything else, for which it is left the two capabilities that this takes.
    """
    root = os.geteuid() == 0
    options = ["--unshare-pid", "--unshare-net", "--unshare-ipc", "--unshare-uts", "--unshare-cgroup-try"]
    options += ["--die-with-parent", "--new-session", "--hostname", "student"]
    if root:
        options += ["--cap-drop", "ALL", "--cap-add", "CAP_SETUID", "--cap-add", "CAP_SETGID"]
    else:
        options += ["--unshare-user", "--uid", str(NOBODY), "--gid", str(NOBODY)]
    shown = [*python_folders(), *map(_absolute, readable)]
    masks = [h for h in map(_absolute, hidden) if any(h.is_relative_to(s) for s in shown)]
    tree = _Tree()
    for name in _SYSTEM:
        path = Path(name)
        if path.is_symlink():
            options += ["--symlink", str(path.readlink()), name]
        elif path.is_dir():
            options += ["--ro-bind", name, name]
    for name in _ETC:
        path = Path("/etc") / name
        if path.exists():
            options += [*tree.parents(path), "--ro-bind", str(path.resolve()), str(path)]
    if _HUGE_PAGES.is_dir():
        options += [*tree.parents(_HUGE_PAGES), "--ro-bind", str(_HUGE_PAGES), str(_HUGE_PAGES)]
    options += ["--perms", "1777", "--size", str(_SCRATCH_BYTES), "--tmpfs", "/tmp"]
    outermost = [s for s in shown if not any(s != o and s.is_relative_to(o) for o in shown)]
    for path in dict.fromkeys(outermost):
        if not _is_system(path):
            options += [*tree.parents(path), "--ro-bind", str(path), str(path)]
    for alias, target in _python_aliases(shown):
        options += [*tree.parents(alias), "--ro-bind", str(target), str(alias)]
    for mask in masks:
        options += ["--tmpfs", str(mask)]
        for path in shown:
            if path.is_relative_to(mask):
                options += [*tree.parents(path), "--ro-bind", str(path), str(path)]
        options += ["--remount-ro", str(mask)]
    options += ["--proc", "/proc", "--dev", "/dev", "--remount-ro", "/dev"]
    options += [*tree.parents(Path(HOME) / "x"), "--remount-ro", "/", "--chdir", "/"]
    return [bwrap, *options]


def python_folders() -> list[Path]:
    """Where this Python and its packages are installed: the environment, the interpreter it was made from, user site.

    Only whole installations are named: a folder that merely is on ``sys.path`` (an editable install, the working
    directory) may hold anything.
    """
    folders = [Path(sys.prefix), Path(sys.base_prefix), Path(sys.exec_prefix)]
    user = site.getusersitepackages()
    if user in sys.path:
        folders.append(Path(user))
    return list(dict.fromkeys(map(_absolute, folders)))


class _Tree:
    """Remembers which folders of the new root exist already."""

    def __init__(self) -> None:
        self._made: set[Path] = {Path("/"), Path("/tmp")}

    def parents(self, path: Path) -> list[str]:
        """Options that make the folders above ``path`` (bubblewrap's own would be closed to other users)."""
        options: list[str] = []
        for parent in reversed(path.parents):
            if parent not in self._made and not _is_system(parent):
                self._made.add(parent)
                options += ["--perms", "0755", "--dir", str(parent)]
        return options


def _python_aliases(shown: Iterable[Path]) -> list[tuple[Path, Path]]:
    """Folders that the interpreter's chain of links passes through and that would be missing: (as named, real one)."""
    shown = list(shown)
    aliases: dict[Path, Path] = {}
    path = Path(sys.executable)
    for _ in range(20):
        if not path.is_symlink():
            break
        path = Path(os.path.normpath(path.parent / path.readlink()))
        prefix = path.parent.parent
        if not any(path.is_relative_to(s) for s in shown) and not _is_system(path):
            aliases[prefix] = prefix.resolve()
    return list(aliases.items())


def _is_system(path: Path) -> bool:
    return any(path == Path(s) or path.is_relative_to(s) for s in _SYSTEM)


def _absolute(path: Path) -> Path:
    return Path(os.path.abspath(path))  # noqa: PTH100 - links stay as they are named: the interpreter uses these names
