"""What one process tells the other about its part of the graph: topics, types, QoS and services, as JSON."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from robotbrain.link.frames import FrameError
from robotbrain.ros.context import SimContext
from robotbrain.ros.names import expand
from robotbrain.ros.qos import DurabilityPolicy, HistoryPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from robotbrain.ros.time import Duration

MOST_NAMES = 2000
"""Topics and services that an end may announce."""


@dataclass(frozen=True, slots=True)
class End:
    """Publishers of a topic, or subscriptions to it: their type and the QoS that speaks for all of them."""

    type_name: str
    qos: QoSProfile


@dataclass
class Graph:
    """One process's part of the graph, by absolute name."""

    publishers: dict[str, End] = field(default_factory=dict)
    subscriptions: dict[str, End] = field(default_factory=dict)
    services: dict[str, str] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON."""
        return {
            "publishers": {name: [end.type_name, qos_to_json(end.qos)] for name, end in self.publishers.items()},
            "subscriptions": {name: [end.type_name, qos_to_json(end.qos)] for name, end in self.subscriptions.items()},
            "services": self.services,
        }

    @classmethod
    def from_json(cls, content: Any) -> Graph:
        """Return what :meth:`to_json` made.

        Raises:
            FrameError: another thing, or names that no ROS topic has.
        """
        try:
            if sum(len(content[key]) for key in ("publishers", "subscriptions", "services")) > MOST_NAMES:
                raise FrameError(f"more than {MOST_NAMES} topics and services were announced")
            return cls(
                _ends(content["publishers"]),
                _ends(content["subscriptions"]),
                {_name(name): str(type_name) for name, type_name in content["services"].items()},
            )
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise FrameError(f"the description of the graph cannot be read: {error}") from None


def _ends(content: Any) -> dict[str, End]:
    return {_name(name): End(str(type_name), qos_from_json(qos)) for name, (type_name, qos) in content.items()}


def _name(name: str) -> str:
    if not name.startswith("/") or expand(name, "link", "/") != name:
        raise FrameError(f"{name!r} is not the absolute name of a topic or service")
    return name


def qos_to_json(qos: QoSProfile) -> list[int]:
    """Return a QoS profile as a list of integers."""
    return [
        int(qos.history),
        qos.depth,
        int(qos.reliability),
        int(qos.durability),
        qos.deadline.nanoseconds,
        qos.lifespan.nanoseconds,
        int(qos.liveliness),
        qos.liveliness_lease_duration.nanoseconds,
    ]


def qos_from_json(values: Any) -> QoSProfile:
    """Return the profile of :func:`qos_to_json`.

    Raises:
        ValueError, TypeError: these are no such integers.
    """
    history, depth, reliability, durability, deadline, lifespan, liveliness, lease = map(int, values)
    return QoSProfile(
        history=HistoryPolicy(history),
        depth=depth,
        reliability=ReliabilityPolicy(reliability),
        durability=DurabilityPolicy(durability),
        deadline=Duration(nanoseconds=deadline),
        lifespan=Duration(nanoseconds=lifespan),
        liveliness=LivelinessPolicy(liveliness),
        liveliness_lease_duration=Duration(nanoseconds=lease),
    )


def local_graph(context: SimContext, is_link: Callable[[Any], bool]) -> Graph:
    """Return what the nodes of ``context`` publish, subscribe to and serve; nodes that ``is_link`` do not count.

    Several publishers of a topic are announced with what all of them offer, several subscriptions with what satisfies
    each of them.
    """
    graph = Graph()
    for name, topic in context.topics.items():
        offered = [p.qos_profile for p in topic.publishers if not is_link(p.node)]
        wanted = [s.qos_profile for s in topic.subscriptions if not is_link(s.node)]
        if offered:
            graph.publishers[name] = End(topic.typename, _joint(offered, offering=True))
        if wanted:
            graph.subscriptions[name] = End(topic.typename, _joint(wanted, offering=False))
    for name, service in context.services.items():
        if not is_link(service.node):
            graph.services[name] = service.typename
    return graph


def _joint(profiles: list[QoSProfile], offering: bool) -> QoSProfile:
    if len(profiles) == 1:
        return profiles[0]
    weak = (ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE)
    strong = (ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL)
    ruling, otherwise = (weak, strong) if offering else (strong, weak)
    endless = any(p.queue_limit is None for p in profiles)
    return QoSProfile(
        history=HistoryPolicy.KEEP_ALL if endless else HistoryPolicy.KEEP_LAST,
        depth=max(p.depth for p in profiles),
        reliability=ruling[0] if any(p.reliability == ruling[0] for p in profiles) else otherwise[0],
        durability=ruling[1] if any(p.durability == ruling[1] for p in profiles) else otherwise[1],
    )


def signature(context: SimContext) -> tuple[int, ...]:
    """Return numbers that change when ends of topics come or go; cheaper than :func:`local_graph`."""
    topics: Mapping[str, Any] = context.topics
    ends = sum(len(topic.publishers) * 1009 + len(topic.subscriptions) for topic in topics.values())
    return (len(topics), ends, len(context.services))
