"""How a random pipeline is drawn: a healthy one first, then what is wrong with it."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from robotbrain.monitoring.generate import BASE_BYTES, SINK, Fault, NodePlan, Pipeline, Sensor, Task, Work
from robotbrain.monitoring.whatif_changes import (
    Change,
    Device,
    Faster,
    OwnExecutor,
    QueueDepth,
    SmallerMessages,
    TimerRate,
    Without,
)

if TYPE_CHECKING:
    from collections.abc import Callable

STAGES = ("rectifier", "segmenter", "detector", "tracker", "predictor", "fuser", "localiser", "smoother", "labeller")
SIDE = ("mapper", "recorder", "inspector", "compressor", "statistics")


class _Draft:
    """A healthy pipeline on its way, with what the faults need to know about it."""

    def __init__(self, seed: int, fault: Fault) -> None:
        rng = self.rng = np.random.default_rng([seed, 20])
        self.seed, self.fault = seed, fault
        # Faults that take most of a frame's time need frames far enough apart.
        self.camera_ms = float(rng.choice([66.0, 80.0, 100.0, 125.0]))
        self.sensors = [Sensor("/camera", self.camera_ms, float(rng.uniform(0, 40)), BASE_BYTES, 0.2)]
        self.nodes: list[NodePlan] = []
        self.names = list(rng.permutation(STAGES))
        self.sides = list(rng.permutation(SIDE))
        self.chain: list[str] = []
        self.networks: list[str] = []
        self.options: list[Change] = []
        self.threads: dict[int, int] = {}
        self.byte_ns = float(rng.uniform(1.0, 3.0))
        self.cores = int(rng.integers(4, 9))
        self.total = int(rng.integers(3, 9))
        self._build()

    def _ms(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def _cpu(self, low: float, high: float, byte_ns: float = 0.0) -> Work:
        return Work("cpu", self._ms(low, high), self._ms(0.05, 0.3), byte_ns)

    def _build(self) -> None:
        rng = self.rng
        navigated = self.fault == "slow service" or (self.total >= 6 and rng.random() < 0.3)
        length = max(1, min(4, self.total - (3 if navigated else 1) - int(rng.integers(0, 3))))
        topic = "/camera"
        for position in range(length):
            name, out = "/" + str(self.names[position]), f"/{self.names[position]}/out"
            work = [self._cpu(1.5, 4.0, self._ms(8, 14) if position == 0 else 0.0)]
            if rng.random() < 0.5 or (self.fault == "slow inference" and not self.networks and position == length - 1):
                work += [Work("gpu", self._ms(2.0, 5.0), self._ms(0.02, 0.1)), self._cpu(0.3, 0.8)]
                self.networks.append(name)
            task = Task(
                "subscription", topic, tuple(work), ((out, int(rng.integers(500, 20_000))),), depth=self._depth()
            )
            self._add(name, task)
            self.chain.append(name)
            topic = out
        if navigated:
            topic = self._navigator(topic)
        lidar = len(self.nodes) + 1 < self.total and rng.random() < 0.7
        joined: str | None = None
        if lidar or self.fault == "serial executor":
            # Sensors run free: were their periods alike, their phases would decide who waits for whom.
            self.sensors.append(Sensor("/lidar", self._ms(86, 97), self._ms(0, 60), 8_000, 0.02))
            if len(self.nodes) + 1 < self.total:
                name = "/" + str(self.names[-1])
                joined = f"/{self.names[-1]}/out"
                self._add(
                    name, Task("subscription", "/lidar", (self._cpu(1, 3),), ((joined, 400),), depth=self._depth())
                )
        self._controller(topic, joined)
        while len(self.nodes) < self.total:
            source = str(rng.choice([s.topic for s in self.sensors] + [f"{name}/out" for name in self.chain]))
            self._add(
                "/" + str(self.sides.pop()), Task("subscription", source, (self._cpu(1, 4),), depth=self._depth())
            )

    def _depth(self) -> int:
        return int(self.rng.choice([1, 2, 5, 10]))

    def _add(self, name: str, *tasks: Task) -> None:
        self.nodes.append(NodePlan(name, tasks, len(self.nodes) + 1))

    def _navigator(self, topic: str) -> str:
        ask = Task("subscription", topic, (self._cpu(0.3, 1.0),), calls="/make_plan", depth=2)
        answer = Task("client", "/make_plan", (self._cpu(0.3, 1.0),), (("/path", 2_000),))
        self._add("/navigator", ask, answer)
        self._add("/planner", Task("service", "/make_plan", (self._cpu(4, 9),)))
        return "/path"

    def _controller(self, topic: str, joined: str | None) -> None:
        rng = self.rng
        inputs = [Task("subscription", topic, (self._cpu(0.1, 0.4),), depth=self._depth())]
        if joined is not None:
            inputs.append(Task("subscription", joined, (self._cpu(0.1, 0.4),), depth=self._depth()))
        timed = self.fault == "low timer rate" or rng.random() < 0.6
        control = self._cpu(0.5, 2.0)
        if timed:
            hz = float(rng.choice([25.0, 40.0, 50.0]))
            timer = Task(
                "timer", "control", (control,), ((SINK, 52),), period_ms=1e3 / hz, phase_ms=self._ms(0, 1e3 / hz)
            )
            self._add("/controller", *inputs, timer)
        else:
            first = dataclasses.replace(inputs[0], work=(control,), publishes=((SINK, 52),))
            self._add("/controller", first, *inputs[1:])

    # ------------------------------------------------------------ edits

    def edit(self, name: str, kind: str, change: Callable[[Task], Task]) -> None:
        """Change the callbacks of one kind of one node."""
        self.nodes = [
            dataclasses.replace(node, tasks=tuple(change(t) if t.kind == kind else t for t in node.tasks))
            if node.name == name
            else node
            for node in self.nodes
        ]

    def task(self, name: str, kind: str) -> Task:
        """Return the first callback of one kind of a node."""
        return next(t for node in self.nodes if node.name == name for t in node.tasks if t.kind == kind)

    def share(self) -> None:
        """Let some light nodes share an executor, as nodes composed into one process do."""
        if self.rng.random() < 0.35:
            light = [n.name for n in self.nodes if n.name not in self.chain]
            shared = len(self.nodes) + 1
            self.nodes = [
                dataclasses.replace(node, executor=shared) if node.name in light else node for node in self.nodes
            ]


def draw_pipeline(seed: int, fault: Fault) -> Pipeline:
    """Return the pipeline of a seed with a fault; see :func:`robotbrain.monitoring.generate.generate_pipeline`."""
    draft = _Draft(seed, fault)
    culprit, cure = _PLANTS[fault](draft)
    if fault in ("slow node", "slow inference", "oversized input", "low timer rate"):
        draft.share()
    for name in draft.networks:
        if not (isinstance(cure, Faster) and cure.node == name and cure.resource == "gpu"):
            draft.options.append(Faster(name, draft._ms(1.5, 2.5), "gpu", how="INT8 instead of FP16"))
    draft.options.append(Device(cores=2 * draft.cores, name="a module with twice the cores"))
    return Pipeline(
        seed=seed,
        sensors=tuple(draft.sensors),
        nodes=tuple(draft.nodes),
        threads=draft.threads,
        cores=draft.cores,
        gpu=1,
        dla=0,
        latency_ms=float(draft.rng.uniform(0.1, 0.3)),
        byte_ns=draft.byte_ns,
        fault=fault,
        culprit=culprit,
        cure=cure,
        options=(*draft.options, cure),
    )


def _slow_node(draft: _Draft) -> tuple[str, Change]:
    name = str(draft.rng.choice(draft.chain))
    target = draft.camera_ms * draft._ms(0.55, 0.8)
    before = draft.task(name, "subscription").work
    scale = target / before[0].mean_ms
    slow = dataclasses.replace(before[0], mean_ms=target, sigma=draft._ms(0.03, 0.12))
    draft.edit(name, "subscription", lambda task: dataclasses.replace(task, work=(slow, *task.work[1:])))
    # Pixels are also worked on in proportion to their number; a better program is quicker in that, too.
    return name, Faster(name, min(scale, draft._ms(5, 12)), "cpu", how="a better algorithm")


def _slow_inference(draft: _Draft) -> tuple[str, Change]:
    name = str(draft.rng.choice(draft.networks))
    target = draft.camera_ms * draft._ms(0.55, 0.8)

    def slow(task: Task) -> Task:
        return dataclasses.replace(
            task, work=tuple(dataclasses.replace(w, mean_ms=target) if w.resource == "gpu" else w for w in task.work)
        )

    draft.edit(name, "subscription", slow)
    return name, Faster(name, draft._ms(3, 6), "gpu", how="INT8 instead of FP32")


def _stale_queue(draft: _Draft) -> tuple[str, Change]:
    name = str(draft.rng.choice(draft.chain))
    target = draft.camera_ms * draft._ms(1.1, 1.5)
    depth = None if draft.rng.random() < 0.6 else int(draft.rng.integers(30, 100))
    first = draft.task(name, "subscription")
    slow = dataclasses.replace(first.work[0], mean_ms=target, sigma=0.08)
    draft.edit(name, "subscription", lambda task: dataclasses.replace(task, work=(slow, *task.work[1:]), depth=depth))
    return name, QueueDepth(name, first.name, 1)


def _serial_executor(draft: _Draft) -> tuple[str, Change]:
    # One node off the chain is busy; alone that harms nobody.
    busy = Task("subscription", "/lidar", (Work("cpu", draft._ms(58, 72), 0.1),), depth=1)
    side = [n for n in draft.nodes if n.name.strip("/") in draft.sides + list(SIDE)]
    if side:
        draft.nodes.remove(side[0])
    draft.nodes.append(NodePlan(side[0].name if side else "/mapper", (busy,), 1))
    draft.nodes = [dataclasses.replace(node, executor=1) for node in draft.nodes]
    draft.cores = max(draft.cores, len(draft.nodes))
    return "", OwnExecutor()


def _oversized_input(draft: _Draft) -> tuple[str, Change]:
    times = draft._ms(25, 45)
    camera = draft.sensors[0]
    draft.sensors[0] = dataclasses.replace(camera, size=round(camera.size * times))
    # Each pixel costs enough for the whole to stay below a frame's time.
    first = draft.task(draft.chain[0], "subscription").work
    total = draft.camera_ms * draft._ms(0.55, 0.75)
    byte_ns = total * 1e6 / (BASE_BYTES * times)
    work = (dataclasses.replace(first[0], byte_ns=byte_ns), *first[1:])
    draft.edit(draft.chain[0], "subscription", lambda task: dataclasses.replace(task, work=work))
    return "/camera", SmallerMessages("/camera", 1 / times)


def _slow_service(draft: _Draft) -> tuple[str, Change]:
    target, times = draft.camera_ms * draft._ms(1.2, 3.5), draft._ms(6, 15)
    draft.edit(
        "/planner", "service", lambda t: dataclasses.replace(t, work=(dataclasses.replace(t.work[0], mean_ms=target),))
    )
    return "/planner", Faster("/planner", times, "cpu", how="repair the last plan instead of planning from scratch")


def _cpu_contention(draft: _Draft) -> tuple[str, Change]:
    draft.cores = int(draft.rng.integers(1, 4))
    threads = draft.cores * int(draft.rng.integers(3, 6))
    executor = len(draft.nodes) + 1
    tasks = tuple(
        Task(
            "timer",
            f"burn{number}",
            (Work("cpu", 100.0, 0.1),),
            period_ms=draft._ms(20, 30),
            phase_ms=draft._ms(0, 50),
        )
        for number in range(threads)
    )
    draft.nodes.append(NodePlan("/indexer", tasks, executor))
    draft.threads[executor] = threads

    def heavier(task: Task) -> Task:
        return dataclasses.replace(task, work=tuple(dataclasses.replace(w, mean_ms=1.3 * w.mean_ms) for w in task.work))

    for name in draft.chain:
        draft.edit(name, "subscription", heavier)
    return "/indexer", Without("/indexer")


def _low_timer_rate(draft: _Draft) -> tuple[str, Change]:
    timer = draft.task("/controller", "timer")
    slow = draft._ms(2.0, 4.0)
    draft.edit("/controller", "timer", lambda task: dataclasses.replace(task, period_ms=1e3 / slow))
    return "/controller", TimerRate("/controller", "control", 1e3 / timer.period_ms)


_PLANTS: dict[Fault, Callable[[_Draft], tuple[str, Change]]] = {
    "slow node": _slow_node,
    "slow inference": _slow_inference,
    "stale queue": _stale_queue,
    "serial executor": _serial_executor,
    "oversized input": _oversized_input,
    "slow service": _slow_service,
    "cpu contention": _cpu_contention,
    "low timer rate": _low_timer_rate,
}
