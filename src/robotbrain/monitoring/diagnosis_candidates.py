"""What could be done about a cause: changes worth trying in a replay."""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

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
    from robotbrain.monitoring.critical_path import Path
    from robotbrain.monitoring.critical_path_blame import Place
    from robotbrain.monitoring.critical_path_load import Load
    from robotbrain.monitoring.diagnosis_causes import Finding
    from robotbrain.monitoring.whatif_model import Model

FASTEST_TIMER_HZ = 200.0
"""No timer is proposed to fire more often than this."""


def candidates(
    finding: Finding, paths: Sequence[Path], model: Model, load: Load, options: Iterable[Change] = ()
) -> list[Change]:
    """Return what could be done about a cause, the nearest first.

    Args:
        finding: the cause.
        paths: the latency that it is part of.
        model, load: of the pipeline.
        options: changes that are known to be possible: where one speeds up the same work, no guess is added.
    """
    kind, place = finding.kind, finding.place
    if kind in ("slow node", "slow inference", "slow service"):
        return _quicker(place, finding.resource, options)
    if kind == "stale queue":
        return [QueueDepth(place.node, place.name, 1), *_quicker(place, None, options)]
    if kind == "serial executor":
        return _apart(finding, model)
    if kind == "busy node":
        blamed = [by for by, _ in finding.blamed if by != place]
        return [change for by in blamed[:1] for change in _quicker(by, None, options)]
    if kind == "oversized input":
        known = [c for c in options if isinstance(c, SmallerMessages) and c.topic == finding.culprit]
        return [] if known else [SmallerMessages(finding.culprit, 0.25)]
    if "contention" in kind:
        return _relief(finding, paths, model, options)
    if kind == "low timer rate" and place.kind == "timer":
        return _timers(place, paths, model, load)
    return []


def addresses(change: Change, finding: Finding) -> bool:
    """Tell whether a change is one against this cause."""
    kind, place = finding.kind, finding.place
    if isinstance(change, Together):
        return any(addresses(part, finding) for part in change.changes)
    if isinstance(change, Faster):
        if kind in ("slow node", "slow inference", "slow service"):
            return change.touches(place) and change.resource in (None, finding.resource)
        return kind in ("stale queue", "busy node") and change.touches(place)
    if isinstance(change, OwnExecutor | Threads):
        return kind == "serial executor"
    if isinstance(change, QueueDepth):
        return kind == "stale queue" and (change.node, change.topic) == (place.node, place.name)
    if isinstance(change, SmallerMessages):
        return kind == "oversized input" and change.topic == finding.culprit
    if isinstance(change, TimerRate | TimerPhase):
        return kind == "low timer rate" and change.node == place.node
    if isinstance(change, MoveTo):
        return kind in ("slow inference", "accelerator contention")
    if isinstance(change, Without):
        return "contention" in kind
    if isinstance(change, Device):
        return "contention" in kind or kind in ("slow node", "slow inference", "slow service")
    return False


def _quicker(place: Place, resource: str | None, options: Iterable[Change]) -> list[Change]:
    for option in options:
        if isinstance(option, Faster) and option.touches(place) and resource in (None, option.resource or resource):
            return []
    return [Faster(place.node, 2.0, resource, place.kind, place.name)]


def _apart(finding: Finding, model: Model) -> list[Change]:
    executor = int(finding.resource.rpartition(" ")[2])
    nodes = sorted({place.node for place, stage in model.stages.items() if stage.executor == executor})
    found: list[Change] = [OwnExecutor()]
    if finding.blamed:
        found.append(OwnExecutor((finding.blamed[0][0].node,)))
    found.append(Threads(nodes[0], len(nodes)))
    return found


def _relief(finding: Finding, paths: Sequence[Path], model: Model, options: Iterable[Change]) -> list[Change]:
    on_path = {span.place.node for path in paths for span in path.spans}
    blamed = finding.blamed[0][0] if finding.blamed else finding.place
    found: list[Change] = []
    if blamed.node not in on_path:
        found.append(Without(blamed.node))
    else:
        found += _quicker(blamed, finding.resource, options)
    if finding.resource == "cpu":
        found.append(Device(cores=2 * model.capacity.get("cpu", 1), name="twice the cores"))
    elif "dla0" in model.capacity and finding.resource == "gpu":
        found.append(MoveTo(blamed.node, "dla0"))
    return found


def _timers(place: Place, paths: Sequence[Path], model: Model, load: Load) -> list[Change]:
    timer = model.stages.get(place)
    if timer is None or not timer.period_ns:
        return []
    hz = 1e9 / timer.period_ns
    stage = next((stage for stage in load.stages if stage.place == place), None)
    busy_ms = stage.service_ms if stage is not None else 0.0
    inputs = [s.offered_hz for s in load.stages if s.place.node == place.node and s.place.kind == "subscription"]
    wanted = max(2 * hz, min(2 * max(inputs, default=hz), 8 * hz))
    most = min(FASTEST_TIMER_HZ, 1e3 / (2 * busy_ms) if busy_ms else FASTEST_TIMER_HZ)
    found: list[Change] = []
    if min(wanted, most) > 1.2 * hz:
        found.append(TimerRate(place.node, place.name, min(wanted, most)))
    later = best_phase_ms(place, paths, timer.period_ns)
    if later is not None:
        found.append(TimerPhase(place.node, place.name, later))
    return found


def best_phase_ms(place: Place, paths: Sequence[Path], period_ns: int) -> float | None:
    """Return by how much later a timer would find its inputs just arrived, ms.

    None if they come at no particular time of the timer's period (mean resultant length of their phases below 0.8;
    Mardia and Jupp, "Directional Statistics"), or just before it fires anyway.
    """
    waits = [
        span.length_ns for path in paths for span in path.spans if span.place == place and span.cause == "sampling"
    ]
    if len(waits) < 10:
        return None
    # How long after a call of the timer the input came, as a direction.
    angles = [2 * math.pi * ((-wait) % period_ns) / period_ns for wait in waits]
    mean = sum(cmath.exp(1j * angle) for angle in angles) / len(angles)
    if abs(mean) < 0.8:
        return None
    middle = cmath.phase(mean)
    spread = sorted((angle - middle + math.pi) % (2 * math.pi) - math.pi for angle in angles)
    # All but the latest 2 % should have come, and 2 % of a period is left for luck.
    latest = middle + spread[int(0.98 * (len(spread) - 1))] + 0.02 * 2 * math.pi
    later = latest / (2 * math.pi) % 1 * period_ns * 1e-6
    wait_ms = sum(waits) / len(waits) * 1e-6
    return later if wait_ms > 0.1 * period_ns * 1e-6 and later < 0.95 * period_ns * 1e-6 else None
