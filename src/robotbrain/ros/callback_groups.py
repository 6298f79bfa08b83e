"""Callback groups (``rclpy.callback_groups``): which callbacks may overlap on a multi-threaded executor."""

from __future__ import annotations

from typing import Any


class CallbackGroup:
    """Base of the callback groups.

    Attributes:
        active: callbacks of the group that run now.
    """

    def __init__(self) -> None:
        self.active = 0

    def has_entity(self, entity: Any) -> bool:
        """Tell whether a timer, subscription, service or client belongs to this group."""
        return getattr(entity, "callback_group", None) is self and not getattr(entity, "destroyed", False)

    def can_execute(self) -> bool:
        """Tell whether one more callback of this group may start now."""
        raise NotImplementedError


class ReentrantCallbackGroup(CallbackGroup):
    """Callbacks of this group run in parallel, each with itself too."""

    def can_execute(self) -> bool:
        """Return True."""
        return True


class MutuallyExclusiveCallbackGroup(CallbackGroup):
    """At most one callback of this group runs at a time."""

    def can_execute(self) -> bool:
        """Return True while no callback of the group runs."""
        return self.active == 0
