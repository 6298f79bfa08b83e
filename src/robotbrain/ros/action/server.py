"""Action servers (``rclpy.action.server``)."""

from __future__ import annotations

import enum
import inspect
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from robotbrain.ros.action.goals import ACTIVE, GoalEvent, GoalState, action_name_of, goal_key
from robotbrain.ros.action.server_goal import ServerGoalHandle
from robotbrain.ros.callback_groups import CallbackGroup
from robotbrain.ros.exceptions import RCLError
from robotbrain.ros.executors import Work
from robotbrain.ros.messages import message_class
from robotbrain.ros.qos import QoSProfile, qos_profile_action_status_default, qos_profile_services_default
from robotbrain.ros.services import DeferredService, Request
from robotbrain.ros.task import Future, Task
from robotbrain.ros.topics import Publisher

if TYPE_CHECKING:
    from robotbrain.ros.node import Node


__all__ = [
    "ActionServer",
    "CancelResponse",
    "GoalEvent",
    "GoalResponse",
    "RCLError",
    "ServerGoalHandle",
    "default_cancel_callback",
    "default_goal_callback",
    "default_handle_accepted_callback",
]


class GoalResponse(enum.Enum):
    """What a goal callback says."""

    REJECT = 1
    ACCEPT = 2


class CancelResponse(enum.Enum):
    """What a cancel callback says."""

    REJECT = 1
    ACCEPT = 2


def default_handle_accepted_callback(goal_handle: ServerGoalHandle) -> None:
    """Execute the goal."""
    goal_handle.execute()


def default_goal_callback(goal_request: Any) -> GoalResponse:
    """Accept every goal."""
    return GoalResponse.ACCEPT


def default_cancel_callback(cancel_request: Any) -> CancelResponse:
    """Refuse to cancel."""
    return CancelResponse.REJECT


async def _call(callback: Callable[..., Any], argument: Any) -> Any:
    result = callback(argument)
    return await result if inspect.iscoroutine(result) else result


class ActionServer:
    """Executes goals.

    Args:
        node: it belongs to.
        action_type: e.g. ``nav2_msgs.action.NavigateToPose``.
        action_name: relative, private or absolute.
        execute_callback: ``execute(goal_handle) -> Result``, plain or ``async def``; see :mod:`robotbrain.ros.action`.
        callback_group: of the services' callbacks; executing goals is a task of its own, in no group.
        goal_callback: ``(goal) -> GoalResponse``; accepts all by default.
        handle_accepted_callback: ``(goal_handle)``; executes by default.
        cancel_callback: ``(goal_handle) -> CancelResponse``; refuses by default.
        result_timeout: seconds for which a result is kept after the goal is over; negative for ever.
    """

    def __init__(
        self,
        node: Node,
        action_type: Any,
        action_name: str,
        execute_callback: Callable[[ServerGoalHandle], Any],
        *,
        callback_group: CallbackGroup | None = None,
        goal_callback: Callable[[Any], Any] | None = default_goal_callback,
        handle_accepted_callback: Callable[[ServerGoalHandle], Any] | None = default_handle_accepted_callback,
        cancel_callback: Callable[[Any], Any] | None = default_cancel_callback,
        goal_service_qos_profile: QoSProfile = qos_profile_services_default,
        result_service_qos_profile: QoSProfile = qos_profile_services_default,
        cancel_service_qos_profile: QoSProfile = qos_profile_services_default,
        feedback_pub_qos_profile: QoSProfile | None = None,
        status_pub_qos_profile: QoSProfile = qos_profile_action_status_default,
        result_timeout: float = 10,
    ) -> None:
        self.typename = action_name_of(action_type)
        self.register_execute_callback(execute_callback)
        self.register_goal_callback(goal_callback)
        self.register_handle_accepted_callback(handle_accepted_callback)
        self.register_cancel_callback(cancel_callback)
        node._check_alive()
        self._node, self._action_type = node, action_type
        self.action_name = name = node.resolve_service_name(action_name)
        self._timeout_ns = None if result_timeout < 0 else round(result_timeout * 1e9)
        self._goals: dict[bytes, ServerGoalHandle] = {}
        self._results: dict[bytes, Future] = {}
        self._logger = node.get_logger().get_child("action_server")
        impl, base = action_type.Impl, f"{name}/_action/"
        self.parts: list[Any] = []

        def serve(kind: Any, part: str, callback: Callable[[Any, Request], Any], qos: QoSProfile) -> DeferredService:
            self.parts.append(DeferredService(node, kind, base + part, callback, qos, callback_group))
            return self.parts[-1]  # type: ignore[no-any-return]

        try:
            self._send_goal = serve(impl.SendGoalService, "send_goal", self._on_goal, goal_service_qos_profile)
            self._cancel = serve(impl.CancelGoalService, "cancel_goal", self._on_cancel, cancel_service_qos_profile)
            self._get_result = serve(
                impl.GetResultService, "get_result", self._on_get_result, result_service_qos_profile
            )
            feedback_qos = feedback_pub_qos_profile or QoSProfile(depth=10)
            self._feedback = Publisher(node, impl.FeedbackMessage, base + "feedback", feedback_qos)
            self.parts.append(self._feedback)
            self._status = Publisher(node, impl.GoalStatusMessage, base + "status", status_pub_qos_profile)
            self.parts.append(self._status)
        except Exception:
            self._destroy_parts()
            raise
        node._keep(self)

    @property
    def action_type(self) -> Any:
        """The class of the action."""
        return self._action_type

    # ------------------------------------------------------------ callbacks

    def register_handle_accepted_callback(self, handle_accepted_callback: Callable[[Any], Any] | None) -> None:
        """Set what is done with a goal that was accepted; None executes it."""
        self._handle_accepted_callback = handle_accepted_callback or default_handle_accepted_callback

    def register_goal_callback(self, goal_callback: Callable[[Any], Any] | None) -> None:
        """Set what decides whether a goal is accepted; None accepts all."""
        self._goal_callback = goal_callback or default_goal_callback

    def register_cancel_callback(self, cancel_callback: Callable[[Any], Any] | None) -> None:
        """Set what decides whether a cancel request is accepted; None accepts none."""
        self._cancel_callback = cancel_callback or default_cancel_callback

    def register_execute_callback(self, execute_callback: Callable[[ServerGoalHandle], Any]) -> None:
        """Set what executes a goal.

        Raises:
            TypeError: not callable.
        """
        if not callable(execute_callback):
            raise TypeError("Failed to register goal execution callback: not callable")
        self._execute_callback = execute_callback

    # ------------------------------------------------------------ services

    async def _on_goal(self, request: Any, header: Request) -> None:
        self._expire()
        key = goal_key(request.goal_id)
        accepted = False
        if key not in self._goals:
            answer = await _call(self._goal_callback, request.goal)
            if not isinstance(answer, GoalResponse):
                self._logger.warning("Goal request callback did not return a GoalResponse type. Rejecting goal.")
            accepted = answer == GoalResponse.ACCEPT
        response = self._action_type.Impl.SendGoalService.Response(accepted=accepted)
        if not accepted:
            self._send_goal.send_response(response, header)
            return
        info = message_class("action_msgs/msg/GoalInfo")(
            goal_id=request.goal_id, stamp=self._node.get_clock().now().to_msg()
        )
        goal = self._goals[key] = ServerGoalHandle(self, info, request.goal)
        self._results[key] = Future()
        response.stamp = info.stamp
        self._send_goal.send_response(response, header)
        self._publish_status()
        await _call(self._handle_accepted_callback, goal)

    async def _on_cancel(self, request: Any, header: Request) -> None:
        self._expire()
        response = self._action_type.Impl.CancelGoalService.Response()
        canceling = []
        for goal in self._goals_to_cancel(request.goal_info, response):
            if await _call(self._cancel_callback, goal) != CancelResponse.ACCEPT:
                continue
            try:
                goal._update_state(GoalEvent.CANCEL_GOAL)
            except RCLError as error:  # it has ended in its own cancel callback
                self._logger.debug(f"Failed to cancel goal in cancel callback: {error}")
                continue
            canceling.append(goal._goal_info)
        response.goals_canceling = canceling
        self._cancel.send_response(response, header)

    def _goals_to_cancel(self, info: Any, response: Any) -> list[ServerGoalHandle]:
        """Return the goals that a request is about: by id, by time of acceptance, by both, or all."""
        key = goal_key(info.goal_id)
        stamp = info.stamp.sec * 1_000_000_000 + info.stamp.nanosec
        one = key != bytes(16)
        if one and not stamp:
            goal = self._goals.get(key)
            if goal is None:
                response.return_code = response.ERROR_UNKNOWN_GOAL_ID
                return []
            if goal._state not in (GoalState.ACCEPTED, GoalState.EXECUTING):
                response.return_code = response.ERROR_GOAL_TERMINATED
                return []
            return [goal]

        def accepted_ns(goal: ServerGoalHandle) -> int:
            return int(goal._goal_info.stamp.sec * 1_000_000_000 + goal._goal_info.stamp.nanosec)

        return [
            goal
            for known, goal in self._goals.items()
            if goal._state in (GoalState.ACCEPTED, GoalState.EXECUTING)
            and (not stamp or accepted_ns(goal) <= stamp or (one and known == key))
        ]

    def _on_get_result(self, request: Any, header: Request) -> None:
        self._expire()
        result = self._results.get(goal_key(request.goal_id))
        if result is None:
            self._logger.warning(
                f"Sending result response for unknown or expired goal ID: {goal_key(request.goal_id).hex()}"
            )
            self._get_result.send_response(self._action_type.Impl.GetResultService.Response(), header)
            return
        result.add_done_callback(lambda future: self._get_result.send_response(future.result(), header))

    # ------------------------------------------------------------ execution

    def notify_execute(
        self, goal_handle: ServerGoalHandle, execute_callback: Callable[[ServerGoalHandle], Any] | None
    ) -> None:
        """Run the execute callback as a task of the node's executor."""
        callback = execute_callback or self._execute_callback
        task = Task(self._execute, (callback, goal_handle), node=self._node, kind="action", name=self.action_name)
        self._node.context.release(self._begin, task)

    def _begin(self, task: Task) -> None:
        self._node._enqueue(Work(task.entity, None, self._node.context.now_ns))

    async def _execute(self, callback: Callable[[ServerGoalHandle], Any], goal: ServerGoalHandle) -> None:
        impl, key = self._action_type.Impl, goal_key(goal.goal_id)
        result = None
        try:
            result = await _call(callback, goal)
        except Exception as error:  # as in genuine rclpy the server survives
            self._logger.error(f"Error raised in execute callback: {type(error).__name__}: {error}")
            result = self._action_type.Result()
        if goal.is_active:
            self._logger.warning(f"Goal state not set, assuming aborted. Goal ID: {key.hex()}")
            goal.abort()
        if not isinstance(result, self._action_type.Result):
            raise TypeError(
                f"the execute callback of action {self.action_name} returned {type(result).__name__}; it must return a "
                f"{self.typename} Result (is 'return result' missing?)"
            )
        if key in self._results:
            response = impl.GetResultService.Response(status=goal.status, result=result)
            # When the cost of the callback is over: another thread may be asking for it meanwhile.
            self._node.context.release(self._results[key].set_result, response)

    def _publish_status(self) -> None:
        status = message_class("action_msgs/msg/GoalStatus")
        self._status.publish(
            self._action_type.Impl.GoalStatusMessage(
                status_list=[status(goal_info=goal._goal_info, status=goal.status) for goal in self._goals.values()]
            )
        )

    def _expire(self) -> None:
        """Forget goals that have been over for longer than results are kept."""
        if self._timeout_ns is None:
            return
        limit = self._node.context.now_ns - self._timeout_ns
        for key, goal in list(self._goals.items()):
            if goal._state not in ACTIVE and goal._over_ns <= limit and self._results[key].done():
                goal.destroy()
                del self._goals[key], self._results[key]

    def _destroy_parts(self) -> None:
        for part in self.parts:
            part.destroy()
        self.parts.clear()

    def destroy(self) -> None:
        """Stop serving; goals are forgotten."""
        for goal in self._goals.values():
            goal.destroy()
        self._destroy_parts()
        self._node._forget(self)
