"""What a simulation records and calls: messages, callbacks, their costs, and who observes them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, Protocol

from robotbrain.ros.resources import Segment

if TYPE_CHECKING:
    from robotbrain.ros.node import Node

Event = Callable[[Any], None]
Tap = Callable[[int, str, str, str, bytes], None]
CallbackTap = Callable[["CallbackRecord"], None]
MessageTap = Callable[["MessageRecord", bytes], None]
Filter = Callable[["MessageRecord", bytes], Sequence[tuple[bytes, int]]]


class CostModel(Protocol):
    """How long callbacks take.

    A model may have three more methods, all of which return ns of CPU time:

    - ``work_ns(kind, units)``: of work that a callback did and names by :func:`robotbrain.ros.charge_work`;
    - ``uncharged_ns(node_name, kind, name)``: of a callback that charged nothing itself;
    - ``traffic_ns(node_name, received, sent)``: of taking a message of ``received`` bytes off the wire (None: there
      was none) and putting messages of ``sent`` bytes each on it.
    """

    def cost(self, node_name: str, kind: str, name: str) -> int:
        """Return the simulated nanoseconds of one callback.

        Args:
            node_name: fully qualified node name, e.g. ``/planner``.
            kind: ``timer``, ``subscription``, ``service``, ``client``, ``action`` (executing a goal), ``task``,
                ``event`` (of QoS) or ``guard_condition``.
            name: topic, service or action name; for the others the name of their callback function.
        """
        ...


@dataclass(frozen=True, slots=True)
class MessageRecord:
    """One message on its way: what it is, who sent it, and when it left.

    Attributes:
        id: counted from 1 in each context, in the order in which messages were given to the middleware.
        kind: ``topic``, ``request`` or ``response``.
        name: of the topic or service.
        type_name: ROS type, e.g. ``sensor_msgs/msg/LaserScan``; for requests and responses that of the service.
        node: fully qualified name of the sender.
        released_ns: simulated time at which it left: when the callback that sent it was over.
        size: bytes of CDR.
    """

    id: int
    kind: Literal["topic", "request", "response"]
    name: str
    type_name: str
    node: str
    released_ns: int
    size: int


@dataclass(frozen=True, slots=True)
class CallbackRecord:
    """One executed callback, for monitoring: became ready, started and ended at these simulated times (ns).

    Attributes:
        node: fully qualified name of its node.
        kind: ``timer``, ``subscription``, ``service``, ``client``, ``action`` (executing a goal), ``task``, ``event``
            (of QoS) or ``guard_condition``.
        name: topic, service or action name; for the others the name of their callback function.
        ready_ns: when it could have started, had its worker and callback group been free.
        start_ns: when it started.
        end_ns: when what it published was released, and its worker free again.
        demand_ns: what it cost.
        segments: the cost in order, as (resource, ns).
        id: counted from 1 in each context, in the order of starting.
        message: ``id`` of the message that set it off; 0 for a timer.
        published: ``id`` of every message that it sent, in order.
        executor: number of its executor, from 0 in the order in which a context's executors were made.
        worker: which of the executor's threads ran it, from 0.
    """

    node: str
    kind: str
    name: str
    ready_ns: int
    start_ns: int
    end_ns: int
    demand_ns: int = 0
    segments: tuple[Segment, ...] = ()
    id: int = 0
    message: int = 0
    published: tuple[int, ...] = ()
    executor: int = 0
    worker: int = 0

    @property
    def queued_ns(self) -> int:
        """How long it waited to be started."""
        return self.start_ns - self.ready_ns

    @property
    def contention_ns(self) -> int:
        """How much longer it took than it would have on an idle device."""
        return self.end_ns - self.start_ns - self.demand_ns


@dataclass(slots=True)
class Execution:
    """The callback that is running now: what it charged and what it has to release when its cost is over."""

    node: Node
    cost_model: CostModel | None = None
    id: int = 0
    message: int = 0
    worker: int = 0
    segments: list[Segment] = field(default_factory=list)
    outbox: list[tuple[Event, Any]] = field(default_factory=list)
    published: list[int] = field(default_factory=list)

    def add(self, resource: str, nanoseconds: int) -> None:
        """Append to the cost; CPU time that follows CPU time is one segment."""
        segments = self.segments
        if not nanoseconds:
            return
        if resource == "cpu" and segments and segments[-1][0] == "cpu":
            nanoseconds += segments.pop()[1]
        segments.append((resource, nanoseconds))
