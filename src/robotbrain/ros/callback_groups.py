"""Callback groups (``rclpy.callback_groups``): which callbacks may overlap on a multi-threaded executor."""

from __future__ import annotations


class CallbackGroup:
    """Base of the callback groups."""

    def __init__(self) -> None:
        self.active = 0

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
