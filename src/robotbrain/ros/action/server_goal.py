"""A goal as its server sees it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from robotbrain.ros.action.goals import ACTIVE, GoalEvent, GoalState, goal_key, next_state

if TYPE_CHECKING:
    from robotbrain.ros.action.server import ActionServer


class ServerGoalHandle:
    """A goal that an action server has accepted."""

    def __init__(self, action_server: ActionServer, goal_info: Any, goal_request: Any) -> None:
        self._action_server, self._goal_info, self._goal_request = action_server, goal_info, goal_request
        self._state: GoalState | None = GoalState.ACCEPTED
        self._over_ns = 0

    @property
    def request(self) -> Any:
        """The goal, as the client sent it."""
        return self._goal_request

    @property
    def goal_id(self) -> Any:
        """The goal's ``unique_identifier_msgs/msg/UUID``."""
        return self._goal_info.goal_id

    @property
    def status(self) -> int:
        """The state, as ``action_msgs/msg/GoalStatus`` numbers it; UNKNOWN once the result has expired."""
        self._action_server._expire()
        return int(self._state or GoalState.UNKNOWN)

    @property
    def is_active(self) -> bool:
        """Whether the goal is accepted, executing or being cancelled."""
        return self.status in ACTIVE

    @property
    def is_cancel_requested(self) -> bool:
        """Whether a cancel request was accepted and nothing has come of it yet."""
        return self.status == GoalState.CANCELING

    def _update_state(self, event: GoalEvent) -> None:
        if self._state is None:
            return
        self._state = next_state(self._state, event)
        if self._state not in ACTIVE:
            self._over_ns = self._action_server._node.context.now_ns
        self._action_server._publish_status()

    def execute(self, execute_callback: Callable[[ServerGoalHandle], Any] | None = None) -> None:
        """Have the goal executed, by another callback than the server's if one is given."""
        if not self.is_cancel_requested:
            self._update_state(GoalEvent.EXECUTE)
        self._action_server.notify_execute(self, execute_callback)

    def publish_feedback(self, feedback: Any) -> None:
        """Send feedback to the client.

        Raises:
            TypeError: not the action's Feedback.
        """
        server = self._action_server
        if not isinstance(feedback, server.action_type.Feedback):
            raise TypeError(
                f"publish_feedback of {server.action_name}: expected a {server.typename} Feedback, got "
                f"{getattr(feedback, '__msgtype__', type(feedback).__name__)}"
            )
        if self._state is not None:
            server._feedback.publish(server.action_type.Impl.FeedbackMessage(goal_id=self.goal_id, feedback=feedback))

    def succeed(self) -> None:
        """Say that the goal was reached."""
        self._update_state(GoalEvent.SUCCEED)

    def abort(self) -> None:
        """Say that the goal cannot be reached."""
        self._update_state(GoalEvent.ABORT)

    def canceled(self) -> None:
        """Say that the goal was given up as requested."""
        self._update_state(GoalEvent.CANCELED)

    def destroy(self) -> None:
        """Forget the goal."""
        self._state = None

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ServerGoalHandle) and goal_key(self.goal_id) == goal_key(other.goal_id)

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return f"<ServerGoalHandle {goal_key(self.goal_id).hex()} {GoalState(self.status).name}>"
