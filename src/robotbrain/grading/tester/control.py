"""The tester's conversation with the executor: JSON lines, and connections to students' processes."""

from __future__ import annotations

import base64
import json
import os
import socket
import sys
from collections import deque
from typing import Any

_READ = 1 << 16
_MOST_FDS = 8


class ExecutorGone(Exception):  # noqa: N818 - what happened
    """The executor ended the conversation."""


class Control:
    """A :class:`robotbrain.grading.tester.world.Executor` at the other end of a socket."""

    def __init__(self, sock: socket.socket) -> None:
        self._sock = sock
        self._buffer = b""
        self._messages: deque[dict[str, Any]] = deque()
        self._fds: deque[int] = deque()

    def begun(self, exercise: str, test: str, limit_s: float) -> None:
        """Announce that the student's process is being waited for."""
        self.send(event="begun", exercise=exercise, test=test, limit_s=limit_s)

    def ended(self) -> None:
        """Announce that it is not."""
        self.send(event="ended")

    def lost(self, number: int, why: str) -> tuple[str, socket.socket | None]:
        """Say that a process is gone, and wait for the reason and perhaps for another one."""
        self.send(event="lost", student=number, why=why)
        gone = self._expect("gone", number)
        if not gone.get("again"):
            return str(gone["why"]), None
        return str(gone["why"]), self.socket(self._expect("student", number))

    def send(self, **message: Any) -> None:
        """Send an event."""
        try:
            self._sock.sendall(json.dumps(message).encode() + b"\n")
        except OSError as error:
            raise ExecutorGone(str(error)) from None

    def receive(self) -> dict[str, Any]:
        """The executor's next wish."""
        while not self._messages:
            try:
                chunk = self._receive_bytes()
            except OSError as error:
                raise ExecutorGone(str(error)) from None
            if not chunk:
                raise ExecutorGone("it closed the connection")
            *lines, self._buffer = (self._buffer + chunk).split(b"\n")
            self._messages.extend(json.loads(line) for line in lines)
        return self._messages.popleft()

    def _receive_bytes(self) -> bytes:
        if not hasattr(socket, "recv_fds"):  # Windows
            return self._sock.recv(_READ)
        chunk, fds, _, _ = socket.recv_fds(self._sock, _READ, _MOST_FDS)
        for fd in fds:
            os.set_inheritable(fd, False)
        self._fds.extend(fds)
        return chunk

    def socket(self, message: dict[str, Any]) -> socket.socket:
        """The connection that came with ``message``, beside it or (on Windows) in it."""
        if sys.platform == "win32":
            return socket.fromshare(base64.b64decode(message["shared"]))
        return socket.socket(fileno=self._fds.popleft())

    def _expect(self, operation: str, number: int) -> dict[str, Any]:
        message = self.receive()
        if (message["op"], message["student"]) != (operation, number):
            raise ExecutorGone(f"it said {message['op']!r} where {operation!r} was due")
        return message
