"""End-to-end latency: from the sensor reading to the command that was built on it, along a chain of topics.

A message is *built on* the message that set its callback off, and on what the node keeps from before: for each other
topic that the node takes, the newest message whose callback had ended when this one started. Following that back
from a command, topic by topic along a chain, leads to one sensor reading. The age of its stamp when the command leaves
is the latency of the chain. This holds for timers too, which no message sets off.

The literature calls this the data age of a cause-effect chain: Feiertag, Richter, Nordlander and Jonsson, "A
compositional framework for end-to-end path delay calculation of automotive systems under different path semantics",
CRTS 2008. It holds the sensor's period as well as the computing: a saw-tooth from the latency up to that plus a period.
"""

from __future__ import annotations

import math
from collections import defaultdict, deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from robotbrain.errors import InputError

if TYPE_CHECKING:
    from robotbrain.monitoring.trace import Trace
    from robotbrain.ros.context import CallbackRecord, MessageRecord

Chain = tuple[str, ...]
"""Labels from a sensor topic to a command topic; of services ``"/plan (request)"`` and ``"/plan (response)"``."""

Inputs = dict[tuple[int, int], int]
"""Stamps of sensor readings, ns, by (index of the chain, position in it)."""

SINK = "/cmd_vel"
"""The topic that moves the robot."""

CAMERA_CHAIN: Chain = ("/camera/image", "/perception/points", SINK)
SCAN_CHAIN: Chain = ("/scan", "/odometry/filtered", SINK)
KIT_CHAINS: tuple[Chain, ...] = (CAMERA_CHAIN, SCAN_CHAIN)
"""The chains of the kit's brain that decide how fresh a command is."""

_REMEMBERED = 20_000  # messages under way whose origin is kept
_HISTORY = 256  # callbacks per node and place in a chain


def label_of(message: MessageRecord) -> str:
    """Return the topic of a publication; of service traffic the service and which way it goes."""
    return message.name if message.kind == "topic" else f"{message.name} ({message.kind})"


def check_chains(chains: Iterable[Sequence[str]]) -> tuple[Chain, ...]:
    """Return chains as tuples.

    Raises:
        InputError: for one of fewer than two topics.
    """
    checked = tuple(tuple(chain) for chain in chains)
    for chain in checked:
        if len(chain) < 2 or not all(isinstance(label, str) for label in chain):
            raise InputError(
                "chain",
                given=chain,
                expected="two or more topics, from the sensor's to the command's",
                fix="For instance ('/scan', '/odometry/filtered', '/cmd_vel').",
            )
    return checked


class ChainTracker:
    """Follows stamps along chains while messages pass, in bounded memory.

    It must be told of each callback before the messages that it sent, and of a message before the callbacks that it
    sets off. That is the order in which a simulation calls its taps, and the order of the ids.

    Args:
        chains: to follow.
    """

    def __init__(self, chains: Iterable[Sequence[str]]) -> None:
        self.chains = check_chains(chains)
        self._places: dict[str, list[tuple[int, int]]] = defaultdict(list)
        for index, chain in enumerate(self.chains):
            for position, label in enumerate(chain):
                self._places[label].append((index, position))
        self._carried: dict[int, Inputs] = {}
        self._inputs: dict[int, Inputs] = {}
        self._state: dict[str, dict[tuple[int, int], deque[tuple[int, int, int]]]] = {}

    def callback(self, record: CallbackRecord) -> None:
        """Note a callback: what it took, what it had, and which messages are built on that."""
        if record.message not in self._carried and record.node not in self._state:
            return
        if record.published:
            inputs = self.inputs(record.node, record.start_ns, record.id, record.message)
            for message_id in record.published:
                self.sends(message_id, inputs)
        self.ended(record.node, record.end_ns, record.id, record.message)

    def inputs(self, node: str, start_ns: int, number: int, message_id: int) -> Inputs:
        """Return what a callback is built on when it starts.

        Args:
            node: that it belongs to.
            start_ns: when it starts.
            number: that grows from callback to callback.
            message_id: of the message that it takes, 0 for none.
        """
        inputs = dict(self._carried.get(message_id, {})) if message_id else {}
        for place, history in self._state.get(node, {}).items():
            if place not in inputs:
                for end_ns, earlier, stamp_ns in reversed(history):
                    if end_ns <= start_ns and earlier < number:
                        inputs[place] = stamp_ns
                        break
        return inputs

    def sends(self, message_id: int, inputs: Inputs) -> None:
        """Note that a message is built on these inputs."""
        if inputs:
            _remember(self._inputs, message_id, inputs)

    def ended(self, node: str, end_ns: int, number: int, message_id: int) -> None:
        """Note that a callback ended; the node keeps what it took."""
        taken = self._carried.get(message_id) if message_id else None
        if taken:
            state = self._state.setdefault(node, {})
            for place, stamp_ns in taken.items():
                history = state.setdefault(place, deque(maxlen=_HISTORY))
                history.append((end_ns, number, stamp_ns))

    def message(self, message_id: int, label: str, stamp_ns: int | None) -> dict[int, int | None]:
        """Note a message that leaves.

        Returns:
            Of each chain that ends here, by its index, the stamp at its beginning, ns; None: not known (yet).
        """
        places = self._places.get(label)
        if places is None:
            self._inputs.pop(message_id, None)
            return {}
        inputs = self._inputs.pop(message_id, {})
        carried: Inputs = {}
        ends: dict[int, int | None] = {}
        for index, position in places:
            origin = stamp_ns if position == 0 else inputs.get((index, position - 1))
            if position == len(self.chains[index]) - 1:
                ends[index] = origin
            elif origin is not None:
                carried[index, position] = origin
        if carried:
            _remember(self._carried, message_id, carried)
        return ends


def _remember(table: dict[int, Inputs], message_id: int, value: Inputs) -> None:
    table[message_id] = value
    if len(table) > _REMEMBERED:
        del table[next(iter(table))]


@dataclass(frozen=True)
class ChainAges:
    """How old the beginning of a chain was at each message that left at its end.

    Attributes:
        chain: its topics.
        time_ns: (N,) int64, when each message of the last topic left.
        age_ms: (N,) how old the reading behind it was; NaN where there was none yet.
    """

    chain: Chain
    time_ns: NDArray[np.int64]
    age_ms: NDArray[np.float64]

    @property
    def known_ms(self) -> NDArray[np.float64]:
        """The ages that are known."""
        return self.age_ms[~np.isnan(self.age_ms)]


def chain_ages(trace: Trace, chains: Iterable[Sequence[str]] = KIT_CHAINS) -> list[ChainAges]:
    """Return the ages along each of some chains.

    Args:
        trace: of a run.
        chains: see Chain; those of the kit's brain by default.

    Raises:
        InputError: for a chain of fewer than two topics.
    """
    tracker = ChainTracker(chains)
    rows: list[list[tuple[int, float]]] = [[] for _ in tracker.chains]

    def leave(message: MessageRecord) -> None:
        found = tracker.message(message.id, label_of(message), trace.stamps.get(message.id))
        for index, origin in found.items():
            age = math.nan if origin is None else (message.released_ns - origin) * 1e-6
            rows[index].append((message.released_ns, age))

    for message in trace.messages:
        if message.id not in trace.sender:
            leave(message)
    for callback in trace.callbacks:
        tracker.callback(callback)
        for message_id in callback.published:
            sent = trace.message_by_id.get(message_id)
            if sent is not None:
                leave(sent)
    ages = []
    for chain, found in zip(tracker.chains, rows, strict=True):
        found.sort(key=lambda row: row[0])
        times = np.array([time for time, _ in found], dtype=np.int64)
        ages.append(ChainAges(chain, times, np.array([age for _, age in found], dtype=np.float64)))
    return ages


def end_to_end_ms(trace: Trace, chains: Iterable[Sequence[str]] = KIT_CHAINS) -> NDArray[np.float64]:
    """Return the end-to-end latency of each command: the age of its oldest input, ms.

    Args:
        trace: of a run.
        chains: that count, all ending in the same topic.

    Returns:
        (N,), of the commands for which all chains are known.

    Raises:
        InputError: for chains that end in different topics, or none.
    """
    checked = check_chains(chains)
    if len({chain[-1] for chain in checked}) != 1:
        raise InputError(
            "chains",
            given=[chain[-1] for chain in checked],
            expected="one or more that end in the same topic",
            fix="Ask for each by itself.",
        )
    ages = np.vstack([found.age_ms for found in chain_ages(trace, checked)])
    oldest: NDArray[np.float64] = ages.max(axis=0)
    return oldest[~np.isnan(oldest)]


def outside_nodes(trace: Trace, sink: str = SINK) -> frozenset[str]:
    """Return the nodes that are the robot, not its brain: those without a role.

    Without any roles: those that take the sink topic, and those that take nothing.
    """
    nodes = {callback.node for callback in trace.callbacks} | {message.node for message in trace.messages}
    if trace.roles:
        return frozenset(nodes - set(trace.roles))
    inputs = _inputs(trace)
    return frozenset(node for node in nodes if not inputs.get(node) or sink in inputs[node])


def _inputs(trace: Trace) -> Mapping[str, set[str]]:
    found: dict[str, set[str]] = defaultdict(set)
    for callback in trace.callbacks:
        message = trace.message_by_id.get(callback.message)
        if message is not None:
            found[callback.node].add(label_of(message))
    return found


def find_chains(trace: Trace, sink: str = SINK, *, longest: int = 6) -> list[Chain]:
    """Return every chain of a run from a stamped topic of the robot to the sink, shortest first.

    A node's outputs are taken to depend on everything that it takes: which chains matter is for a person to say.

    Args:
        trace: of a run.
        sink: topic at the end.
        longest: leave out chains of more topics than that.
    """
    outside = outside_nodes(trace, sink)
    inputs = _inputs(trace)
    senders: dict[str, set[str]] = defaultdict(set)
    sources: set[str] = set()
    for message in trace.messages:
        if message.node in outside:
            if message.id in trace.stamps:
                sources.add(label_of(message))
        else:
            senders[label_of(message)].add(message.node)
    chains: list[Chain] = []
    grow: deque[Chain] = deque([(sink,)])
    while grow:
        chain = grow.popleft()
        for label in sorted({label for node in senders.get(chain[0], ()) for label in inputs.get(node, ())}):
            if label in chain:
                continue
            longer = (label, *chain)
            if label in sources:
                chains.append(longer)
            elif len(longer) < longest:
                grow.append(longer)
    return chains


def main_chains(trace: Trace, sink: str = SINK) -> tuple[Chain, ...]:
    """Return the chains to watch: those of the kit's brain if the run has them, else the shortest from each source."""
    topics = {label_of(message) for message in trace.messages}
    kit = tuple(chain for chain in KIT_CHAINS if chain[-1] == sink and topics.issuperset(chain))
    if kit:
        return kit
    shortest: dict[str, Chain] = {}
    for chain in find_chains(trace, sink):
        shortest.setdefault(chain[0], chain)
    return tuple(shortest.values())
