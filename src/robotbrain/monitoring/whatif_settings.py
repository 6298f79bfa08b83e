"""Changes of settings: queues, timers, sizes of messages."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from robotbrain.errors import InputError
from robotbrain.monitoring.whatif_change import Change, Effort, check_positive, edit_stages
from robotbrain.monitoring.whatif_model import Model, Stage
from robotbrain.ros.resources import RESOURCES


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
        check_positive("depth", self.depth, "1 keeps the newest only.")

    def apply(self, model: Model) -> Model:
        """Return the changed model."""
        chosen = model.stage(self.node, "subscription", self.topic).place
        return edit_stages(
            model, lambda stage: stage.place == chosen, lambda stage: dataclasses.replace(stage, depth=int(self.depth))
        )

    def __str__(self) -> str:
        newest = "the newest message" if self.depth == 1 else f"the newest {self.depth} messages"
        return f"let {self.node} keep only {newest} of {self.topic} (queue depth {self.depth})"


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
        check_positive("hz", self.hz, "20 is every 50 ms.")

    def apply(self, model: Model) -> Model:
        """Return the changed model."""
        timer = _timer(model, self.node, self.timer)
        period = round(1e9 / self.hz)
        first = timer.first_ns - timer.period_ns + period
        changed = dataclasses.replace(timer, period_ns=period, first_ns=first)
        return edit_stages(model, lambda stage: stage is timer, lambda _: changed)

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
        check_positive("later_ms", self.later_ms, "Less than one period is enough.")

    def apply(self, model: Model) -> Model:
        """Return the changed model."""
        timer = _timer(model, self.node, self.timer)
        changed = dataclasses.replace(timer, first_ns=timer.first_ns + round(self.later_ms * 1e6))
        return edit_stages(model, lambda stage: stage is timer, lambda _: changed)

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
        check_positive("left", self.left, "0.25 is a quarter.")
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

        changed = edit_stages(model, lambda stage: stage.place in takers, edit)
        sizes: Mapping[str, float] = {**model.sizes, self.topic: model.sizes.get(self.topic, 1.0) * self.left}
        return dataclasses.replace(changed, sizes=sizes)

    def __str__(self) -> str:
        return f"make the messages on {self.topic} smaller, to {self.left:.0%} of their size"
