"""Changes to a pipeline that a what-if can try: each takes a recorded pipeline's model and returns a changed one."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from robotbrain.errors import InputError
from robotbrain.monitoring.critical_path_blame import Place
from robotbrain.monitoring.whatif_model import Model, Stage
from robotbrain.ros.resources import RESOURCES

Effort = Literal["configuration", "hardware", "code"]
"""What a change takes: a setting, other hardware or power, or work on the program."""

EFFORTS: tuple[Effort, ...] = ("configuration", "hardware", "code")
"""From little to much: of two changes that gain about the same, the easier one is named first."""


@dataclass(frozen=True)
class Change:
    """Base of the changes.

    ``takes`` says how much trouble it is; ``str(change)`` says it in words.
    """

    effort: ClassVar[Effort] = "configuration"

    @property
    def takes(self) -> Effort:
        """What it takes: a setting, other hardware, or work on the code."""
        return self.effort

    def apply(self, model: Model) -> Model:
        """Return the changed model.

        Raises:
            InputError: if the pipeline does not have what is to be changed.
        """
        raise NotImplementedError

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {"change": type(self).__name__, "text": str(self), **dataclasses.asdict(self)}


def _positive(what: str, value: object, fix: str) -> None:
    good = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) and value > 0
    if not good:
        raise InputError(what, given=value, expected="a number > 0", fix=fix)


def _stages(model: Model, chosen: Callable[[Stage], bool], edit: Callable[[Stage], Stage]) -> Model:
    return dataclasses.replace(
        model, stages={place: edit(stage) if chosen(stage) else stage for place, stage in model.stages.items()}
    )


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
        _positive("times", self.times, "2 is twice as fast.")
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

        return _stages(model, lambda stage: self.touches(stage.place), edit)

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
        changed = _stages(
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
        _positive("threads", self.threads, "2 is a first try.")

    def apply(self, model: Model) -> Model:
        """Return the changed model."""
        executor = model.of_node(self.node)[0].executor
        return dataclasses.replace(model, threads={**model.threads, executor: int(self.threads)})

    def __str__(self) -> str:
        return f"run {self.node} and those that share its executor on {self.threads} threads"


@dataclass(frozen=True)
class QueueDepth(Change):
    """Let fewer or more messages wait for a subscription.

    Attributes:
        node, topic: of the subscription.
        depth: messages that may wait, >= 1; the oldest makes way.
    """

    node: str
    topic: str
    depth: int = 1

    def __post_init__(self) -> None:
        _positive("depth", self.depth, "1 keeps the newest only.")

    def apply(self, model: Model) -> Model:
        """Return the changed model."""
        chosen = model.stage(self.node, "subscription", self.topic).place
        return _stages(
            model, lambda stage: stage.place == chosen, lambda stage: dataclasses.replace(stage, depth=int(self.depth))
        )

    def __str__(self) -> str:
        newest = "the newest message" if self.depth == 1 else f"the newest {self.depth} messages"
        return f"let {self.node} keep only {newest} of {self.topic} (queue depth {self.depth})"


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
        _positive("slower", self.slower, "2 is twice as long.")

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

        return _stages(model, lambda stage: stage.place.node == self.node, edit)

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
            _positive(label, value, "1 leaves it as it is.")

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
class TimerRate(Change):
    """Let a timer fire more or less often.

    Attributes:
        node, timer: its node and the name of its callback.
        hz: calls per second.
    """

    node: str
    timer: str
    hz: float

    def __post_init__(self) -> None:
        _positive("hz", self.hz, "20 is every 50 ms.")

    def apply(self, model: Model) -> Model:
        """Return the changed model."""
        timer = _timer(model, self.node, self.timer)
        period = round(1e9 / self.hz)
        first = timer.first_ns - timer.period_ns + period
        changed = dataclasses.replace(timer, period_ns=period, first_ns=first)
        return _stages(model, lambda stage: stage is timer, lambda _: changed)

    def __str__(self) -> str:
        return f"run {self.node}'s timer {self.timer} at {self.hz:.3g} Hz"


@dataclass(frozen=True)
class TimerPhase(Change):
    """Start a timer later, so that it fires just after its inputs have come.

    Attributes:
        node, timer: its node and the name of its callback.
        later_ms: by how much, ms.
    """

    node: str
    timer: str
    later_ms: float

    def __post_init__(self) -> None:
        _positive("later_ms", self.later_ms, "Less than one period is enough.")

    def apply(self, model: Model) -> Model:
        """Return the changed model."""
        timer = _timer(model, self.node, self.timer)
        changed = dataclasses.replace(timer, first_ns=timer.first_ns + round(self.later_ms * 1e6))
        return _stages(model, lambda stage: stage is timer, lambda _: changed)

    def __str__(self) -> str:
        return f"start {self.node}'s timer {self.timer} {self.later_ms:.3g} ms later, just after its inputs come"


def _timer(model: Model, node: str, name: str) -> Stage:
    timer = model.stage(node, "timer", name)
    if not timer.period_ns:
        raise InputError(
            f"timer {name} of {node}",
            given="no regular period in the trace",
            expected="a timer that fires on a grid",
            fix="Record for longer, or change another timer.",
        )
    return timer


@dataclass(frozen=True)
class SmallerMessages(Change):
    """Shrink the messages of a topic: smaller images, thinner clouds.

    Attributes:
        topic: which.
        left: share of the size that is left, e.g. 0.25.
        work: share of the takers' time that goes by size, 0 to 1; None: fitted from the trace where sizes vary, or 1.
    """

    effort: ClassVar[Effort] = "code"
    topic: str
    left: float
    work: float | None = None

    def __post_init__(self) -> None:
        _positive("left", self.left, "0.25 is a quarter.")
        if self.work is not None and not 0 <= self.work <= 1:
            raise InputError("work", given=self.work, expected="0 to 1", fix="Or None to fit it.")

    def apply(self, model: Model) -> Model:
        """Return the changed model."""
        takers = [p for p in model.stages if p.kind == "subscription" and p.name == self.topic]
        if not takers:
            names = sorted({place.name for place in model.stages if place.kind == "subscription"})
            raise InputError(
                "topic", given=self.topic, expected="one of " + ", ".join(names), fix="Name one that is taken."
            )

        def edit(stage: Stage) -> Stage:
            scale: dict[str, float] = dict(stage.scale)
            for resource in RESOURCES:
                share = stage.by_size(resource) if self.work is None else self.work
                scale[resource] = scale.get(resource, 1.0) * (1 - share + share * self.left)
            return dataclasses.replace(stage, scale=scale)

        changed = _stages(model, lambda stage: stage.place in takers, edit)
        sizes: Mapping[str, float] = {**model.sizes, self.topic: model.sizes.get(self.topic, 1.0) * self.left}
        return dataclasses.replace(changed, sizes=sizes)

    def __str__(self) -> str:
        return f"make the messages on {self.topic} smaller, to {self.left:.0%} of their size"


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
