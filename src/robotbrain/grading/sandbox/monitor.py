"""The process of trusted code that stands between a submission and the rest, and ends it.

It is the parent of the student's process and lives outside of its namespaces, so that nothing the student runs can
see it. It obeys single bytes on its socket; when that socket closes, or its own parent ends, everything ends.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import socket
import time
from pathlib import Path

GO, INTERRUPT, THREADS = b"g", b"i", b"t"
_GONE_S = 2.0


def wait_for_go(sock: socket.socket) -> bool:
    """Wait until the grader has put this process under its bounds; False if the grader is gone."""
    try:
        return sock.recv(1) == GO
    except OSError:
        return False


def watch(pid: int, sock: socket.socket, *, contained: bool) -> None:
    """Serve the grader until the student's process ``pid`` has ended and everything below it too.

    Args:
        contained: ``pid`` leads a pid namespace, so that the kernel ends the rest with it.
    """
    process = os.pidfd_open(pid)
    poll = select.poll()
    poll.register(process, select.POLLIN)
    poll.register(sock, select.POLLIN)
    while True:
        ready = {fd for fd, _ in poll.poll()}
        if process in ready:
            break
        order = b""
        with contextlib.suppress(OSError):
            order = sock.recv(1)
        if order == INTERRUPT:
            signal.pidfd_send_signal(process, signal.SIGINT)
        elif order == THREADS:
            _tell(sock, {"threads": _threads(pid)})
        elif not order:
            signal.pidfd_send_signal(process, signal.SIGKILL)
            poll.unregister(sock)
    _, status = os.waitpid(pid, 0)
    if not contained:
        _kill_descendants()
    _tell(sock, {"exit": os.waitstatus_to_exitcode(status)})


def _tell(sock: socket.socket, fact: dict[str, int]) -> None:
    with contextlib.suppress(OSError):
        sock.sendall(json.dumps(fact).encode() + b"\n")


def _threads(pid: int) -> int:
    """Threads of process ``pid``, native ones too; 0 if that cannot be told."""
    try:
        return len(list(Path(f"/proc/{pid}/task").iterdir()))
    except OSError:
        return 0


def _kill_descendants() -> None:
    """Without a pid namespace: end all processes that the student's process left behind; they are ours by now."""
    import psutil

    deadline = time.monotonic() + _GONE_S
    while time.monotonic() < deadline:
        left = psutil.Process().children(recursive=True)
        for process in left:
            with contextlib.suppress(psutil.NoSuchProcess, psutil.AccessDenied):
                process.kill()
        with contextlib.suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        if not left:
            return
        time.sleep(0.01)
