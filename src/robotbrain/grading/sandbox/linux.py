"""The few Linux system calls that Python's standard library lacks."""

from __future__ import annotations

import ctypes
import functools
import os
import platform

CLONE_NEWNS = 0x00020000
CLONE_NEWCGROUP = 0x02000000
CLONE_NEWUTS = 0x04000000
CLONE_NEWIPC = 0x08000000
CLONE_NEWUSER = 0x10000000
CLONE_NEWPID = 0x20000000
CLONE_NEWNET = 0x40000000

MS_NOSUID, MS_NODEV = 0x2, 0x4
MS_BIND, MS_REC, MS_PRIVATE = 0x1000, 0x4000, 0x40000

_PR_SET_PDEATHSIG, _PR_SET_DUMPABLE, _PR_SET_SECCOMP, _PR_CAPBSET_DROP = 1, 4, 22, 24
_PR_SET_CHILD_SUBREAPER, _PR_SET_NO_NEW_PRIVS = 36, 38
_SECCOMP_MODE_FILTER = 2
_CAPABILITY_VERSION_3 = 0x20080522
_SYS_CAPSET = {"x86_64": 126, "aarch64": 91}
_SYS_CLOSE_RANGE = 436  # the same number on every architecture
_LAST_FD = 0xFFFFFFFF


class _FilterProgram(ctypes.Structure):
    _fields_ = (("length", ctypes.c_ushort), ("instructions", ctypes.c_char_p))


@functools.cache
def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def _check(answer: int, what: str) -> None:
    if answer != 0:
        number = ctypes.get_errno()
        raise OSError(number, f"{what}: {os.strerror(number)}")


def _prctl(option: int, *arguments: int) -> None:
    words = [ctypes.c_ulong(a) for a in (*arguments, 0, 0, 0, 0)[:4]]
    _check(_libc().prctl(option, *words), f"prctl {option}")


def unshare(flags: int) -> None:
    """Move this process (its children, for a pid namespace) into new namespaces."""
    _check(_libc().unshare(flags), "unshare")


def enter_user_namespace(other_flags: int) -> None:
    """Make a user namespace with this process's own uid and gid in it, and with it the other namespaces of ``flags``.

    Needs no privilege where the host lets ordinary users make user namespaces.
    """
    uid, gid = os.getuid(), os.getgid()
    unshare(CLONE_NEWUSER | other_flags)
    for name, text in (("setgroups", "deny"), ("uid_map", f"{uid} {uid} 1"), ("gid_map", f"{gid} {gid} 1")):
        with open(f"/proc/self/{name}", "w", encoding="ascii") as file:  # noqa: PTH123 - one write call, as it must be
            file.write(text)


def mount(source: str, target: str, kind: str | None, flags: int, options: str | None = None) -> None:
    """``mount(2)``."""
    encoded = [None if s is None else s.encode() for s in (source, target, kind, options)]
    arguments = (encoded[0], encoded[1], encoded[2], ctypes.c_ulong(flags), encoded[3])
    _check(_libc().mount(*arguments), f"mount {target}")


def die_with_parent(signal_number: int) -> None:
    """Ask for ``signal_number`` when the *thread* that started this process ends."""
    _prctl(_PR_SET_PDEATHSIG, signal_number)


def set_dumpable(allowed: bool) -> None:
    """Whether other processes of this user may look into this one (and whether its ``/proc`` files are its own)."""
    _prctl(_PR_SET_DUMPABLE, int(allowed))


def adopt_orphans() -> None:
    """Become the parent of descendants whose own parent ends."""
    _prctl(_PR_SET_CHILD_SUBREAPER, 1)


def forbid_new_privileges() -> None:
    """No program that this process starts can have more rights than it has (setuid, file capabilities)."""
    _prctl(_PR_SET_NO_NEW_PRIVS, 1)


def drop_capabilities() -> None:
    """Give up every capability for good, in the bounding set too."""
    capability = 0
    while True:
        try:
            _prctl(_PR_CAPBSET_DROP, capability)
        except OSError:  # beyond the last one that this kernel knows, or no right to (then there is nothing to drop)
            break
        capability += 1
    header = (ctypes.c_uint32 * 2)(_CAPABILITY_VERSION_3, 0)
    nothing = (ctypes.c_uint32 * 6)()
    number = _SYS_CAPSET.get(platform.machine())
    if number is None:
        raise OSError(f"dropping capabilities is not known for {platform.machine()}")
    _check(_libc().syscall(number, header, nothing), "capset")


def install_filter(program: bytes) -> None:
    """Install a compiled seccomp filter (8 bytes per instruction); needs :func:`forbid_new_privileges` before."""
    prog = _FilterProgram(len(program) // 8, program)
    answer = _libc().prctl(_PR_SET_SECCOMP, ctypes.c_ulong(_SECCOMP_MODE_FILTER), ctypes.byref(prog), 0, 0)
    _check(answer, "seccomp")


def close_all_but(keep: set[int]) -> None:
    """Close every file descriptor of this process except those in ``keep``."""
    first = 0
    for fd in [*sorted(keep), _LAST_FD + 1]:
        if fd > first:
            answer = _libc().syscall(_SYS_CLOSE_RANGE, ctypes.c_uint(first), ctypes.c_uint(fd - 1), ctypes.c_uint(0))
            if answer != 0:  # a kernel before 5.9
                os.closerange(first, min(fd, 1 << 16))
        first = fd + 1
