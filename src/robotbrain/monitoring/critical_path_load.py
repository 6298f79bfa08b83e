"""How busy is everything, and what saturates first? The throughput side of a trace."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from robotbrain.errors import InputError
from robotbrain.monitoring.critical_path_blame import Place, place_of

if TYPE_CHECKING:
    from robotbrain.monitoring.trace import Trace
    from robotbrain.ros.context import MessageRecord


@dataclass(frozen=True, slots=True)
class StageLoad:
    """One callback of one node as a stage of the pipeline.

    Attributes:
        place: which.
        executor: number of its executor.
        runs: how often it ran.
        cycle_ms: median time between two starts, ms; infinite for a single run.
        service_ms: mean time from start to end, waiting for the device included, ms.
        demand_ms: mean time on an idle device, ms.
        offered_hz: messages that came for it, or calls that its timer owed, per second.
        served_hz: runs per second.
        waiting: messages or calls that waited for it on average (Little's law: their rate times their mean wait); those
            still waiting at the end are counted in.
        lost: messages that were dropped before it could take them.
        use: offered_hz times service_ms: the share of one thread that it needs to keep up; above 1 it cannot.
    """

    place: Place
    executor: int
    runs: int
    cycle_ms: float
    service_ms: float
    demand_ms: float
    offered_hz: float
    served_hz: float
    waiting: float
    lost: int
    use: float


@dataclass(frozen=True)
class Load:
    """How busy resources, threads and stages are.

    Attributes:
        resources: share of its capacity that each resource is used, 0 to 1, by name.
        workers: share of the time that each executor's thread is occupied (its waiting for the device included), 0 to
            1, by (executor, thread).
        threads: number of threads seen by executor.
        stages: by use, the largest first.
        nodes: names of the nodes on each executor.
    """

    resources: dict[str, float]
    workers: dict[tuple[int, int], float]
    threads: dict[int, int]
    stages: tuple[StageLoad, ...]
    nodes: dict[int, tuple[str, ...]]

    def executor_use(self, executor: int) -> float:
        """Return the mean share of the time that an executor's threads are occupied."""
        busy = [use for (number, _), use in self.workers.items() if number == executor]
        return sum(busy) / max(1, self.threads.get(executor, 1))

    @property
    def saturates_first(self) -> tuple[str, float]:
        """The resource or executor that is nearest to its limit, in words, and the share of it in use."""
        found = dict(self.resources)
        for executor in self.threads:
            names = ", ".join(self.nodes[executor])
            found[f"the thread of {names}" if self.threads[executor] == 1 else f"the threads of {names}"] = (
                self.executor_use(executor)
            )
        name = max(found, key=lambda key: (found[key], key))
        return name, found[name]

    @property
    def headroom(self) -> float:
        """How many times more of everything could come in before something saturates; below 1: it already does."""
        offered = max((stage.use for stage in self.stages), default=0.0)
        use = max(self.saturates_first[1], offered)
        return 1.0 / use if use else float("inf")

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {
            "resources": dict(self.resources),
            "workers": {f"{executor}.{worker}": use for (executor, worker), use in self.workers.items()},
            "saturates_first": list(self.saturates_first),
            "stages": [
                {
                    "callback": str(stage.place),
                    "executor": stage.executor,
                    "runs": stage.runs,
                    "cycle_ms": stage.cycle_ms if np.isfinite(stage.cycle_ms) else None,
                    "service_ms": stage.service_ms,
                    "demand_ms": stage.demand_ms,
                    "offered_hz": stage.offered_hz,
                    "served_hz": stage.served_hz,
                    "waiting": stage.waiting,
                    "lost": stage.lost,
                    "use": stage.use,
                }
                for stage in self.stages
            ],
        }


def load(trace: Trace) -> Load:
    """Return how busy everything was in a trace.

    Raises:
        InputError: for a trace without callbacks or of no length.
    """
    span = trace.end_ns - trace.start_ns
    if not trace.callbacks or span <= 0:
        raise InputError(
            "trace",
            given=f"{len(trace.callbacks)} callbacks in {span} ns",
            expected="a trace of a run",
            fix="Record while the simulation runs.",
        )
    demand: Counter[str] = Counter()
    busy: Counter[tuple[int, int]] = Counter()
    threads: dict[int, int] = {}
    names: dict[int, dict[str, None]] = {}
    for record in trace.callbacks:
        for resource, length in record.segments:
            demand[resource] += length
        busy[record.executor, record.worker] += record.end_ns - record.start_ns
        threads[record.executor] = max(threads.get(record.executor, 1), record.worker + 1)
        names.setdefault(record.executor, {})[record.node] = None
    resources = {name: demand[name] / (span * count) for name, count in trace.capacity.items()}
    return Load(
        resources,
        {worker: time / span for worker, time in sorted(busy.items())},
        threads,
        _stages(trace, span * 1e-9),
        {executor: tuple(nodes) for executor, nodes in names.items()},
    )


def _stages(trace: Trace, seconds: float) -> tuple[StageLoad, ...]:
    runs: dict[Place, list[int]] = {}
    for index, record in enumerate(trace.callbacks):
        runs.setdefault(place_of(record), []).append(index)
    published = Counter(message.name for message in trace.messages if message.kind == "topic")
    arrivals: dict[str, list[MessageRecord]] = {}
    for message in trace.messages:
        if message.kind == "topic":
            arrivals.setdefault(message.name, []).append(message)
    taken: dict[Place, set[int]] = {}
    for record in trace.callbacks:
        if record.kind == "subscription":
            taken.setdefault(place_of(record), set()).add(record.message)
    stages = []
    for place, indices in runs.items():
        records = [trace.callbacks[index] for index in indices]
        starts = np.array([record.start_ns for record in records])
        service = float(np.mean([record.end_ns - record.start_ns for record in records])) * 1e-6
        lost = trace.dropped.get((place.node, place.name), 0) if place.kind == "subscription" else 0
        offered = max(len(records), published[place.name]) if place.kind == "subscription" else len(records)
        # What still waits at the end has no record; unless queues are full it is what was neither taken nor lost.
        left = [m for m in arrivals.get(place.name, ()) if m.id not in taken[place]] if place in taken else []
        waits = sorted((trace.end_ns - m.released_ns) * 1e-9 for m in left)
        hanging = sum(waits[: max(0, len(waits) - lost)])
        stages.append(
            StageLoad(
                place,
                records[0].executor,
                len(records),
                float(np.median(np.diff(starts))) * 1e-6 if len(starts) > 1 else float("inf"),
                service,
                float(np.mean([record.demand_ns for record in records])) * 1e-6,
                offered / seconds,
                len(records) / seconds,
                sum(record.queued_ns for record in records) * 1e-9 / seconds + hanging / seconds,
                lost,
                offered / seconds * service * 1e-3,
            )
        )
    return tuple(sorted(stages, key=lambda stage: (-stage.use, stage.place)))
