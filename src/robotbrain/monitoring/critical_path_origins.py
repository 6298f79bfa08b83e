"""Which measurements are behind a message? The newest of each sensor, followed from callback to callback.

What a callback knows: the message that set it off, and the newest message of every other topic of its node whose
callback had ended. That holds for nodes of anybody; a node that ignores an input seems to know more than it does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

from robotbrain.errors import InputError
from robotbrain.monitoring.critical_path_blame import Place, place_of

if TYPE_CHECKING:
    from robotbrain.monitoring.trace import Trace
    from robotbrain.ros.context import CallbackRecord, MessageRecord

FEWEST = 3
"""A topic with fewer messages than this in a trace is taken for a setting, not for a sensor."""


class Origin(NamedTuple):
    """The newest measurement behind a callback, and the earlier callback that knew it (0: its own message)."""

    origin_ns: int
    state: int


class Origins:
    """Which measurements are behind each message on the way to a sink.

    Args:
        trace: of a run.
        sink: topic, or service whose answers are followed.
        sources: topics of measurements; None: what reaches the sink from nodes that take the sink's messages (the
            robot's driver), from nodes without inputs, or from outside any callback.

    Attributes:
        trace, sink: as given.
        sinks: the sink's messages.
        sources: topics of measurements that reach it.
        source_topics: all topics at which chains begin.
        origins: by callback id and source, what is behind a callback.
        reached: times of the measurements that were behind a callback at any time, by (callback, source).
        known: callbacks by id.

    Raises:
        InputError: for a sink without messages or sources that do not reach it.
    """

    def __init__(self, trace: Trace, sink: str = "/cmd_vel", sources: Sequence[str] | None = None) -> None:
        self.trace, self.sink = trace, sink
        topics = [message for message in trace.messages if message.name == sink and message.kind == "topic"]
        answers = [message for message in trace.messages if message.name == sink and message.kind == "response"]
        self.sinks = topics or answers
        if not self.sinks:
            names = sorted({message.name for message in trace.messages if message.kind != "request"})
            raise InputError(
                "sink", given=sink, expected="a topic or service of the trace: " + ", ".join(names), fix="Name one."
            )
        self.known = {record.id: record for record in trace.callbacks}
        # What the robot measures is where chains begin, asked for or not: else they would run on through its motion.
        self.source_topics = self._find_sources() | set(sources or ())
        self.origins: dict[int, dict[str, Origin]] = {}
        self.reached: dict[tuple[Place, str], set[int]] = {}
        self._trace_origins()
        reach = self._reaching()
        if sources is not None and (missing := [topic for topic in sources if topic not in reach]):
            raise InputError(
                "sources",
                given=missing,
                expected=f"topics behind {sink}: {', '.join(sorted(reach)) or 'none found'}",
                fix="Leave sources out to see all of them.",
            )
        if not reach:
            raise InputError(
                "sources",
                given=f"a trace in which nothing measured leads to {sink}",
                expected="a chain of messages from a sensor",
                fix="Name the topics to start from: sources=['/scan'].",
            )
        self.sources = tuple(sorted(reach if sources is None else set(sources)))

    # ------------------------------------------------------------ what is behind each callback

    def _find_sources(self) -> set[str]:
        trace = self.trace
        takes = {record.node for message in self.sinks for record in trace.takers.get(message.id, ())}
        fed = {record.node for record in trace.callbacks if record.message}
        count: dict[str, int] = {}
        for message in trace.messages:
            sender = trace.sender.get(message.id)
            outside = sender is None or sender.node in takes or sender.node not in fed
            if outside and message.kind == "topic" and message.name != self.sink:
                count[message.name] = count.get(message.name, 0) + 1
        return {topic for topic, messages in count.items() if messages >= FEWEST}

    def origin_ns(self, message: MessageRecord) -> int:
        """Return when what a source's message describes was measured: its stamp, unless that lies in the future."""
        stamp = self.trace.stamps.get(message.id, 0)
        return stamp if 0 < stamp <= message.released_ns else message.released_ns

    def _trace_origins(self) -> None:
        inputs: dict[str, dict[Place, list[CallbackRecord]]] = {}
        for record in self.trace.callbacks:
            here: dict[str, Origin] = {}
            message = self.trace.message_by_id.get(record.message)
            if message is not None:
                for topic, origin in self.behind(message).items():
                    here[topic] = Origin(origin, 0)
            triggered = set(here)
            mine = place_of(record)
            if record.published or record.kind == "timer":
                for place, earlier in inputs.get(record.node, {}).items():
                    if place == mine:
                        continue
                    last = next((other for other in reversed(earlier) if other.end_ns <= record.start_ns), None)
                    for topic, found in self.origins[last.id].items() if last is not None else ():
                        if topic in triggered:
                            continue
                        known = here.get(topic)
                        if known is None or found.origin_ns >= known.origin_ns:
                            here[topic] = Origin(found.origin_ns, last.id if last is not None else 0)
            self.origins[record.id] = here
            for topic, found in here.items():
                self.reached.setdefault((mine, topic), set()).add(found.origin_ns)
            if record.message:
                inputs.setdefault(record.node, {}).setdefault(mine, []).append(record)

    def behind(self, message: MessageRecord) -> Mapping[str, int]:
        """Return the time of the newest measurement of each source behind a message, ns."""
        if message.kind == "topic" and message.name in self.source_topics:
            return {message.name: self.origin_ns(message)}
        sender = self.trace.sender.get(message.id)
        if sender is None:
            return {}
        return {topic: found.origin_ns for topic, found in self.origins.get(sender.id, {}).items()}

    def _reaching(self) -> set[str]:
        return {topic for message in self.sinks for topic in self.behind(message)}
