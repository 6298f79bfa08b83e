"""Sleeping in ``async def`` callbacks, on the kit and on genuine rclpy alike."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from robotbrain.ros.task import Future


def sleep(node: Any, seconds: float) -> Future:
    """Return a future that is done ``seconds`` later by the node's clock: ``await sleep(self, 0.5)``.

    Awaiting it hands the thread back, so that other callbacks run and what was published leaves. It is a one-shot timer
    in a callback group of its own, nothing more, and works with genuine rclpy as well.
    """
    from rclpy.callback_groups import ReentrantCallbackGroup
    from rclpy.task import Future

    future = Future()

    def wake() -> None:
        timer.cancel()
        node.destroy_timer(timer)
        future.set_result(None)

    timer = node.create_timer(seconds, wake, callback_group=ReentrantCallbackGroup())
    return future  # type: ignore[no-any-return]
