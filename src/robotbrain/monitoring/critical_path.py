"""Where did the time between a sensor and a command go? The chain of causes behind each, in pieces that add up.

Going back from a message, each piece of time has one cause:

- ``execution`` on a resource; ``contention``: a core, the GPU or a DLA was shared with, or taken by, somebody else;
- ``queueing``: a ready callback waited for its executor's thread or for its callback group;
- ``transport`` from publisher to subscription; ``sensor``: from the stamp of a measurement to its publication;
- ``sampling``: a value lay in the node until the timer that uses it fired (or until the message it is joined with
  came); ``holding``: it had been used before and was used again, because no newer one had come;
- ``superseded``: this measurement was overwritten or dropped on its way; the command reflects a newer one.

Two views of end-to-end latency (Feiertag et al. 2009; Günzel et al., "Timing Analysis of Asynchronized Distributed
Cause-Effect Chains", RTAS 2021):

- ``age``, one path per command: how old are the newest measurements behind it (data age, the immediate backward chain);
- ``reaction``, one path per measurement: how long until a command reflects it or a newer one (the forward chain).

What a callback knows: the message that set it off, and the newest message of every other topic of its node whose
callback had ended. That holds for nodes of anybody; a node that ignores an input seems to know more than it does.
"""

from __future__ import annotations

import bisect
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Literal

from robotbrain.errors import InputError
from robotbrain.monitoring.critical_path_blame import Occupancy, Place, place_of
from robotbrain.monitoring.critical_path_device import Piece, lay_out
from robotbrain.monitoring.critical_path_origins import Origins

if TYPE_CHECKING:
    from robotbrain.monitoring.trace import Trace
    from robotbrain.ros.context import CallbackRecord, MessageRecord

__all__ = ["CAUSES", "Chains", "Path", "Place", "Span", "View", "critical_paths"]

View = Literal["age", "reaction"]

CAUSES = ("execution", "contention", "queueing", "transport", "sensor", "sampling", "holding", "superseded")
"""What a piece of latency can be due to."""


@dataclass(frozen=True, slots=True)
class Span:
    """A piece of a path.

    Attributes:
        cause: one of CAUSES.
        place: the callback that ran or waited; for ``transport`` and ``sensor`` that which took the message.
        resource: ``cpu``, ``gpu``, …; ``executor 2``; the topic of a transport, sensor, sampling or superseding.
        by: whose work was waited for, if that is known.
        begin_ns, end_ns: simulated time.
        callback: id of the callback's record.
    """

    cause: str
    place: Place
    resource: str
    by: Place | None
    begin_ns: int
    end_ns: int
    callback: int = 0

    @property
    def length_ns(self) -> int:
        """Its length, ns."""
        return self.end_ns - self.begin_ns


@dataclass(frozen=True, slots=True)
class Path:
    """The chain between one measurement and one message of the sink.

    Attributes:
        source: topic of the measurement.
        message: id of the sink's message.
        origin_ns: time of the measurement: its stamp, or when it was published if it has none.
        end_ns: when the sink's message left.
        spans: without gaps, from ``origin_ns`` to ``end_ns``.
    """

    source: str
    message: int
    origin_ns: int
    end_ns: int
    spans: tuple[Span, ...] = field(repr=False)

    @property
    def latency_ns(self) -> int:
        """End-to-end latency, ns: exactly the sum of the spans."""
        return self.end_ns - self.origin_ns


class Chains(Origins):
    """Everything that led to the messages of one sink, as paths.

    Args:
        trace: of a run.
        sink: topic, or service whose answers are followed.
        sources: topics of measurements; None: what reaches the sink from nodes that take the sink's messages (the
            robot's driver), from nodes without inputs, or from outside any callback.

    Raises:
        InputError: for a sink without messages or sources that do not reach it.
    """

    @cached_property
    def pieces(self) -> Mapping[int, tuple[Piece, ...]]:
        """When each piece of each callback ran, by callback id."""
        return lay_out(self.trace)

    @cached_property
    def _workers(self) -> Occupancy:
        return Occupancy((r.executor, r.start_ns, r.end_ns, place_of(r)) for r in self.trace.callbacks)

    @cached_property
    def _resources(self) -> Occupancy:
        return Occupancy(
            (piece.resource, piece.served_from_ns, piece.end_ns, place_of(record))
            for record in self.trace.callbacks
            for piece in self.pieces[record.id]
        )

    @cached_property
    def _starts(self) -> Mapping[Place, tuple[list[int], list[CallbackRecord]]]:
        found: dict[Place, tuple[list[int], list[CallbackRecord]]] = {}
        for record in self.trace.callbacks:
            starts, records = found.setdefault(place_of(record), ([], []))
            starts.append(record.start_ns)
            records.append(record)
        return found

    def path(self, message: MessageRecord, source: str) -> Path | None:
        """Return the path to a message from the newest measurement of ``source`` behind it; None without one."""
        origin = self.behind(message).get(source)
        if origin is None:
            return None
        spans: list[Span] = []
        end = message.released_ns
        record = self.trace.sender.get(message.id)
        while record is not None:
            mine, state = place_of(record), self.origins[record.id][source].state
            spans.extend(self._running(record))
            if state:
                before = self.known[state]
                spans.extend(self._waiting(record, max(before.end_ns, min(record.ready_ns, record.start_ns))))
                spans.extend(self._sampling(record, before))
                record = before
                continue
            spans.extend(self._waiting(record, record.ready_ns))
            taken = self.trace.message_by_id[record.message]
            spans.append(Span("transport", mine, taken.name, None, taken.released_ns, record.ready_ns, record.id))
            if taken.kind == "topic" and taken.name in self.source_topics:
                measured = self.origin_ns(taken)
                spans.append(Span("sensor", mine, taken.name, None, measured, taken.released_ns))
                break
            record = self.trace.sender.get(taken.id)
        return Path(source, message.id, origin, end, tuple(span for span in reversed(spans) if span.length_ns))

    def _running(self, record: CallbackRecord) -> Iterator[Span]:
        """Yield the spans of a callback that runs, the last first."""
        mine = place_of(record)
        for piece in reversed(self.pieces[record.id]):
            served = piece.end_ns - piece.demand_ns
            yield Span("execution", mine, piece.resource, None, served, piece.end_ns, record.id)
            if served > piece.arrived_ns:
                yield from self._contended(record, piece, served)

    def _contended(self, record: CallbackRecord, piece: Piece, served: int) -> Iterator[Span]:
        mine, taken = place_of(record), self._resources
        if piece.resource == "cpu":
            # Cores are shared all the time; the time lost is drawn before the time used, in proportion to the others'.
            others = taken.shares(piece.resource, piece.arrived_ns, piece.end_ns, mine)
            total, last = sum(time for _, time in others), served
            for place, time in reversed(others[1:]):
                begin = last - (served - piece.arrived_ns) * time // total
                if begin < last:
                    yield Span("contention", mine, piece.resource, place, begin, last, record.id)
                last = begin
            first_of_all = others[0][0] if others else None
            yield Span("contention", mine, piece.resource, first_of_all, piece.arrived_ns, last, record.id)
            return
        for first, last, by in reversed(taken.between(piece.resource, piece.arrived_ns, served, "")):
            yield Span("contention", mine, piece.resource, by, first, last, record.id)

    def _waiting(self, record: CallbackRecord, since_ns: int) -> Iterator[Span]:
        """Yield the spans of a callback that is ready but not started, the last first."""
        mine, resource = place_of(record), f"executor {record.executor}"
        for first, last, by in reversed(self._workers.between(record.executor, since_ns, record.start_ns, record.node)):
            yield Span("queueing", mine, resource, by, first, last, record.id)

    def _sampling(self, record: CallbackRecord, before: CallbackRecord) -> Iterator[Span]:
        """Yield the spans of a value that lies in a node until a callback uses it, the last first."""
        begin, end = before.end_ns, max(before.end_ns, min(record.ready_ns, record.start_ns))
        mine, topic = place_of(record), before.name
        starts, records = self._starts[mine]
        first = records[bisect.bisect_left(starts, begin)]
        used = min(end, max(begin, first.ready_ns)) if first.id != record.id else end
        yield Span("holding", mine, topic, None, used, end, record.id)
        yield Span("sampling", mine, topic, None, begin, used, record.id)

    # ------------------------------------------------------------ views

    def ages(self, source: str | None = None) -> tuple[Path, ...]:
        """Return the path to each message of the sink: from ``source``, or from the source that is oldest then.

        Messages behind which not all sources are yet are left out.
        """
        found = []
        for message in self.sinks:
            behind = {topic: origin for topic, origin in self.behind(message).items() if topic in self.sources}
            if len(behind) < len(self.sources):
                continue
            # The name decides between sources of one age, so that the choice does not flutter.
            topic = source or min(behind, key=lambda name: (behind[name], name))
            path = self.path(message, topic)
            if path is not None:
                found.append(path)
        return tuple(found)

    def oldest_ns(self) -> list[int]:
        """Return the latencies of :meth:`ages` without building the paths, ns."""
        found = []
        for message in self.sinks:
            behind = self.behind(message)
            if all(topic in behind for topic in self.sources):
                found.append(message.released_ns - min(behind[topic] for topic in self.sources))
        return found

    def _answers(self, source: str) -> list[tuple[int, MessageRecord | None]]:
        """Return (time, first message of the sink that reflects it) of each measurement; None: there was none."""
        steps: list[tuple[int, MessageRecord]] = []
        for message in self.sinks:
            origin = self.behind(message).get(source)
            if origin is not None and (not steps or origin > steps[-1][0]):
                steps.append((origin, message))
        origins = [origin for origin, _ in steps]
        found: list[tuple[int, MessageRecord | None]] = []
        for message in self.trace.messages:
            if message.name == source and message.kind == "topic":
                origin = self.origin_ns(message)
                place = bisect.bisect_left(origins, origin)
                found.append((origin, steps[place][1] if place < len(steps) else None))
        return found

    def _counted(self, source: str) -> list[tuple[int, MessageRecord | None]]:
        """Return those answers that count: without the measurements that had no time to be answered."""
        found = self._answers(source)
        middle = _median([sink.released_ns - origin for origin, sink in found if sink is not None])
        end = self.trace.end_ns
        return [(o, sink) for o, sink in found if sink is not None or (middle >= 0 and end - o > middle)]

    def unanswered(self, source: str) -> int:
        """Return how many measurements of ``source`` nothing reflected before the trace ended."""
        return sum(sink is None for _, sink in self._answers(source))

    def delays(self, source: str) -> list[int]:
        """Return the latencies of :meth:`reactions` without building the paths, ns."""
        end = self.trace.end_ns
        return [(end if sink is None else sink.released_ns) - origin for origin, sink in self._counted(source)]

    def reactions(self, source: str) -> tuple[Path, ...]:
        """Return the path of each measurement of ``source`` to the first message of the sink that reflects it.

        A measurement that nothing reflected before the trace ended counts with the time that it had waited (its
        ``message`` is 0), if that is longer than the median of the others: leaving it out would make a brain that
        hangs look quick. Those at the very end, which had no time, are left out.
        """
        paths: dict[int, Path] = {}
        found = []
        for origin, sink in self._counted(source):
            if sink is None:
                last = paths[max(paths)]
                lost = Span("superseded", self._lost(last, origin), source, None, origin, self.trace.end_ns)
                found.append(Path(source, 0, origin, self.trace.end_ns, (lost,)))
                continue
            path = paths.get(sink.id)
            if path is None:
                built = self.path(sink, source)
                assert built is not None
                path = paths[sink.id] = built
            if origin < path.origin_ns:
                lost = Span("superseded", self._lost(path, origin), source, None, origin, path.origin_ns)
                path = Path(source, sink.id, origin, path.end_ns, (lost, *path.spans))
            found.append(path)
        return tuple(found)

    def _lost(self, path: Path, origin_ns: int) -> Place:
        """Return the first callback on a path that an older measurement did not get to."""
        places = list(dict.fromkeys(span.place for span in path.spans))
        for place in places:
            if origin_ns not in self.reached.get((place, path.source), ()):
                return place
        return places[-1]

    @cached_property
    def slowest_source(self) -> str:
        """The source whose measurements take longest to show at the sink, by the median reaction.

        A timer makes many sources equally slow; of those within 5 % it is the one with most work and waiting behind it.
        """
        medians = {source: _median(self.delays(source)) for source in self.sources}
        worst = max(medians.values())
        close = [source for source in self.sources if medians[source] >= 0.95 * worst]
        if len(close) == 1:
            return close[0]
        return max(close, key=lambda source: (self._busy_ns(source), source))

    def _busy_ns(self, source: str) -> int:
        """Return the median, over the reactions of a source, of what is not spent lying in a node, ns."""
        idle = ("sampling", "holding", "superseded")
        return _median([sum(s.length_ns for s in p.spans if s.cause not in idle) for p in self.reactions(source)])


def _median(values: Sequence[int]) -> int:
    return sorted(values)[len(values) // 2] if values else -1


def critical_paths(
    trace: Trace, sink: str = "/cmd_vel", *, sources: Sequence[str] | None = None, view: View = "age"
) -> tuple[Path, ...]:
    """Return the causal chains behind a sink; see the module's description for the two views.

    Args:
        trace: of a run: ``drive(..., trace=True).trace``.
        sink: topic, or service whose answers are followed.
        sources: topics of measurements; None: found by themselves.
        view: ``age``: a path for each message of the sink, from the source that is oldest behind it; ``reaction``: a
            path for each measurement of the source that takes longest to show.

    Raises:
        InputError: for an unknown view or sink, or sources that do not lead there.
    """
    chains = Chains(trace, sink, sources)
    if view == "age":
        return chains.ages()
    if view == "reaction":
        return chains.reactions(chains.slowest_source)
    raise InputError("view", given=view, expected="'age' or 'reaction'", fix="Choose one of the two.")
