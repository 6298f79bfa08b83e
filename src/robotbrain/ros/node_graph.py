"""The graph functions of ``Node``: which nodes, topics and services there are."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

from robotbrain.ros.endpoint_info import TopicEndpointInfo, TopicEndpointTypeEnum, endpoint_info
from robotbrain.ros.exceptions import NodeNameNonExistentError, SimulationDeadlockError
from robotbrain.ros.services import Client, Service
from robotbrain.ros.spinning import spin_while
from robotbrain.ros.system_topics import SYSTEM_TOPICS
from robotbrain.ros.topics import Publisher, Subscription

if TYPE_CHECKING:
    from robotbrain.ros.context import SimContext

Names = list[tuple[str, list[str]]]
"""Names, each with its types."""


def _names(pairs: Iterable[tuple[str, str]]) -> Names:
    found: dict[str, set[str]] = {}
    for name, typename in pairs:
        found.setdefault(name, set()).add(typename)
    return [(name, sorted(types)) for name, types in sorted(found.items())]


class NodeGraph:
    """Looking at the graph; a part of :class:`~robotbrain.ros.node.Node`. It is always up to date."""

    context: SimContext
    resolve_topic_name: Callable[..., str]
    resolve_service_name: Callable[..., str]

    def get_topic_names_and_types(self, no_demangle: bool = False) -> Names:
        """Return every topic of the graph with its types, sorted by name."""
        system = [(name, kind) for name, (kind, _) in SYSTEM_TOPICS.items() if self.context.nodes]
        return _names([*system, *((name, topic.typename) for name, topic in self.context.topics.items())])

    def get_service_names_and_types(self) -> Names:
        """Return every service of the graph with its types, also those that only have clients, sorted by name."""
        parts = (part for node in self.context.nodes for part in node._all_parts())
        return _names((part.service_name, part.typename) for part in parts if isinstance(part, (Service, Client)))

    def get_node_names(self) -> list[str]:
        """Return the names of all nodes."""
        return [node.get_name() for node in self.context.nodes]

    def get_fully_qualified_node_names(self) -> list[str]:
        """Return the names of all nodes, with their namespaces."""
        return [node.get_fully_qualified_name() for node in self.context.nodes]

    def get_node_names_and_namespaces(self) -> list[tuple[str, str]]:
        """Return names and namespaces of all nodes."""
        return [(node.get_name(), node.get_namespace()) for node in self.context.nodes]

    def get_node_names_and_namespaces_with_enclaves(self) -> list[tuple[str, str, str]]:
        """Return names, namespaces and enclaves (always ``/``) of all nodes."""
        return [(node.get_name(), node.get_namespace(), "/") for node in self.context.nodes]

    def _parts(self, node_name: str, node_namespace: str, kind: type) -> list[Any]:
        namespace = node_namespace if node_namespace.startswith("/") else f"/{node_namespace}"
        nodes = [n for n in self.context.nodes if (n.get_name(), n.get_namespace()) == (node_name, namespace)]
        if not nodes:
            raise NodeNameNonExistentError(
                "node",
                given=f"{namespace.rstrip('/')}/{node_name}",
                expected="one of " + ", ".join(self.get_fully_qualified_node_names()),
                fix="Check name and namespace.",
            )
        return [part for node in nodes for part in node._all_parts() if isinstance(part, kind)]

    def get_publisher_names_and_types_by_node(
        self, node_name: str, node_namespace: str, no_demangle: bool = False
    ) -> Names:
        """Return the topics that a node publishes; raise NodeNameNonExistentError when there is no such node."""
        parts = self._parts(node_name, node_namespace, Publisher)
        return _names((part.topic, part._topic.typename) for part in parts)

    def get_subscriber_names_and_types_by_node(
        self, node_name: str, node_namespace: str, no_demangle: bool = False
    ) -> Names:
        """Return the topics that a node subscribes to; raise NodeNameNonExistentError when there is no such node."""
        parts = self._parts(node_name, node_namespace, Subscription)
        return _names((part.topic, part._topic.typename) for part in parts)

    def get_service_names_and_types_by_node(self, node_name: str, node_namespace: str) -> Names:
        """Return the services of a node; raise NodeNameNonExistentError when there is no such node."""
        parts = self._parts(node_name, node_namespace, Service)
        return _names((part.service_name, part.typename) for part in parts)

    def get_client_names_and_types_by_node(self, node_name: str, node_namespace: str) -> Names:
        """Return the services that a node calls; raise NodeNameNonExistentError when there is no such node."""
        parts = self._parts(node_name, node_namespace, Client)
        return _names((part.service_name, part.typename) for part in parts)

    def count_publishers(self, topic_name: str) -> int:
        """Return the number of publishers on a topic."""
        name = self.resolve_topic_name(topic_name)
        topic = self.context.topics.get(name)
        if topic is None:
            return len(self.context.nodes) if name in SYSTEM_TOPICS else 0
        return len(topic.publishers)

    def count_subscribers(self, topic_name: str) -> int:
        """Return the number of subscriptions to a topic."""
        topic = self.context.topics.get(self.resolve_topic_name(topic_name))
        return len(topic.subscriptions) if topic else 0

    def count_services(self, service_name: str) -> int:
        """Return the number of servers of a service: 0 or 1."""
        return int(self.resolve_service_name(service_name) in self.context.services)

    def count_clients(self, service_name: str) -> int:
        """Return the number of clients of a service."""
        name = self.resolve_service_name(service_name)
        parts = (part for node in self.context.nodes for part in node._all_parts())
        return sum(isinstance(part, Client) and part.service_name == name for part in parts)

    def get_publishers_info_by_topic(self, topic_name: str, no_mangle: bool = False) -> list[TopicEndpointInfo]:
        """Return what is known of the publishers on a topic."""
        topic = self.context.topics.get(self.resolve_topic_name(topic_name))
        ends = topic.publishers if topic else []
        return [endpoint_info(end, TopicEndpointTypeEnum.PUBLISHER, k) for k, end in enumerate(ends)]

    def get_subscriptions_info_by_topic(self, topic_name: str, no_mangle: bool = False) -> list[TopicEndpointInfo]:
        """Return what is known of the subscriptions to a topic."""
        topic = self.context.topics.get(self.resolve_topic_name(topic_name))
        ends = topic.subscriptions if topic else []
        return [endpoint_info(end, TopicEndpointTypeEnum.SUBSCRIPTION, k) for k, end in enumerate(ends)]

    def wait_for_node(self, fully_qualified_node_name: str, timeout: float) -> bool:
        """Return whether a node is there, letting simulated time pass until it is; negative: without limit.

        Inside a callback it answers at once.
        """
        wanted = "/" + fully_qualified_node_name.lstrip("/")

        def missing() -> bool:
            return wanted not in self.get_fully_qualified_node_names()

        if missing() and not self.context.in_callback():
            try:
                spin_while(self.context, missing, timeout, "wait_for_node")
            except SimulationDeadlockError:
                raise SimulationDeadlockError(
                    f"node {wanted} never comes: there are {', '.join(self.get_fully_qualified_node_names())}"
                ) from None
        return not missing()
