"""The grader's line to the tester: JSON lines, with the student's sockets beside them."""

from __future__ import annotations

import contextlib
import json
import socket
import sys
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

from robotbrain.grading.sandbox.channel import readable
from robotbrain.grading.sandbox.forkserver import ForkServer
from robotbrain.grading.sandbox.handle import Process
from robotbrain.grading.sandbox.spawn import share

_SOON_S = 0.2


class TesterDied(Exception):  # noqa: N818 - what happened
    """The tester ended, or does not answer any more."""


class TesterProcess:
    """One tester; use it as a context manager.

    Args:
        server: where it comes from.
        job: what it is to test, as ``robotbrain.grading.tester.process`` documents it.
    """

    def __init__(self, server: ForkServer, job: Mapping[str, Any]) -> None:
        self.socket, theirs = socket.socketpair()
        self._buffer = b""
        self._afterwards: list[Callable[[], object]] = []
        self._events: deque[dict[str, Any]] = deque()
        try:
            with theirs:
                self._process: Process | None = server.start(job, [theirs])
                self._server, self._generation = server, server.starts
        except BaseException:
            self.socket.close()
            raise

    def __enter__(self) -> TesterProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def alive(self) -> bool:
        """Whether it still runs."""
        return self._process is not None and not self._process.wait(0)

    def taken_away(self) -> bool:
        """Whether it ended because its fork server did: no doing of a test."""
        return self._server.starts != self._generation or self._server.ends_within(_SOON_S)

    def send(self, request: Mapping[str, Any], sock: socket.socket | None = None) -> None:
        """Send ``request``, and ``sock`` with it.

        Raises:
            TesterDied: it is gone.
        """
        data = json.dumps(request).encode() + b"\n"
        try:
            if sock is not None and sys.platform == "win32":
                shared = share(sock, self._process.pid if self._process is not None else 0)
                data = json.dumps({**request, "shared": shared}).encode() + b"\n"
            elif sock is not None:
                sent = socket.send_fds(self.socket, [data], [sock.fileno()])
                data = data[sent:]
            self.socket.sendall(data)
        except OSError as error:
            raise TesterDied(str(error)) from None

    def event(self, timeout_s: float) -> dict[str, Any] | None:
        """The next event, or None if none came within ``timeout_s``.

        Raises:
            TesterDied: it is gone.
        """
        while not self._events:
            if not readable(self.socket, timeout_s):
                return None
            try:
                chunk = self.socket.recv(1 << 16)
            except OSError as error:
                raise TesterDied(str(error)) from None
            if not chunk:
                raise TesterDied("the tester ended")
            *lines, self._buffer = (self._buffer + chunk).split(b"\n")
            self._events.extend(json.loads(line) for line in lines)
        return self._events.popleft()

    def close(self) -> None:
        """End it; safe to call twice."""
        with contextlib.suppress(TesterDied):
            self.send({"op": "end"})
        self.socket.close()
        if self._process is not None:
            self._process.kill()
            self._process.close()
            self._process = None
        while self._afterwards:
            self._afterwards.pop()()

    def on_close(self, function: Callable[[], object]) -> None:
        """Have ``function`` called once the tester has ended."""
        self._afterwards.append(function)
