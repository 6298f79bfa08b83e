"""One connection: a thread that reads frames, a thread that writes them, and signs of life in both directions."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from robotbrain.link.frames import Frame, FrameError, Ping, decode, encode, frame_length
from robotbrain.link.handshake import read_exactly
from robotbrain.link.queues import FrameQueue

PING_S = 0.5
"""An idle connection sends a sign of life this often."""

SILENCE_S = 3.0
"""A connection on which nothing came for this long is taken for dead."""

SEND_BUFFER = 65536
"""Bytes of the system's own send buffer: what lies there can no longer be overtaken."""


@dataclass(slots=True)
class Traffic:
    """What passed, for monitoring: frames and bytes each way, and the last round trip of a sign of life, ns."""

    sent: int = 0
    sent_bytes: int = 0
    received: int = 0
    received_bytes: int = 0
    round_trip_ns: int | None = None


class Connection:
    """A socket after its handshake.

    Args:
        sock: connected; the connection owns it from now on.
        on_frame: called with every frame but signs of life, in the reading thread.
        on_closed: called once with the reason, in one of the threads or in that of :meth:`close`.

    Attributes:
        outgoing: what waits to be sent.
        traffic: what passed.
    """

    def __init__(
        self, sock: socket.socket, on_frame: Callable[[Frame], None], on_closed: Callable[[str], None]
    ) -> None:
        self._sock, self._on_frame, self._on_closed = sock, on_frame, on_closed
        self.outgoing = FrameQueue(by_urgency=True)
        self.traffic = Traffic()
        self._closing = threading.Lock()
        self._closed = False
        self._idle = threading.Event()
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        sock.settimeout(SILENCE_S)
        self._threads = [
            threading.Thread(target=work, name=f"link-{name}", daemon=True)
            for name, work in (("read", self._read), ("write", self._write))
        ]

    def start(self) -> None:
        """Begin to read and to write."""
        for thread in self._threads:
            thread.start()

    @property
    def closed(self) -> bool:
        """Whether the connection has ended."""
        return self._closed

    def send(self, frame: Frame) -> None:
        """Send a frame when its turn comes; never waits. After the end it does nothing."""
        try:
            self.outgoing.put(frame)
        except FrameError as error:
            self.close(str(error))

    def flush(self, timeout_s: float = 1.0) -> bool:
        """Wait until all has left for the system's buffer; tell whether it has."""
        deadline = time.monotonic() + timeout_s
        while not self._closed and time.monotonic() < deadline:
            if not len(self.outgoing) and self._idle.is_set():
                return True
            time.sleep(0.002)
        return False

    def close(self, reason: str) -> None:
        """End the connection; what still waits is lost."""
        with self._closing:
            if self._closed:
                return
            self._closed = True
        self.outgoing.close()
        with contextlib.suppress(OSError):  # the other end was faster
            self._sock.shutdown(socket.SHUT_RDWR)
        self._sock.close()
        self._on_closed(reason)

    def _read(self) -> None:
        try:
            while not self._closed:
                data = read_exactly(self._sock, frame_length(read_exactly(self._sock, 4)))
                self.traffic.received += 1
                self.traffic.received_bytes += len(data) + 4
                frame = decode(data)
                if isinstance(frame, Ping):
                    self._take_ping(frame)
                else:
                    self._on_frame(frame)
        except TimeoutError:
            self.close(f"nothing was heard of the other end for {SILENCE_S:g} s")
        except EOFError as error:
            self.close(str(error))
        except FrameError as error:
            self.close(f"the other end sent nonsense: {error}")
        except OSError as error:
            self.close(f"the connection broke: {error}")

    def _take_ping(self, ping: Ping) -> None:
        if ping.answer:
            self.traffic.round_trip_ns = time.monotonic_ns() - ping.sent_ns
        else:
            self.send(Ping(ping.sent_ns, answer=True))

    def _write(self) -> None:
        last = 0.0
        try:
            while not self._closed:
                self._idle.set()
                frame = self.outgoing.get(PING_S)
                self._idle.clear()
                now = time.monotonic()
                if frame is None or now - last > PING_S:
                    last = now
                    self._put(Ping(time.monotonic_ns()))
                if frame is not None:
                    self._put(frame)
        except FrameError as error:
            self.close(str(error))
        except OSError as error:
            self.close(f"the connection broke: {error}")

    def _put(self, frame: Frame) -> None:
        data = encode(frame)
        self._sock.sendall(data)
        self.traffic.sent += 1
        self.traffic.sent_bytes += len(data)
