"""From a trace to the model of its pipeline; see :mod:`robotbrain.monitoring.whatif_model` for the rules."""

from __future__ import annotations

import bisect
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from robotbrain.errors import InputError
from robotbrain.monitoring.critical_path_blame import Place, place_of
from robotbrain.monitoring.whatif_model import (
    Activation,
    History,
    Injected,
    Model,
    Send,
    Stage,
    Transport,
    timer_grid,
)

if TYPE_CHECKING:
    from robotbrain.monitoring.trace import Trace
    from robotbrain.ros.context import CallbackRecord, MessageRecord


ROUNDING_NS = 1000
"""Latencies that differ by less are taken as alike, ns."""


def stage_of(trace: Trace, record: CallbackRecord) -> Place:
    """Return the stage that a record belongs to; the parts of a coroutine after the first are one of their own."""
    message = trace.message_by_id.get(record.message)
    if message is not None and message.kind == "response" and record.kind != "client":
        return Place(record.node, "resumed", record.name)
    return place_of(record)


def infer_model(trace: Trace) -> Model:
    """Return the model of the pipeline that a trace was recorded from.

    Raises:
        InputError: for a trace without callbacks.
    """
    if not trace.callbacks:
        raise InputError("trace", given="no callbacks", expected="a trace of a run", fix="Record while it runs.")
    by_place: dict[Place, list[CallbackRecord]] = {}
    for record in trace.callbacks:
        by_place.setdefault(stage_of(trace, record), []).append(record)
    roots = _roots(trace)
    transport = _transport(trace)
    groups = _groups(trace, by_place)
    threads: dict[int, int] = {}
    stages: dict[Place, Stage] = {}
    for place, records in by_place.items():
        executor = records[-1].executor
        threads[executor] = max([threads.get(executor, 1), *(record.worker + 1 for record in records)])
        period, first = _grid(trace, place, records)
        history = History([_activation(trace, record, roots[record.id]) for record in records])
        stages[place] = Stage(
            place,
            executor,
            groups.get(place, 0),
            _depth(trace, place, records, transport),
            period,
            first,
            history,
            closed_loop=_closed_loop(trace, place, records),
        )
    return Model(
        trace.start_ns,
        trace.end_ns,
        stages,
        threads,
        dict(trace.capacity),
        transport,
        _injected(trace, by_place, stages),
        _stamps(trace, roots),
        _disturbed(trace, roots, transport),
    )


def _grid(trace: Trace, place: Place, records: Sequence[CallbackRecord]) -> tuple[int, int]:
    """Return (period, first time) of a timer; (0, 0) for anything else, and for a timer that kept no grid."""
    if place.kind != "timer":
        return 0, 0
    due = [record.ready_ns for record in records]
    if len(set(due)) < len(due):
        # Several timers whose callbacks have one name: each run is replayed at its recorded time.
        return 0, 0
    period = trace.periods_ns.get((place.node, place.name), 0)
    if period and all((time - due[0]) % period == 0 for time in due) and len(due) > 1:
        return period, due[0]
    return timer_grid(due)


def _roots(trace: Trace) -> dict[int, int]:
    """Return the root of every callback, by its id, ns."""
    roots: dict[int, int] = {}
    for record in trace.callbacks:
        message = trace.message_by_id.get(record.message)
        if message is None:
            roots[record.id] = record.ready_ns
            continue
        sender = trace.sender.get(message.id)
        roots[record.id] = message.released_ns if sender is None else roots.get(sender.id, message.released_ns)
    return roots


def _stamps(trace: Trace, roots: Mapping[int, int]) -> dict[tuple[str, int], int]:
    found = {}
    for message in trace.messages:
        stamp = trace.stamps.get(message.id)
        if stamp is not None:
            sender = trace.sender.get(message.id)
            root = message.released_ns if sender is None else roots[sender.id]
            found[message.name, root] = stamp
    return found


def _activation(trace: Trace, record: CallbackRecord, root_ns: int) -> Activation:
    sends = []
    for number in record.published:
        message = trace.message_by_id.get(number)
        if message is not None:
            to = ""
            if message.kind == "response":
                to = next((taker.node for taker in trace.takers.get(number, ()) if taker.kind == "client"), "")
            sends.append(Send(message.kind, message.name, message.size, message.type_name, to))
    taken = trace.message_by_id.get(record.message)
    if record.kind == "client":
        for other in trace.takers.get(record.message, ()):
            if other.kind != "client":
                sends.append(Send("resume", other.name, 0, "", other.node))
    return Activation(root_ns, record.segments, tuple(sends), 0 if taken is None else taken.size)


def _transport(trace: Trace) -> Transport:
    seen: dict[str, list[tuple[int, int]]] = {}
    for record in trace.callbacks:
        message = trace.message_by_id.get(record.message)
        if message is not None and stage_of(trace, record).kind != "resumed":
            seen.setdefault(message.name, []).append((message.size, record.ready_ns - message.released_ns))
    typical = {
        name: (float(np.median([size for size, _ in rows])), float(np.median([time for _, time in rows])))
        for name, rows in seen.items()
    }
    rows = np.array([row for found in seen.values() for row in found], dtype=float).reshape(-1, 2)
    slope = 0.0
    if len(rows) and rows[:, 0].std() > 0 and rows[:, 1].std() > 0:
        slope = max(0.0, float(np.cov(rows.T, bias=True)[0, 1] / rows[:, 0].var()))
    for name, found in seen.items():
        size, latency = typical[name]
        # What comes later than the quickest of its kind was delayed on its way, see _disturbed.
        early = min(time - latency - slope * (bytes_ - size) for bytes_, time in found)
        if early < -ROUNDING_NS:
            typical[name] = size, latency + early
    return Transport(typical, slope)


def _disturbed(trace: Trace, roots: Mapping[int, int], transport: Transport) -> dict[tuple[str, int], int | None]:
    """Return what happened to messages on their way: a further delay in ns, or None for one that got lost.

    A message is lost if nobody who takes its topic took it, though no queue dropped any and later ones were taken.
    """
    last_taken: dict[str, int] = {}
    for message in trace.messages:
        if message.kind == "topic" and message.id in trace.takers:
            last_taken[message.name] = message.id
    full = {topic for (_, topic), count in (*trace.dropped.items(), *trace.expired.items()) if count}
    found: dict[tuple[str, int], int | None] = {}
    for message in trace.messages:
        if message.kind != "topic" or message.name not in last_taken:
            continue
        sender = trace.sender.get(message.id)
        key = (message.name, message.released_ns if sender is None else roots[sender.id])
        takers = trace.takers.get(message.id)
        if takers:
            expected = transport.latency_ns(message.name, message.size)
            late = min(record.ready_ns for record in takers) - message.released_ns - expected
            if late > ROUNDING_NS:
                found[key] = late
        elif message.name not in full and message.id < last_taken[message.name]:
            found[key] = None
    return found


def _groups(trace: Trace, by_place: Mapping[Place, Sequence[CallbackRecord]]) -> dict[Place, int | None]:
    """Return the callback group of every stage whose group is not the node's default one."""
    spans: dict[str, list[tuple[int, int, Place]]] = {}
    for place, records in by_place.items():
        spans.setdefault(place.node, []).extend((r.start_ns, r.end_ns, place) for r in records if r.end_ns > r.start_ns)
    groups: dict[Place, int | None] = {}
    for rows in spans.values():
        rows.sort()
        running: list[tuple[int, Place]] = []
        apart: dict[Place, bool] = {}
        for begin, end, place in rows:
            running = [(until, other) for until, other in running if until > begin]
            for _, other in running:
                apart[place] = apart.get(place, False) or other == place
                apart.setdefault(other, False)
            running.append((end, place))
        for number, (place, reentrant) in enumerate(apart.items(), start=1):
            groups[place] = None if reentrant else number
    return groups


def _depth(trace: Trace, place: Place, records: Sequence[CallbackRecord], transport: Transport) -> int | None:
    """Return the depth of a subscription's queue: a full one holds just so many when its oldest is taken next."""
    if place.kind == "subscription" and trace.queue_limits:
        return trace.queue_limits.get((place.node, place.name))
    if place.kind != "subscription" or not trace.dropped.get((place.node, place.name)):
        return 10 if place.kind == "service" else None
    taken = {record.message: record for record in records}
    arrivals = []
    for message in trace.messages:
        if message.kind == "topic" and message.name == place.name:
            record = taken.get(message.id)
            arrived = message.released_ns + transport.latency_ns(place.name, message.size)
            arrivals.append((arrived if record is None else record.ready_ns, record))
    times = [time for time, _ in arrivals]
    depths = [
        bisect.bisect_right(times, record.start_ns) - index
        for index, (_, record) in enumerate(arrivals)
        if record is not None and index and arrivals[index - 1][1] is None
    ]
    return max(depths) if depths else 1


def _closed_loop(trace: Trace, place: Place, records: Sequence[CallbackRecord]) -> str:
    """Return the service that a callback calls just when no answer is outstanding, or ``""``."""
    services = {
        message.name
        for record in records
        for number in record.published
        if (message := trace.message_by_id.get(number)) is not None and message.kind == "request"
    }
    if len(services) != 1:
        return ""
    service = services.pop()
    calls = [m for m in trace.messages if m.kind == "request" and m.name == service and m.node == place.node]
    answers = sorted(
        record.start_ns
        for record in trace.callbacks
        if record.kind == "client" and record.name == service and record.node == place.node
    )
    sent = {message.id for message in calls}
    started = sorted(
        record.start_ns for record in trace.callbacks if record.node == place.node and sent & set(record.published)
    )
    skipped = free = 0
    for record in records:
        # What was sent by earlier callbacks, less what has been answered.
        out = bisect.bisect_left(started, record.start_ns) - bisect.bisect_right(answers, record.start_ns)
        called = bool(sent & set(record.published))
        if out > 0 and called:
            return ""
        skipped += out > 0
        free += out <= 0 and not called and bool(started) and record.start_ns > started[0]
    return service if skipped and free <= 0.02 * len(records) else ""


def _injected(
    trace: Trace, by_place: Mapping[Place, Sequence[CallbackRecord]], stages: Mapping[Place, Stage]
) -> tuple[Injected, ...]:
    found = []
    for message in trace.messages:
        if message.id not in trace.sender and _from_outside(trace, message):
            send = Send(message.kind, message.name, message.size, message.type_name)
            found.append(Injected(message.released_ns, message.node, send))
    for place, records in by_place.items():
        if place.kind == "timer" and not stages[place].period_ns:
            found += [Injected(r.ready_ns, place.node, Send("", "", 0, ""), place) for r in records]
    return tuple(sorted(found, key=lambda injected: injected.time_ns))


def _from_outside(trace: Trace, message: MessageRecord) -> bool:
    # A callback that was running when the recording ended has no record, but its messages may.
    return message.kind in ("topic", "request") and bool(trace.takers.get(message.id))
