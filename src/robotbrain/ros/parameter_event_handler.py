"""Acting on changes of parameters, of this node and of others (``rclpy.parameter_event_handler``)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, Any

from robotbrain.ros.callback_groups import CallbackGroup
from robotbrain.ros.messages import message_class
from robotbrain.ros.qos import QoSProfile, qos_profile_parameter_events

if TYPE_CHECKING:
    from robotbrain.ros.node import Node


@dataclass(eq=False)
class ParameterCallbackHandle:
    """A callback on changes of one parameter of one node."""

    parameter_name: str
    node_name: str
    callback: Callable[[Any], Any]


@dataclass(eq=False)
class ParameterEventCallbackHandle:
    """A callback on all changes."""

    callback: Callable[[Any], Any]


class ParameterEventHandler:
    """Calls back when parameters change; the callback that was added last is called first.

    Args:
        node: that listens to ``/parameter_events``.
        qos_profile, callback_group, event_callbacks, qos_overriding_options, raw: of the subscription.
    """

    def __init__(
        self,
        node: Node,
        qos_profile: QoSProfile = qos_profile_parameter_events,
        callback_group: CallbackGroup | None = None,
        event_callbacks: Any = None,
        qos_overriding_options: Any = None,
        raw: bool = False,
    ) -> None:
        self.node, self.qos_profile = node, qos_profile
        self._parameter_callbacks: list[ParameterCallbackHandle] = []
        self._event_callbacks: list[ParameterEventCallbackHandle] = []
        self.parameter_event_subscription = node.create_subscription(
            message_class("rcl_interfaces/msg/ParameterEvent"),
            "/parameter_events",
            self._on_event,
            qos_profile,
            callback_group=callback_group,
            event_callbacks=event_callbacks,
            qos_overriding_options=qos_overriding_options,
            raw=raw,
        )

    def _on_event(self, event: Any) -> None:
        for handle in list(self._parameter_callbacks):
            parameter = self.get_parameter_from_event(event, handle.parameter_name, handle.node_name)
            if parameter is not None:
                handle.callback(parameter)
        for each in list(self._event_callbacks):
            each.callback(event)

    @staticmethod
    def get_parameter_from_event(event: Any, parameter_name: str, node_name: str) -> Any:
        """Return the message of a parameter that an event of a node (full name) tells of, or None."""
        if event.node != node_name:
            return None
        found = ParameterEventHandler.get_parameters_from_event(event)
        return next((parameter for parameter in found if parameter.name == parameter_name), None)

    @staticmethod
    def get_parameters_from_event(event: Any) -> Iterator[Any]:
        """Yield the messages of all new and changed parameters of an event."""
        yield from chain(event.new_parameters, event.changed_parameters)

    def add_parameter_callback(
        self, parameter_name: str, node_name: str, callback: Callable[[Any], Any]
    ) -> ParameterCallbackHandle:
        """Call ``callback(parameter)`` when that parameter of that node (relative to this one's namespace) changes."""
        handle = ParameterCallbackHandle(parameter_name, self._resolve(node_name), callback)
        self._parameter_callbacks.insert(0, handle)
        return handle

    def remove_parameter_callback(self, handle: ParameterCallbackHandle) -> None:
        """Remove a callback.

        Raises:
            RuntimeError: it is not there.
        """
        _remove(self._parameter_callbacks, handle)

    def add_parameter_event_callback(self, callback: Callable[[Any], Any]) -> ParameterEventCallbackHandle:
        """Call ``callback(event)`` on every change of any parameter."""
        handle = ParameterEventCallbackHandle(callback)
        self._event_callbacks.insert(0, handle)
        return handle

    def remove_parameter_event_callback(self, handle: ParameterEventCallbackHandle) -> None:
        """Remove a callback.

        Raises:
            RuntimeError: it is not there.
        """
        _remove(self._event_callbacks, handle)

    def _resolve(self, node_name: str) -> str:
        if not node_name:
            return self.node.get_fully_qualified_name()
        if node_name.startswith("/"):
            return node_name
        return f"{self.node.get_namespace().rstrip('/')}/{node_name}"

    def destroy(self) -> None:
        """Stop listening."""
        self.node.destroy_subscription(self.parameter_event_subscription)


def _remove(handles: list[Any], handle: Any) -> None:
    if handle not in handles:
        raise RuntimeError("Callback doesn't exist")
    handles.remove(handle)
