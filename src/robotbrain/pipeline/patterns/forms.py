"""What a brain must do, in closed form: latency, throughput and age at the actuator from its stage times.

Frames arrive every T. A stage that takes s <= T is never in anybody's way. One that takes s > T is saturated: it starts
anew the moment it is done, with the newest frame that has come (queues hold one), and drops the others. It then starts
at 0, s, 2s, … and the j-th frame that it takes has waited

    w_j = j s mod T,   or T where that is 0 (a frame that comes in the very moment is too late),

which runs through g, 2g, …, T with g = gcd(s, T), each equally often: on average (T + g) / 2. Its results leave every
s, so that it is the camera of the stage behind it. From this everything here follows by addition:

- sequential: one stage of s = Σ s_i; throughput 1 / max(T, Σ s_i);
- pipelined: throughput 1 / max(T, max s_i), latency Σ s_i and the waits before saturated stages;
- W frames at once in perception: throughput min(1 / T, W / s, 1 / GPU time). With the GPU as the limit all W frames
  queue up before it, and each takes W times the GPU time (Little's law): more threads make older frames;
- parallel: control reads the newest state every T_c: ages by the read delay, (P - g) / 2 on average for states every P.

The age at the actuator is a saw-tooth: it falls to the latency of a new command and rises until the next one.

Where the device is shared (fewer cores than busy stages, two stages on one GPU) there is no such formula; the forms
are then bounds: throughput is at most the inverse of the busiest resource's time per frame, latency at least Σ s_i.

Sources: Denning and Buzen, "The operational analysis of queueing network models", ACM Computing Surveys 10(3), 1978
(bounds by the busiest resource); Little, "A proof for the queuing formula L = λW", Operations Research 9(3), 1961;
Kaul, Yates and Gruteser, "Real-time status: How often should one update?", INFOCOM 2012 (age).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from robotbrain.errors import InputError
from robotbrain.pipeline.patterns.stages import NS_PER_S, Device, Stage, as_device, check_stages

if TYPE_CHECKING:
    from robotbrain.jetson.profiles import JetsonProfile

Accuracy = Literal["exact", "asymptotic", "bound"]


@dataclass(frozen=True)
class ClosedForm:
    """What theory says about a brain.

    Attributes:
        kind: of brain.
        accuracy: ``exact``: true of every whole cycle of frames. ``asymptotic``: means are those of a long run with
            times that have no common rhythm, maxima may not be reached. ``bound``: the device is shared; throughput is
            an upper bound, everything else a lower one.
        throughput_hz: frames per second that reach the actuator.
        latency_ns: of a frame, from its stamp to the first command that it is in: mean.
        latency_max_ns: largest.
        mean_age_ns: of what the actuator acts on, averaged over time.
        peak_age_ns: largest: how long something can go unseen.
        limited_by: ``camera``, ``control``, the name of a stage, or a resource.
        plan_age_ns: of the frame behind the plan, mean over commands (asymptotic if planning is saturated); for kinds
            other than parallel the latency.
    """

    kind: str
    accuracy: Accuracy
    throughput_hz: float
    latency_ns: float
    latency_max_ns: float
    mean_age_ns: float
    peak_age_ns: float
    limited_by: str
    plan_age_ns: float


def waits_ns(service_ns: int, period_ns: int, count: int) -> NDArray[np.int64]:
    """Return how long each of the first frames that a stage takes has waited, ns.

    Args:
        service_ns: what a frame takes there.
        period_ns: of the frames' arrivals, the first at time 0.
        count: of frames taken.
    """
    if service_ns <= period_ns:
        return np.zeros(count, dtype=np.int64)
    waits = np.arange(count, dtype=np.int64) * service_ns % period_ns
    waits[waits == 0] = period_ns
    waits[:1] = 0
    return waits


def common_rhythm_ns(first_ns: int, second_ns: int) -> tuple[float, int]:
    """Return the common rhythm g of two periods, ns, and the sign of what they miss it by.

    In whole ns 30 Hz is 33 333 333 ns, whose rhythm with 50 Hz would be 1 ns and take half an hour to come round, while
    any run of seconds sees 3 to 5. So periods that miss a small ratio by less than 1 ppm count as having it. The sign
    tells on which side of a tie they are: 1 if ``first`` is a little more than its ratio to ``second`` says.
    """
    ratio = Fraction(first_ns, second_ns).limit_denominator(32)
    missed = first_ns * ratio.denominator - second_ns * ratio.numerator
    if abs(missed) * 1_000_000 <= second_ns:
        return second_ns / ratio.denominator, (missed > 0) - (missed < 0)
    return float(math.gcd(first_ns, second_ns)), 0


def _wait(service_ns: int, period_ns: int, first_ns: int = 0) -> tuple[float, float]:
    """Return mean and largest wait before a stage that starts at ``first_ns`` after a frame and then back to back."""
    if service_ns <= period_ns:
        return 0.0, 0.0
    rhythm, side = common_rhythm_ns(service_ns, period_ns)
    # Just after a tie the newest frame is brand-new, at or before one it is a rhythm older.
    least = first_ns % rhythm or (0.0 if side > 0 else rhythm)
    return least + (period_ns - rhythm) / 2, least + period_ns - rhythm


@dataclass
class _Chain:
    """Stages in a row, a thread each: what comes out of them."""

    latency: float
    longest: float
    gaps: list[int]  # between results, over one cycle
    limit: str
    accuracy: Accuracy = "exact"
    saturated: int = 0
    several: bool = False  # the first stage is saturated with several frames at once

    @property
    def period(self) -> float:
        return sum(self.gaps) / len(self.gaps)

    @property
    def mean_gap(self) -> float:
        """Mean time since the last result, at a random time."""
        return sum(gap * gap for gap in self.gaps) / (2 * sum(self.gaps))


def _chain(stages: Sequence[Stage], period: int, at_once: int) -> _Chain:
    found = _first(stages[0], period, at_once)
    for stage in stages[1:]:
        found.latency += stage.ns
        found.longest += stage.ns
        if stage.ns <= min(found.gaps):
            continue
        if len(found.gaps) > 1:
            found.accuracy = "bound"
            if stage.ns > found.period:
                found.limit = stage.name
            found.gaps = [max(round(found.period), stage.ns)]
            continue
        mean, most = _wait(stage.ns, found.gaps[0])
        found.latency, found.longest = found.latency + mean, found.longest + most
        found.gaps, found.limit, found.saturated = [stage.ns], stage.name, found.saturated + 1
    if found.saturated > 1 and found.accuracy == "exact":
        found.accuracy = "asymptotic"
    return found


def _first(stage: Stage, period: int, at_once: int) -> _Chain:
    """The first stage, which may work on several frames at once."""
    if at_once == 1:
        mean, most = _wait(stage.ns, period)
        return _Chain(
            stage.ns + mean,
            stage.ns + most,
            [max(period, stage.ns)],
            stage.name if most else "camera",
            saturated=int(most > 0),
        )
    # What one frame after the other must pass: the busiest of GPU and DLAs.
    serial = {r: stage.on(r) for r, _ in stage.segments if r != "cpu"}
    neck = max(serial, key=lambda r: serial[r], default="")
    turn = serial.get(neck, 0)
    if stage.ns <= at_once * period and turn <= period:
        return _Chain(stage.ns, stage.ns, [period], "camera")
    if turn > period and at_once * turn >= stage.ns:
        # Once the GPU is never idle, a thread is free whenever a frame has come off it and been finished.
        mean, most = _wait(turn, period, stage.ns - turn)
        return _Chain(at_once * turn + mean, at_once * turn + most, [turn], neck, saturated=1, several=True)
    # The threads are the limit: they run in a group, one period (or one turn on the GPU) after the other.
    step = max(period, turn)
    mean, most = _wait(stage.ns, period)
    gaps = [*[step] * (at_once - 1), stage.ns - (at_once - 1) * step]
    accuracy: Accuracy = "exact" if turn <= period else "asymptotic"
    return _Chain(stage.ns + mean, stage.ns + most, gaps, stage.name, accuracy, 1, several=True)


# ------------------------------------------------------------ is the device shared?


def overlap(intervals: Iterable[tuple[int, int]], period: int) -> int:
    """Return how many of ``intervals`` (start, end), repeated every ``period``, run at the same time at most."""
    whole, edges = 0, []
    for start, end in intervals:
        whole += (end - start) // period
        rest = (end - start) % period
        if rest:
            first, last = start % period, start % period + rest
            edges += [(first, 1), (min(last, period), -1)]
            if last > period:
                edges += [(0, 1), (last - period, -1)]
    level = most = 0
    for _, change in sorted(edges):
        level += change
        most = max(most, level)
    return whole + most


def is_shared(stages: Sequence[Stage], device: Device, period: int, at_once: int, *, spare: int = 0) -> bool:
    """Tell whether stages that run side by side can get into each other's way on the device.

    Args:
        stages: of a pipeline.
        device: has cores, and one each of the other resources.
        period: of the camera, ns.
        at_once: frames in the first stage.
        spare: cores that are not to be counted on.
    """
    cores = device.cpu_cores - spare
    relaxed = all(stage.ns <= period for stage in stages[1:]) and stages[0].ns <= at_once * period
    by_resource: dict[str, list[tuple[int, int]]] = {}
    users: dict[str, int] = {}
    time = 0
    for place, stage in enumerate(stages):
        for resource in {name for name, _ in stage.segments}:
            users[resource] = users.get(resource, 0) + (at_once if place == 0 and resource == "cpu" else 1)
        for resource, length in stage.segments:
            by_resource.setdefault(resource, []).append((time, time + length))
            time += length
    for resource, count in users.items():
        limit = cores if resource == "cpu" else 1
        if count > limit and not (relaxed and overlap(by_resource[resource], period) <= limit):
            return True
    return cores < 1


def _bound(stages: Sequence[Stage], device: Device, period: int, at_once: int) -> tuple[float, str]:
    """Return the least time per frame, ns, and whose it is."""
    times: dict[str, float] = {"camera": period, stages[0].name: stages[0].ns / at_once}
    times |= {stage.name: float(stage.ns) for stage in stages[1:]}
    for resource in {name for stage in stages for name, _ in stage.segments}:
        total = sum(stage.on(resource) for stage in stages)
        times[resource] = total / (device.cpu_cores if resource == "cpu" else 1)
    name = max(times, key=lambda key: times[key])
    return times[name], name


# ------------------------------------------------------------ brains


def closed_form(
    kind: str,
    stages: Sequence[Stage],
    device: Device | JetsonProfile | str | int,
    period_ns: int,
    *,
    frames_at_once: int = 1,
    control_period_ns: int = 20_000_000,
) -> ClosedForm:
    """Return what a brain must do, for queues that hold one frame and no jitter.

    Args:
        kind: ``sequential``, ``pipelined`` or ``parallel``.
        stages: as run_brain takes them.
        device: likewise.
        period_ns: of the camera.
        frames_at_once: in the first stage.
        control_period_ns: of control in a parallel brain.

    Raises:
        InputError: for an unknown kind, or stages whose times change from frame to frame.
    """
    found = as_device(device)
    chosen = check_stages(stages, found)
    if any(stage.work is not None for stage in chosen):
        raise InputError(
            "closed form",
            given=[stage.name for stage in chosen if stage.work is not None],
            expected="stages with fixed times",
            fix="Take the bound for the longest times: Stage(name, segments) without work.",
        )
    if kind == "sequential":
        return _sequential(chosen, period_ns)
    if kind == "pipelined":
        return _pipelined(chosen, found, period_ns, frames_at_once)
    if kind == "parallel" and len(chosen) >= 3:
        return _parallel(chosen, found, period_ns, frames_at_once, control_period_ns)
    raise InputError(
        "kind of brain",
        given=(kind, len(chosen)),
        expected="sequential, pipelined, or parallel with at least three stages",
        fix="Choose one of these.",
    )


def _sequential(stages: Sequence[Stage], period: int) -> ClosedForm:
    total = sum(stage.ns for stage in stages)
    chain = _first(Stage("update", (("cpu", total),)), period, 1)
    return _form("sequential", chain)


def _pipelined(stages: Sequence[Stage], device: Device, period: int, at_once: int) -> ClosedForm:
    chain = _chain(stages, period, at_once)
    if is_shared(stages, device, period, at_once):
        least, name = _bound(stages, device, period, at_once)
        total = sum(stage.ns for stage in stages)
        chain = _Chain(total, total, [round(least)], name, "bound")
    return _form("pipelined", chain)


def _form(kind: str, chain: _Chain) -> ClosedForm:
    return ClosedForm(
        kind=kind,
        accuracy=chain.accuracy,
        throughput_hz=NS_PER_S / chain.period,
        latency_ns=chain.latency,
        latency_max_ns=chain.longest,
        mean_age_ns=chain.latency + chain.mean_gap,
        peak_age_ns=chain.longest + max(chain.gaps),
        limited_by=chain.limit,
        plan_age_ns=chain.latency,
    )


def _phase(chain: _Chain, stages: Sequence[Stage], period: int, tick: int) -> tuple[float, float]:
    """Return the rhythm of a chain's results and the ticks that read them, and the least delay between the two, ns."""
    rhythm, _ = common_rhythm_ns(round(chain.period), tick)
    if chain.several:
        return rhythm, rhythm / 2
    # The first frame is taken at one period and meets no queue; what comes in the moment of a tick is too late for it.
    first = period + sum(stage.ns for stage in stages)
    return rhythm, -first % rhythm or rhythm


def _parallel(stages: Sequence[Stage], device: Device, period: int, at_once: int, tick: int) -> ClosedForm:
    control = stages[-1].ns
    state, plan = _chain(stages[:-2], period, at_once), _chain(stages[:-1], period, at_once)
    if is_shared(stages[:-1], device, period, at_once, spare=1) or control > tick:
        least, name = _bound(stages[:-2], device, period, at_once)
        total = sum(stage.ns for stage in stages[:-2])
        state = _Chain(total, total, [round(least)], name, "bound")
        plan = _Chain(total + stages[-2].ns, total, [round(least)], name, "bound")
    elif (state.saturated or len(state.gaps) > 1) and state.accuracy == "exact":
        state.accuracy = "asymptotic"
    step = round(state.period)
    rhythm, offset = _phase(state, stages[:-2], period, tick)
    read = offset + (step - rhythm) / 2
    use = offset + (min(step, tick) - rhythm) / 2
    plan_rhythm, plan_offset = _phase(plan, stages[:-1], period, tick)
    plan_read = plan_offset + (plan.period - plan_rhythm) / 2
    base = state.latency + control
    if state.accuracy == "bound":
        read = use = plan_read = offset = 0.0
        rhythm = min(step, tick)
    return ClosedForm(
        kind="parallel",
        accuracy=state.accuracy,
        throughput_hz=NS_PER_S / max(step, tick),
        latency_ns=base + use,
        latency_max_ns=state.longest + control + offset + min(step, tick) - rhythm,
        mean_age_ns=base + read + tick / 2,
        peak_age_ns=state.longest + control + offset + step - rhythm + tick,
        limited_by=state.limit if step >= tick else "control",
        plan_age_ns=plan.latency + control + plan_read,
    )
