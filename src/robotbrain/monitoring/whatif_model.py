"""The structure of a recorded pipeline, read from its trace: what a replay needs to run it again.

A :class:`Model` says which callbacks there are, what sets each off, on which executor and in which group it runs, how
many messages may wait, what it took each time and what it sent. What the trace does not say is inferred from it:

- a timer's period is the greatest common divisor of the distances between the times at which it was due;
- a queue that dropped messages was full when it did, which gives its depth exactly; one that never dropped any is taken
  as unlimited, unless the trace has its depth;
- callbacks of a node that never overlap are taken as mutually exclusive;
- a callback that calls a service just when no answer is outstanding is taken to do so by intention.

What one activation took and sent is filed under its *root*: the time of the sensor message or timer tick that it goes
back to. In a replay the same measurement finds the same work again, though it may come later, or on another thread.
"""

from __future__ import annotations

import bisect
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from robotbrain.errors import InputError
from robotbrain.monitoring.critical_path_blame import Place

if TYPE_CHECKING:
    from robotbrain.ros.resources import Segment

WINDOW = 15
"""Work that was never recorded is drawn from this many activations around the same time."""


class Send(NamedTuple):
    """One message that an activation sent.

    ``kind`` is ``topic``, ``request``, ``response``, or ``resume`` (a coroutine goes on); ``to`` the client's node for
    a response, the resumed callback for ``resume``.
    """

    kind: str
    name: str
    size: int
    type_name: str
    to: str = ""


@dataclass(frozen=True, slots=True)
class Activation:
    """What a callback took and sent once.

    Attributes:
        root_ns: time of the sensor message or timer tick that it goes back to.
        segments: its cost in order.
        sends: what it sent, in order.
        size: bytes of the message that set it off; 0 for a timer.
    """

    root_ns: int
    segments: tuple[Segment, ...]
    sends: tuple[Send, ...]
    size: int = 0

    def calls(self, service: str) -> bool:
        """Tell whether it called ``service``."""
        return any(send.kind == "request" and send.name == service for send in self.sends)


class History:
    """All activations of one callback, found by their root."""

    def __init__(self, activations: Sequence[Activation]) -> None:
        self.activations = tuple(sorted(activations, key=lambda a: a.root_ns))
        self._roots = [activation.root_ns for activation in self.activations]
        self._by_root: dict[int, list[Activation]] = {}
        for activation in activations:
            self._by_root.setdefault(activation.root_ns, []).append(activation)

    def find(self, root_ns: int, occurrence: int, service: str = "", calling: bool = True) -> Activation:
        """Return the activation with this root, or one of those around its time.

        Args:
            root_ns: time of its sensor message or tick.
            occurrence: how many with the same root came before it.
            service: empty, or one that must have been called (``calling``) or must not.
            calling: which of the two.
        """
        same = self._by_root.get(root_ns, ())
        if occurrence < len(same) and (not service or same[occurrence].calls(service) == calling):
            return same[occurrence]
        pool = self.activations
        middle = bisect.bisect_left(self._roots, root_ns)
        if service:
            pool = tuple(a for a in pool if a.calls(service) == calling) or pool
            middle = bisect.bisect_left([a.root_ns for a in pool], root_ns)
        low = max(0, min(middle - WINDOW // 2, len(pool) - WINDOW))
        near = pool[low : low + WINDOW]
        return near[_scramble(root_ns + occurrence) % len(near)]


def _scramble(value: int) -> int:
    """Return a number that looks drawn at random but depends on ``value`` alone (Fibonacci hashing)."""
    mixed = ((value ^ (value >> 31)) * 0x9E3779B97F4A7C15) & 0xFFFFFFFFFFFFFFFF
    return mixed >> 40


@dataclass(frozen=True)
class Stage:
    """One callback of one node.

    Attributes:
        place: which.
        executor: number of its executor.
        group: number of its mutually exclusive group within its node; None: it may overlap with itself.
        depth: of its queue; None: unlimited.
        period_ns, first_ns: of a timer: its period and when it is first due; 0 for a timer without a grid (it is
            replayed at the recorded times).
        scale: factor on its time by resource.
        moved: resource that it uses instead of another.
        closed_loop: service that it calls just when no answer is outstanding; empty for none.
        history: what it took and sent.
    """

    place: Place
    executor: int
    group: int | None
    depth: int | None
    period_ns: int
    first_ns: int
    history: History = field(repr=False)
    scale: Mapping[str, float] = field(default_factory=dict)
    moved: Mapping[str, str] = field(default_factory=dict)
    closed_loop: str = ""

    def segments(self, activation: Activation, speed: Mapping[str, float]) -> list[Segment]:
        """Return what an activation costs here, changes and the device's speed counted in."""
        found = []
        for resource, length in activation.segments:
            target = self.moved.get(resource, resource)
            factor = self.scale.get(resource, 1.0) / speed.get(target, 1.0)
            found.append((target, length if factor == 1.0 else max(1, round(length * factor))))
        return found

    def by_size(self, resource: str) -> float:
        """Return the share of its time on a resource that goes by the size of its messages, 0 to 1.

        A straight line is fitted through time over size; where sizes hardly vary it cannot be told and is taken as 1.
        """
        rows = [(a.size, sum(t for r, t in a.segments if r == resource)) for a in self.history.activations if a.size]
        if not rows:
            return 0.0
        sizes, times = np.array(rows, dtype=float).T
        mean = float(times.mean())
        if not mean:
            return 0.0
        if len(rows) < 10 or sizes.std() < 0.02 * sizes.mean():
            return 1.0
        slope = float(np.cov(sizes, times, bias=True)[0, 1] / sizes.var())
        return min(1.0, max(0.0, slope * float(sizes.mean()) / mean))


@dataclass(frozen=True)
class Transport:
    """Latency from publisher to subscription: a median by topic, and a slope over size for what is changed.

    Attributes:
        typical: (bytes, ns) by topic or service.
        ns_per_byte: fitted over all messages.
    """

    typical: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    ns_per_byte: float = 0.0

    def latency_ns(self, name: str, size: int) -> int:
        """Return the latency of a message of ``size`` bytes on a topic or service, ns."""
        bytes_, latency = self.typical.get(name, (float(size), 0.0))
        return max(0, round(latency + self.ns_per_byte * (size - bytes_)))


@dataclass(frozen=True)
class Injected:
    """A message that nobody's callback sent, or the run of a timer without a grid, at its recorded time."""

    time_ns: int
    node: str
    send: Send
    fires: Place | None = None


@dataclass(frozen=True)
class Model:
    """A recorded pipeline that can be run again; changes return a changed copy.

    Attributes:
        start_ns, end_ns: of the recording.
        stages: by callback, in the order of their first runs.
        threads: of each executor.
        capacity: of the device by resource; empty: none, nothing is shared.
        transport: latency of messages.
        injected: what comes from outside.
        stamps: stamp of the messages of a topic by (topic, root), ns.
        disturbed: by (topic, root), a message's further delay on its way in ns, or None if it got lost there.
        speed: how many times faster each resource is than when recorded.
        sizes: factor on the size of a topic's messages.
    """

    start_ns: int
    end_ns: int
    stages: Mapping[Place, Stage]
    threads: Mapping[int, int]
    capacity: Mapping[str, int]
    transport: Transport
    injected: tuple[Injected, ...] = field(default=(), repr=False)
    stamps: Mapping[tuple[str, int], int] = field(default_factory=dict, repr=False)
    disturbed: Mapping[tuple[str, int], int | None] = field(default_factory=dict, repr=False)
    speed: Mapping[str, float] = field(default_factory=dict)
    sizes: Mapping[str, float] = field(default_factory=dict)

    @property
    def nodes(self) -> tuple[str, ...]:
        """Names of the nodes."""
        return tuple(dict.fromkeys(place.node for place in self.stages))

    def of_node(self, node: str) -> list[Stage]:
        """Return the callbacks of a node.

        Raises:
            InputError: for a node that the trace does not have.
        """
        found = [stage for place, stage in self.stages.items() if place.node == node]
        if not found:
            raise InputError(
                "node", given=node, expected="one of " + ", ".join(self.nodes), fix="Use the fully qualified name."
            )
        return found

    def stage(self, node: str, kind: str, name: str) -> Stage:
        """Return one callback.

        Raises:
            InputError: for one that the trace does not have.
        """
        stage = self.stages.get(Place(node, kind, name))
        if stage is None:
            names = [place.name for place in self.stages if place.node == node and place.kind == kind]
            raise InputError(
                f"{kind} of {node}",
                given=name,
                expected="one of " + (", ".join(names) or f"none: {node} has no {kind}"),
                fix="Use the names of the trace.",
            )
        return stage


def timer_grid(due_ns: Sequence[int]) -> tuple[int, int]:
    """Return (period, first time) of a timer from the times at which it was due; (0, 0) if they are on no grid."""
    steps = [later - earlier for earlier, later in itertools.pairwise(due_ns) if later > earlier]
    if len(steps) < 2:
        return 0, 0
    period = math.gcd(*steps)
    # On a grid of a few ns everything lies; a timer's is coarse against the distances seen.
    if period < 100_000 or period * 1000 < min(steps):
        return 0, 0
    return period, due_ns[0]
