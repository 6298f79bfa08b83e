"""Which actions there are (``rclpy.action.graph``)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from robotbrain.ros.action.client import ActionClient
from robotbrain.ros.action.server import ActionServer

if TYPE_CHECKING:
    from robotbrain.ros.node import Node

Names = list[tuple[str, list[str]]]
"""Names of actions, each with its types."""


def _by_node(node: Node, name: str, namespace: str, kind: type[ActionServer] | type[ActionClient]) -> Names:
    found: dict[str, set[str]] = {}
    for other in node.context.nodes:
        if (other.get_name(), other.get_namespace()) == (name, namespace or "/"):
            for entity in other._entities:
                if isinstance(entity, kind):
                    action = entity.action_name if isinstance(entity, ActionServer) else entity._action_name
                    found.setdefault(action, set()).add(entity.typename)
    return [(action, sorted(types)) for action, types in sorted(found.items())]


def get_action_server_names_and_types_by_node(node: Node, remote_node_name: str, remote_node_namespace: str) -> Names:
    """Return the actions that a node serves."""
    return _by_node(node, remote_node_name, remote_node_namespace, ActionServer)


def get_action_client_names_and_types_by_node(node: Node, remote_node_name: str, remote_node_namespace: str) -> Names:
    """Return the actions that a node has clients of."""
    return _by_node(node, remote_node_name, remote_node_namespace, ActionClient)


def get_action_names_and_types(node: Node) -> Names:
    """Return all actions of the graph: those with a feedback topic."""
    suffix = "/_action/feedback"
    return [
        (name.removesuffix(suffix), [topic.typename.removesuffix("_FeedbackMessage")])
        for name, topic in sorted(node.context.topics.items())
        if name.endswith(suffix)
    ]
