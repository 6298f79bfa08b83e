"""What holds a robot brain up, and what would help by how much.

The latency side follows the chain from each measurement to the first command that reflects it (see
:mod:`robotbrain.monitoring.critical_path`) and adds its pieces up by cause: the largest about which something can be
done is the bottleneck. The throughput side asks what saturates first. Both can differ. Every proposal was tried by
running the recorded pipeline again with it (see :mod:`robotbrain.monitoring.whatif`), those of no use as well.
"""

from __future__ import annotations

import itertools
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

from robotbrain.errors import InputError
from robotbrain.monitoring.critical_path_blame import place_of
from robotbrain.monitoring.critical_path_budget import LatencyBudget, latency_budget
from robotbrain.monitoring.critical_path_load import Load, load
from robotbrain.monitoring.diagnosis_candidates import addresses, candidates
from robotbrain.monitoring.diagnosis_causes import KINDS, Finding, find_causes
from robotbrain.monitoring.whatif import EFFORTS, Change, Outcome, Prediction, WhatIf

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from robotbrain.monitoring.trace import Trace

WORTH = 0.03
"""A change that gains less than this share of the median latency is of no use."""


ABSORBED = "No change against it gains anything by itself: what is saved here is waited for further on."
"""Said of a cause with slack behind it, e.g. a timer that fires when it fires."""

ABSORBED_BELOW = 0.2
"""If changes against a cause gain less than this share of what it contributes, the rest of it is not the cause's."""


@dataclass(frozen=True)
class Throughput:
    """What limits how many measurements per second reach the sink.

    Attributes:
        offered_hz: measurements per second of the source.
        fresh_hz: commands per second that reflect a new one.
        limit: what is nearest to its limit, in words.
        use: the share of it that is in use; above 1 more is asked of it than it can do.
        limited: whether measurements are lost on the way because of it.
    """

    offered_hz: float
    fresh_hz: float
    limit: str
    use: float
    limited: bool

    def __str__(self) -> str:
        reach = f"{self.fresh_hz:.1f} of {self.offered_hz:.1f} measurements a second reach the sink"
        if self.limited:
            return f"{reach}; {self.limit} is the limit ({self.use:.0%} of what it can do is asked of it)"
        return f"{reach}; the nearest limit is {self.limit}, {self.use:.0%} in use"


@dataclass(frozen=True)
class Deadline:
    """A deadline and how often it was missed.

    Attributes:
        name: the sink (end to end), or a callback.
        limit_ms: from a measurement to its command; of a callback from ready to end.
        missed, count: how many were later, of how many.
    """

    name: str
    limit_ms: float
    missed: int
    count: int


@dataclass(frozen=True)
class Diagnosis:
    """What was found in a trace; ``print(diagnosis)`` says it in words.

    Attributes:
        title: of the trace.
        before: how quick the run was.
        budget: what the latency consists of, callback by callback.
        bottleneck: the largest cause that something can be done about: a change against it was tried and helps.
        causes: the latency by cause, the largest first.
        throughput: its limit.
        load: how busy everything was.
        deadlines: those asked for.
        proposals: changes that help, with what they are predicted to gain, the best first.
        useless: changes that were tried and do not help.
        replay_error: by how much the replay of the run itself misses the recorded median, relative.
    """

    title: str
    before: Outcome
    budget: LatencyBudget = field(repr=False)
    bottleneck: Finding
    causes: tuple[Finding, ...] = field(repr=False)
    throughput: Throughput
    load: Load = field(repr=False)
    deadlines: tuple[Deadline, ...]
    proposals: tuple[Prediction, ...] = field(repr=False)
    useless: tuple[Prediction, ...] = field(repr=False)
    replay_error: float = 0.0

    @property
    def best(self) -> Prediction | None:
        """The first proposal; None if nothing helps."""
        return self.proposals[0] if self.proposals else None

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {
            "title": self.title,
            "before": asdict(self.before),
            "bottleneck": self.bottleneck.to_dict(),
            "causes": [cause.to_dict() for cause in self.causes],
            "throughput": asdict(self.throughput),
            "budget": self.budget.to_dict(),
            "load": self.load.to_dict(),
            "deadlines": [asdict(deadline) for deadline in self.deadlines],
            "proposals": [proposal.to_dict() for proposal in self.proposals],
            "useless": [proposal.to_dict() for proposal in self.useless],
            "replay_error": self.replay_error,
        }

    def plot(self) -> tuple[Figure, str]:
        """Return a figure of the latency budget and of what is busy, and its alternative text."""
        from robotbrain.monitoring.diagnosis_plots import plot_diagnosis

        return plot_diagnosis(self)

    def _repr_markdown_(self) -> str:
        return f"```text\n{self}\n```"

    def __str__(self) -> str:
        return "\n".join(_words(self))


def diagnose(
    trace: Trace,
    sink: str = "/cmd_vel",
    *,
    source: str | None = None,
    deadlines: Mapping[str, float] | None = None,
    options: Iterable[Change] = (),
    tries: int = 12,
) -> Diagnosis:
    """Find what holds a recorded brain up, and try what would help.

    Args:
        trace: of a run: ``drive(..., trace=True).trace``.
        sink: topic that the latency is to, or service whose answers count.
        source: topic that it is from; None: the sensor whose measurements take longest.
        deadlines: ms, by the name of the sink (end to end) or of a callback (``"/controller timer _control"``).
        options: changes that are known to be possible, to be tried besides the diagnosis's own ideas, e.g.
            ``[Faster("/perception", 2.4, "gpu", how="INT8")]``.
        tries: at most so many changes of its own are tried.

    Raises:
        InputError: for a sink, source, deadline or option that does not fit the trace.
    """
    study = WhatIf(trace, sink, source)
    busy, paths = load(trace), study.paths
    causes = find_causes(paths, study.model, busy)
    known = list(options)
    against = [candidates(cause, paths, study.model, busy, known) for cause in causes[:5] if cause.share >= WORTH]
    ideas = [change for change in dict.fromkeys(itertools.chain(*against)) if change not in known]
    predictions = [study.predict(change) for change in known]
    for idea in ideas[:tries]:
        try:
            predictions.append(study.predict(idea))
        except InputError:
            continue
    helping = [p for p in predictions if p.gain >= WORTH or p.throughput_gain >= 1 + WORTH]
    helping.sort(key=lambda p: (-round(p.overall_gain, 1), EFFORTS.index(p.change.takes), -p.gain, str(p.change)))
    useless = [p for p in predictions if p not in helping]
    bottleneck, causes = _verified(causes, predictions)
    return Diagnosis(
        title=trace.title,
        before=study.before,
        budget=latency_budget(paths),
        bottleneck=bottleneck,
        causes=causes,
        throughput=_throughput(trace, study.before, busy),
        load=busy,
        deadlines=_deadlines(trace, study, deadlines or {}),
        proposals=tuple(helping),
        useless=tuple(sorted(useless, key=lambda p: (-p.gain, str(p.change)))),
        replay_error=predictions[0].replay_error if predictions else 0.0,
    )


def _verified(causes: Sequence[Finding], predictions: Sequence[Prediction]) -> tuple[Finding, tuple[Finding, ...]]:
    """Return the largest cause that a change helps against, and the causes with what is to be said of larger ones."""
    said: list[Finding] = []
    for place, cause in enumerate(causes):
        gains = [p.gain for p in predictions if addresses(p.change, cause)]
        if gains and max(gains) >= max(WORTH, ABSORBED_BELOW * cause.share):
            return cause, (*said, *causes[place:])
        said.append(replace(cause, evidence=(*cause.evidence, ABSORBED)) if gains else cause)
    return said[0], tuple(said)


def _throughput(trace: Trace, before: Outcome, busy: Load) -> Throughput:
    offered = sum(m.name == before.source and m.kind == "topic" for m in trace.messages) / trace.seconds
    limit, use = busy.saturates_first
    limited = before.fresh_hz < 0.95 * offered
    stage = busy.stages[0]
    if stage.use > max(use, 1.0):
        limit, use = str(stage.place), stage.use
    if limited and use < 0.9:
        # Nothing is saturated, so something lets measurements pass on purpose: the slowest step of the way.
        slow = [s for s in busy.stages if s.place.kind == "timer" and s.served_hz < 0.95 * offered]
        on_way = [s for s in slow if s.served_hz <= 1.2 * before.fresh_hz]
        if on_way:
            chosen = min(on_way, key=lambda s: (abs(s.served_hz - before.fresh_hz), s.place))
            limit, use = f"{chosen.place}, which runs only {chosen.served_hz:.1f} times a second,", 1.0
    return Throughput(offered, before.fresh_hz, limit, use, limited)


def _deadlines(trace: Trace, study: WhatIf, wanted: Mapping[str, float]) -> tuple[Deadline, ...]:
    times: dict[str, list[int]] = {study.before.sink: [path.latency_ns for path in study.paths]}
    for record in trace.callbacks:
        times.setdefault(str(place_of(record)), []).append(record.end_ns - record.ready_ns)
    found = []
    for name, limit in wanted.items():
        if name not in times:
            raise InputError(
                "deadlines",
                given=name,
                expected="the sink or a callback: " + ", ".join(sorted(times)),
                fix='A callback is named "/node kind name", as in the report.',
            )
        if not limit > 0:
            raise InputError(f"deadline of {name}", given=limit, expected="ms > 0", fix="100 is a tenth of a second.")
        found.append(Deadline(name, float(limit), sum(t > limit * 1e6 for t in times[name]), len(times[name])))
    return tuple(found)


# ------------------------------------------------------------ words


def _words(diagnosis: Diagnosis) -> list[str]:
    b, top = diagnosis.before, diagnosis.bottleneck
    lines = [diagnosis.title] if diagnosis.title else []
    lines += [
        f"From {b.source} to {b.sink}: median {b.p50_ms:.1f} ms, 99th percentile {b.p99_ms:.1f} ms "
        f"({diagnosis.budget.count} measurements)",
        f"Age of {b.source} behind a command: median {b.age_p50_ms:.1f} ms, 99th percentile {b.age_p99_ms:.1f} ms",
        "",
        f"Latency bottleneck: {top.name}, {top.mean_ms:.1f} of {b.mean_ms:.1f} ms ({top.share:.0%}): {KINDS[top.kind]}",
        *(f"    {line}" for line in top.evidence),
        f"Throughput: {diagnosis.throughput}",
    ]
    lines += [
        f"Deadline of {d.name}, {d.limit_ms:g} ms: missed {d.missed} of {d.count} times" for d in diagnosis.deadlines
    ]
    if top != diagnosis.causes[0]:
        first = diagnosis.causes[0]
        lines.append(
            f"    {first.name} is a larger part ({first.share:.0%}), but nothing that was tried against it helps."
        )
    lines += ["", "Where the time goes (mean):"]
    shown = [cause for cause in diagnosis.causes if cause.share >= 0.02][:7]
    lines += [f"  {cause.mean_ms:8.1f} ms {cause.share:5.0%}  {cause.name}" for cause in shown]
    rest = 1 - sum(cause.share for cause in shown)
    if rest > 0.005:
        lines.append(f"  {rest * b.mean_ms:8.1f} ms {rest:5.0%}  everything else")
    lines += ["", "What would help (the recorded pipeline run again with each change):"]
    for number, proposal in enumerate(diagnosis.proposals[:6], start=1):
        lines += _proposal(f"{number:3}. ", proposal)
    if not diagnosis.proposals:
        lines.append("  nothing that was tried")
    if diagnosis.useless:
        lines += ["", "What would not:"]
        for proposal in diagnosis.useless[:6]:
            lines += textwrap.wrap(_useless(proposal), 110, initial_indent="  - ", subsequent_indent="    ")
    if diagnosis.replay_error > 0.02:
        lines += ["", f"Caution: the replay misses the recorded median by {diagnosis.replay_error:.0%}."]
    return lines


def _proposal(head: str, p: Prediction) -> list[str]:
    effort = {"configuration": "a setting", "hardware": "other hardware or power mode", "code": "work on the code"}
    text = f"{p.change} [{effort[p.change.takes]}]"
    gain = (
        f"median {p.before.p50_ms:.1f} -> {p.after.p50_ms:.1f} ms ({-p.gain:+.0%}), 99th percentile "
        f"{p.before.p99_ms:.1f} -> {p.after.p99_ms:.1f} ms, fresh commands {p.before.fresh_hz:.1f} -> "
        f"{p.after.fresh_hz:.1f}/s"
    )
    lines = [*textwrap.wrap(text, 110, initial_indent=head, subsequent_indent=" " * 5), " " * 5 + gain]
    if p.slowest[1] > 1.1 * p.after.p50_ms:
        lines.append(f"     but then {p.slowest[0]} takes longest: median {p.slowest[1]:.1f} ms")
    return lines


def _useless(p: Prediction) -> str:
    verdict = "makes it worse" if p.gain < -WORTH else "changes the median"
    figures = f"{p.before.p50_ms:.1f} -> {p.after.p50_ms:.1f} ms"
    if abs(p.gain_ms) < 0.005 * p.before.p50_ms:
        text = f"{p.change}: no gain ({figures})"
    else:
        text = f"{p.change}: {verdict} {figures} ({-p.gain:+.0%})"
    if p.limit_ms is not None:
        text += f"; if it took no time at all, {p.limit_ms:.1f} of {p.before.mean_ms:.1f} ms would go (Amdahl)"
    return text
