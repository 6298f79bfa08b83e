"""Frames between tester and student's process: a small msgpack header, then raw bytes of what is big.

A frame is ``length of the rest, length of the header, number of blobs`` (32 bits each, little-endian), the blobs'
lengths, the header and the blobs. The header is one msgpack array of scalars and arrays, without maps or extension
types. Everything that arrives is hostile: :class:`Reader` and :func:`unpack` raise :class:`WireError` and nothing else.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Sequence
from typing import Any

import msgpack

MAX_MESSAGE = 64 << 20
"""Longest frame (bytes)."""
MAX_HEADER = 8 << 20
"""Longest header (bytes); each element of a value takes at least one, so this bounds their number as well."""
_PREFIX = struct.Struct("<III")
_PIECE = 1 << 20


class WireError(Exception):
    """Bytes or values that the wire does not carry."""


class ConnectionLostError(WireError):
    """The other side is gone."""


def pack(header: Sequence[Any], blobs: Sequence[bytes]) -> list[bytes]:
    """The pieces of one frame, ready to be sent one after the other."""
    try:
        packed = msgpack.packb(header, use_bin_type=True, unicode_errors="surrogatepass")
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise WireError(f"cannot be packed: {error}") from None
    sizes = struct.pack(f"<{len(blobs)}I", *map(len, blobs))
    rest = 8 + len(sizes) + len(packed) + sum(map(len, blobs))
    if len(packed) > MAX_HEADER or rest > MAX_MESSAGE:
        raise WireError(f"too big to be sent: more than {MAX_MESSAGE >> 20} MB, or more than about 4 million elements")
    return [_PREFIX.pack(rest, len(packed), len(blobs)) + sizes + packed, *blobs]


def unpack(frame: bytearray) -> tuple[list[Any], list[memoryview]]:
    """Header and blobs of a frame whose first number is already taken off."""
    try:
        header_size, count = struct.unpack_from("<II", frame)
        if header_size > MAX_HEADER or 8 + 4 * count + header_size > len(frame):
            raise WireError("a frame with wrong lengths")
        sizes = struct.unpack_from(f"<{count}I", frame, 8)
        at = 8 + 4 * count
        if at + header_size + sum(sizes) != len(frame):
            raise WireError("a frame with wrong lengths")
        view = memoryview(frame)
        header = msgpack.unpackb(
            view[at : at + header_size],
            unicode_errors="surrogatepass",
            max_map_len=0,
            max_ext_len=0,
            max_array_len=header_size,
        )
        at += header_size
        blobs = []
        for size in sizes:
            blobs.append(view[at : at + size])
            at += size
    except WireError:
        raise
    except Exception as error:  # msgpack names a good many
        raise WireError(f"a frame that cannot be read ({type(error).__name__})") from None
    if type(header) is not list:
        raise WireError("a frame whose header is no array")
    return header, blobs


class Reader:
    """Takes frames off a socket. Interrupted half way, it goes on where it was."""

    def __init__(self, sock: socket.socket) -> None:
        self._sock = sock
        self._buffer = bytearray()
        self._filled = 0
        self._in_body = False

    @property
    def idle(self) -> bool:
        """Whether no part of a frame has arrived yet."""
        return not self._in_body and self._filled == 0

    def read(self) -> tuple[list[Any], list[memoryview]]:
        """Wait for a frame; raises :class:`ConnectionLostError` when the other side is gone."""
        if not self._in_body:
            self._fill(4)
            size = int.from_bytes(self._buffer, "little")
            if not 8 <= size <= MAX_MESSAGE:
                raise WireError("a frame that is too long or too short")
            self._start(size, in_body=True)
        self._fill(len(self._buffer))
        frame = self._buffer
        self._start(0, in_body=False)
        return unpack(frame)

    def _start(self, size: int, *, in_body: bool) -> None:
        self._buffer, self._filled, self._in_body = bytearray(size), 0, in_body

    def _fill(self, size: int) -> None:
        if len(self._buffer) < size:
            self._buffer = bytearray(size)
        while self._filled < size:
            with memoryview(self._buffer) as view:
                try:
                    got = self._sock.recv_into(view[self._filled : min(size, self._filled + _PIECE)])
                except OSError as error:
                    raise ConnectionLostError(f"the connection broke ({error.strerror})") from None
            if not got:
                raise ConnectionLostError("the connection was closed")
            self._filled += got


def send(sock: socket.socket, pieces: Sequence[bytes]) -> None:
    """Send a frame; raises :class:`ConnectionLostError` when the other side is gone."""
    try:
        sock.sendall(b"".join(pieces))
    except OSError as error:
        raise ConnectionLostError(f"the connection broke ({error.strerror})") from None
