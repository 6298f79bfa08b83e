"""``Rate`` (``rclpy.timer.Rate``): a loop at a fixed rate, outside callbacks."""

from __future__ import annotations

from typing import TYPE_CHECKING

from robotbrain.ros.exceptions import InvalidHandle, ReentrancyError, ROSInterruptException
from robotbrain.ros.spinning import spin_while

if TYPE_CHECKING:
    from robotbrain.ros.timer import Timer


class Rate:
    """Sleeps until the next tick of a grid in simulated time; everything else goes on meanwhile.

    Made by ``Node.create_rate``. A loop that takes longer than a period skips the ticks it has missed.
    """

    def __init__(self, timer: Timer) -> None:
        self._timer = timer
        self._ticks = 0
        self._destroyed = False
        timer.callback = self._tick

    def _tick(self) -> None:
        self._ticks += 1

    def sleep(self) -> None:
        """Let simulated time pass until the next tick.

        Raises:
            ReentrancyError: inside a callback, where genuine rclpy waits for ever on a single-threaded executor.
            ROSInterruptException: the context was shut down.
            RuntimeError: the rate was destroyed.
        """
        context = self._timer.node.context
        if not context.ok():
            raise ROSInterruptException("rclpy.shutdown() has been called")
        if self._destroyed:
            raise RuntimeError("Rate cannot sleep because it has been destroyed")
        if self._timer.destroyed:
            raise InvalidHandle("Rate cannot sleep because the timer has been destroyed")
        if context.in_callback():
            raise ReentrancyError(
                "rate.sleep() was called inside a callback, which keeps the thread that would tick the rate: do one "
                "round per call of create_timer(period, callback), or write an async def callback with "
                "'await robotbrain.ros.sleep(node, seconds)'"
            )
        before = self._ticks
        spin_while(context, lambda: self._ticks == before, None, "rate.sleep")
        if not context.ok():
            raise ROSInterruptException("rclpy.shutdown() has been called")

    def destroy(self) -> None:
        """Stop ticking."""
        self._destroyed = True
        self._timer.destroy()
