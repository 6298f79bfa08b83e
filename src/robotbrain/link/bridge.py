"""The node that stands for the other process: its publishers, subscriptions and services, in this graph.

A bridge tells the other end what this graph has (:mod:`~robotbrain.link.graph`) and makes proxies of what the other end
has. A publication on a topic that the other end subscribes to is sent there as the CDR it is; the bridge at the other
end publishes it anew. A request to a proxied service goes there and its response comes back.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from robotbrain.errors import InputError, RobotBrainError
from robotbrain.link.frames import Frame, FrameError, Message, Note, Request, Response
from robotbrain.link.graph import End, Graph, local_graph, signature
from robotbrain.ros import cdr
from robotbrain.ros.callback_groups import ReentrantCallbackGroup
from robotbrain.ros.context import SimContext
from robotbrain.ros.messages import message_class, service_class
from robotbrain.ros.node import Node
from robotbrain.ros.qos import DurabilityPolicy
from robotbrain.ros.services import Client, Service
from robotbrain.ros.task import Future
from robotbrain.ros.topics import Publisher, Subscription

PREFIX = "_link"
"""Names of bridges begin like this: hidden nodes, which are not announced and not forwarded."""

MOST_CALLS = 1000
"""Requests that may be on their way at a time."""


def is_link(node: Node | str) -> bool:
    """Tell whether a node, or the node of a fully qualified name, is a bridge."""
    name = node if isinstance(node, str) else node.get_name()
    return name.rpartition("/")[2].startswith(PREFIX)


@dataclass(slots=True)
class TopicStats:
    """What came of one topic: messages, and how long ago the other end had released them when they got here, ns."""

    messages: int = 0
    total_ns: int = 0
    worst_ns: int = 0

    def add(self, age_ns: int) -> None:
        """Count one message."""
        self.messages += 1
        self.total_ns += age_ns
        self.worst_ns = max(self.worst_ns, age_ns)


class Bridge:
    """One end of a link. All methods are called in the thread that runs ``context``.

    Args:
        context: this process's graph.
        send: puts a frame on its way to the other end; it must not wait.
        name: of this link, where a process has several.

    Attributes:
        node: holds the proxies.
        received: statistics of what came, by topic.
        remote: what the other end has announced.
    """

    def __init__(self, context: SimContext, send: Callable[[Frame], None], name: str = "") -> None:
        self.context, self._send = context, send
        self.node = Node(
            f"{PREFIX}_{name}" if name else PREFIX,
            context=context,
            use_global_arguments=False,
            start_parameter_services=False,
        )
        self.received: dict[str, TopicStats] = {}
        self.remote = Graph()
        self._announced: Graph | None = None
        self._signature: tuple[int, ...] = ()
        self._publishers: dict[str, Publisher] = {}
        self._subscriptions: dict[str, Subscription] = {}
        self._services: dict[str, Service] = {}
        self._clients: dict[str, Client] = {}
        self._calls: dict[int, Future] = {}
        self._last_call = 0
        self._unknown: set[str] = set()
        self._closed = False
        self._remove_tap = context.add_tap(self._on_publication)

    # ------------------------------------------------------------ to the other end

    def announce(self) -> None:
        """Tell the other end what this graph has, if that has changed."""
        now = signature(self.context)
        if now == self._signature and self._announced is not None:
            return
        self._signature = now
        graph = local_graph(self.context, is_link)
        if graph != self._announced:
            self._announced = graph
            self._send(Note({"graph": graph.to_json()}))

    def _on_publication(self, time_ns: int, topic: str, type_name: str, node: str, data: bytes) -> None:
        wanted = self.remote.subscriptions.get(topic)
        if wanted is not None and wanted.type_name == type_name and not is_link(node):
            if self._announced is None or topic not in self._announced.publishers:
                self.announce()  # the other end must know the publisher before its first message comes
            self._send(Message(topic, type_name, time_ns, data))

    def _send_latched(self, topic: str) -> None:
        known = self.context.topics.get(topic)
        if known is None:
            return
        for publisher in known.publishers:
            if not is_link(publisher.node):
                for packet in publisher.latched:
                    self._send(Message(topic, known.typename, self.context.now_ns, packet[0]))

    # ------------------------------------------------------------ from the other end

    def receive(self, frame: Frame) -> None:
        """Take a frame.

        Raises:
            FrameError: it makes no sense here; the connection should end.
        """
        if self._closed:
            return
        if isinstance(frame, Message):
            self._on_message(frame)
        elif isinstance(frame, Request):
            self._on_request(frame)
        elif isinstance(frame, Response):
            self._on_response(frame)
        elif isinstance(frame, Note) and "graph" in frame.content:
            self._on_graph(Graph.from_json(frame.content["graph"]))
        else:
            raise FrameError(f"a {type(frame).__name__} came at the wrong moment")

    def _on_message(self, frame: Message) -> None:
        publisher = self._publishers.get(frame.topic)
        if publisher is None or self.remote.publishers[frame.topic].type_name != frame.type_name:
            return  # from before a change of the graph
        self.received.setdefault(frame.topic, TopicStats()).add(self.context.now_ns - frame.stamp_ns)
        inject(publisher, frame.data)

    def _on_graph(self, graph: Graph) -> None:
        before, self.remote = self.remote, graph
        for name in [n for n in self._publishers if graph.publishers.get(n) != before.publishers.get(n)]:
            self._publishers.pop(name).destroy()
        for name in [n for n in self._subscriptions if graph.subscriptions.get(n) != before.subscriptions.get(n)]:
            self._subscriptions.pop(name).destroy()
        for name in [n for n in self._services if graph.services.get(n) != before.services.get(n)]:
            self._services.pop(name).destroy()
        for name, end in graph.publishers.items():
            if name not in self._publishers:
                self._make(name, partial(self._make_publisher, name, end))
        for name, end in graph.subscriptions.items():
            if name not in self._subscriptions:
                self._make(name, partial(self._make_subscription, name, end))
                if end.qos.durability == DurabilityPolicy.TRANSIENT_LOCAL:
                    self._send_latched(name)
        for name, type_name in graph.services.items():
            if name not in self._services:
                self._make(name, partial(self._make_service, name, type_name))

    def _make(self, name: str, make: Callable[[], None]) -> None:
        """Make a proxy; what this graph cannot have (an unknown type, a second server) it does without, saying so."""
        try:
            make()
        except (RobotBrainError, KeyError) as error:
            if name not in self._unknown:
                self._unknown.add(name)
                self.node.get_logger().warning(f"{name} of the other process is not available here: {error}")

    def _make_publisher(self, name: str, end: End) -> None:
        self._publishers[name] = self.node.create_publisher(message_class(end.type_name), name, end.qos)

    def _make_subscription(self, name: str, end: End) -> None:
        # Publications are forwarded as they are released. This subscription makes the graph tell the truth.
        self._subscriptions[name] = self.node.create_subscription(
            message_class(end.type_name), name, _ignore, end.qos, raw=True
        )

    # ------------------------------------------------------------ services

    def _make_service(self, name: str, type_name: str) -> None:
        kind: Any = service_class(type_name)

        async def forward(request: Any, response: Any) -> Any:
            if len(self._calls) >= MOST_CALLS:
                raise InputError(
                    f"service {name}",
                    given=f"{MOST_CALLS} calls without an answer",
                    expected="fewer at a time",
                    fix="Wait for answers before calling again.",
                )
            self._last_call = (self._last_call + 1) % (1 << 32)
            future = self._calls[self._last_call] = Future()
            self._send(Request(self._last_call, name, cdr.to_cdr(request)))
            return cdr.from_cdr(await future, kind.Response)

        # Reentrant: a slow service of the other process keeps nobody else waiting.
        self._services[name] = self.node.create_service(kind, name, forward, callback_group=ReentrantCallbackGroup())

    def _on_request(self, frame: Request) -> None:
        server = self.context.services.get(frame.service)
        if server is None or is_link(server.node):
            self._send(Response(frame.call, f"nobody offers {frame.service}", b""))
            return
        kind = server.srv_type
        client = self._clients.get(frame.service)
        if client is None or client.srv_type is not kind:
            client = self.node.create_client(kind, frame.service, callback_group=ReentrantCallbackGroup())
            self._clients[frame.service] = client
        try:
            request = cdr.from_cdr(frame.data, kind.Request)
        except InputError as error:
            raise FrameError(f"a request to {frame.service} cannot be read: {error}") from None

        def answer(future: Future) -> None:
            if not self._closed and not future.cancelled():
                self._send(Response(frame.call, "", cdr.to_cdr(future.result())))

        client.call_async(request).add_done_callback(answer)

    def _on_response(self, frame: Response) -> None:
        future = self._calls.pop(frame.call, None)
        if future is None:
            return
        if frame.problem:
            self.node.get_logger().warning(f"a request to the other process failed: {frame.problem}")
        else:
            future.set_result(frame.data)

    # ------------------------------------------------------------ end

    def close(self) -> None:
        """Remove all proxies. Requests on their way stay without an answer, as in ROS 2 when a server dies."""
        if not self._closed:
            self._closed = True
            self._remove_tap()
            self.node.destroy_node()


def inject(publisher: Publisher, data: bytes) -> None:
    """Publish CDR that comes from outside, as if a callback that ends now had published it.

    ``publish`` outside callbacks is for programs: it collects what is published between two spins.
    """
    publisher.published += 1
    publisher._release((data, publisher.node.context.new_message_id()))


def _ignore(_: bytes) -> None:
    pass
