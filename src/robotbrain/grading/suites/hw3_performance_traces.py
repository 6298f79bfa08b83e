"""Small traces for the tests of `hw3_performance`: written out by hand, or planted with a known bottleneck.

A trace crosses to the student's process as columns (:func:`columns`), which is fifty times as fast as record by record.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from robotbrain.grading.suites.hw3_performance_probes import rebuilt
from robotbrain.monitoring.trace import Trace
from robotbrain.ros.context import CallbackRecord, MessageRecord

if TYPE_CHECKING:
    from robotbrain.grading import Student
    from robotbrain.pipeline.brain import RunResult
    from robotbrain.pipeline.inherited import BrainSetup

MS = 1_000_000
"""Nanoseconds in a millisecond."""

ROLES = {"/robot": "robot", "/perception": "perception", "/controller": "controller"}

Kind = Literal["topic", "request", "response"]


class Script:
    """Writes a trace down line by line; all times are in ms, and become ns in the records."""

    def __init__(self) -> None:
        self._callbacks: list[CallbackRecord] = []
        self._messages: list[MessageRecord] = []
        self._stamps: dict[int, int] = {}

    def message(self, node: str, name: str, at: float, stamp: float | None = None) -> int:
        """Add a publication and return its id; with a stamp (ms) it counts as stamped."""
        number = len(self._messages) + 1
        self._messages.append(MessageRecord(number, "topic", name, "any/msg/Type", node, round(at * MS), 100))
        if stamp is not None:
            self._stamps[number] = round(stamp * MS)
        return number

    def callback(
        self,
        node: str,
        kind: str,
        name: str,
        span: tuple[float, float, float],
        *,
        message: int = 0,
        sends: Sequence[tuple[str, float | None]] = (),
        segments: Sequence[tuple[str, float]] | None = None,
        thread: tuple[int, int] = (0, 0),
    ) -> list[int]:
        """Add a callback that was ready, started and ended at ``span``; return the ids of what it sent.

        Args:
            sends: (topic, stamp in ms or None) of each message, which leaves when the callback ends.
            segments: (resource, ms); all of it CPU time if None.
            thread: executor and worker.
        """
        ready, start, end = (round(t * MS) for t in span)
        cost = tuple((r, round(t * MS)) for r, t in (segments or [("cpu", span[2] - span[1])]) if t)
        published = [self.message(node, topic, span[2], stamp) for topic, stamp in sends]
        self._callbacks.append(
            CallbackRecord(
                node,
                kind,
                name,
                ready,
                start,
                end,
                sum(length for _, length in cost),
                cost,
                0,
                message,
                tuple(published),
                *thread,
            )
        )
        return published

    def trace(
        self,
        end: float,
        capacity: Mapping[str, int] | None = None,
        roles: Mapping[str, str] | None = None,
        dropped: Mapping[tuple[str, str], int] | None = None,
        start: float = 0.0,
    ) -> Trace:
        """Return what was written, callbacks and messages in the order in which they would have been recorded."""
        ordered = sorted(self._callbacks, key=lambda c: (c.start_ns, c.end_ns))
        return Trace(
            start_ns=round(start * MS),
            end_ns=round(end * MS),
            callbacks=tuple(replace(c, id=k) for k, c in enumerate(ordered, 1)),
            messages=tuple(sorted(self._messages, key=lambda m: m.released_ns)),
            stamps=dict(self._stamps),
            capacity=dict(capacity or {"cpu": 4, "gpu": 1}),
            dropped=dict(dropped or {}),
            roles=dict(ROLES if roles is None else roles),
        )


def camera_to_command(
    images: Sequence[tuple[float, float]],
    commands: Sequence[float],
    *,
    inference: float = 30.0,
    hand_over: float = 1.0,
    end: float | None = None,
) -> Trace:
    """Return a trace of camera, perception and controller, each with a thread of its own.

    Args:
        images: (taken, perception starts) of each image, ms; a start of inf: it never gets its turn.
        commands: when the controller's timer fires, ms; it takes 2 ms.
        inference: GPU time between 5 ms and 3 ms of CPU time, ms.
        hand_over: CPU time for which the controller takes the points, ms.
        end: of the recording, ms.
    """
    script = Script()
    last = 0.0
    for taken, start in images:
        sent = script.callback(
            "/robot", "timer", "_camera", (taken, taken, taken), sends=[("/camera/image", taken)], thread=(0, 0)
        )
        if start == float("inf"):
            continue
        over = start + 5 + inference + 3
        points = script.callback(
            "/perception",
            "subscription",
            "/camera/image",
            (taken, start, over),
            message=sent[0],
            sends=[("/perception/segmentation", taken), ("/perception/points", taken)],
            segments=[("cpu", 5), ("gpu", inference), ("cpu", 3)],
            thread=(1, 0),
        )
        script.callback(
            "/controller",
            "subscription",
            "/perception/points",
            (over, over, over + hand_over),
            message=points[1],
            thread=(2, 0),
        )
        last = max(last, over + hand_over)
    for at in commands:
        script.callback("/controller", "timer", "_control", (at, at, at + 2), sends=[("/cmd_vel", None)], thread=(2, 0))
        last = max(last, at + 2)
    return script.trace(last + 50 if end is None else end)


def columns(trace: Trace) -> dict[str, Any]:
    """Return a trace as arrays, lists of names and plain dicts."""
    calls, messages = trace.callbacks, trace.messages
    who = {key: k for k, key in enumerate(dict.fromkeys((c.node, c.kind, c.name) for c in calls))}
    what = {key: k for k, key in enumerate(dict.fromkeys((m.kind, m.name, m.type_name, m.node) for m in messages))}
    resources = list(dict.fromkeys(resource for c in calls for resource, _ in c.segments))
    return {
        "who": list(who),
        "calls": np.array(
            [
                (who[c.node, c.kind, c.name], c.ready_ns, c.start_ns, c.end_ns, c.demand_ns, len(c.segments), c.id,
                 c.message, len(c.published), c.executor, c.worker)
                for c in calls
            ],
            dtype=np.int64,
        ).reshape(-1, 11),
        "resources": resources,
        "segments": np.array(
            [(resources.index(resource), length) for c in calls for resource, length in c.segments], dtype=np.int64
        ).reshape(-1, 2),
        "published": np.array([number for c in calls for number in c.published], dtype=np.int64),
        "what": list(what),
        "messages": np.array(
            [(m.id, what[m.kind, m.name, m.type_name, m.node], m.released_ns, m.size) for m in messages], dtype=np.int64
        ).reshape(-1, 4),
        "stamps": np.array(list(trace.stamps.items()), dtype=np.int64).reshape(-1, 2),
        "rest": {
            name: dict(value) if isinstance(value := getattr(trace, name), Mapping) else value
            for name in ("start_ns", "end_ns", "capacity", "dropped", "expired", "roles", "title", "queue_limits",
                         "periods_ns")
        },
    }  # fmt: skip


def hand_over(student: Student, trace: Trace) -> Any:
    """Return a copy of ``trace`` that lives where the student's code does, to be passed to it."""
    return student.run(rebuilt, columns(trace))


@dataclass(frozen=True)
class Stage:
    """A node of a planted pipeline: its cost per message, ms, and its executor's number."""

    role: str
    cpu: float
    gpu: float = 0.0
    executor: int = 0


def planted(stages: Sequence[Stage], *, period: float = 100.0, seconds: float = 4.0) -> Trace:
    """Run a pipeline on a device in simulated time and return its trace.

    A source sends a message each ``period`` ms to the first stage, each stage sends one on to the next; queues hold two
    messages. Beside it run, each in a thread of its own, ``archivist`` (400 ms of CPU time every 1.2 s: long, but rare)
    and ``heartbeat`` (0.2 ms, 25 times a second: frequent, but short).
    """
    from robotbrain.monitoring.trace import Recorder
    from robotbrain.ros import DeviceResources, SimContext, charge

    from geometry_msgs.msg import PointStamped  # isort: skip
    from rclpy.node import Node  # isort: skip
    from robotbrain.ros.executors import SingleThreadedExecutor

    context = SimContext(resources=DeviceResources(cpu_cores=4, gpu=1))
    recorder = Recorder(context)
    with context.as_default():
        source, archivist, heartbeat = Node("source"), Node("archivist"), Node("heartbeat")
        first = source.create_publisher(PointStamped, "stage_0", 2)

        def send() -> None:
            message = PointStamped()
            message.header.stamp = source.get_clock().now().to_msg()
            first.publish(message)

        source.create_timer(period * 1e-3, send)
        archivist.create_timer(1.2, lambda: charge(400 * MS))
        heartbeat.create_timer(0.04, lambda: charge(MS // 5))
        executors: dict[int, Any] = {}
        for place, stage in enumerate(stages):
            if stage.executor not in executors:
                executors[stage.executor] = SingleThreadedExecutor(context=context)
            node = Node(f"{stage.role}_node")
            executors[stage.executor].add_node(node)
            onward = node.create_publisher(PointStamped, f"stage_{place + 1}", 2)

            def work(message: Any, stage: Stage = stage, onward: Any = onward) -> None:
                charge(round(stage.cpu / 2 * MS))
                charge(round(stage.gpu * MS), "gpu")
                charge(round(stage.cpu / 2 * MS))
                onward.publish(message)

            node.create_subscription(PointStamped, f"stage_{place}", work, 2)
        context.run_for(seconds)
    return recorder.trace(roles={f"/{s.role}_node": s.role for s in stages})


STAGES = (
    "detector",
    "tracker",
    "mapper",
    "planner",
    "locator",
    "fuser",
    "filter",
    "segmenter",
    "stitcher",
    "predictor",
)
"""What stages of a planted pipeline may be called."""

PLANTS = ("cpu", "gpu", "sharing", "none")
"""Causes that a pipeline can be planted with."""


def random_pipeline(rng: np.random.Generator, cause: str, *, one_thread: bool = False) -> tuple[Trace, tuple[str, str]]:
    """Return a planted trace and its bottleneck (role, cause), clear of every threshold.

    Args:
        cause: of PLANTS.
        one_thread: let one heavy stage (``cpu``, ``gpu``) fill a thread that it shares, instead of one of its own.
    """
    roles = [str(role) for role in rng.choice(STAGES, 4, replace=False)]
    place = int(rng.integers(len(roles)))
    if cause == "sharing":
        # The first is the heaviest: a full thread drops messages on the way, so the later ones run no more often.
        costs = [float(rng.uniform(40, 48)) for _ in roles]
        costs[0] += 15.0
        return planted([Stage(r, c) for r, c in zip(roles, costs, strict=True)]), (roles[0], cause)
    stages = [Stage(r, float(rng.uniform(3, 9)), 0.0, 0 if one_thread else k) for k, r in enumerate(roles)]
    heavy, light = float(rng.uniform(120, 170)), float(rng.uniform(5, 30))
    if cause == "none":
        return planted(stages), ("", cause)
    cpu, gpu = (heavy, light) if cause == "cpu" else (light, heavy)
    stages[place] = Stage(roles[place], cpu, gpu, stages[place].executor)
    return planted(stages), (roles[place], cause)


@functools.cache
def stages_of_repair() -> Mapping[str, BrainSetup]:
    """Return the inherited brain and some of its repairs, by name."""
    from robotbrain.pipeline.inherited import inherited_brain

    ill = inherited_brain()

    def with_deployment(setup: BrainSetup, **changes: Any) -> BrainSetup:
        return replace(setup, deployment=replace(setup.deployment, **changes))

    size = with_deployment(ill, image_size=(640, 480))
    int8 = with_deployment(ill, precision="int8")
    both = with_deployment(size, precision="int8")
    return {
        "inherited": ill,
        "size": size,
        "int8": int8,
        "size+int8": both,
        "size+int8+threads": with_deployment(both, one_thread=False, camera_queue=1),
    }


def brain_run(stage: str, module: str = "orin-nano-8gb:15W", seconds: float = 2.5, world: int = 12) -> RunResult:
    """Return a short traced run of a stage of repair; runs are deterministic, so each is made once."""
    return _brain_run(stage, module, seconds, world)  # a cache tells apart what is left out and what is spelled out


@functools.cache
def _brain_run(stage: str, module: str, seconds: float, world: int) -> RunResult:
    return replace(stages_of_repair()[stage], module=module).drive(world, time_limit=seconds, trace=True)


def brain_trace(stage: str, module: str = "orin-nano-8gb:15W", seconds: float = 2.5) -> Trace:
    """Return the trace of :func:`brain_run`."""
    trace = brain_run(stage, module, seconds).trace
    assert trace is not None
    return trace
