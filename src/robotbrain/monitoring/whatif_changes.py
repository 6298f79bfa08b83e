"""Changes to a pipeline that a what-if can try: each takes a recorded pipeline's model and returns a changed one."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar

from robotbrain.errors import InputError
from robotbrain.monitoring.critical_path_blame import Place
from robotbrain.monitoring.whatif_change import EFFORTS, Change, Effort, check_positive, edit_stages
from robotbrain.monitoring.whatif_model import Model, Stage
from robotbrain.monitoring.whatif_settings import QueueDepth, SmallerMessages, TimerPhase, TimerRate
from robotbrain.ros.resources import RESOURCES

__all__ = [
    "EFFORTS",
    "Change",
    "Device",
    "Effort",
    "Faster",
    "MoveTo",
    "OwnExecutor",
    "QueueDepth",
    "SmallerMessages",
    "Threads",
    "TimerPhase",
    "TimerRate",
    "Together",
    "Without",
]


@dataclass(frozen=True)
class Faster(Change):
    """Make a node's work take less time.

    Attributes:
        node: fully qualified name.
        times: how many times faster; below 1 slower.
        resource: only its work there; None: all.
        kind, name: only this callback, e.g. ``"service", "/plan"``; None: all.
        how: in words, e.g. ``INT8 instead of FP32``.
    """

    effort: ClassVar[Effort] = "code"
    node: str
    times: float
    resource: str | None = None
    kind: str | None = None
    name: str | None = None
    how: str = ""

    def __post_init__(self) -> None:
        check_positive("times", self.times, "2 is twice as fast.")
        if self.resource is not None and self.resource not in RESOURCES:
            raise InputError(
                "resource", given=self.resource, expected="one of " + ", ".join(RESOURCES), fix="Or None for all."
            )

    def touches(self, place: Place) -> bool:
        """Tell whether a callback gets faster."""
        kind, name = self.kind or place.kind, self.name or place.name
        return place.node == self.node and place.kind == kind and place.name == name

    def apply(self, model: Model) -> Model:
        """Return the changed model."""
        model.of_node(self.node)
        if not any(self.touches(place) for place in model.stages):
            model.stage(self.node, self.kind or "subscription", self.name or "")
        resources = RESOURCES if self.resource is None else (self.resource,)

        def edit(stage: Stage) -> Stage:
            scale = dict(stage.scale)
            for resource in resources:
                scale[resource] = scale.get(resource, 1.0) / self.times
            return dataclasses.replace(stage, scale=scale)

        return edit_stages(model, lambda stage: self.touches(stage.place), edit)

    def __str__(self) -> str:
        where = f" on the {self.resource.upper()}" if self.resource else ""
        part = f"'s {self.kind or ''} {self.name or ''}".rstrip() if self.kind or self.name else ""
        how = f" ({self.how})" if self.how else ""
        return f"make {self.node}{part} {self.times:.3g} times faster{where}{how}"


@dataclass(frozen=True)
class OwnExecutor(Change):
    """Give nodes executors of their own: processes of their own, or threads that spin one node each.

    Attributes:
        nodes: which; empty: every node that shares an executor.
    """

    nodes: tuple[str, ...] = ()

    def apply(self, model: Model) -> Model:
        """Return the changed model."""
        for node in self.nodes:
            model.of_node(node)
        sharing: dict[int, set[str]] = {}
        for place, stage in model.stages.items():
            sharing.setdefault(stage.executor, set()).add(place.node)
        threads, own = dict(model.threads), dict[str, int]()
        for place, stage in model.stages.items():
            chosen = place.node in self.nodes if self.nodes else len(sharing[stage.executor]) > 1
            if chosen and place.node not in own:
                own[place.node] = max(threads) + 1
                threads[own[place.node]] = 1
        changed = edit_stages(
            model,
            lambda stage: stage.place.node in own,
            lambda stage: dataclasses.replace(stage, executor=own[stage.place.node]),
        )
        return dataclasses.replace(changed, threads=threads)

    def __str__(self) -> str:
        if not self.nodes:
            return "give every node an executor of its own"
        return f"give {' and '.join(self.nodes)} {'an executor' if len(self.nodes) == 1 else 'executors'} of its own"


@dataclass(frozen=True)
class Threads(Change):
    """Give the executor of a node more threads (a ``MultiThreadedExecutor``).

    Attributes:
        node: any node on it.
        threads: how many, >= 1.
    """

    node: str
    threads: int

    def __post_init__(self) -> None:
        check_positive("threads", self.threads, "2 is a first try.")

    def apply(self, model: Model) -> Model:
        """Return the changed model."""
        executor = model.of_node(self.node)[0].executor
        return dataclasses.replace(model, threads={**model.threads, executor: int(self.threads)})

    def __str__(self) -> str:
        return f"run {self.node} and those that share its executor on {self.threads} threads"


@dataclass(frozen=True)
class MoveTo(Change):
    """Run a node's accelerated work on another resource.

    Attributes:
        node: fully qualified name.
        to: ``gpu``, ``dla0``, ``dla1`` or ``cpu``.
        source: where it runs now.
        slower: how many times longer it takes there.
    """

    effort: ClassVar[Effort] = "code"
    node: str
    to: str
    source: str = "gpu"
    slower: float = 1.0

    def __post_init__(self) -> None:
        check_positive("slower", self.slower, "2 is twice as long.")

    def apply(self, model: Model) -> Model:
        """Return the changed model."""
        model.of_node(self.node)
        if model.capacity and self.to not in model.capacity:
            raise InputError(
                "resource to move to",
                given=self.to,
                expected="one of " + ", ".join(model.capacity),
                fix="Choose one that the device has.",
            )

        def edit(stage: Stage) -> Stage:
            scale = {**stage.scale, self.source: stage.scale.get(self.source, 1.0) * self.slower}
            return dataclasses.replace(stage, scale=scale, moved={**stage.moved, self.source: self.to})

        return edit_stages(model, lambda stage: stage.place.node == self.node, edit)

    def __str__(self) -> str:
        cost = f", where it takes {self.slower:.3g} times as long" if self.slower != 1 else ""
        return f"move {self.node} from the {self.source.upper()} to {self.to.upper()}{cost}"


@dataclass(frozen=True)
class Device(Change):
    """Another power mode or module: more cores, faster resources.

    Attributes:
        cores: CPU cores; None: as now.
        cpu, gpu, dla: how many times faster each is.
        name: in words, e.g. ``MAXN``.
    """

    effort: ClassVar[Effort] = "hardware"
    cores: int | None = None
    cpu: float = 1.0
    gpu: float = 1.0
    dla: float = 1.0
    name: str = ""

    def __post_init__(self) -> None:
        for label, value in (("cores", self.cores or 1), ("cpu", self.cpu), ("gpu", self.gpu), ("dla", self.dla)):
            check_positive(label, value, "1 leaves it as it is.")

    def apply(self, model: Model) -> Model:
        """Return the changed model."""
        capacity = dict(model.capacity)
        if self.cores is not None and capacity:
            capacity["cpu"] = int(self.cores)
        speed = dict(model.speed)
        for resource, factor in (("cpu", self.cpu), ("gpu", self.gpu), ("dla0", self.dla), ("dla1", self.dla)):
            speed[resource] = speed.get(resource, 1.0) * factor
        return dataclasses.replace(model, capacity=capacity, speed=speed)

    def __str__(self) -> str:
        parts = [] if self.cores is None else [f"{self.cores} CPU cores"]
        parts += [
            f"{name} {value:.3g} times as fast"
            for name, value in (("CPU", self.cpu), ("GPU", self.gpu), ("DLA", self.dla))
            if value != 1
        ]
        return f"{self.name or 'other hardware'}: {', '.join(parts) or 'no difference'}"


@dataclass(frozen=True)
class Without(Change):
    """Stop a node, e.g. one that only loads the device.

    Attributes:
        node: fully qualified name.
    """

    node: str

    def apply(self, model: Model) -> Model:
        """Return the changed model."""
        model.of_node(self.node)
        return dataclasses.replace(
            model, stages={place: stage for place, stage in model.stages.items() if place.node != self.node}
        )

    def __str__(self) -> str:
        return f"stop {self.node}, or move it off this device"


@dataclass(frozen=True)
class Together(Change):
    """Several changes at once.

    Attributes:
        changes: in this order.
        name: of the whole, in words; empty: their words one after the other.
    """

    changes: tuple[Change, ...]
    name: str = ""

    def apply(self, model: Model) -> Model:
        """Return the changed model."""
        for change in self.changes:
            model = change.apply(model)
        return model

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {"change": "Together", "text": str(self), "changes": [change.to_dict() for change in self.changes]}

    @property
    def takes(self) -> Effort:
        """What it takes: the most that one of its parts takes."""
        return max((change.takes for change in self.changes), key=EFFORTS.index, default="configuration")

    def __str__(self) -> str:
        return self.name or "; and ".join(str(change) for change in self.changes)
