"""The services through which other nodes read and set a node's parameters (``rclpy.parameter_service``)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from robotbrain.ros.exceptions import ParameterNotDeclaredException, ParameterUninitializedException
from robotbrain.ros.messages import message_class, service_class
from robotbrain.ros.parameter import Parameter
from robotbrain.ros.qos import qos_profile_parameters
from robotbrain.ros.services import Service

if TYPE_CHECKING:
    from robotbrain.ros.node import Node

SERVICES = {
    "describe_parameters": "DescribeParameters",
    "get_parameters": "GetParameters",
    "get_parameter_types": "GetParameterTypes",
    "list_parameters": "ListParameters",
    "set_parameters": "SetParameters",
    "set_parameters_atomically": "SetParametersAtomically",
}
"""Service below the node's name -> type in ``rcl_interfaces/srv``."""


class ParameterService:
    """Serves the parameters of ``node`` under ``<node>/get_parameters`` and the like."""

    def __init__(self, node: Node) -> None:
        self._node = node
        for name, type_name in SERVICES.items():
            full = f"{node.get_fully_qualified_name()}/{name}"
            node._keep(
                Service(
                    node,
                    service_class(f"rcl_interfaces/srv/{type_name}"),
                    node._remappings.get(full, full),
                    getattr(self, f"_{name}"),
                    qos_profile_parameters,
                )
            )

    def _describe_parameters(self, request: Any, response: Any) -> Any:
        try:
            response.descriptors = [self._node.describe_parameter(name) for name in request.names]
        except ParameterNotDeclaredException:
            response.descriptors = []
        return response

    def _get_parameters(self, request: Any, response: Any) -> Any:
        try:
            response.values = [self._node.get_parameter(name).get_parameter_value() for name in request.names]
        except (ParameterNotDeclaredException, ParameterUninitializedException):
            response.values = []
        return response

    def _get_parameter_types(self, request: Any, response: Any) -> Any:
        try:
            response.types = [int(self._node.get_parameter_type(name)) for name in request.names]
        except ParameterNotDeclaredException:
            response.types = []
        return response

    def _list_parameters(self, request: Any, response: Any) -> Any:
        response.result = self._node.list_parameters(list(request.prefixes), request.depth)
        return response

    def _set(self, messages: Any) -> Any:
        try:
            return self._node.set_parameters_atomically([Parameter.from_parameter_msg(message) for message in messages])
        except ParameterNotDeclaredException as error:
            return message_class("rcl_interfaces/msg/SetParametersResult")(successful=False, reason=str(error))

    def _set_parameters(self, request: Any, response: Any) -> Any:
        response.results = [self._set([message]) for message in request.parameters]
        return response

    def _set_parameters_atomically(self, request: Any, response: Any) -> Any:
        response.result = self._set(request.parameters)
        return response
