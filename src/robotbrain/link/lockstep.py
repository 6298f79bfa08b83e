"""Brain and robot in two processes and one simulated time: the robot grants windows, both run them at the same time.

Conservative synchronisation with lookahead (Chandy and Misra, "Distributed simulation: a case study in design and
verification of distributed programs", IEEE TSE SE-5, 1979): what either end releases at time t reaches the other at
t + latency, so that nothing can arrive within less than the latency after the next event of either. Both may run that
far before they speak again. The outcome is that of one process with the same transport latency, whatever the speed of
the machines.
"""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable, Mapping
from typing import Any

from robotbrain.errors import InputError
from robotbrain.link import handshake
from robotbrain.link.bridge import Bridge
from robotbrain.link.frames import Frame, FrameError, Message, Note, Window, decode, encode, frame_length
from robotbrain.link.handshake import LinkError, read_exactly
from robotbrain.link.local import bind, close_listener
from robotbrain.ros.context import SimContext

NEVER = 1 << 62
PATIENCE_S = 60.0
"""The other end may take this long for one window, s."""


class LinkEnded(LinkError):  # noqa: N818 - not an error
    """The other end said goodbye."""


class LockstepEnd:
    """What both ends have in common.

    Args:
        context: this process's graph, with a transport latency of ``latency_ns``.
        sock: after the handshake.
        latency_ns: from either process to the other, > 0.
    """

    def __init__(self, context: SimContext, sock: socket.socket, latency_ns: int) -> None:
        if not isinstance(latency_ns, int) or latency_ns <= 0:
            raise InputError(
                "lockstep latency",
                given=latency_ns,
                expected="ns, a whole number > 0",
                fix="Without latency neither end could ever run ahead of the other.",
            )
        self.context, self._sock, self._latency_ns = context, sock, latency_ns
        sock.settimeout(PATIENCE_S)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._outgoing: list[Frame] = []
        self.bridge = Bridge(context, self._outgoing.append)
        self._local_latency = context.latency_ns
        context.latency_ns = self._latency
        self.windows = 0

    def _latency(self, name: str, size: int) -> int:
        # What the bridge publishes anew has its way behind it.
        if name in self.bridge.remote.publishers:
            return 0
        local = self._local_latency
        return local if isinstance(local, int) else local(name, size)

    def _send(self, last: Frame) -> None:
        self.bridge.announce()
        data = b"".join([encode(frame) for frame in (*self._outgoing, last)])
        self._outgoing.clear()
        try:
            self._sock.sendall(data)
        except OSError as error:
            raise LinkError(f"the connection between brain and robot broke: {error}") from None

    def _receive(self) -> int:
        """Take frames up to and including the next Window, and return its time."""
        try:
            while True:
                frame = decode(read_exactly(self._sock, frame_length(read_exactly(self._sock, 4))))
                if isinstance(frame, Window):
                    return frame.time_ns
                if isinstance(frame, Note) and "bye" in frame.content:
                    raise LinkEnded(str(frame.content["bye"])[:200])
                if isinstance(frame, Message):
                    self.context.schedule(frame.stamp_ns + self._latency_ns, self._deliver, frame)
                else:
                    self.bridge.receive(frame)
        except TimeoutError:
            raise LinkError(f"nothing was heard of the other end for {PATIENCE_S:g} s") from None
        except (EOFError, FrameError, OSError) as error:
            raise LinkError(f"the connection between brain and robot broke: {error}") from None

    def _deliver(self, frame: Message) -> None:
        self.bridge.receive(frame)

    def _due_there(self) -> int:
        """Return when the first frame that waits to be sent arrives at the other end."""
        now = self.context.now_ns
        return min(
            (f.stamp_ns + self._latency_ns if isinstance(f, Message) else now for f in self._outgoing), default=NEVER
        )

    def _next(self) -> int:
        upcoming = self.context.next_event_ns()
        return NEVER if upcoming is None else upcoming

    def close(self, reason: str) -> None:
        """Say goodbye and end."""
        with contextlib.suppress(LinkError, FrameError):
            self._send(Note({"bye": reason}))
        self._sock.close()
        self.bridge.close()


class LockstepRobot(LockstepEnd):
    """The robot's end: it grants the windows."""

    def run(self, until: Callable[[], bool], end_ns: int) -> str:
        """Run until ``until()``, up to ``end_ns``, or until the brain says goodbye; return why it ended.

        Raises:
            LinkError: the connection broke.
        """
        try:
            there = self._receive()
            while not until():
                upcoming = min(self._next(), there, self._due_there())
                if upcoming > end_ns:
                    return f"the time of {end_ns * 1e-9:g} s is over"
                window = max(upcoming, min(upcoming + self._latency_ns - 1, end_ns))
                self._send(Window(window))
                self.windows += 1
                self.context.run_until(window)
                there = self._receive()
        except LinkEnded as goodbye:
            return str(goodbye)
        return "it was asked to stop"


class LockstepBrain(LockstepEnd):
    """The brain's end: it runs what it is granted."""

    def run(self, until: Callable[[], bool]) -> str:
        """Run until ``until()`` or until the robot says goodbye; return why it ended.

        Raises:
            LinkError: the connection broke.
        """
        self._send(Window(self._next()))
        while True:
            try:
                window = self._receive()
            except LinkEnded as goodbye:
                return str(goodbye)
            self.windows += 1
            if window < self.context.now_ns:
                raise LinkError(f"the robot granted a window that is over ({window} ns)")
            self.context.run_until(window)
            if until():
                return "the brain is done"
            self._send(Window(self._next()))


def drive_lockstep(
    context: SimContext,
    sock: socket.socket,
    latency_ns: int,
    nodes: Mapping[str, Callable[[], Any]],
    until: Callable[[], bool],
) -> str:
    """Make the brain's nodes and run them in lockstep with the robot at the other end; return why it ended.

    Raises:
        LinkError: the connection broke.
    """
    with context.as_default():
        for factory in nodes.values():
            factory()
        link = LockstepBrain(context, sock, latency_ns)
        reason = "the brain failed"
        try:
            reason = link.run(until)
        except KeyboardInterrupt:
            reason = "interrupted"
        finally:
            link.close(reason)
            context.try_shutdown()
    return reason


def accept_one(host: str, port: int, token: str | None, offer: dict[str, Any], ready: Callable[[int], None]) -> Any:
    """Wait for one brain and return the socket after the handshake; ``ready(port)`` is called when it may connect."""
    listener = bind(host, port)
    try:
        actual = listener.getsockname()[1]
        known = token if token is not None else handshake.new_token(actual)
        listener.listen(8)
        ready(actual)
        listener.settimeout(0.5)  # so that Ctrl-C is noticed everywhere
        while True:
            try:
                sock, _ = listener.accept()
            except TimeoutError:
                continue
            try:
                handshake.serve_handshake(sock, known, offer)
                return sock
            except (LinkError, FrameError, EOFError, OSError):
                sock.close()
    finally:
        close_listener(listener)
