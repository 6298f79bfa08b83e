"""Handles on processes: they name one process for good, whatever becomes of its number."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import subprocess


class Process:
    """A process that a fork server started.

    Args:
        pid: its number on this host.
        pidfd: descriptor that names it for good, which this object closes; None where there are none.
    """

    def __init__(self, pid: int, pidfd: int | None, popen: subprocess.Popen[bytes] | None = None) -> None:
        self.pid, self._pidfd, self._popen = pid, pidfd, popen

    def wait(self, timeout_s: float) -> bool:
        """Whether the process has ended within ``timeout_s``."""
        if self._popen is not None:
            try:
                self._popen.wait(timeout_s)
            except subprocess.TimeoutExpired:
                return False
            return True
        if self._pidfd is None:
            return True
        poll = select.poll()
        poll.register(self._pidfd, select.POLLIN)
        return bool(poll.poll(timeout_s * 1000))

    def kill(self) -> None:
        """End it at once; without a fork server, everything below it too."""
        if self._popen is not None:
            kill_tree(self._popen)
        elif self._pidfd is not None:
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._pidfd, signal.SIGKILL)

    def interrupt(self) -> None:
        """Raise ``KeyboardInterrupt`` in it."""
        with contextlib.suppress(OSError, ValueError):
            if self._popen is not None:
                windows = getattr(signal, "CTRL_BREAK_EVENT", signal.SIGINT)  # CTRL_C does not reach a group of its own
                self._popen.send_signal(windows)
            elif self._pidfd is not None:
                signal.pidfd_send_signal(self._pidfd, signal.SIGINT)

    def fileno(self) -> int | None:
        """A descriptor that is readable once the process has ended, or None."""
        return self._pidfd

    def close(self) -> None:
        """Forget the process, without ending it; safe to call twice."""
        if self._pidfd is not None:
            os.close(self._pidfd)
            self._pidfd = None


def kill_tree(popen: subprocess.Popen[bytes]) -> None:
    """Kill ``popen``, its process group where it leads one, and its descendants."""
    import psutil

    victims: list[psutil.Process] = []
    with contextlib.suppress(psutil.NoSuchProcess):
        victims = psutil.Process(popen.pid).children(recursive=True)
    if os.name == "posix":
        with contextlib.suppress(ProcessLookupError, PermissionError):
            if os.getpgid(popen.pid) == popen.pid:
                os.killpg(popen.pid, signal.SIGKILL)
    with contextlib.suppress(OSError):
        popen.kill()
    for victim in victims:
        with contextlib.suppress(psutil.NoSuchProcess, psutil.AccessDenied):
            victim.kill()
    with contextlib.suppress(subprocess.TimeoutExpired):
        popen.wait(5.0)
