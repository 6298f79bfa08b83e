"""What a run of a brain gives: commands with the age of what they are based on, and where the time went."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from robotbrain.errors import InputError
from robotbrain.pipeline.patterns.stages import NS_PER_MS, Device, Stage

if TYPE_CHECKING:
    from robotbrain.monitoring.trace import Trace


class Command(NamedTuple):
    """A command at the actuator.

    Attributes:
        released_ns: when it left the brain.
        state_ns: stamp of the newest frame that it is based on.
        plan_ns: stamp of the frame behind the plan that it follows; the same frame unless control runs on its own.
    """

    released_ns: int
    state_ns: int
    plan_ns: int


class Span(NamedTuple):
    """A piece of work on a timeline.

    Attributes:
        stage: whose it is.
        frame: which frame's, counted from 1.
        resource: what it ran on (or waited for).
        start_ns, end_ns: when.
        worker: thread of its executor, from 0.
    """

    stage: str
    frame: int
    resource: str
    start_ns: int
    end_ns: int
    worker: int


def age_curve(commands: Sequence[Command], *, of: str = "state") -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the saw-tooth of the age at the actuator as corners (times ns, ages ns), two for each command.

    Between commands the data behind the last one grows older by the time that passes; a new command lets the age fall
    to its own latency. The curve ends with the last command.

    Args:
        commands: in order of release.
        of: ``"state"`` or ``"plan"``: whose age.
    """
    stamps = [command.state_ns if of == "state" else command.plan_ns for command in commands]
    times, ages = [], []
    for place, (command, stamp) in enumerate(zip(commands, stamps, strict=True)):
        if place:
            times.append(command.released_ns)
            ages.append(command.released_ns - stamps[place - 1])
        times.append(command.released_ns)
        ages.append(command.released_ns - stamp)
    return np.array(times, dtype=np.int64), np.array(ages, dtype=np.int64)


def mean_age_ns(times: NDArray[np.int64], ages: NDArray[np.int64]) -> float:
    """Return the time average of an :func:`age_curve`, ns.

    The curve is made of straight lines, so trapezoids are exact. This is the "age of information" of Kaul, Yates and
    Gruteser, "Real-time status: How often should one update?", INFOCOM 2012.
    """
    spans = np.diff(times).astype(float)  # products of ns do not fit 64 bits
    if not spans.sum():
        return float("nan")
    return float(spans @ (ages[1:] + ages[:-1]) / (2 * spans.sum()))


@dataclass(frozen=True)
class PatternResult:
    """How a brain ran.

    Attributes:
        kind: ``sequential``, ``pipelined`` or ``parallel``.
        stages: what it is made of.
        device: what it ran on.
        period_ns: of the camera.
        seconds: simulated time.
        warmup_ns: what was released before is not counted in any figure below.
        commands: all that reached the actuator, in order.
        frames: how many the camera took.
        drops: by stage, frames that its full queue pushed out.
        overtaken: results discarded since a newer one had passed them (only with several frames at once).
        busy: share of its capacity that each resource of the device was busy, 0 to 1.
        spans: all work, for timelines.
        trace: every callback and message.
    """

    kind: str
    stages: tuple[Stage, ...]
    device: Device
    period_ns: int
    seconds: float
    warmup_ns: int
    commands: tuple[Command, ...] = field(repr=False)
    frames: int
    drops: Mapping[str, int]
    overtaken: int
    busy: Mapping[str, float]
    spans: tuple[Span, ...] = field(repr=False)
    trace: Trace = field(repr=False)

    @property
    def counted(self) -> tuple[Command, ...]:
        """Commands after the warm-up.

        Raises:
            InputError: there are fewer than two.
        """
        found = tuple(command for command in self.commands if command.released_ns >= self.warmup_ns)
        if len(found) < 2:
            raise InputError(
                "run of a brain",
                given=f"{len(found)} commands after {self.warmup_ns / 1e9:g} s of warm-up",
                expected="at least two",
                fix="Run it for longer.",
            )
        return found

    @property
    def first_uses(self) -> tuple[Command, ...]:
        """Of each frame that reached the actuator, the first command that it is in."""
        found: list[Command] = []
        for command in self.commands:
            if not found or command.state_ns > found[-1].state_ns:
                found.append(command)
        return tuple(command for command in found if command.released_ns >= self.counted[0].released_ns)

    @property
    def latency_ns(self) -> NDArray[np.int64]:
        """Of each frame that reached the actuator: from its stamp to the first command that it is in, ns."""
        return np.array([c.released_ns - c.state_ns for c in self.first_uses], dtype=np.int64)

    @property
    def latency_ms(self) -> NDArray[np.float64]:
        """The same in ms."""
        return self.latency_ns / NS_PER_MS

    @property
    def plan_age_ms(self) -> NDArray[np.float64]:
        """Age of the frame behind the plan at each command, ms."""
        return np.array([(c.released_ns - c.plan_ns) / NS_PER_MS for c in self.counted])

    @property
    def throughput_hz(self) -> float:
        """Frames per second that reached the actuator."""
        return _rate([command.released_ns for command in self.first_uses])

    @property
    def command_hz(self) -> float:
        """Commands per second."""
        return _rate([command.released_ns for command in self.counted])

    @property
    def age(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The saw-tooth of the age at the actuator: (times ns, ages ns), see :func:`age_curve`."""
        return age_curve(self.counted)

    @property
    def mean_age_ms(self) -> float:
        """Age at the actuator, averaged over time, ms."""
        return mean_age_ns(*self.age) / NS_PER_MS

    @property
    def peak_age_ms(self) -> float:
        """Largest age at the actuator, ms: something that happened just after a frame stays unseen for so long."""
        return float(self.age[1].max()) / NS_PER_MS


def _rate(times_ns: Sequence[int]) -> float:
    span = times_ns[-1] - times_ns[0]
    return (len(times_ns) - 1) * 1e9 / span if span else 0.0
