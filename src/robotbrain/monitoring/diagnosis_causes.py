"""From pieces of latency to causes that have a name and somebody who can do something about them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from robotbrain.monitoring.critical_path_blame import Place

if TYPE_CHECKING:
    from robotbrain.monitoring.critical_path import Path, Span
    from robotbrain.monitoring.critical_path_load import Load, StageLoad
    from robotbrain.monitoring.whatif_model import Model

LARGE_BYTES = 1_000_000
"""Messages above this are called large: a VGA colour image has 0.92 MB."""

PILED_UP = 5.0
"""A queue in which more messages than this wait on average holds all of them up for long."""

DEEP = 30
"""Queues that hold fewer are not called deep: one that is full is a symptom of a busy thread, not the cause."""

KINDS: Mapping[str, str] = {
    "slow node": "its callback takes long on the CPU",
    "slow inference": "its work on an accelerator takes long",
    "slow service": "its answers take long",
    "stale queue": "messages wait for it behind older ones of their own topic",
    "serial executor": "nodes wait for each other's callbacks, because they share a thread",
    "busy node": "its callbacks wait for each other",
    "oversized input": "large messages take long to carry and to work on",
    "cpu contention": "there are more callbacks than CPU cores",
    "accelerator contention": "several nodes queue for one accelerator",
    "low timer rate": "inputs lie and wait until a timer fires",
    "unsynchronised inputs": "one input waits for another that it is joined with",
    "low input rate": "values are used again because no newer ones come",
    "transport": "messages take long on their way",
    "sensor latency": "measurements are published late",
}
"""Every kind of cause, and what it means."""


@dataclass(frozen=True)
class Finding:
    """One cause and what it costs.

    Attributes:
        kind: one of KINDS.
        culprit: node at fault; the topic of an oversized input, a transport or a sensor; for a serial executor empty.
        place: the callback that it shows in most, or whose work is waited for.
        resource: that it is about, e.g. ``gpu`` or ``executor 1``.
        mean_ms: mean contribution to the end-to-end latency, ms.
        share: of the mean end-to-end latency, 0 to 1.
        blamed: whose work is waited for, with mean ms each, the largest first.
        evidence: what shows it, in sentences with figures.
    """

    kind: str
    culprit: str
    place: Place
    resource: str
    mean_ms: float
    share: float
    blamed: tuple[tuple[Place, float], ...] = ()
    evidence: tuple[str, ...] = field(default=(), repr=False)

    @property
    def name(self) -> str:
        """The cause in a few words, e.g. ``slow inference in /detector``."""
        if self.kind == "serial executor":
            return f"serial executor ({self.resource})"
        if self.kind in ("slow node", "busy node"):
            return f"{self.kind} {self.culprit}"
        preposition = {"oversized input": "on", "transport": "of", "sensor latency": "of", "low input rate": "on"}
        word = preposition.get(self.kind, "by" if "contention" in self.kind else "in")
        return f"{self.kind} {word} {self.culprit}"

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {
            "kind": self.kind,
            "culprit": self.culprit,
            "callback": str(self.place),
            "resource": self.resource,
            "mean_ms": self.mean_ms,
            "share": self.share,
            "blamed": [[str(place), value] for place, value in self.blamed],
            "evidence": list(self.evidence),
        }


_Key = tuple[str, str, str]


class _Sum:
    """What one cause adds up to."""

    def __init__(self) -> None:
        self.total = 0.0
        self.places: dict[Place, float] = {}
        self.blamed: dict[Place, float] = {}

    def add(self, place: Place, by: Place | None, value: float) -> None:
        self.total += value
        self.places[place] = self.places.get(place, 0.0) + value
        if by is not None:
            self.blamed[by] = self.blamed.get(by, 0.0) + value


def find_causes(paths: Sequence[Path], model: Model, load: Load) -> tuple[Finding, ...]:
    """Return what the latency of these paths is due to, the largest first; contributions add up to its mean."""
    sums: dict[_Key, _Sum] = {}
    total = 0.0
    naming = _Naming(model, load)
    for path in paths:
        for span in path.spans:
            total += span.length_ns
            for key, place, share in naming.name(span):
                sums.setdefault(key, _Sum()).add(place, span.by, span.length_ns * share)
    count = max(1, len(paths))
    findings = []
    for (kind, culprit, resource), found in sums.items():
        blamed = sorted(found.blamed.items(), key=lambda item: (-item[1], item[0]))
        place = max(found.places, key=lambda p: (found.places[p], p))
        if kind == "stale queue":
            # Others may wait behind it as well; what can be done is done to the queue itself.
            place = Place(culprit, "subscription", resource)
        if "contention" in kind and blamed:
            culprit = blamed[0][0].node
        mean = found.total / count * 1e-6
        shown = tuple((p, value / count * 1e-6) for p, value in blamed[:5])
        draft = Finding(kind, culprit, place, resource, mean, found.total / total if total else 0.0, shown)
        findings.append(Finding(kind, culprit, place, resource, mean, draft.share, shown, naming.evidence(draft)))
    return tuple(sorted(findings, key=lambda f: (-f.mean_ms, f.kind, f.culprit)))


def _backlogs(model: Model, load: Load) -> dict[int, Place]:
    """Return, for each executor in which messages pile up in a deep queue, the subscription whose queue it is."""
    depths = {place: stage.depth for place, stage in model.stages.items()}
    found: dict[int, StageLoad] = {}
    for stage in load.stages:
        known = found.get(stage.executor)
        depth = depths.get(stage.place)
        deep = stage.place.kind == "subscription" and (depth is None or depth >= DEEP)
        if deep and stage.waiting > (known.waiting if known else PILED_UP):
            found[stage.executor] = stage
    return {executor: stage.place for executor, stage in found.items()}


class _Naming:
    """Gives spans their names, and findings their evidence."""

    def __init__(self, model: Model, load: Load) -> None:
        self._model, self._load = model, load
        self._stage = {stage.place: stage for stage in load.stages}
        self._size: dict[str, float] = {name: size for name, (size, _) in model.transport.typical.items()}
        self._by_size: dict[tuple[Place, str], float] = {}
        self._behind = _backlogs(model, load)

    def name(self, span: Span) -> list[tuple[_Key, Place, float]]:
        """Return the causes of a span: (kind, culprit, resource), place and share."""
        place, resource = span.place, span.resource
        if span.cause == "execution":
            return self._execution(place, resource)
        if span.cause == "contention":
            kind = "cpu contention" if resource == "cpu" else "accelerator contention"
            return [((kind, "", resource), place, 1.0)]
        if span.cause == "queueing":
            return [(self._queueing(place, span.by, resource), place, 1.0)]
        if span.cause == "transport":
            kind = "oversized input" if self._size.get(resource, 0) >= LARGE_BYTES else "transport"
            return [((kind, resource, ""), place, 1.0)]
        if span.cause == "sensor":
            return [(("sensor latency", resource, ""), place, 1.0)]
        if span.cause == "holding":
            return [(("low input rate", resource, ""), place, 1.0)]
        if span.cause == "sampling":
            kind = "low timer rate" if place.kind == "timer" else "unsynchronised inputs"
            return [((kind, place.node, ""), place, 1.0)]
        return [(self._lost(place), place, 1.0)]

    def _execution(self, place: Place, resource: str) -> list[tuple[_Key, Place, float]]:
        plain = self._working(place, resource)
        size = self._size.get(place.name, 0.0) if place.kind == "subscription" else 0.0
        if size < LARGE_BYTES:
            return [(plain, place, 1.0)]
        key = (place, resource)
        if key not in self._by_size:
            self._by_size[key] = self._model.stages[place].by_size(resource) if place in self._model.stages else 0.0
        share = self._by_size[key]
        return [(("oversized input", place.name, ""), place, share), (plain, place, 1 - share)]

    @staticmethod
    def _working(place: Place, resource: str) -> _Key:
        if resource != "cpu":
            return ("slow inference", place.node, resource)
        return ("slow service" if place.kind == "service" else "slow node", place.node, resource)

    def _queueing(self, place: Place, by: Place | None, resource: str) -> _Key:
        backlog = self._behind.get(int(resource.rpartition(" ")[2]))
        if backlog is not None:
            # All on this thread wait behind the messages that lie in one queue.
            return ("stale queue", backlog.node, backlog.name)
        if by is not None and by.node != place.node:
            return ("serial executor", "", resource)
        if by == place and place.kind == "subscription":
            stage = self._model.stages.get(place)
            if stage is not None and stage.depth == 1:
                # The newest message waits for the one before it: no queue can be shorter.
                return self._working(place, self._heaviest(place))
            return ("stale queue", place.node, place.name)
        if by == place and place.kind == "service":
            return ("slow service", place.node, "cpu")
        return ("busy node", place.node, resource)

    def _lost(self, place: Place) -> _Key:
        """Name why a measurement was overtaken by a newer one on its way to a callback."""
        if place.kind == "timer":
            return ("low timer rate", place.node, "")
        if place.kind in ("service", "client"):
            return ("slow service", place.node, "cpu")
        stage = self._stage.get(place)
        if stage is not None and stage.executor in self._behind:
            backlog = self._behind[stage.executor]
            return ("stale queue", backlog.node, backlog.name)
        if stage is not None and self._shares(stage.executor, place):
            return ("serial executor", "", f"executor {stage.executor}")
        return self._working(place, self._heaviest(place))

    def _shares(self, executor: int, place: Place) -> bool:
        """Tell whether others keep a callback's executor busier than it does itself."""
        busy: dict[bool, float] = {True: 0.0, False: 0.0}
        for stage in self._load.stages:
            if stage.executor == executor:
                busy[stage.place.node == place.node] += stage.served_hz * stage.service_ms
        return busy[False] > busy[True]

    def _heaviest(self, place: Place) -> str:
        stage = self._model.stages.get(place)
        totals: dict[str, int] = {"cpu": 0}
        for activation in stage.history.activations if stage is not None else ():
            for resource, length in activation.segments:
                totals[resource] = totals.get(resource, 0) + length
        return max(totals, key=lambda resource: (totals[resource], resource))

    # ------------------------------------------------------------ evidence

    def evidence(self, finding: Finding) -> tuple[str, ...]:
        """Return the figures that show a cause, in sentences."""
        place, kind = finding.place, finding.kind
        stage = self._stage.get(place)
        lines: list[str] = []
        if kind in ("slow node", "slow service", "slow inference") and stage is not None:
            lines.append(self._work(place, finding.resource))
            lines.append(
                f"It is wanted {stage.offered_hz:.1f} times a second, runs {stage.served_hz:.1f} times and needs "
                f"{stage.use:.0%} of a thread to keep up."
            )
        elif kind == "stale queue" and stage is not None:
            depth = self._model.stages[place].depth if place in self._model.stages else None
            waits = "any number of messages" if depth is None else f"{depth} messages"
            lines.append(
                f"{place.name} brings {stage.offered_hz:.1f} messages a second, {place.node} takes "
                f"{stage.service_ms:.1f} ms for each: {stage.use:.0%} of a thread. {waits.capitalize()} may wait."
            )
        elif kind in ("serial executor", "busy node") and stage is not None:
            nodes = self._load.nodes.get(stage.executor, ())
            use = self._load.executor_use(stage.executor)
            lines.append(f"{', '.join(nodes)} share {finding.resource}, which is busy {use:.0%} of the time.")
        elif kind == "oversized input":
            size = self._size.get(finding.culprit, 0.0)
            lines.append(f"A message on {finding.culprit} has {size / 1e6:.1f} MB.")
        elif "contention" in kind:
            use = self._load.resources.get(finding.resource, float("nan"))
            count = self._model.capacity.get(finding.resource, 1)
            what = f"{count} CPU cores are" if finding.resource == "cpu" else f"The {finding.resource.upper()} is"
            lines.append(f"{what} busy {use:.0%} of the time.")
        elif kind == "low timer rate":
            timer = self._model.stages.get(place)
            if timer is not None and timer.period_ns:
                lines.append(f"Its timer {place.name} fires every {timer.period_ns * 1e-6:.1f} ms.")
        if finding.blamed and kind not in ("stale queue", "slow service"):
            lines.append("Waited for: " + ", ".join(f"{by} {value:.1f} ms" for by, value in finding.blamed[:3]) + ".")
        return tuple(lines)

    def _work(self, place: Place, resource: str) -> str:
        stage = self._model.stages.get(place)
        times = [
            sum(length for name, length in activation.segments if name == resource) * 1e-6
            for activation in (stage.history.activations if stage is not None else ())
        ]
        if not times:
            return f"Its callback {place.kind} {place.name} does the work."
        return (
            f"Its {place.kind} {place.name} takes {np.median(times):.1f} ms of {resource.upper()} "
            f"(99th percentile {np.percentile(times, 99):.1f} ms)."
        )
