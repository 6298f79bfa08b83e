"""Action clients (``rclpy.action.client``)."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Any
from weakref import WeakValueDictionary

from robotbrain.ros.action.goals import ACTIVE, GoalState, action_name_of, goal_key
from robotbrain.ros.callback_groups import CallbackGroup
from robotbrain.ros.exceptions import ReentrancyError
from robotbrain.ros.messages import message_class
from robotbrain.ros.qos import QoSProfile, qos_profile_action_status_default, qos_profile_services_default
from robotbrain.ros.services import Client, Patience
from robotbrain.ros.spinning import spin_while
from robotbrain.ros.task import Future
from robotbrain.ros.topics import Subscription

if TYPE_CHECKING:
    from robotbrain.ros.node import Node


class ClientGoalHandle:
    """A goal that was sent, once the server has said whether it accepts it."""

    def __init__(self, action_client: ActionClient, goal_id: Any, goal_response: Any) -> None:
        self._action_client, self._goal_id, self._goal_response = action_client, goal_id, goal_response
        self._status = int(GoalState.UNKNOWN)

    @property
    def goal_id(self) -> Any:
        """The goal's ``unique_identifier_msgs/msg/UUID``."""
        return self._goal_id

    @property
    def stamp(self) -> Any:
        """When it was accepted, ``builtin_interfaces/msg/Time``."""
        return self._goal_response.stamp

    @property
    def accepted(self) -> bool:
        """Whether the server accepted it."""
        return bool(self._goal_response.accepted)

    @property
    def status(self) -> int:
        """The state last heard of, as ``action_msgs/msg/GoalStatus`` numbers it."""
        return self._status

    def cancel_goal_async(self) -> Future:
        """Ask the server to cancel; the future's result is a ``CancelGoal.Response``."""
        return self._action_client._cancel_goal_async(self)

    def cancel_goal(self) -> Any:
        """Ask the server to cancel and wait for its answer; outside callbacks only."""
        return self._action_client._wait_for(self.cancel_goal_async(), "cancel_goal")

    def get_result_async(self) -> Future:
        """Ask for the result; the future's result has ``status`` and ``result``."""
        return self._action_client._get_result_async(self)

    def get_result(self) -> Any:
        """Ask for the result and wait for it; outside callbacks only."""
        return self._action_client._wait_for(self.get_result_async(), "get_result")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ClientGoalHandle) and goal_key(self.goal_id) == goal_key(other.goal_id)

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return f"ClientGoalHandle <id={self.goal_id.uuid}, accepted={self.accepted}, status={self.status}>"


class ActionClient:
    """Sends goals.

    Args:
        node: it belongs to.
        action_type: e.g. ``nav2_msgs.action.NavigateToPose``.
        action_name: relative, private or absolute.
        callback_group: in which responses and feedback are taken.
    """

    def __init__(
        self,
        node: Node,
        action_type: Any,
        action_name: str,
        *,
        callback_group: CallbackGroup | None = None,
        goal_service_qos_profile: QoSProfile = qos_profile_services_default,
        result_service_qos_profile: QoSProfile = qos_profile_services_default,
        cancel_service_qos_profile: QoSProfile = qos_profile_services_default,
        feedback_sub_qos_profile: QoSProfile | None = None,
        status_sub_qos_profile: QoSProfile = qos_profile_action_status_default,
    ) -> None:
        self.typename = action_name_of(action_type)
        node._check_alive()
        self._node, self._action_type = node, action_type
        self._action_name = name = node.resolve_service_name(action_name)
        self._patience = Patience(node)
        self._goals: WeakValueDictionary[bytes, ClientGoalHandle] = WeakValueDictionary()
        self._feedback_callbacks: dict[bytes, Callable[[Any], Any]] = {}
        impl, base, group = action_type.Impl, f"{name}/_action/", callback_group
        self._goal_client = Client(node, impl.SendGoalService, base + "send_goal", goal_service_qos_profile, group)
        self._cancel_client = Client(
            node, impl.CancelGoalService, base + "cancel_goal", cancel_service_qos_profile, group
        )
        self._result_client = Client(
            node, impl.GetResultService, base + "get_result", result_service_qos_profile, group
        )
        feedback_qos = feedback_sub_qos_profile or QoSProfile(depth=10)
        self._feedback = Subscription(
            node, impl.FeedbackMessage, base + "feedback", self._on_feedback, feedback_qos, group
        )
        self._status = Subscription(
            node, impl.GoalStatusMessage, base + "status", self._on_status, status_sub_qos_profile, group
        )
        self.parts = (self._goal_client, self._cancel_client, self._result_client, self._feedback, self._status)
        node._keep(self)

    # ------------------------------------------------------------ goals

    def send_goal_async(
        self,
        goal: Any,
        feedback_callback: Callable[[Any], Any] | None = None,
        goal_uuid: Any = None,
    ) -> Future:
        """Send a goal; the future's result is a :class:`ClientGoalHandle` when the server has answered.

        Args:
            goal: a Goal of the action.
            feedback_callback: called with each FeedbackMessage (its ``feedback`` has the action's Feedback).
            goal_uuid: ``unique_identifier_msgs/msg/UUID``; a new one by default.

        Raises:
            TypeError: another type of goal.
        """
        if not isinstance(goal, self._action_type.Goal):
            raise TypeError(
                f"send_goal to {self._action_name}: expected a {self.typename} Goal, got "
                f"{getattr(goal, '__msgtype__', type(goal).__name__)}: use {self._action_type.__name__}.Goal()"
            )
        goal_id = goal_uuid if goal_uuid is not None else self._new_goal_id()
        if feedback_callback is not None:
            self._feedback_callbacks[goal_key(goal_id)] = feedback_callback
        future = Future()
        future.completed_in = self._goal_client.callback_group
        request = self._action_type.Impl.SendGoalService.Request(goal_id=goal_id, goal=goal)
        answer = self._goal_client.call_async(request)
        answer.add_done_callback(lambda done: self._on_goal_response(future, goal_id, done.result()))
        return future

    def send_goal(self, goal: Any, **kwargs: Any) -> Any:
        """Send a goal and wait for its result, outside callbacks only; arguments as of :meth:`send_goal_async`.

        Returns:
            The response of ``get_result``, with ``status`` and ``result``; status UNKNOWN if the goal was rejected.

        Raises:
            ReentrancyError: inside a callback, where genuine rclpy deadlocks.
        """
        handle = self._wait_for(self.send_goal_async(goal, **kwargs), "send_goal")
        return self._wait_for(self._get_result_async(handle), "send_goal")

    def _new_goal_id(self) -> Any:
        # Random in genuine rclpy; here it is drawn from a count, so that two runs are the same.
        context = self._node.context
        context.goal_count += 1
        digest = hashlib.blake2b(f"goal {context.goal_count}".encode(), digest_size=16).digest()
        return message_class("unique_identifier_msgs/msg/UUID")(uuid=list(digest))

    def _wait_for(self, future: Future, what: str) -> Any:
        context = self._node.context
        if context.in_callback():
            raise ReentrancyError(
                f"{what} on {self._action_name} inside a callback waits for an answer that can only come after the "
                "callback returns (genuine rclpy deadlocks): use the ..._async form with add_done_callback, or 'await' "
                "it in an async def callback"
            )
        spin_while(context, future._pending, None, what)
        return future.result()

    def _on_goal_response(self, future: Future, goal_id: Any, response: Any) -> None:
        handle = ClientGoalHandle(self, goal_id, response)
        if handle.accepted:
            key = goal_key(goal_id)
            if key in self._goals:
                raise RuntimeError(f"Two goals were accepted with the same ID ({handle})")
            self._goals[key] = handle
        if future._pending():
            future.set_result(handle)

    def _cancel_goal_async(self, handle: ClientGoalHandle) -> Future:
        self._check_handle(handle)
        request = self._action_type.Impl.CancelGoalService.Request()
        request.goal_info.goal_id = handle.goal_id
        return self._cancel_client.call_async(request)

    def _get_result_async(self, handle: ClientGoalHandle) -> Future:
        self._check_handle(handle)
        future = self._result_client.call_async(self._action_type.Impl.GetResultService.Request(goal_id=handle.goal_id))
        key = goal_key(handle.goal_id)
        future.add_done_callback(lambda _: self._feedback_callbacks.pop(key, None))
        return future

    @staticmethod
    def _check_handle(handle: Any) -> None:
        if not isinstance(handle, ClientGoalHandle):
            raise TypeError(f"Expected type ClientGoalHandle but received {type(handle)}")

    # ------------------------------------------------------------ topics

    def _on_feedback(self, message: Any) -> Any:
        callback = self._feedback_callbacks.get(goal_key(message.goal_id))
        return callback(message) if callback is not None else None

    def _on_status(self, message: Any) -> None:
        for status in message.status_list:
            handle = self._goals.get(goal_key(status.goal_info.goal_id))
            if handle is not None:
                handle._status = status.status
                if status.status not in ACTIVE:
                    self._goals.pop(goal_key(status.goal_info.goal_id), None)

    # ------------------------------------------------------------ server

    def server_is_ready(self) -> bool:
        """Tell whether a server offers all parts of the action."""
        clients = (self._goal_client, self._cancel_client, self._result_client)
        subscriptions = (self._feedback, self._status)
        return all(client.service_is_ready() for client in clients) and all(
            subscription.get_publisher_count() for subscription in subscriptions
        )

    def wait_for_server(self, timeout_sec: float | None = None) -> bool:
        """Return whether the server is there, letting simulated time pass until it is.

        Inside a callback it answers at once: nothing else can happen before the callback returns.

        Raises:
            SimulationDeadlockError: waited without limit, or 100 times in vain.
        """
        return self._patience.wait(self.server_is_ready, timeout_sec, "wait_for_server", self._never)

    def _never(self) -> str:
        return (
            f"{self._node.get_fully_qualified_name()} waits in vain for action {self._action_name} ({self.typename}): "
            "create the node that serves it first, or check the name"
        )

    def destroy(self) -> None:
        """Stop; answers that come later are not heard."""
        for part in self.parts:
            part.destroy()
        self._node._forget(self)
