"""Guard conditions (``rclpy.guard_condition``): callbacks that a program sets off itself."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from robotbrain.ros.entity import Entity
from robotbrain.ros.executors import Work

if TYPE_CHECKING:
    from collections.abc import Callable

    from robotbrain.ros.callback_groups import CallbackGroup
    from robotbrain.ros.node import Node


class GuardCondition(Entity):
    """Calls back once after each :meth:`trigger`; triggers that come before the callback has run are one."""

    kind = "guard_condition"

    def __init__(self, node: Node, callback: Callable[[], Any] | None, group: CallbackGroup | None = None) -> None:
        super().__init__(node, getattr(callback, "__name__", None) or "guard_condition", callback, group)
        self._waiting = False

    def trigger(self) -> None:
        """Have the callback run, when the callback that is running now is over."""
        self.check_usable()
        if not self._waiting:
            self._waiting = True
            self.node.context.release(self._enqueue, None)

    def _enqueue(self, _: None) -> None:
        if not self.destroyed:
            self.node._enqueue(Work(self, None, self.node.context.now_ns))

    def execute(self, work: Work) -> Any:
        """Call back."""
        self._waiting = False
        return self.callback() if self.callback is not None and not self.destroyed else None
