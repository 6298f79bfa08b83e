"""Shuts a freshly forked process in, step by step; each step says whether it could be done.

Order matters: namespaces first (they give the rights to mount), then the mounts, then limits, and last the steps that
give rights up. Everything here runs before the first line of student code.
"""

from __future__ import annotations

import contextlib
import os
import socket
import stat
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from robotbrain.grading.sandbox.bubblewrap import HOME

if sys.platform != "win32":
    import resource

WORK = f"{HOME}/work"
_OPEN_FILES = 256
_LARGEST_FILE = 64 << 20


def enter_namespaces() -> bool:
    """Make user, pid, network, IPC and host name namespaces; the pid namespace holds for the next child."""
    if sys.platform != "linux":
        return False
    from robotbrain.grading.sandbox import linux

    others = linux.CLONE_NEWPID | linux.CLONE_NEWNET | linux.CLONE_NEWIPC | linux.CLONE_NEWUTS
    try:
        linux.enter_user_namespace(others)
    except OSError:
        return False
    with contextlib.suppress(OSError):  # a name, nothing that protects
        socket.sethostname("student")
    return True


def mount_private_folders(size_bytes: int, files: int) -> bool:
    """Give this process its own writable folders, all on one small file system in memory, and hide ``/proc``.

    Needs the rights of :func:`enter_namespaces` and the place that bubblewrap prepared.
    """
    from robotbrain.grading.sandbox import linux

    if not Path(HOME).is_dir():
        return False
    linux.unshare(linux.CLONE_NEWNS)
    linux.mount("none", "/", None, linux.MS_REC | linux.MS_PRIVATE)
    guarded = linux.MS_NOSUID | linux.MS_NODEV
    # A course, or a Python, may lie below /tmp.
    shown = {path: os.open(path, os.O_RDONLY) for path in _mounted_below("/tmp")}
    linux.mount("student", HOME, "tmpfs", guarded, f"size={size_bytes},nr_inodes={files},mode=0700")
    for name, target in (("work", None), (".tmp", "/tmp"), (".shm", "/dev/shm")):
        folder = Path(HOME, name)
        folder.mkdir()
        if target is not None:
            linux.mount(str(folder), target, None, linux.MS_BIND)
    for path, fd in shown.items():
        if stat.S_ISDIR(os.fstat(fd).st_mode):
            Path(path).mkdir(parents=True, exist_ok=True)
        else:
            Path(path).parent.mkdir(parents=True, exist_ok=True)
            Path(path).touch()
        linux.mount(f"/proc/self/fd/{fd}", path, None, linux.MS_BIND)  # read-only, as it was
        os.close(fd)
    linux.mount("none", "/proc", "tmpfs", guarded, "size=4k,nr_inodes=4,mode=0555")
    if Path("/dev/pts").is_dir():  # the host's view has one for all submissions, which run as the same user
        linux.mount("none", "/dev/pts", "devpts", guarded, "newinstance,max=8,ptmxmode=0666,mode=0600")
    return True


def _mounted_below(folder: str) -> list[str]:
    """Where something is mounted below ``folder``, the outermost only."""
    lines = Path("/proc/self/mountinfo").read_text(encoding="ascii").splitlines()
    places = sorted(line.split()[4].encode().decode("unicode_escape") for line in lines)
    below = [p for p in places if p.startswith(f"{folder}/")]
    return [p for p in below if not any(p.startswith(f"{other}/") for other in below)]


def set_limits(bounds: Mapping[str, Any], contained: bool) -> None:
    """Resource limits per process: memory, file size, open files, processes, processor time, no core dumps.

    Args:
        bounds: ``memory_bytes`` beyond what this process maps already, ``processes``, ``cpu_s``.
        contained: this process is in a user namespace of its own, so that its user's processes are the submission's.
    """
    if sys.platform == "win32":
        return
    mapped = _mapped_bytes()
    wanted = {
        resource.RLIMIT_CORE: 0,
        resource.RLIMIT_NOFILE: _OPEN_FILES,
        resource.RLIMIT_FSIZE: _LARGEST_FILE,
        resource.RLIMIT_CPU: int(bounds["cpu_s"]) + 1,
    }
    if contained:
        wanted[resource.RLIMIT_NPROC] = int(bounds["processes"])
    if mapped:  # unknown without /proc; macOS does not keep this limit anyway
        wanted[resource.RLIMIT_AS] = mapped + int(bounds["memory_bytes"])
    for name, value in wanted.items():
        hard = resource.getrlimit(name)[1]
        value = value if hard == resource.RLIM_INFINITY else min(value, hard)
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(name, (value, value))


def give_up_rights(seccomp: bytes | None) -> None:
    """Drop capabilities, forbid gaining any, and install the filter of system calls."""
    if sys.platform != "linux":
        return
    from robotbrain.grading.sandbox import linux

    linux.drop_capabilities()
    linux.forbid_new_privileges()
    if seccomp:
        linux.install_filter(seccomp)


def _mapped_bytes() -> int:
    try:
        return int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[0]) * resource.getpagesize()
    except OSError:
        return 0
