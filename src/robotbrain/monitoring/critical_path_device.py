"""When did each piece of a callback run? The pieces of a recorded run, laid out on its device again.

A record says what a callback wanted of each resource and when it started and ended, not when each piece began. The
device is deterministic, so the pieces follow from the starts: they are given to a fresh
:class:`~robotbrain.ros.resources.DeviceResources` at the recorded times. Where the end comes out differently (a trace
that begins in the middle of a run), all waiting of that callback is laid on the resource that it wanted most.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from robotbrain.monitoring.trace import Trace
    from robotbrain.ros.context import CallbackRecord, SimContext
    from robotbrain.ros.resources import DeviceResources, Segment


@dataclass(frozen=True, slots=True)
class Piece:
    """One segment of a callback on its resource.

    Attributes:
        resource: ``cpu``, ``gpu``, ``dla0`` or ``dla1``.
        arrived_ns: when it was wanted.
        demand_ns: its length on an idle resource.
        end_ns: when it was done.
    """

    resource: str
    arrived_ns: int
    demand_ns: int
    end_ns: int

    @property
    def waited_ns(self) -> int:
        """How much longer it took than on an idle resource."""
        return self.end_ns - self.arrived_ns - self.demand_ns

    @property
    def served_from_ns(self) -> int:
        """From when on it was served: queues serve a piece in one go at its end, cores share from the start."""
        return self.arrived_ns if self.resource == "cpu" else self.end_ns - self.demand_ns


def lay_out(trace: Trace) -> dict[int, tuple[Piece, ...]]:
    """Return the pieces of every callback of a trace by its id; together they fill it from start to end."""
    if not trace.capacity:
        return {record.id: _fallback(record) for record in trace.callbacks}
    found = _simulate(trace.callbacks, trace.capacity)
    return {
        record.id: pieces if pieces and pieces[-1].end_ns == record.end_ns else _fallback(record)
        for record in trace.callbacks
        for pieces in [found.get(record.id, ())]
    }


def _simulate(records: Sequence[CallbackRecord], capacity: Mapping[str, int]) -> dict[int, tuple[Piece, ...]]:
    from robotbrain.ros import DeviceResources, SimContext

    used = {resource for record in records for resource, _ in record.segments}
    if not used <= set(capacity):
        return {}
    accelerators = [name for name in capacity if name.startswith("dla")]
    device = DeviceResources(cpu_cores=capacity["cpu"], gpu=capacity.get("gpu", 0), dla=len(accelerators))
    start = min((record.start_ns for record in records), default=0)
    context = SimContext(resources=device, start_ns=start)
    runs = [_Run(record, device, context) for record in records if record.segments]
    for run in runs:
        context.schedule(run.record.start_ns, run.begin)
    while context.step():
        pass
    return {run.record.id: tuple(run.pieces) for run in runs}


class _Run:
    """A recorded callback that runs again, one segment after the other."""

    def __init__(self, record: CallbackRecord, device: DeviceResources, context: SimContext) -> None:
        self.record, self.pieces = record, list[Piece]()
        self._device, self._context = device, context

    def begin(self, _: object = None) -> None:
        place = len(self.pieces)
        if place == len(self.record.segments):
            return
        segment: Segment = self.record.segments[place]
        arrived = self._context.now_ns
        self._device.submit([segment], lambda: self._done(segment, arrived))

    def _done(self, segment: Segment, arrived_ns: int) -> None:
        self.pieces.append(Piece(segment[0], arrived_ns, segment[1], self._context.now_ns))
        self.begin()


def _fallback(record: CallbackRecord) -> tuple[Piece, ...]:
    """Lay a callback's segments end to end, with all of its waiting at the longest."""
    spare = record.end_ns - record.start_ns - sum(length for _, length in record.segments)
    if not record.segments:
        return ()
    longest = max(range(len(record.segments)), key=lambda place: record.segments[place][1])
    pieces, now = [], record.start_ns
    for place, (resource, length) in enumerate(record.segments):
        end = now + length + (spare if place == longest else 0)
        pieces.append(Piece(resource, now, length, end))
        now = end
    return tuple(pieces)
