"""Random pipelines with a planted bottleneck, to test a diagnosis against the truth.

A pipeline has a camera, mostly a lidar, and three to eight nodes: a chain from the camera to a controller, side
branches that fork off, a join, timers, GPU work, sometimes a service. Each callback's work is drawn from a log-normal
law. One thing is wrong with it; which, and its cure, is known.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from robotbrain.errors import InputError
from robotbrain.monitoring.whatif_changes import (
    Change,
    Device,
    Faster,
    MoveTo,
    OwnExecutor,
    QueueDepth,
    SmallerMessages,
    Threads,
    TimerPhase,
    TimerRate,
    Together,
    Without,
)

if TYPE_CHECKING:
    from robotbrain.monitoring.trace import Trace

Fault = Literal[
    "slow node",
    "slow inference",
    "stale queue",
    "serial executor",
    "oversized input",
    "slow service",
    "cpu contention",
    "low timer rate",
]

FAULTS: tuple[Fault, ...] = (
    "slow node",
    "slow inference",
    "stale queue",
    "serial executor",
    "oversized input",
    "slow service",
    "cpu contention",
    "low timer rate",
)
"""What can be wrong."""

SINK = "/cmd_vel"
BASE_BYTES = 120_000
"""A camera image of the usual size, bytes."""

TaskKind = Literal["subscription", "timer", "service", "client"]


@dataclass(frozen=True)
class Work:
    """One segment of a callback's cost: a log-normal time, and a time per byte of the message taken.

    Attributes:
        resource: ``cpu``, ``gpu``, ``dla0`` or ``dla1``.
        mean_ms: mean time, ms.
        sigma: standard deviation of its logarithm.
        byte_ns: further time per byte, ns.
    """

    resource: str
    mean_ms: float
    sigma: float = 0.15
    byte_ns: float = 0.0


@dataclass(frozen=True)
class Task:
    """One callback.

    Attributes:
        kind, name: as in a trace; for a timer the name of its function.
        work: its cost in order.
        publishes: (topic, bytes) of what it sends each time.
        calls: service that it calls whenever no answer is outstanding.
        depth: of a subscription's queue; None: unlimited.
        period_ms, phase_ms: of a timer; the first call is one period after the phase.
    """

    kind: TaskKind
    name: str
    work: tuple[Work, ...] = ()
    publishes: tuple[tuple[str, int], ...] = ()
    calls: str = ""
    depth: int | None = 10
    period_ms: float = 0.0
    phase_ms: float = 0.0


@dataclass(frozen=True)
class NodePlan:
    """One node: its name with a leading slash, its callbacks and the number of its executor."""

    name: str
    tasks: tuple[Task, ...]
    executor: int


@dataclass(frozen=True)
class Sensor:
    """What the robot publishes: sizes vary by ``size_sigma`` (log-normal), as of compressed images."""

    topic: str
    period_ms: float
    phase_ms: float
    size: int
    size_sigma: float = 0.0


@dataclass(frozen=True)
class Pipeline:
    """A pipeline that can be run, and changed as :mod:`robotbrain.monitoring.whatif` would.

    Attributes:
        seed: that it was generated from.
        sensors, nodes: what it consists of.
        threads: of executors with more than one, by number.
        cores, gpu, dla: of the device.
        latency_ms, byte_ns: of transport: fixed, and per byte in ns.
        fault: what is wrong.
        culprit: node, or topic for an oversized input, at fault; empty for a serial executor.
        cure: the change that puts it right.
        options: further changes that could be made, most of no use: INT8 for every network, and the like.
        speed: how many times faster each resource is than generated.
    """

    seed: int
    sensors: tuple[Sensor, ...]
    nodes: tuple[NodePlan, ...]
    threads: Mapping[int, int]
    cores: int
    gpu: int
    dla: int
    latency_ms: float
    byte_ns: float
    fault: Fault
    culprit: str
    cure: Change
    options: tuple[Change, ...] = ()
    speed: Mapping[str, float] = dataclasses.field(default_factory=dict)

    def run(self, seconds: float = 20.0, *, day: int = 0) -> Trace:
        """Run it in simulated time and return the trace.

        Args:
            seconds: how long.
            day: the same pipeline on another day draws other work times.
        """
        from robotbrain.monitoring.generate_program import run_pipeline

        return run_pipeline(self, seconds, day)

    def changed(self, change: Change) -> Pipeline:
        """Return the pipeline with a change really made.

        Raises:
            InputError: for a change that it cannot make.
        """
        if isinstance(change, Together):
            pipeline = self
            for part in change.changes:
                pipeline = pipeline.changed(part)
            return pipeline
        if isinstance(change, Without):
            return dataclasses.replace(self, nodes=tuple(node for node in self.nodes if node.name != change.node))
        if isinstance(change, Device):
            speed = {"cpu": change.cpu, "gpu": change.gpu, "dla0": change.dla, "dla1": change.dla}
            faster = {name: self.speed.get(name, 1.0) * factor for name, factor in speed.items()}
            return dataclasses.replace(self, cores=change.cores or self.cores, speed=faster)
        if isinstance(change, OwnExecutor | Threads):
            return self._spread(change)
        if isinstance(change, SmallerMessages):
            return self._shrunk(change)
        nodes = tuple(
            dataclasses.replace(node, tasks=tuple(_changed(node.name, task, change) for task in node.tasks))
            for node in self.nodes
        )
        return dataclasses.replace(self, nodes=nodes)

    def _spread(self, change: OwnExecutor | Threads) -> Pipeline:
        executors = {node.name: node.executor for node in self.nodes}
        if isinstance(change, Threads):
            return dataclasses.replace(self, threads={**self.threads, executors[change.node]: change.threads})
        free, seen = max(executors.values()) + 1, set[str]()
        nodes = []
        for node in self.nodes:
            shares = sum(number == node.executor for number in executors.values()) > 1
            if (node.name in change.nodes if change.nodes else shares) and node.name not in seen:
                seen.add(node.name)
                node = dataclasses.replace(node, executor=free)
                free += 1
            nodes.append(node)
        return dataclasses.replace(self, nodes=tuple(nodes))

    def _shrunk(self, change: SmallerMessages) -> Pipeline:
        sensors = tuple(
            dataclasses.replace(s, size=round(s.size * change.left)) if s.topic == change.topic else s
            for s in self.sensors
        )

        def shrink(task: Task) -> Task:
            sizes = tuple((t, round(size * change.left) if t == change.topic else size) for t, size in task.publishes)
            return dataclasses.replace(task, publishes=sizes)

        nodes = tuple(dataclasses.replace(node, tasks=tuple(map(shrink, node.tasks))) for node in self.nodes)
        return dataclasses.replace(self, sensors=sensors, nodes=nodes)


def _changed(node: str, task: Task, change: Change) -> Task:
    """Return a callback with a change that concerns single callbacks."""
    if getattr(change, "node", None) != node:
        return task
    if isinstance(change, Faster):
        if (change.kind or task.kind) != task.kind or (change.name or task.name) != task.name:
            return task

        def quicker(work: Work) -> Work:
            if change.resource not in (None, work.resource):
                return work
            times = change.times
            return dataclasses.replace(work, mean_ms=work.mean_ms / times, byte_ns=work.byte_ns / times)

        return dataclasses.replace(task, work=tuple(map(quicker, task.work)))
    if isinstance(change, QueueDepth):
        mine = task.kind == "subscription" and task.name == change.topic
        return dataclasses.replace(task, depth=change.depth) if mine else task
    if isinstance(change, MoveTo):
        moved = tuple(
            dataclasses.replace(w, resource=change.to, mean_ms=w.mean_ms * change.slower)
            if w.resource == change.source
            else w
            for w in task.work
        )
        return dataclasses.replace(task, work=moved)
    if isinstance(change, TimerRate):
        mine = task.kind == "timer" and task.name == change.timer
        return dataclasses.replace(task, period_ms=1e3 / change.hz) if mine else task
    if isinstance(change, TimerPhase):
        mine = task.kind == "timer" and task.name == change.timer
        return dataclasses.replace(task, phase_ms=task.phase_ms + change.later_ms) if mine else task
    raise InputError(
        "change", given=change, expected="a change that a generated pipeline can make", fix="See Pipeline.changed."
    )


def generate_pipeline(seed: int, fault: Fault | None = None) -> Pipeline:
    """Return a random pipeline with a planted bottleneck.

    Args:
        seed: any whole number >= 0; decides everything.
        fault: what is wrong; None: the seed decides.

    Raises:
        InputError: for an unknown fault or a negative seed.
    """
    from robotbrain.monitoring.generate_plan import draw_pipeline

    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise InputError("seed", given=seed, expected="a whole number >= 0", fix="1000 is a fine seed.")
    chosen = FAULTS[int(seed) % len(FAULTS)] if fault is None else fault
    if chosen not in FAULTS:
        raise InputError("fault", given=fault, expected="one of " + ", ".join(FAULTS), fix="Choose one of these.")
    return draw_pipeline(int(seed), chosen)
