"""A student's objects in another process: as values where they are plain, as stand-ins where not.

Tests see the same :class:`~robotbrain.grading.student.Student` in the notebook and here. :func:`loopback` gives one
that goes through the real codec within a process, to try a lab's tests with.
"""

from __future__ import annotations

import socket
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
