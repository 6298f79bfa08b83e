"""Frames of msgpack on a stream socket, with file descriptors beside them where the platform has that."""

from __future__ import annotations

import array
import contextlib
import os
import select
import socket
import struct
import time
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import msgpack

_HEADER = struct.Struct(">I")
_READ = 1 << 16
_MOST_FDS = 8


class ChannelError(Exception):
    """The other side broke the protocol; it is to be treated as dead."""


class ChannelClosed(ChannelError):  # noqa: N818 - a state rather than an error of ours
    """The other side is gone."""


class Channel:
    """One end of a conversation.

    Args:
        sock: a connected stream socket, which this object owns from now on.
        largest: the largest frame that is accepted (bytes).
        accept_fds: keep descriptors that arrive; otherwise they are closed at once.
    """

    def __init__(self, sock: socket.socket, largest: int, accept_fds: bool = False) -> None:
        self.socket, self._largest, self._accept = sock, largest, accept_fds
        self._buffer = bytearray()
        self._frames: deque[Any] = deque()
        self._fds: deque[int] = deque()

    def fileno(self) -> int:
        """For ``select``."""
        return self.socket.fileno()

    def send(self, message: Mapping[str, Any], fds: Sequence[int] = (), timeout_s: float | None = None) -> None:
        """Send one frame.

        Raises:
            ChannelClosed: the other side is gone, or did not take it within ``timeout_s``.
        """
        body = msgpack.packb(message, unicode_errors="backslashreplace")  # a notebook may hold half a character
        data = memoryview(_HEADER.pack(len(body)) + body)
        self.socket.settimeout(timeout_s)
        try:
            if fds:
                sent = socket.send_fds(self.socket, [data[:1]], list(fds))
                data = data[sent:]
            self.socket.sendall(data)
        except OSError as error:
            raise ChannelClosed(f"cannot send: {error}") from None

    def receive(self, timeout_s: float | None = None) -> dict[str, Any] | None:
        """The next message, or None if none arrived within ``timeout_s``.

        Raises:
            ChannelClosed: the other side is gone and everything it sent has been read.
            ChannelError: it sent something that is no message.
        """
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        while not self._frames:
            left = None if deadline is None else max(0.0, deadline - time.monotonic())
            if not readable(self.socket, left):
                return None
            self._read()
        return self._frames.popleft()  # type: ignore[no-any-return]

    def take_fd(self) -> int:
        """The descriptor that came first and was not taken yet; the caller closes it."""
        if not self._fds:
            raise ChannelError("no descriptor came")
        return self._fds.popleft()

    @property
    def pending(self) -> bool:
        """Whether a whole message waits in memory (``select`` does not tell)."""
        return bool(self._frames)

    def close(self) -> None:
        """Close the socket and what was received with it; safe to call twice."""
        while self._fds:
            os.close(self._fds.popleft())
        with contextlib.suppress(OSError):
            self.socket.close()

    def _read(self) -> None:
        try:
            chunk = self._receive_bytes()
        except (ConnectionError, TimeoutError, OSError) as error:
            raise ChannelClosed(str(error)) from None
        if not chunk:
            raise ChannelClosed("the other side closed the connection")
        self._buffer += chunk
        while len(self._buffer) >= _HEADER.size:
            (length,) = _HEADER.unpack_from(self._buffer)
            if length > self._largest:
                raise ChannelError(f"a message of {length} bytes; at most {self._largest} are accepted")
            end = _HEADER.size + length
            if len(self._buffer) < end:
                return
            self._frames.append(_decode(bytes(self._buffer[_HEADER.size : end])))
            del self._buffer[:end]

    def _receive_bytes(self) -> bytes:
        self.socket.settimeout(None)
        if not hasattr(socket, "recv_fds"):  # Windows
            return self.socket.recv(_READ)
        room = socket.CMSG_SPACE(_MOST_FDS * array.array("i").itemsize)
        flags = getattr(socket, "MSG_CMSG_CLOEXEC", 0)
        chunk, ancillary, _, _ = self.socket.recvmsg(_READ, room, flags)
        for level, kind, data in ancillary:
            if level == socket.SOL_SOCKET and kind == socket.SCM_RIGHTS:
                fds = array.array("i")
                fds.frombytes(data[: len(data) - len(data) % fds.itemsize])
                for fd in fds:
                    if self._accept and len(self._fds) < _MOST_FDS:
                        self._fds.append(fd)
                    else:
                        os.close(fd)
        return chunk


def readable(sock: socket.socket, timeout_s: float | None) -> bool:
    """Whether ``sock`` has something to read (or its end) within ``timeout_s``."""
    if hasattr(select, "poll"):  # select() fails beyond descriptor 1023
        poll = select.poll()
        poll.register(sock, select.POLLIN)
        return bool(poll.poll(None if timeout_s is None else timeout_s * 1000))
    return bool(select.select([sock], [], [], timeout_s)[0])


def _decode(frame: bytes) -> dict[str, Any]:
    try:
        message = msgpack.unpackb(frame, strict_map_key=True)
    except Exception as error:
        raise ChannelError(f"no message: {type(error).__name__}") from None
    if type(message) is not dict:
        raise ChannelError("a message is a map")
    return message
