"""Copies of a student's process that answer the tests, and the process itself where no copy can be made."""

from __future__ import annotations

import contextlib
import socket
from typing import TYPE_CHECKING

from robotbrain.grading.sandbox.handle import Process

if TYPE_CHECKING:
    from robotbrain.grading.sandbox.process import StudentProcess


class Snapshot:
    """A copy of the student's process that answers the tests of one graded cell.

    Args:
        rpc: the tester's end of its socket, which this object owns.
        process: the copy.
    """

    def __init__(self, rpc: socket.socket, process: Process) -> None:
        self.rpc, self.process = rpc, process
        self.number: int | None = None  # how the tester calls it, once it was introduced

    def alive(self) -> bool:
        """Whether the copy still runs."""
        return not self.process.wait(0)

    def ends_within(self, timeout_s: float) -> bool:
        """Whether the copy ends within ``timeout_s``."""
        return self.process.wait(timeout_s)

    def cut(self) -> None:
        """End the connection, whoever else may still hold it."""
        with contextlib.suppress(OSError):
            self.rpc.shutdown(socket.SHUT_RDWR)

    def interrupt(self) -> None:
        """Raise ``KeyboardInterrupt`` in it."""
        self.process.interrupt()

    def kill(self) -> None:
        """End it at once."""
        self.process.kill()

    def close(self) -> None:
        """End it and forget it."""
        self.cut()
        self.rpc.close()
        self.process.kill()
        self.process.close()


class Served(Snapshot):
    """The student's process itself, answering tests where no copy of it can be made."""

    def __init__(self, rpc: socket.socket, student: StudentProcess) -> None:
        self.rpc, self._student, self.number = rpc, student, None

    def alive(self) -> bool:
        """Whether the process still runs."""
        return self._student.alive()

    def ends_within(self, timeout_s: float) -> bool:
        """Whether the process ends within ``timeout_s``."""
        return self._student.ends_within(timeout_s)

    def interrupt(self) -> None:
        """Raise ``KeyboardInterrupt`` in it."""
        self._student.interrupt()

    def kill(self) -> None:
        """End it at once."""
        self._student.close()

    def close(self) -> None:
        """Let it go; other cells may still use it."""
        if not self.alive():
            self.cut()
            self.rpc.close()
