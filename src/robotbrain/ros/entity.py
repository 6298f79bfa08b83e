"""What timers, subscriptions, services and clients have in common."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

from robotbrain.errors import InputError
from robotbrain.ros.callback_groups import CallbackGroup
from robotbrain.ros.exceptions import InvalidHandle

if TYPE_CHECKING:
    from robotbrain.ros.executors import Work
    from robotbrain.ros.node import Node


class Entity:
    """Something with a callback that an executor runs.

    Attributes:
        node: its node.
        name: topic, service or callback name, as the cost model sees it.
        callback_group: its group.
    """

    kind: ClassVar[str] = ""
    cancelled = False

    def __init__(self, node: Node, name: str, callback: Callable[..., Any] | None, group: CallbackGroup | None) -> None:
        if callback is not None and not callable(callback):
            raise InputError(
                f"{self.kind} callback of {name}", given=callback, expected="a function", fix="Pass it without ()."
            )
        self.node, self.name, self.callback = node, name, callback
        self.callback_group = group if group is not None else node.default_callback_group
        self.destroyed = False

    @property
    def callback_name(self) -> str:
        """Readable name of the callback function."""
        return getattr(self.callback, "__qualname__", None) or repr(self.callback)

    def execute(self, work: Work) -> Any:
        """Run the callback for one piece of work; may return a coroutine."""
        raise NotImplementedError

    def complete(self, work: Work, result: Any) -> None:
        """Take what the callback returned."""

    def check_usable(self) -> None:
        """Raise InvalidHandle after destruction."""
        if self.destroyed:
            raise InvalidHandle(
                f"{self.kind} {self.name} of {self.node.get_fully_qualified_name()} was destroyed and cannot be used"
            )

    def destroy(self) -> None:
        """Stop; nothing of it runs any more."""
        self.destroyed = True
        self.node._forget(self)
