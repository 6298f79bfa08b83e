"""The system calls that student code is refused (seccomp), compiled once by the grader.

What is refused is what no exercise needs and what kernels have had holes in: other processes' memory, mounts and
namespaces, keyrings, BPF, ``io_uring``, memory that no limit counts; and every socket but Unix ones, so that the
network is refused even where no namespace hides it. Everything else passes: scientific Python uses a good half of all
system calls.
"""

from __future__ import annotations

import errno
import socket
import tempfile

from robotbrain.grading.sandbox import linux

_REFUSED = frozenset(
    """
    ptrace process_vm_readv process_vm_writev process_madvise kcmp pidfd_getfd
    mount umount2 pivot_root chroot fsopen fsconfig fsmount fspick move_mount open_tree mount_setattr
    unshare setns bpf perf_event_open userfaultfd io_uring_setup io_uring_enter io_uring_register
    keyctl add_key request_key kexec_load kexec_file_load init_module finit_module delete_module
    name_to_handle_at open_by_handle_at fanotify_init quotactl quotactl_fd acct swapon swapoff reboot
    settimeofday clock_settime clock_adjtime adjtimex iopl ioperm modify_ldt lookup_dcookie syslog
    memfd_create memfd_secret shmget mq_open mbind migrate_pages move_pages set_mempolicy
    """.split()  # noqa: SIM905 - sixty short words
)
_NEW_NAMESPACES = (
    linux.CLONE_NEWNS,
    linux.CLONE_NEWCGROUP,
    linux.CLONE_NEWUTS,
    linux.CLONE_NEWIPC,
    linux.CLONE_NEWUSER,
    linux.CLONE_NEWPID,
    linux.CLONE_NEWNET,
)


def compile_filter() -> bytes:
    """The filter as BPF instructions.

    Raises:
        ImportError, RuntimeError: pyseccomp or the library behind it is not installed.
    """
    import pyseccomp

    rules = pyseccomp.SyscallFilter(pyseccomp.ALLOW)
    refuse = pyseccomp.ERRNO(errno.EPERM)
    for name in _REFUSED:
        _add(rules, refuse, name)
    for flag in _NEW_NAMESPACES:
        _add(rules, refuse, "clone", pyseccomp.Arg(0, pyseccomp.MASKED_EQ, flag, flag))
    # Its flags lie in memory, which a filter cannot see; without it the C library falls back to clone.
    _add(rules, pyseccomp.ERRNO(errno.ENOSYS), "clone3")
    unix = int(getattr(socket, "AF_UNIX", 1))
    _add(rules, refuse, "socket", pyseccomp.Arg(0, pyseccomp.NE, unix))
    _add(rules, refuse, "socketpair", pyseccomp.Arg(0, pyseccomp.NE, unix))
    with tempfile.TemporaryFile() as file:
        rules.export_bpf(file)
        file.seek(0)
        return file.read()


def _add(rules: object, action: int, name: str, *arguments: object) -> None:
    try:
        rules.add_rule(action, name, *arguments)  # type: ignore[attr-defined]
    except (OSError, ValueError, RuntimeError):  # a call that this architecture, or this libseccomp, does not know
        return
