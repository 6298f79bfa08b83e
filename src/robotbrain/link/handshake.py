"""Who may speak: both ends prove that they know the robot's token, and neither sends it.

The robot makes a random token at its start and leaves it in a file that only its user can read. Each end challenges the
other with a nonce; the answer is an HMAC-SHA256 of both nonces under the token, so that a program that merely got hold
of the port learns nothing.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import secrets
import socket
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from robotbrain.errors import InputError, RobotBrainError
from robotbrain.link.frames import PROTOCOL, FrameError, Note, decode, encode, frame_length

DEFAULT_PORT = 9470
HANDSHAKE_LIMIT = 4096
"""Longest frame accepted from a stranger, bytes."""
HANDSHAKE_S = 3.0
"""A stranger has this long to prove itself, s."""


class LinkError(RobotBrainError):
    """The connection between brain and robot failed."""


class RefusedError(LinkError):
    """The other end does not want to speak to this one; trying again will not help."""


def link_dir() -> Path:
    """Return the folder of the tokens: ``ROBOTBRAIN_LINK_DIR``, or ``.robotbrain`` in the user's home."""
    return Path(os.environ.get("ROBOTBRAIN_LINK_DIR") or Path.home() / ".robotbrain")


def token_path(port: int) -> Path:
    """Return where the robot on ``port`` leaves its token."""
    return link_dir() / f"link-{port}.token"


def new_token(port: int) -> str:
    """Make the token of the robot on ``port`` and leave it in its file, readable by this user only."""
    token = secrets.token_hex(16)
    path = token_path(port)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(handle, "w", encoding="ascii") as file:
        file.write(token + "\n")
    return token


def read_token(port: int) -> str:
    """Return the token that the robot on ``port`` left on this computer.

    Raises:
        InputError: there is none.
    """
    path = token_path(port)
    try:
        return path.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            "token of the robot",
            given=f"{path}: {error}",
            expected="the file that `robotbrain robot` writes when it starts",
            fix="Start `robotbrain robot` first, or pass the token that it printed with --token.",
        ) from None


def read_exactly(sock: socket.socket, size: int) -> bytes:
    """Return the next ``size`` bytes.

    Raises:
        EOFError: the other end closed the connection.
    """
    data = bytearray(size)
    view, place = memoryview(data), 0
    while place < size:
        count = sock.recv_into(view[place:])
        if not count:
            raise EOFError("the other end closed the connection")
        place += count
    return bytes(data)


def _send_note(sock: socket.socket, **content: Any) -> None:
    sock.sendall(encode(Note(content)))


def _receive_note(sock: socket.socket) -> dict[str, Any]:
    frame = decode(read_exactly(sock, frame_length(read_exactly(sock, 4), HANDSHAKE_LIMIT)))
    if not isinstance(frame, Note):
        raise FrameError(f"a {type(frame).__name__} came before the handshake was over")
    return frame.content


def _proof(token: str, end: str, first: str, second: str) -> str:
    return hmac.new(token.encode(), f"{end}:{first}:{second}".encode(), hashlib.sha256).hexdigest()


def _is_proof(token: str, end: str, first: str, second: str, given: object) -> bool:
    return isinstance(given, str) and hmac.compare_digest(_proof(token, end, first, second).encode(), given.encode())


def serve_handshake(sock: socket.socket, token: str, offer: Mapping[str, Any]) -> None:
    """Do the robot's part; ``offer`` is what it tells about itself (JSON).

    Raises:
        LinkError, FrameError, EOFError, OSError: the other end is no brain of this robot.
    """
    sock.settimeout(HANDSHAKE_S)
    mine = secrets.token_hex(16)
    _send_note(sock, robotbrain=PROTOCOL, nonce=mine)
    answer = _receive_note(sock)
    theirs = str(answer.get("nonce"))
    if answer.get("robotbrain") != PROTOCOL:
        reason = f"it speaks version {answer.get('robotbrain')!r} of the protocol, this end {PROTOCOL}"
    elif not _is_proof(token, "brain", mine, theirs, answer.get("proof")):
        reason = "its token is wrong"
    else:
        _send_note(sock, proof=_proof(token, "robot", mine, theirs), offer=dict(offer))
        return
    _send_note(sock, refused=reason)
    raise RefusedError(f"refused a connection: {reason}")


def join_handshake(sock: socket.socket, token: str) -> dict[str, Any]:
    """Do the brain's part; return what the robot offers.

    Raises:
        RefusedError: wrong token, other version, or no robot at all.
        FrameError, EOFError, OSError: something else answers there.
    """
    sock.settimeout(HANDSHAKE_S)
    hello = _receive_note(sock)
    if "refused" in hello:
        raise RefusedError(f"the robot refuses the connection: {hello['refused']}")
    if hello.get("robotbrain") != PROTOCOL:
        raise RefusedError(f"the robot speaks version {hello.get('robotbrain')!r} of the protocol, this end {PROTOCOL}")
    mine, theirs = secrets.token_hex(16), str(hello.get("nonce"))
    _send_note(sock, robotbrain=PROTOCOL, nonce=mine, proof=_proof(token, "brain", theirs, mine))
    answer = _receive_note(sock)
    if "refused" in answer:
        raise RefusedError(f"the robot refuses the connection: {answer['refused']}")
    if not _is_proof(token, "robot", theirs, mine, answer.get("proof")):
        raise RefusedError("what answers there does not know the robot's token")
    offer = answer.get("offer")
    return dict(offer) if isinstance(offer, dict) else {}


def refuse(sock: socket.socket, reason: str) -> None:
    """Tell a stranger why it is not let in."""
    sock.settimeout(HANDSHAKE_S)
    _send_note(sock, refused=reason)


def parse_address(address: str) -> tuple[str, int]:
    """Return host and port of ``host:port``, ``:port`` or ``host`` (default port, this computer).

    Raises:
        InputError: no such thing.
    """
    host, colon, port = address.rpartition(":")
    if not colon:
        host, port = port, str(DEFAULT_PORT)
    if port.isascii() and port.isdigit() and 0 < int(port) < 65536 and not host.count(":"):
        return host or "127.0.0.1", int(port)
    raise InputError("address", given=address, expected="host:port", fix=f"On this computer: 127.0.0.1:{DEFAULT_PORT}.")
