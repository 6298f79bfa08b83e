"""What protects the grader from student code on this host, named one by one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from robotbrain.grading.sandbox import bubblewrap
from robotbrain.grading.sandbox.cgroups import Cgroups


@dataclass(frozen=True)
class Layer:
    """One layer of protection.

    Attributes:
        active: whether it holds for the next submission.
        note: what it protects, or why it is missing and how to get it.
    """

    name: str
    active: bool
    note: str


_PROTECTS = {
    "bubblewrap": "no network, a read-only view of the host without the course, another user",
    "namespaces": "each submission has its own processes and its own small disk, sees no other, and ends as a whole",
    "seccomp": "no system calls that reach other processes, mounts, kernel modules or sockets of the network",
    "limits": "memory, file size, open files and processor time of each process are bounded",
    "cgroup": "memory, processes and processor time of a submission as a whole are bounded",
    "tester": "hidden tests run in a process of their own, which student code never enters",
}
NAMES = tuple(_PROTECTS)
_GET = {
    "bubblewrap": "bubblewrap is missing: install it (Debian, Ubuntu: apt install bubblewrap); Linux only.",
    "namespaces": "this host lets ordinary users make no namespaces: see `sysctl kernel.unprivileged_userns_clone "
    "user.max_user_namespaces kernel.apparmor_restrict_unprivileged_userns`.",
    "seccomp": "libseccomp is missing: install it (Debian, Ubuntu: apt install libseccomp2; pip install pyseccomp).",
    "limits": "this system has no resource limits.",
    "cgroup": "no control group could be made: run as root, or under `systemd-run --user --scope -p Delegate=yes`",
}
_REQUIRED = ("bubblewrap", "namespaces", "seccomp", "limits")


def layers_of(held: Sequence[str], *, wrapped: bool, cgroups: Cgroups, failure: str = "") -> list[Layer]:
    """The layers of this host, given those that a student's process reported to hold."""
    found = []
    for name, protects in _PROTECTS.items():
        active = name in held or name == "tester" or (name == "bubblewrap" and wrapped and not failure)
        note = protects if active else _GET.get(name, "")
        if name == "cgroup":
            note = f"{note} ({cgroups.note})"
        if not active and failure:
            note = f"{note} The sandbox did not start: {failure}"
        if not active and name == "namespaces" and bubblewrap.program() is None:
            note = f"needs bubblewrap. {note}"
        found.append(Layer(name, active, note))
    return found


def required_missing(layers: Sequence[Layer]) -> list[Layer]:
    """Layers without which ``--require-sandbox`` refuses; the control group is a bonus."""
    return [layer for layer in layers if layer.name in _REQUIRED and not layer.active]


def warning_of(active: Sequence[str]) -> str:
    """What a report says of a run that had only the layers ``active``; ``""`` if nothing that matters was missing."""
    missing = [name for name in _REQUIRED if name not in active]
    return f"graded without sandbox: {', '.join(missing)} missing" if missing else ""
