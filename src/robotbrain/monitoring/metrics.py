"""The figures of a recorded run, exact: every call and every message is in the trace.

:func:`measure` gives the same :class:`~robotbrain.monitoring.summary.Summary` as a
:class:`~robotbrain.monitoring.monitor.Monitor` that watched the run, whose percentiles come from sketches.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from robotbrain.monitoring.chains import ChainAges, chain_ages, main_chains
from robotbrain.monitoring.deadlines import KIT_DEADLINES, Deadlines, Jitter, jitter_of
from robotbrain.monitoring.distribution import Distribution
from robotbrain.monitoring.queues import queue_timelines
from robotbrain.monitoring.summary import CallbackSummary, ChainSummary, QueueSummary, Summary, TopicSummary

if TYPE_CHECKING:
    from robotbrain.monitoring.trace import Trace
    from robotbrain.ros.context import CallbackRecord, MessageRecord

__all__ = ["KIT_DEADLINES", "Deadlines", "Distribution", "Jitter", "jitter_of", "measure", "rate_hz", "utilisation"]


def rate_hz(times_ns: ArrayLike) -> float:
    """Return events per second from the first to the last; NaN for fewer than two, or all at once."""
    times = np.asarray(times_ns, dtype=np.int64)
    span = int(times[-1] - times[0]) if len(times) > 1 else 0
    return (len(times) - 1) * 1e9 / span if span else math.nan


def measure(
    trace: Trace,
    deadlines: Deadlines | None = None,
    chains: Iterable[Sequence[str]] | None = None,
) -> Summary:
    """Return the figures of a run.

    Args:
        trace: of the run.
        deadlines: of its callbacks; those of the kit's brain by default.
        chains: whose ages are wanted; see :func:`~robotbrain.monitoring.chains.main_chains` by default.

    Raises:
        InputError: for a chain of fewer than two topics.
    """
    limits = KIT_DEADLINES if deadlines is None else deadlines
    groups: dict[tuple[str, str, str], list[CallbackRecord]] = defaultdict(list)
    for callback in trace.callbacks:
        groups[callback.node, callback.kind, callback.name].append(callback)
    for node, topic in {*trace.dropped, *trace.expired}:
        groups.setdefault((node, "subscription", topic), [])
    ages = chain_ages(trace, main_chains(trace) if chains is None else chains)
    return Summary(
        title=trace.title,
        clock="simulated",
        seconds=trace.seconds,
        callbacks=tuple(_callback(trace, key, groups[key], limits) for key in sorted(groups)),
        topics=_topics(trace),
        queues=tuple(
            QueueSummary(q.node, q.topic, q.limit, q.max_depth, q.mean_depth, q.dropped, q.expired)
            for q in queue_timelines(trace)
        ),
        chains=tuple(ChainSummary(found.chain, Distribution.of(found.age_ms)) for found in ages),
        utilisation=utilisation(trace),
        end_to_end=Distribution.of(_oldest(ages)),
    )


def _oldest(ages: Sequence[ChainAges]) -> ArrayLike:
    """Return the age of the oldest input of each command; chains to other topics than the first's are left out."""
    alike = [found.age_ms for found in ages if found.chain[-1] == ages[0].chain[-1]]
    return np.vstack(alike).max(axis=0) if alike else ()


def utilisation(trace: Trace) -> Mapping[str, float]:
    """Return the share of its capacity that each resource was busy with calls that ended, 0 to 1."""
    if not trace.capacity or trace.end_ns <= trace.start_ns:
        return {}
    busy = dict.fromkeys(trace.capacity, 0)
    for callback in trace.callbacks:
        for resource, length in callback.segments:
            busy[resource] += length
    length_ns = trace.end_ns - trace.start_ns
    return {name: total / (length_ns * trace.capacity[name]) for name, total in busy.items()}


def _callback(
    trace: Trace, key: tuple[str, str, str], calls: Sequence[CallbackRecord], deadlines: Deadlines
) -> CallbackSummary:
    node, kind, name = key
    role = trace.roles.get(node, "")
    ready, start, end, demand = (
        np.array([getattr(call, field) for call in calls], dtype=np.int64)
        for field in ("ready_ns", "start_ns", "end_ns", "demand_ns")
    )
    response = (end - ready) * 1e-6
    deadline = deadlines.of(node, role, kind, name)
    misses = 0
    if deadline is not None:
        misses = int(np.count_nonzero(response > deadline))
        if kind == "subscription":
            misses += trace.dropped.get((node, name), 0) + trace.expired.get((node, name), 0)
    periodic = kind in ("timer", "subscription")
    return CallbackSummary(
        node=node,
        role=role,
        kind=kind,
        name=name,
        calls=len(calls),
        rate_hz=rate_hz(start),
        latency=Distribution.of((end - start) * 1e-6),
        response=Distribution.of(response),
        queueing=Distribution.of((start - ready) * 1e-6),
        contention=Distribution.of((end - start - demand) * 1e-6),
        demand=_demand(calls),
        jitter=jitter_of(start, trace.periods_ns.get((node, name))) if periodic else Jitter(),
        age=Distribution.of(
            [(call.start_ns - trace.stamps[call.message]) * 1e-6 for call in calls if call.message in trace.stamps]
        ),
        deadline_ms=deadline,
        misses=misses,
    )


def _demand(calls: Sequence[CallbackRecord]) -> dict[str, Distribution]:
    found: dict[str, list[float]] = defaultdict(list)
    for call in calls:
        sums: dict[str, int] = defaultdict(int)
        for resource, length in call.segments:
            sums[resource] += length
        for resource, total in sums.items():
            found[resource].append(total * 1e-6)
    return {resource: Distribution.of(values) for resource, values in found.items()}


def _topics(trace: Trace) -> tuple[TopicSummary, ...]:
    groups: dict[str, list[MessageRecord]] = defaultdict(list)
    for message in trace.messages:
        if message.kind == "topic":
            groups[message.name].append(message)
    found = []
    for topic, messages in sorted(groups.items()):
        times = [message.released_ns for message in messages]
        mean = float(np.mean([message.size for message in messages]))
        found.append(TopicSummary(topic, len(messages), rate_hz(times), mean, jitter_of(times)))
    return tuple(found)
