"""The states of a goal and the events that change them (https://design.ros2.org/articles/actions.html)."""

from __future__ import annotations

import enum
from typing import Any

from robotbrain.errors import InputError
from robotbrain.ros.exceptions import RCLError


class GoalState(enum.IntEnum):
    """States as ``action_msgs/msg/GoalStatus`` numbers them."""

    UNKNOWN = 0
    ACCEPTED = 1
    EXECUTING = 2
    CANCELING = 3
    SUCCEEDED = 4
    CANCELED = 5
    ABORTED = 6


class GoalEvent(enum.Enum):
    """What can happen to a goal."""

    EXECUTE = 0
    CANCEL_GOAL = 1
    SUCCEED = 2
    ABORT = 3
    CANCELED = 4


ACTIVE = frozenset({GoalState.ACCEPTED, GoalState.EXECUTING, GoalState.CANCELING})
"""States in which there is still something to do."""

TRANSITIONS: dict[tuple[GoalState, GoalEvent], GoalState] = {
    (GoalState.ACCEPTED, GoalEvent.EXECUTE): GoalState.EXECUTING,
    (GoalState.ACCEPTED, GoalEvent.CANCEL_GOAL): GoalState.CANCELING,
    (GoalState.EXECUTING, GoalEvent.CANCEL_GOAL): GoalState.CANCELING,
    (GoalState.EXECUTING, GoalEvent.SUCCEED): GoalState.SUCCEEDED,
    (GoalState.EXECUTING, GoalEvent.ABORT): GoalState.ABORTED,
    (GoalState.CANCELING, GoalEvent.SUCCEED): GoalState.SUCCEEDED,
    (GoalState.CANCELING, GoalEvent.ABORT): GoalState.ABORTED,
    (GoalState.CANCELING, GoalEvent.CANCELED): GoalState.CANCELED,
}


def next_state(state: GoalState, event: GoalEvent) -> GoalState:
    """Return the state after an event.

    Raises:
        RCLError: there is no such transition.
    """
    try:
        return TRANSITIONS[state, event]
    except KeyError:
        possible = ", ".join(e.name for s, e in TRANSITIONS if s == state) or "none: the goal is over"
        hint = " (canceled() needs a cancel request that was accepted)" if event == GoalEvent.CANCELED else ""
        raise RCLError(
            f"a goal in state {state.name} has no transition {event.name}{hint}; it has: {possible}"
        ) from None


def action_name_of(action_type: Any) -> str:
    """Return the ROS name of an action class; raise InputError when it is none."""
    name = getattr(action_type, "__actiontype__", None)
    if not isinstance(name, str):
        raise InputError(
            "action type",
            given=action_type,
            expected="an action class such as nav2_msgs.action.NavigateToPose",
            fix="Pass the class itself: from nav2_msgs.action import NavigateToPose.",
        )
    return name


def goal_key(goal_id: Any) -> bytes:
    """Return the 16 bytes of a ``unique_identifier_msgs/msg/UUID``."""
    return bytes(goal_id.uuid.tolist())
