"""A trace as a file for ``ui.perfetto.dev`` or ``chrome://tracing``: the Trace Event format, JSON.

A process for each node, with a thread for each worker that ran it; a process for the device, with a lane for each
piece of CPU work side by side, the GPU and the DLAs; arrows from the callback that published a message to those that
took it; counters of queues and of what is busy; marks where messages were lost and deadlines missed.

Times are in microseconds from the start of the recording, with three decimals: to the nanosecond.

Source: "Trace Event Format", the Chromium project's document, 2016; Perfetto's documentation of what it imports.
"""

from __future__ import annotations

import gzip
import json
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from robotbrain.errors import InputError
from robotbrain.files import write_bytes
from robotbrain.monitoring.chains import label_of
from robotbrain.monitoring.critical_path_device import lay_out
from robotbrain.monitoring.deadlines import KIT_DEADLINES, Deadlines
from robotbrain.monitoring.queues import queue_timelines

if TYPE_CHECKING:
    from robotbrain.monitoring.resources import Reading
    from robotbrain.monitoring.trace import Trace
    from robotbrain.ros.context import CallbackRecord

Event = dict[str, Any]

_DEVICE = "device"
_ORDER = {"M": 0, "C": 1, "X": 2, "i": 3, "s": 4, "t": 5, "f": 6}


def write_perfetto(
    trace: Trace,
    path: str | Path,
    *,
    deadlines: Deadlines | None = None,
    readings: Sequence[Reading] = (),
    by: Literal["node", "executor"] = "node",
) -> Path:
    """Write a trace for Perfetto, whole or not at all; return the path.

    Args:
        trace: of a run.
        path: of the file; compressed if it ends in ``.gz`` (Perfetto opens that too).
        deadlines: of the callbacks; those of the kit's brain by default.
        readings: of the machine, as counters; their times are seconds on the trace's clock.
        by: what becomes a process.

    Raises:
        InputError: for a place that cannot be written to, or another ``by``.
    """
    target = Path(path)
    events = perfetto_events(trace, deadlines=deadlines, readings=readings, by=by)
    document = {"displayTimeUnit": "ms", "otherData": {"title": trace.title}, "traceEvents": events}
    data = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    if target.suffix == ".gz":
        # Without the time of day, the same trace gives the same bytes.
        data = gzip.compress(data, mtime=0)
    try:
        return write_bytes(target, data)
    except OSError as error:
        raise InputError(
            "trace file", given=str(path), expected="a place that can be written to", fix=str(error)
        ) from error


def perfetto_events(
    trace: Trace,
    *,
    deadlines: Deadlines | None = None,
    readings: Sequence[Reading] = (),
    by: Literal["node", "executor"] = "node",
) -> list[Event]:
    """Return a trace's events, in the order of their times; see :func:`write_perfetto`.

    Raises:
        InputError: for another ``by``.
    """
    if by not in ("node", "executor"):
        raise InputError("by", given=by, expected="'node' or 'executor'", fix="Choose one of the two.")
    writer = _Writer(trace, KIT_DEADLINES if deadlines is None else deadlines, by)
    writer.callbacks()
    writer.device()
    writer.queues()
    writer.readings(readings)
    events = sorted(writer.events, key=lambda event: (event["ts"], _ORDER[event["ph"]], -event.get("dur", 0.0)))
    return writer.names() + events


class _Writer:
    def __init__(self, trace: Trace, deadlines: Deadlines, by: str) -> None:
        self.trace, self.deadlines, self.by = trace, deadlines, by
        self.events: list[Event] = []
        self._processes: dict[str, int] = {}
        self._threads: dict[tuple[int, str], int] = {}
        self._labels: dict[str, str] = {}

    def us(self, time_ns: int) -> float:
        return round((time_ns - self.trace.start_ns) / 1000, 3)

    def process(self, key: str, label: str) -> int:
        self._labels[key] = label
        return self._processes.setdefault(key, len(self._processes) + 1)

    def thread(self, process: int, label: str) -> int:
        return self._threads.setdefault((process, label), len(self._threads) + 1)

    def names(self) -> list[Event]:
        events: list[Event] = []
        for index, (key, pid) in enumerate(self._processes.items()):
            base = {"ph": "M", "pid": pid, "tid": 0, "ts": 0.0}
            events.append({**base, "name": "process_name", "args": {"name": self._labels[key]}})
            events.append({**base, "name": "process_sort_index", "args": {"sort_index": index}})
        for (pid, label), tid in self._threads.items():
            events.append(
                {"ph": "M", "pid": pid, "tid": tid, "ts": 0.0, "name": "thread_name", "args": {"name": label}}
            )
        return events

    # ------------------------------------------------------------ callbacks and messages

    def place(self, callback: CallbackRecord) -> tuple[int, int]:
        if self.by == "node":
            role = self.trace.roles.get(callback.node, "")
            process = self.process(callback.node, callback.node + (f" ({role})" if role else ""))
            label = f"executor {callback.executor}, worker {callback.worker}"
        else:
            nodes = self._nodes_by_executor().get(callback.executor, [])
            process = self.process(f"executor {callback.executor}", f"executor {callback.executor}: {', '.join(nodes)}")
            label = f"worker {callback.worker}"
        return process, self.thread(process, label)

    def _nodes_by_executor(self) -> dict[int, list[str]]:
        if not hasattr(self, "_by_executor"):
            found: dict[int, dict[str, None]] = defaultdict(dict)
            for callback in self.trace.callbacks:
                found[callback.executor][callback.node] = None
            self._by_executor = {number: list(nodes) for number, nodes in found.items()}
        return self._by_executor

    def callbacks(self) -> None:
        trace = self.trace
        for callback in trace.callbacks:
            pid, tid = self.place(callback)
            arguments: dict[str, Any] = {
                "id": callback.id,
                "waited_ms": callback.queued_ns * 1e-6,
                "contention_ms": callback.contention_ns * 1e-6,
                "demand_ms": callback.demand_ns * 1e-6,
            }
            stamp = trace.stamps.get(callback.message)
            if stamp is not None:
                arguments["age_ms"] = (callback.start_ns - stamp) * 1e-6
            begin, end = self.us(callback.start_ns), self.us(callback.end_ns)
            self.events.append(
                {
                    "name": f"{callback.kind} {callback.name}",
                    "cat": callback.kind,
                    "ph": "X",
                    "ts": begin,
                    "dur": round(end - begin, 3),
                    "pid": pid,
                    "tid": tid,
                    "args": arguments,
                }
            )
            limit = self.deadlines.of(callback.node, trace.roles.get(callback.node, ""), callback.kind, callback.name)
            if limit is not None and callback.end_ns - callback.ready_ns > limit * 1e6:
                self.mark("deadline missed", end, pid, tid, {"deadline_ms": limit, "callback": callback.name})
            self.arrow(callback, pid, tid)

    def arrow(self, callback: CallbackRecord, pid: int, tid: int) -> None:
        message = self.trace.message_by_id.get(callback.message)
        sender = self.trace.sender.get(callback.message)
        if message is None or sender is None:
            return
        # One arrow for each taker. It has to begin within the sender's slice, which is open at its end.
        common = {"name": label_of(message), "cat": "message", "id": callback.id}
        begin = max(sender.start_ns, sender.end_ns - 1)
        from_pid, from_tid = self.place(sender)
        self.events.append({**common, "ph": "s", "ts": self.us(begin), "pid": from_pid, "tid": from_tid})
        self.events.append({**common, "ph": "f", "bp": "e", "ts": self.us(callback.start_ns), "pid": pid, "tid": tid})

    def mark(self, name: str, ts: float, pid: int, tid: int, arguments: dict[str, Any]) -> None:
        self.events.append(
            {"name": name, "cat": "trouble", "ph": "i", "s": "t", "ts": ts, "pid": pid, "tid": tid, "args": arguments}
        )

    # ------------------------------------------------------------ device, queues, machine

    def device(self) -> None:
        trace = self.trace
        if not trace.capacity:
            return
        pid = self.process(_DEVICE, "device: " + ", ".join(f"{n} × {c}" for n, c in trace.capacity.items()))
        by_id = {callback.id: callback for callback in trace.callbacks}
        lanes: dict[str, list[int]] = defaultdict(list)
        load: dict[str, list[tuple[int, int]]] = defaultdict(list)
        pieces = [(piece, by_id[number]) for number, found in lay_out(trace).items() for piece in found]
        pieces.sort(key=lambda entry: (entry[0].served_from_ns, entry[1].id))
        for piece, callback in pieces:
            begin, end = piece.served_from_ns, piece.end_ns
            load[piece.resource] += [(begin, 1), (end, -1)]
            ends = lanes[piece.resource]
            lane = next((k for k, free in enumerate(ends) if free <= begin), len(ends))
            ends[lane : lane + 1] = [end]
            name = piece.resource if piece.resource != "cpu" else f"cpu work {lane + 1}"
            ts = self.us(begin)
            self.events.append(
                {
                    "name": f"{callback.node} {callback.name}",
                    "cat": piece.resource,
                    "ph": "X",
                    "ts": ts,
                    "dur": round(self.us(end) - ts, 3),
                    "pid": pid,
                    "tid": self.thread(pid, name),
                    "args": {"callback": callback.id, "demand_ms": piece.demand_ns * 1e-6},
                }
            )
        for resource, changes in load.items():
            self.counter(f"{resource} in use", pid, _running_sum(changes))

    def queues(self) -> None:
        for queue in queue_timelines(self.trace):
            if not queue.max_depth and not queue.dropped:
                continue
            role = self.trace.roles.get(queue.node, "")
            pid = self.process(queue.node, queue.node + (f" ({role})" if role else ""))
            points = zip((int(t) for t in queue.time_ns), (int(d) for d in queue.depth), strict=True)
            self.counter(f"queue {queue.topic}", pid, points)
            tid = self.thread(pid, "lost messages") if len(queue.drop_ns) else 0
            for time_ns in queue.drop_ns:
                self.mark("message dropped", self.us(int(time_ns)), pid, tid, {"topic": queue.topic})

    def readings(self, readings: Iterable[Reading]) -> None:
        for reading in readings:
            ts = round(reading.time_s * 1e6 - self.trace.start_ns / 1000, 3)
            if ts < 0:
                continue
            pid = self.process(reading.source, f"machine: {reading.source}")
            for name, value in reading.known().items():
                self.events.append({"name": name, "ph": "C", "ts": ts, "pid": pid, "tid": 0, "args": {"value": value}})

    def counter(self, name: str, pid: int, points: Iterable[tuple[int, int]]) -> None:
        for time_ns, value in points:
            self.events.append(
                {"name": name, "ph": "C", "ts": self.us(time_ns), "pid": pid, "tid": 0, "args": {"value": value}}
            )


def _running_sum(changes: Iterable[tuple[int, int]]) -> list[tuple[int, int]]:
    steps: dict[int, int] = defaultdict(int)
    for time_ns, step in changes:
        steps[time_ns] += step
    points, level = [], 0
    for time_ns in sorted(steps):
        if steps[time_ns]:
            level += steps[time_ns]
            points.append((time_ns, level))
    return points
