"""Frames of the local transport: what goes over the wire, as bytes and back.

A frame is its length as unsigned 32-bit little endian, one byte of kind, and a body. Texts in a body are UTF-8 after
their length as unsigned 16-bit; times are signed 64-bit ns. Message data is CDR with its 4-byte header, as on DDS.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

from robotbrain.errors import RobotBrainError

PROTOCOL = 1
"""Version of the frames; both ends must have the same."""

MAX_FRAME = 32 * 1024 * 1024
"""Longest frame accepted, bytes: a 4-byte-per-pixel image of 8 megapixels."""

_LENGTH = struct.Struct("<I")
_TEXT = struct.Struct("<H")


class FrameError(RobotBrainError):
    """Bytes that are no frame, or a frame at the wrong moment. The connection that they came on must end."""


@dataclass(frozen=True, slots=True)
class Message:
    """A publication.

    Args:
        topic: absolute name.
        type_name: e.g. ``sensor_msgs/msg/LaserScan``.
        stamp_ns: when it was released, on the sender's clock.
        data: CDR.
    """

    kind: ClassVar[int] = 1
    topic: str
    type_name: str
    stamp_ns: int
    data: bytes

    def body(self) -> bytes:
        """Return the body of the frame."""
        return b"".join((_text(self.topic), _text(self.type_name), struct.pack("<q", self.stamp_ns), self.data))

    @classmethod
    def parse(cls, reader: _Reader) -> Message:
        """Return the frame in a body."""
        return cls(reader.text(), reader.text(), reader.integer("<q"), reader.rest())


@dataclass(frozen=True, slots=True)
class Request:
    """A service request; ``call`` numbers the sender's calls."""

    kind: ClassVar[int] = 2
    call: int
    service: str
    data: bytes

    def body(self) -> bytes:
        """Return the body of the frame."""
        return struct.pack("<I", self.call) + _text(self.service) + self.data

    @classmethod
    def parse(cls, reader: _Reader) -> Request:
        """Return the frame in a body."""
        return cls(reader.integer("<I"), reader.text(), reader.rest())


@dataclass(frozen=True, slots=True)
class Response:
    """The answer to request ``call``; ``problem`` says why there is none."""

    kind: ClassVar[int] = 3
    call: int
    problem: str
    data: bytes

    def body(self) -> bytes:
        """Return the body of the frame."""
        return struct.pack("<I", self.call) + _text(self.problem) + self.data

    @classmethod
    def parse(cls, reader: _Reader) -> Response:
        """Return the frame in a body."""
        return cls(reader.integer("<I"), reader.text(), reader.rest())


@dataclass(frozen=True, slots=True)
class Ping:
    """A sign of life. The receiver sends it back as it is, with ``answer`` set."""

    kind: ClassVar[int] = 4
    sent_ns: int
    answer: bool = False

    def body(self) -> bytes:
        """Return the body of the frame."""
        return struct.pack("<q?", self.sent_ns, self.answer)

    @classmethod
    def parse(cls, reader: _Reader) -> Ping:
        """Return the frame in a body."""
        return cls(reader.integer("<q"), bool(reader.integer("<B")))


@dataclass(frozen=True, slots=True)
class Note:
    """A JSON object: handshake, description of the graph (``{"graph": …}``), goodbye (``{"bye": reason}``)."""

    kind: ClassVar[int] = 5
    content: dict[str, Any]

    def body(self) -> bytes:
        """Return the body of the frame."""
        return json.dumps(self.content, separators=(",", ":"), sort_keys=True).encode()

    @classmethod
    def parse(cls, reader: _Reader) -> Note:
        """Return the frame in a body."""
        try:
            content = json.loads(reader.rest())
        except (ValueError, RecursionError) as error:
            raise FrameError(f"a note is not JSON: {error}") from None
        if not isinstance(content, dict):
            raise FrameError("a note is not a JSON object")
        return cls(content)


@dataclass(frozen=True, slots=True)
class Window:
    """Lockstep: "run up to and including ``time_ns``", or, from the brain, "done; my next event is at ``time_ns``"."""

    kind: ClassVar[int] = 6
    time_ns: int

    def body(self) -> bytes:
        """Return the body of the frame."""
        return struct.pack("<q", self.time_ns)

    @classmethod
    def parse(cls, reader: _Reader) -> Window:
        """Return the frame in a body."""
        return cls(reader.integer("<q"))


Frame = Message | Request | Response | Ping | Note | Window

_KINDS: dict[int, Callable[[_Reader], Frame]] = {}


class _Reader:
    """Takes a body apart; every step past its end is a FrameError."""

    def __init__(self, body: memoryview) -> None:
        self._body, self._place = body, 0

    def _take(self, size: int) -> memoryview:
        end = self._place + size
        if end > len(self._body):
            raise FrameError("a frame ends too early")
        part, self._place = self._body[self._place : end], end
        return part

    def integer(self, code: str) -> int:
        """Return the next integer."""
        return int(struct.unpack(code, self._take(struct.calcsize(code)))[0])

    def text(self) -> str:
        """Return the next text."""
        try:
            return str(self._take(self.integer("<H")), "utf-8")
        except UnicodeDecodeError:
            raise FrameError("a name in a frame is not UTF-8") from None

    def rest(self) -> bytes:
        """Return what is left."""
        return bytes(self._take(len(self._body) - self._place))


_KINDS.update({kind.kind: kind.parse for kind in (Message, Request, Response, Ping, Note, Window)})


def _text(text: str) -> bytes:
    data = text.encode()[:0xFFFF]
    return _TEXT.pack(len(data)) + data


def encode(frame: Frame) -> bytes:
    """Return a frame as it goes over the wire, length first.

    Raises:
        FrameError: longer than MAX_FRAME.
    """
    body = frame.body()
    if len(body) + 1 > MAX_FRAME:
        raise FrameError(f"a {type(frame).__name__} of {len(body)} bytes is longer than a frame may be ({MAX_FRAME})")
    return b"".join((_LENGTH.pack(len(body) + 1), bytes((frame.kind,)), body))


def frame_length(prefix: bytes, limit: int = MAX_FRAME) -> int:
    """Return how many bytes follow the 4-byte ``prefix``.

    Raises:
        FrameError: none, or more than ``limit``. Not a frame, most likely: another program speaks.
    """
    length = int(_LENGTH.unpack(prefix)[0])
    if not 1 <= length <= limit:
        raise FrameError(f"a frame claims a length of {length} bytes; 1 to {limit} are possible")
    return length


def decode(data: bytes) -> Frame:
    """Return the frame in ``data``, which is what follows the length.

    Raises:
        FrameError: unknown kind, or a body that is not of its kind.
    """
    parse = _KINDS.get(data[0]) if data else None
    if parse is None:
        raise FrameError(f"a frame is of unknown kind {data[:1].hex() or '(empty)'}")
    return parse(_Reader(memoryview(data)[1:]))
