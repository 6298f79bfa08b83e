"""Run a recorded pipeline again in simulated time: the replay twin.

The kit's own executors, queues, timers and device do the work; only what happens inside a callback is played back.
Services travel as messages on topics of their own and are given their names back in the trace that comes out.
"""

from __future__ import annotations

import dataclasses
import struct
from collections import Counter
from typing import TYPE_CHECKING, Any

from robotbrain.monitoring.critical_path_blame import Place
from robotbrain.monitoring.trace import Recorder, Trace
from robotbrain.monitoring.whatif_model import Injected, Model, Send, Stage

if TYPE_CHECKING:
    from collections.abc import Callable

    from robotbrain.ros.context import CallbackRecord, MessageRecord
    from robotbrain.ros.executors import Executor
    from robotbrain.ros.node import Node

HEAD = struct.Struct("<qq")
"""What a replayed message carries: its root, and the number of the client that asked (0: none)."""


def run_model(model: Model, *, title: str = "") -> Trace:
    """Run a model from its start to its end and return the trace."""
    return _Player(model, title).run()


class _Player:
    def __init__(self, model: Model, title: str) -> None:
        from robotbrain.ros import SimContext
        from robotbrain.ros.executors import Executor

        self.model = model
        first = min([model.start_ns, *(s.first_ns - s.period_ns for s in model.stages.values() if s.period_ns)])
        self.context = SimContext(start_ns=first, latency_ns=self._latency, resources=_device(model))
        self.context.log_sink = lambda _: None
        self.recorder = Recorder(self.context, title=title)
        self.executors: dict[int, Executor] = {}
        for number in sorted(model.threads):
            self.executors[number] = Executor(context=self.context, num_threads=model.threads[number])
        self.real_number = {executor.number: number for number, executor in self.executors.items()}
        self.nodes: dict[str, Node] = {}
        self.groups: dict[tuple[str, int], Any] = {}
        self.publishers: dict[tuple[str, str], Any] = {}
        self.names: dict[str, tuple[str, str]] = {}
        self.channels: dict[tuple[str, str, str], str] = {}
        self.clients: dict[str, int] = {}
        self.outstanding: Counter[tuple[str, str]] = Counter()
        self.stamps: dict[int, int] = {}
        if model.disturbed:
            self.context.add_filter("*", self._disturb)
        for stage in model.stages.values():
            _Runner(self, stage)
        for injected in model.injected:
            self.context.schedule(injected.time_ns, self._inject, injected)

    def run(self) -> Trace:
        self.context.run_until(self.model.end_ns)
        raw = self.recorder.trace()
        messages = tuple(self._named(message) for message in raw.messages)
        dropped = {(node, self.names.get(name, ("", name))[1]): count for (node, name), count in raw.dropped.items()}
        return dataclasses.replace(
            raw,
            start_ns=self.model.start_ns,
            callbacks=tuple(self._placed(record) for record in raw.callbacks),
            messages=messages,
            stamps=self.stamps,
            dropped=dropped,
        )

    def _named(self, message: MessageRecord) -> MessageRecord:
        kind, name = self.names.get(message.name, ("topic", message.name))
        return dataclasses.replace(message, kind=kind, name=name)  # type: ignore[arg-type]

    def _placed(self, record: CallbackRecord) -> CallbackRecord:
        number = self.real_number.get(record.executor, record.executor)
        kind, name = record.kind, record.name
        if record.name in self.names:
            what, name = self.names[record.name]
            kind = {"request": "service", "response": "client"}.get(what, what)
        # What set a timer without a grid off is no message of the pipeline.
        message = 0 if kind == "timer" else record.message
        return dataclasses.replace(record, kind=kind, name=name, executor=number, message=message)

    # ------------------------------------------------------------ parts

    def _latency(self, name: str, size: int) -> int:
        kind, real = self.names.get(name, ("topic", name))
        return self.model.transport.latency_ns(real, size) if kind in ("topic", "request", "response") else 0

    def _disturb(self, record: MessageRecord, data: bytes) -> list[tuple[bytes, int]]:
        late = self.model.disturbed.get((record.name, HEAD.unpack_from(data)[0]), 0)
        return [] if late is None else [(data, late)]

    def channel(self, kind: str, name: str, node: str = "") -> str:
        """Return the topic that stands for a service's requests, its answers to a node, or a timer's runs."""
        if kind == "topic":
            return name
        key = (kind, name, node)
        if key not in self.channels:
            topic = f"/_replay/channel{len(self.channels)}"
            self.channels[key] = topic
            self.names[topic] = (kind, name)
        return self.channels[key]

    def node(self, name: str, executor: int) -> Node:
        from robotbrain.ros.node import Node

        if name not in self.nodes:
            namespace, _, base = name.rpartition("/")
            self.context.default_executor_factory = lambda _: self.executors[executor]
            self.nodes[name] = Node(
                base,
                namespace=namespace or "/",
                context=self.context,
                use_global_arguments=False,
                start_parameter_services=False,
            )
        return self.nodes[name]

    def publish(self, node: str, send: Send, root_ns: int, client: int) -> None:
        from rclpy.qos import QoSProfile
        from std_msgs.msg import UInt8MultiArray

        size = round(send.size * self.model.sizes.get(send.name, 1.0)) if send.kind == "topic" else send.size
        name = self.channel(send.kind, send.name, send.to)
        publisher = self.publishers.get((node, name))
        if publisher is None:
            owner = self.nodes.get(node) or self.node(node, min(self.executors))
            publisher = self.publishers[node, name] = owner.create_publisher(UInt8MultiArray, name, QoSProfile(depth=1))
        if send.kind == "request":
            client = self.clients.setdefault(node, len(self.clients) + 1)
            self.outstanding[node, send.name] += 1
        stamp = self.model.stamps.get((send.name, root_ns)) if send.kind == "topic" else None
        before = self.context.message_count
        publisher.publish(HEAD.pack(root_ns, client) + bytes(max(0, size - HEAD.size)))
        if stamp is not None:
            self.stamps[before + 1] = stamp

    def _inject(self, injected: Injected) -> None:
        if injected.fires is None:
            self.publish(injected.node, injected.send, injected.time_ns, 0)
        elif injected.fires in self.model.stages:
            send = Send("timer", injected.fires.name, 0, "", injected.node)
            self.publish(injected.node, send, injected.time_ns, 0)

    def group(self, stage: Stage, node: Node) -> Any:
        from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup

        if stage.group is None:
            return ReentrantCallbackGroup()
        if not stage.group:
            return node.default_callback_group
        key = (stage.place.node, stage.group)
        return self.groups.setdefault(key, MutuallyExclusiveCallbackGroup())


class _Runner:
    """One stage in the replay."""

    def __init__(self, player: _Player, stage: Stage) -> None:
        from rclpy.qos import HistoryPolicy, QoSProfile
        from std_msgs.msg import UInt8MultiArray

        self._player, self._stage = player, stage
        self._seen: Counter[int] = Counter()
        place = stage.place
        node = player.node(place.node, stage.executor)
        group = player.group(stage, node)
        if place.kind == "timer" and stage.period_ns:
            self._due_ns = stage.first_ns
            named = _named(self._tick, place.name)

            def start(_: object) -> None:
                node.create_timer(stage.period_ns * 1e-9, named, group)

            player.context.schedule(stage.first_ns - stage.period_ns, start)
            return
        depth = stage.depth
        qos = QoSProfile(history=HistoryPolicy.KEEP_ALL) if depth is None else QoSProfile(depth=depth)
        kind = {"subscription": "topic", "service": "request", "client": "response", "resumed": "resume"}.get(
            place.kind, place.kind
        )
        to = "" if kind in ("topic", "request") else place.node
        topic = player.channel(kind, place.name, to)
        node.create_subscription(UInt8MultiArray, topic, self._take, qos, callback_group=group, raw=True)

    def _tick(self) -> None:
        now, period = self._player.context.now_ns, self._stage.period_ns
        due = self._due_ns
        # As the timer itself: periods missed are coalesced.
        self._due_ns += period
        if self._due_ns < now:
            self._due_ns += -(-(now - self._due_ns) // period) * period
        self._run(due, 0)

    def _take(self, data: bytes) -> None:
        root, client = HEAD.unpack_from(data)
        if self._stage.place.kind == "client":
            key = (self._stage.place.node, self._stage.place.name)
            self._player.outstanding[key] = max(0, self._player.outstanding[key] - 1)
        self._run(root, client)

    def _run(self, root_ns: int, client: int) -> None:
        player, stage = self._player, self._stage
        service = stage.closed_loop
        calling = bool(service) and not player.outstanding[stage.place.node, service]
        activation = stage.history.find(root_ns, self._seen[root_ns], service, calling)
        self._seen[root_ns] += 1
        for resource, length in stage.segments(activation, player.model.speed):
            player.context.charge(length, resource)
        for send in activation.sends:
            if send.kind == "response" and stage.place.kind == "service" and client:
                asked = next((name for name, number in player.clients.items() if number == client), send.to)
                send = send._replace(to=asked)
            player.publish(stage.place.node, send, root_ns, client)


def _named(function: Callable[[], None], name: str) -> Callable[[], None]:
    """Return a function of that name: a timer is called after its callback."""

    def call() -> None:
        function()

    call.__name__ = name
    return call


def _device(model: Model) -> Any:
    from robotbrain.ros import DeviceResources

    if not model.capacity:
        return None
    accelerators = sum(name.startswith("dla") for name in model.capacity)
    return DeviceResources(cpu_cores=model.capacity["cpu"], gpu=model.capacity.get("gpu", 0), dla=accelerators)


def callback_index(trace: Trace) -> dict[Place, list[CallbackRecord]]:
    """Return the records of a trace by callback, in the order of starting."""
    found: dict[Place, list[CallbackRecord]] = {}
    for record in trace.callbacks:
        found.setdefault(Place(record.node, record.kind, record.name), []).append(record)
    return found
