"""What would a change gain? The recorded pipeline runs again in simulated time with the change made.

A formula such as Amdahl's law says what faster work saves on the critical path, but not that a queue drains, that a
timer still fires when it fires, or that two nodes now get into each other's way. So the pipeline is played back as a
discrete-event simulation: same callbacks, same arrivals, same executors, queues and device, and for each measurement
the work that was recorded for it. :func:`estimate_ms` is the formula, for comparison and explanation.

What a replay cannot know: that the robot would have driven another way, work that moves between callbacks, and what a
node would have done with messages that it never got (it takes what it took for others around that time).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robotbrain.errors import InputError
from robotbrain.monitoring.critical_path import Chains, Path
from robotbrain.monitoring.whatif_changes import (
    EFFORTS,
    Change,
    Device,
    Effort,
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
from robotbrain.monitoring.whatif_estimate import estimate_ms
from robotbrain.monitoring.whatif_infer import infer_model
from robotbrain.monitoring.whatif_model import Model
from robotbrain.monitoring.whatif_replay import run_model

if TYPE_CHECKING:
    from robotbrain.monitoring.trace import Trace

__all__ = [
    "EFFORTS",
    "Change",
    "Device",
    "Effort",
    "Faster",
    "MoveTo",
    "Outcome",
    "OwnExecutor",
    "Prediction",
    "QueueDepth",
    "SmallerMessages",
    "Threads",
    "TimerPhase",
    "TimerRate",
    "Together",
    "WhatIf",
    "Without",
    "estimate_ms",
    "infer_model",
    "outcome",
    "predict",
    "replay_trace",
]


@dataclass(frozen=True)
class Outcome:
    """How quick a run was, from one source to one sink.

    Attributes:
        source, sink: which.
        mean_ms, p50_ms, p99_ms: from a measurement to the first command that reflects it or a newer one, ms; one that
            hung to the end counts with the time it had waited.
        age_p50_ms, age_p99_ms: age of the newest measurement of the source behind each command, ms.
        fresh_hz: commands per second that reflect a measurement which none before did: the throughput.
        sink_hz: commands per second.
        lost: messages dropped by full queues, in all of the pipeline.
        unanswered: measurements that nothing reflected when the trace ended.
    """

    source: str
    sink: str
    mean_ms: float
    p50_ms: float
    p99_ms: float
    age_p50_ms: float
    age_p99_ms: float
    fresh_hz: float
    sink_hz: float
    lost: int
    unanswered: int


def outcome(trace: Trace, sink: str = "/cmd_vel", source: str | None = None) -> Outcome:
    """Return how quick a recorded run was.

    Args:
        trace: of the run.
        sink: topic, or service whose answers count.
        source: topic of the measurements; None: the one that takes longest.

    Raises:
        InputError: for a sink or source that the trace does not have, or too short a trace.
    """
    return _outcome(Chains(trace, sink, None if source is None else [source]), source)


def _outcome(chains: Chains, source: str | None = None) -> Outcome:
    chosen = source or chains.slowest_source
    trace = chains.trace
    reactions = np.array(chains.delays(chosen), dtype=float) * 1e-6
    origins = [chains.behind(message).get(chosen) for message in chains.sinks]
    known = [(message, origin) for message, origin in zip(chains.sinks, origins, strict=True) if origin is not None]
    ages = np.array([message.released_ns - origin for message, origin in known], dtype=float) * 1e-6
    if not len(reactions):
        raise InputError(
            "trace",
            given=f"no measurement of {chosen} that reached {chains.sink}",
            expected="a run in which some did",
            fix="Record for longer.",
        )
    return Outcome(
        chosen,
        chains.sink,
        float(reactions.mean()),
        _percentile(reactions, 50),
        _percentile(reactions, 99),
        _percentile(ages, 50),
        _percentile(ages, 99),
        len({origin for _, origin in known}) / trace.seconds,
        len(chains.sinks) / trace.seconds,
        sum(trace.dropped.values()),
        chains.unanswered(chosen),
    )


def _percentile(values: NDArray[np.float64], percent: float) -> float:
    return float(np.percentile(values, percent)) if len(values) else float("nan")


@dataclass(frozen=True)
class Prediction:
    """What a change would do.

    Attributes:
        change: which.
        before: the recorded run.
        after: predicted; what the replay says of the change, less what the replay without it gets wrong.
        estimate_ms: gain in the mean latency by the closed form, ms, for comparison.
        limit_ms: for faster work: the gain in the mean by the closed form if it took no time at all (Amdahl's limit).
        slowest: the source that takes longest after the change, with its median in ms: a change may help one sensor and
            leave another waiting. Only if sources were left to be found.
        replay_error: by how much the replay without the change misses the recorded median, relative.
    """

    change: Change
    before: Outcome
    after: Outcome
    estimate_ms: float
    replay_error: float
    limit_ms: float | None = None
    slowest: tuple[str, float] = ("", 0.0)

    @property
    def gain_ms(self) -> float:
        """Gain in the median end-to-end latency, ms; negative: it gets worse."""
        return self.before.p50_ms - self.after.p50_ms

    @property
    def gain_p99_ms(self) -> float:
        """Gain in the 99th percentile, ms."""
        return self.before.p99_ms - self.after.p99_ms

    @property
    def gain_mean_ms(self) -> float:
        """Gain in the mean, ms."""
        return self.before.mean_ms - self.after.mean_ms

    @property
    def gain(self) -> float:
        """Gain in the median as a share of it, 0 to 1."""
        return self.gain_ms / self.before.p50_ms if self.before.p50_ms else 0.0

    @property
    def overall_gain(self) -> float:
        """As :attr:`gain`, but with the source that is slowest after the change."""
        left = max(self.after.p50_ms, self.slowest[1])
        return 1 - left / self.before.p50_ms if self.before.p50_ms else 0.0

    @property
    def throughput_gain(self) -> float:
        """How many times as many fresh commands per second."""
        return self.after.fresh_hz / self.before.fresh_hz if self.before.fresh_hz else float("inf")

    def __str__(self) -> str:
        b, a = self.before, self.after
        return (
            f"{self.change}: median {b.p50_ms:.1f} -> {a.p50_ms:.1f} ms ({-self.gain:+.0%}), 99th percentile "
            f"{b.p99_ms:.1f} -> {a.p99_ms:.1f} ms, {b.fresh_hz:.1f} -> {a.fresh_hz:.1f} fresh commands/s"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {
            "change": self.change.to_dict(),
            "effort": self.change.takes,
            "before": asdict(self.before),
            "after": asdict(self.after),
            "gain_ms": self.gain_ms,
            "gain_p99_ms": self.gain_p99_ms,
            "gain": self.gain,
            "throughput_gain": self.throughput_gain,
            "estimate_ms": self.estimate_ms,
            "limit_ms": self.limit_ms,
            "slowest": list(self.slowest),
            "overall_gain": self.overall_gain,
            "replay_error": self.replay_error,
        }


class WhatIf:
    """Tries changes on one recorded run.

    Args:
        trace: of the run.
        sink, source: as of :func:`outcome`.

    Attributes:
        chains: of the recorded run.
        model: of its pipeline.
        before: how quick it was.

    Raises:
        InputError: as :func:`outcome`.
    """

    def __init__(self, trace: Trace, sink: str = "/cmd_vel", source: str | None = None) -> None:
        self.trace = trace
        self.chains = Chains(trace, sink, None if source is None else [source])
        self.before = _outcome(self.chains, source)
        self.model: Model = infer_model(trace)
        self._paths = self.chains.reactions(self.before.source)
        self._baseline = self._measure(run_model(self.model))

    @property
    def paths(self) -> tuple[Path, ...]:
        """The recorded path of every measurement of the source."""
        return self._paths

    def _measure(self, trace: Trace) -> Outcome:
        return outcome(trace, self.before.sink, self.before.source)

    def replay(self, *changes: Change) -> Trace:
        """Return the trace of the pipeline with these changes."""
        model = self.model
        for change in changes:
            model = change.apply(model)
        return run_model(model, title="; ".join(map(str, changes)))

    def predict(self, change: Change) -> Prediction:
        """Return what a change would do.

        Raises:
            InputError: if the pipeline does not have what is to be changed.
        """
        changed_trace = self.replay(change)
        after = self._measure(changed_trace)
        b, r = self.before, self._baseline

        def corrected(name: str) -> float:
            recorded, again, changed = (float(getattr(o, name)) for o in (b, r, after))
            return recorded + changed - again if recorded + changed - again > 0 else changed

        names = ("mean_ms", "p50_ms", "p99_ms", "age_p50_ms", "age_p99_ms", "fresh_hz", "sink_hz")
        values = {name: corrected(name) for name in names}
        adjusted = Outcome(b.source, b.sink, **values, lost=after.lost, unanswered=after.unanswered)
        error = abs(r.p50_ms / b.p50_ms - 1) if b.p50_ms else 0.0
        limit = None
        if isinstance(change, Faster):
            limit = estimate_ms(self._paths, replace(change, times=1e12))
        slowest = self._slowest(changed_trace, adjusted)
        return Prediction(change, b, adjusted, estimate_ms(self._paths, change), error, limit, slowest)

    def _slowest(self, trace: Trace, after: Outcome) -> tuple[str, float]:
        """Return the source that is slowest after a change, with its median, ms."""
        if len(self.chains.sources) == 1:
            return after.source, after.p50_ms
        chains = Chains(trace, after.sink)
        medians = {source: _percentile(np.array(chains.delays(source)) * 1e-6, 50) for source in chains.sources}
        worst = max(medians, key=lambda source: (medians[source], source))
        # Sources that are about as slow as the one in question are no news.
        return (worst, medians[worst]) if medians[worst] > 1.1 * after.p50_ms else (after.source, after.p50_ms)

    def check(self, change: Change, made: Trace) -> tuple[Prediction, Outcome, float]:
        """Compare a prediction with a run in which the change was really made.

        Returns:
            The prediction, how quick the changed run was, and the error of the predicted gain: relative to the gain
            in the median that was made.
        """
        predicted, real = self.predict(change), self._measure(made)
        gain = self.before.p50_ms - real.p50_ms
        return predicted, real, abs(predicted.gain_ms - gain) / abs(gain) if gain else float("inf")


def replay_trace(trace: Trace, *changes: Change) -> Trace:
    """Return the trace of a recorded pipeline run again with changes; without any, the check of the replay itself."""
    model = infer_model(trace)
    for change in changes:
        model = change.apply(model)
    return run_model(model, title="; ".join(map(str, changes)) or trace.title)


def predict(
    trace: Trace, changes: Change | Iterable[Change], sink: str = "/cmd_vel", source: str | None = None
) -> list[Prediction]:
    """Return what each change would do by itself (several at once: :class:`Together`).

    Raises:
        InputError: for a sink, source or change that does not fit the trace.
    """
    study = WhatIf(trace, sink, source)
    return [study.predict(change) for change in ([changes] if isinstance(changes, Change) else changes)]
