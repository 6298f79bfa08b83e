"""The local transport: brain and robot over TCP on the loopback interface.

The robot listens (:class:`LinkServer`), brains connect (:class:`LinkClient`) and come back when the connection broke.
Works wherever Python has sockets. Without encryption: leave it on loopback, or in a network that you trust.
"""

from __future__ import annotations

import contextlib
import errno
import socket
import threading
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

from robotbrain.errors import InputError
from robotbrain.link import handshake
from robotbrain.link.bridge import Bridge
from robotbrain.link.connection import Connection
from robotbrain.link.frames import Frame, FrameError, Message, Note
from robotbrain.link.graph import Graph
from robotbrain.link.handshake import LinkError, RefusedError
from robotbrain.link.queues import FrameQueue
from robotbrain.link.realtime import RealtimeContext

ANNOUNCE_S = 0.1
"""Changes of the graph are told this often."""

MOST_BRAINS = 4
"""Connections that a robot serves at a time: a brain, and some tools that look on."""

BACKOFF_S = (0.1, 2.0)
"""First and longest pause between attempts to connect; each is twice the last."""


class Peer:
    """A connection and its bridge: frames from the reading thread wait here until the graph is free.

    Args:
        context: this process's graph.
        sock: after the handshake.
        on_closed: called with the reason in the context's thread.
        name: of the bridge.
    """

    def __init__(
        self, context: RealtimeContext, sock: socket.socket, on_closed: Callable[[Peer, str], None], name: str = ""
    ) -> None:
        self._context, self._on_closed = context, on_closed
        self._incoming = FrameQueue()
        self._posted = threading.Lock()
        self._final: str | None = None
        self._goodbye = ""
        self.connection = Connection(sock, self._on_frame, self._on_end)
        self.bridge = Bridge(context, self._send, name)
        self._timer = self.bridge.node.create_timer(ANNOUNCE_S, self.bridge.announce)
        self.bridge.announce()
        self.connection.start()

    @property
    def dropped(self) -> Counter[str]:
        """Messages that full queues lost, both ways, by topic."""
        return self.connection.outgoing.dropped + self._incoming.dropped

    def _send(self, frame: Frame) -> None:
        if isinstance(frame, Message):
            end = self.bridge.remote.subscriptions.get(frame.topic)
            if end is not None:
                self.connection.outgoing.set_depth(frame.topic, end.qos.queue_limit)
        self.connection.send(frame)

    def _on_frame(self, frame: Frame) -> None:
        # In the reading thread.
        if isinstance(frame, Note) and "bye" in frame.content:
            self._goodbye = str(frame.content["bye"])[:200]
            return
        if isinstance(frame, Note) and "graph" in frame.content:
            for topic, end in Graph.from_json(frame.content["graph"]).publishers.items():
                self._incoming.set_depth(topic, end.qos.queue_limit)
        self._incoming.put(frame)
        if self._posted.acquire(blocking=False):
            self._context.post(self._drain)

    def _drain(self, _: Any) -> None:
        # Released first: a frame that comes from here on posts anew.
        self._posted.release()
        try:
            while (frame := self._incoming.get()) is not None:
                self.bridge.receive(frame)
        except FrameError as error:
            self.connection.close(f"the other end sent nonsense: {error}")

    def _on_end(self, reason: str) -> None:
        self._context.post(self._end, self._goodbye or reason)

    def _end(self, reason: str) -> None:
        self._incoming.close()
        self.bridge.close()
        self._on_closed(self, reason)

    def close(self, reason: str) -> None:
        """Say goodbye and end the connection."""
        self.connection.send(Note({"bye": reason}))
        self.connection.flush()
        self.connection.close(reason)


class LinkServer:
    """The robot's end.

    Args:
        context: the robot's graph.
        host: interface to listen on; this computer only by default.
        port: 0 for any that is free.
        token: that brains must know; by default a new one, left in a file of this user's.
        offer: what brains are told about this robot (JSON).

    Attributes:
        address: where it listens.
        peers: who is connected.
        refused: connections that were refused or spoke nonsense before they were let in.

    Raises:
        InputError: the port is in use, or the interface does not exist.
    """

    def __init__(
        self,
        context: RealtimeContext,
        host: str = "127.0.0.1",
        port: int = handshake.DEFAULT_PORT,
        token: str | None = None,
        offer: Mapping[str, Any] | None = None,
    ) -> None:
        self._context = context
        self._socket = bind(host, port)
        self.address: tuple[str, int] = self._socket.getsockname()[:2]
        # Before listening: whoever can connect must find the new token, not that of a robot before this one.
        self.token = token if token is not None else handshake.new_token(self.address[1])
        self._socket.listen(8)
        self._offer = {"clock": "wall", **(offer or {})}
        self._logger = context.get_logger()
        self._admitting = threading.BoundedSemaphore(MOST_BRAINS)
        self._numbers = iter(range(1, 1 << 62))
        self._closed = False
        self.peers: list[Peer] = []
        self.refused = 0
        threading.Thread(target=self._accept, name="link-accept", daemon=True).start()

    def _accept(self) -> None:
        while not self._closed:
            try:
                sock, _ = self._socket.accept()
            except OSError:
                return  # closed
            if self._admitting.acquire(blocking=False):
                threading.Thread(target=self._admit, args=(sock,), name="link-admit", daemon=True).start()
            else:
                self._turn_away(sock)

    def _turn_away(self, sock: socket.socket) -> None:
        with sock, contextlib.suppress(OSError):  # it has left
            handshake.refuse(sock, f"{MOST_BRAINS} others are connected already")

    def _admit(self, sock: socket.socket) -> None:
        try:
            handshake.serve_handshake(sock, self.token, self._offer)
        except (LinkError, FrameError, EOFError, OSError) as error:
            sock.close()
            self._admitting.release()
            self._context.post(self._count_refusal, str(error))
            return
        self._context.post(self._welcome, sock)

    def _count_refusal(self, reason: str) -> None:
        self.refused += 1
        self._logger.warning(f"link: a connection was not let in: {reason}", throttle_duration_sec=1.0)

    def _welcome(self, sock: socket.socket) -> None:
        if self._closed:
            sock.close()
            return
        self.peers.append(Peer(self._context, sock, self._farewell, str(next(self._numbers))))
        self._logger.info("link: a brain has connected")

    def _farewell(self, peer: Peer, reason: str) -> None:
        self.peers.remove(peer)
        self._admitting.release()
        self._logger.warning(f"link: a brain has left: {reason}")

    def close(self) -> None:
        """Say goodbye to everybody and stop listening."""
        self._closed = True
        close_listener(self._socket)
        for peer in list(self.peers):
            peer.close("the robot's process ends")


class LinkClient:
    """The brain's end: connects, and connects anew after the connection broke.

    Args:
        context: the brain's graph.
        host, port: where the robot listens.
        token: the robot's; by default the one in the file that it left on this computer, read at each attempt.
        on_change: called in the context's thread with True after connecting and False after losing the connection.

    Attributes:
        peer: the connection, while there is one.
        state: in words, for people.
        connections: how often it has connected.
    """

    def __init__(
        self,
        context: RealtimeContext,
        host: str = "127.0.0.1",
        port: int = handshake.DEFAULT_PORT,
        token: str | None = None,
        on_change: Callable[[bool], None] | None = None,
    ) -> None:
        self._context, self._host, self._port, self._token = context, host, port, token
        self._on_change = on_change or (lambda connected: None)
        self._logger = context.get_logger()
        self._stop = threading.Event()
        self.peer: Peer | None = None
        self.offer: dict[str, Any] = {}
        self.connections = 0
        self.state = f"connecting to {host}:{port}"
        self.refusal: RefusedError | None = None
        self._start()

    def _start(self) -> None:
        threading.Thread(target=self._connect, name="link-connect", daemon=True).start()

    def _connect(self) -> None:
        pause, longest = BACKOFF_S
        while not self._stop.is_set():
            try:
                sock, offer = connect(self._host, self._port, self._token)
                self._context.post(self._welcome, (sock, offer))
                return
            except RefusedError as error:
                self._context.post(self._give_up, error)
                return
            except (LinkError, InputError) as error:
                self.state = str(error)
            self._stop.wait(pause)
            pause = min(2 * pause, longest)

    def _welcome(self, connected: tuple[socket.socket, dict[str, Any]]) -> None:
        sock, self.offer = connected
        if self._stop.is_set():
            sock.close()
            return
        self.connections += 1
        self.state = f"connected to {self._host}:{self._port}"
        self.peer = Peer(self._context, sock, self._farewell)
        self._logger.info(f"link: {self.state}")
        self._on_change(True)

    def _farewell(self, _: Peer, reason: str) -> None:
        self.peer = None
        self.state = f"lost the robot at {self._host}:{self._port}: {reason}"
        if not self._stop.is_set():
            self._logger.warning(f"link: {self.state}; trying to connect again")
            self._start()
        self._on_change(False)

    def _give_up(self, error: RefusedError) -> None:
        self.refusal = error
        self.state = str(error)
        self._logger.error(f"link: {error}")
        self._on_change(False)

    def close(self) -> None:
        """Send what waits, say goodbye, and stay away."""
        self._stop.set()
        if self.peer is not None:
            self.peer.close("the brain's process ends")


def bind(host: str, port: int) -> socket.socket:
    """Return a socket that has a port, and does not listen yet.

    Raises:
        InputError: the port is in use, or the interface does not exist.
    """
    sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        # On Windows this option would let a second program listen on the same port; there the default is right.
        if hasattr(socket, "SO_EXCLUSIVEADDRUSE"):
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_EXCLUSIVEADDRUSE, 1)
        else:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind((host, port))
    except (OSError, OverflowError) as error:
        sock.close()
        used = isinstance(error, OSError) and error.errno == errno.EADDRINUSE
        raise InputError(
            "address to listen on",
            given=f"{host}:{port}",
            expected="a free port on an interface of this computer",
            fix="Another robot runs on it, most likely: stop that, or choose another --port (0: any that is free)."
            if used
            else f"The system says: {error}.",
        ) from None
    return sock


def close_listener(sock: socket.socket) -> None:
    """Close a listening socket so that a thread in ``accept`` returns."""
    with contextlib.suppress(OSError):  # "not connected", say some systems; all wake the thread when it is closed
        sock.shutdown(socket.SHUT_RDWR)
    sock.close()


def connect(host: str, port: int, token: str | None = None) -> tuple[socket.socket, dict[str, Any]]:
    """Connect to a robot and shake hands; return the socket and what the robot offers.

    Raises:
        RefusedError: the robot does not want this brain.
        LinkError: nobody answers there, or something else does.
        InputError: there is no token.
    """
    try:
        sock = socket.create_connection((host, port), timeout=handshake.HANDSHAKE_S)
    except OSError as error:
        raise LinkError(
            f"no robot answers at {host}:{port} ({error.strerror or error}). Is `robotbrain robot` running there?"
        ) from None
    try:
        known = token if token is not None else handshake.read_token(port)
        return sock, handshake.join_handshake(sock, known)
    except (FrameError, EOFError, OSError) as error:
        sock.close()
        raise LinkError(f"what answers at {host}:{port} is no robot of this kit: {error}") from None
    except (RefusedError, InputError):
        sock.close()
        raise
