"""Reading and setting another node's parameters (``rclpy.parameter_client``)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from robotbrain.ros.callback_groups import CallbackGroup
from robotbrain.ros.messages import message_class, service_class
from robotbrain.ros.parameter import Parameter, parameter_dict_from_yaml_file
from robotbrain.ros.parameter_service import SERVICES
from robotbrain.ros.qos import QoSProfile, qos_profile_parameter_events, qos_profile_services_default
from robotbrain.ros.services import Client, Patience
from robotbrain.ros.task import Future

if TYPE_CHECKING:
    from robotbrain.ros.node import Node
    from robotbrain.ros.topics import Subscription

Done = Callable[[Future], Any]


class AsyncParameterClient:
    """Asks for and changes the parameters of a remote node.

    Args:
        node: that asks.
        remote_node_name: of the node with the parameters, with its namespace.
        qos_profile: of the clients.
        callback_group: in which answers are taken.
    """

    def __init__(
        self,
        node: Node,
        remote_node_name: str,
        qos_profile: QoSProfile = qos_profile_services_default,
        callback_group: CallbackGroup | None = None,
    ) -> None:
        self.node, self.remote_node_name = node, remote_node_name
        self._patience = Patience(node)
        self._clients: dict[str, Client] = {
            name: node.create_client(
                service_class(f"rcl_interfaces/srv/{type_name}"),
                f"{remote_node_name}/{name}",
                qos_profile=qos_profile,
                callback_group=callback_group,
            )
            for name, type_name in SERVICES.items()
        }

    def services_are_ready(self) -> bool:
        """Tell whether the remote node offers all parameter services."""
        return all(client.service_is_ready() for client in self._clients.values())

    def wait_for_services(self, timeout_sec: float | None = None) -> bool:
        """Return whether the services are there, letting simulated time pass until they are.

        Raises:
            SimulationDeadlockError: waited without limit, or 100 times in vain.
        """
        return self._patience.wait(
            self.services_are_ready,
            timeout_sec,
            "wait_for_services",
            lambda: (
                f"{self.node.get_fully_qualified_name()} waits in vain for the parameter services of "
                f"{self.remote_node_name}: check the name, and that it has start_parameter_services=True"
            ),
        )

    def _call(self, name: str, callback: Done | None, **fields: Any) -> Future:
        client = self._clients[name]
        future = client.call_async(client.srv_type.Request(**fields))
        if callback is not None:
            future.add_done_callback(callback)
        return future

    def list_parameters(
        self, prefixes: list[str] | None = None, depth: int | None = None, callback: Done | None = None
    ) -> Future:
        """List the parameters below ``prefixes``, ``depth`` levels deep (all when omitted)."""
        return self._call("list_parameters", callback, prefixes=prefixes or [], depth=depth or 0)

    def get_parameters(self, names: list[str], callback: Done | None = None) -> Future:
        """Get values."""
        return self._call("get_parameters", callback, names=names)

    def get_parameter_types(self, names: list[str], callback: Done | None = None) -> Future:
        """Get types."""
        return self._call("get_parameter_types", callback, names=names)

    def describe_parameters(self, names: list[str], callback: Done | None = None) -> Future:
        """Get descriptors."""
        return self._call("describe_parameters", callback, names=names)

    def set_parameters(self, parameters: Sequence[Any], callback: Done | None = None) -> Future:
        """Set parameters (:class:`Parameter` or their messages) one by one."""
        return self._call("set_parameters", callback, parameters=_messages(parameters))

    def set_parameters_atomically(self, parameters: Sequence[Any], callback: Done | None = None) -> Future:
        """Set all parameters or none."""
        return self._call("set_parameters_atomically", callback, parameters=_messages(parameters))

    def delete_parameters(self, names: list[str], callback: Done | None = None) -> Future:
        """Unset parameters; only those with dynamic typing can be."""
        return self.set_parameters([Parameter(name) for name in names], callback)

    def load_parameter_file(
        self, parameter_file: str, use_wildcard: bool = False, callback: Done | None = None
    ) -> Future:
        """Set one by one what a YAML file says of the remote node."""
        found = parameter_dict_from_yaml_file(parameter_file, use_wildcard, [self.remote_node_name])
        return self.set_parameters(list(found.values()), callback)

    def load_parameter_file_atomically(
        self, parameter_file: str, use_wildcard: bool = False, callback: Done | None = None
    ) -> Future:
        """Set all or none of what a YAML file says of the remote node."""
        found = parameter_dict_from_yaml_file(parameter_file, use_wildcard, [self.remote_node_name])
        return self.set_parameters_atomically(list(found.values()), callback)

    def on_parameter_event(
        self, callback: Callable[..., Any], qos_profile: QoSProfile = qos_profile_parameter_events, **options: Any
    ) -> Subscription:
        """Subscribe to ``/parameter_events``; options as of ``Node.create_subscription``."""
        event = message_class("rcl_interfaces/msg/ParameterEvent")
        return self.node.create_subscription(event, "/parameter_events", callback, qos_profile, **options)


def _messages(parameters: Sequence[Any]) -> list[Any]:
    return [item.to_parameter_msg() if isinstance(item, Parameter) else item for item in parameters]
