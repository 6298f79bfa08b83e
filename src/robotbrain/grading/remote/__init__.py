"""A student's objects in another process: as values where they are plain, as stand-ins where not.

Tests see the same :class:`~robotbrain.grading.student.Student` in the notebook and here. :func:`loopback` gives one
that goes through the real codec within a process, to try a lab's tests with.
"""

from __future__ import annotations

import socket
import sys
import threading
from collections.abc import Iterable, MutableMapping
from pathlib import Path
from typing import Any

from robotbrain.grading.expect import CannotCrossError
from robotbrain.grading.remote.proxies import Proxy, type_name
from robotbrain.grading.remote.raised import RemoteError, RemoteRaised, StudentGone, StudentInterrupted
from robotbrain.grading.remote.serve import serve
from robotbrain.grading.remote.student import RemoteStudent, connect, substitute
from robotbrain.grading.remote.wire import WireError
from robotbrain.grading.suite import Suite, load_suite

__all__ = [
    "CannotCrossError",
    "Proxy",
    "RemoteError",
    "RemoteRaised",
    "RemoteStudent",
    "StudentGone",
    "StudentInterrupted",
    "WireError",
    "loopback",
    "rehearse",
    "serve",
    "type_name",
]


def loopback(
    namespace: MutableMapping[str, Any],
    suite: str | Suite,
    references: Iterable[str] = (),
    files: Path | None = None,
) -> RemoteStudent:
    """Return the student whose notebook has the globals ``namespace``, as a test sees them while grading.

    Everything goes through the real codec and a socket to a thread of this process that serves it.

    Args:
        suite: the lab's tests, or the name of the visible ones.
        references: names for which the reference stands in, in the notebook too.
        files: the folder of the submission's further files; default: the working directory.
    """
    suite = load_suite(suite) if isinstance(suite, str) else suite
    ours, theirs = socket.socketpair()
    threading.Thread(target=serve, args=(theirs, namespace), name="student", daemon=True).start()
    peer = connect(ours, suite)
    names = substitute(peer, list(references))
    return RemoteStudent(peer, suite.name, names, files)


def rehearse(suite: Suite) -> None:
    """Do once what every connection does, before this process is forked for each submission.

    What Python remembers of it, such as which class is no ``Mapping``, takes each fork milliseconds to find out anew.
    """
    ours, theirs = socket.socketpair()
    namespace: dict[str, Any] = {"echo": lambda *values, **_: values[0] if values else None}
    serving = threading.Thread(target=serve, args=(theirs, namespace), name="student", daemon=True)
    serving.start()
    with ours:
        peer = connect(ours, suite)
        student = RemoteStudent(peer, suite.name)
        for sample in _samples():
            student.echo(sample, named=sample)
        for exercise in suite.exercises:
            peer.ask("forbidden", str, exercise)
        peer.ask("printed", str)
    serving.join()  # a process with threads must not fork


def _samples() -> list[Any]:
    """Values of every kind that often crosses."""
    numbers: list[Any] = [0, 0.5, 1j, True, None, "text", b"bytes", range(3), slice(1), 2**70]
    found = [*numbers, numbers, tuple(numbers), {"a": 1.0}, {1, 2}, frozenset("ab"), [0.5] * 40, list(range(40))]
    if "numpy" in sys.modules:
        import numpy as np

        found += [np.zeros((2, 3)), np.zeros(400, np.float32), np.float64(1.0), np.array(True), np.arange(3)]
    if "torch" in sys.modules:
        import torch

        found += [torch.zeros(2, 3), {"weight": torch.zeros(400)}]
    return found
