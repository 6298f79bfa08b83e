"""Timers on simulated time (``rclpy.timer``)."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from robotbrain.errors import InputError
from robotbrain.ros.callback_groups import CallbackGroup
from robotbrain.ros.entity import Entity
from robotbrain.ros.executors import Work
from robotbrain.ros.time import seconds_to_ns

if TYPE_CHECKING:
    from robotbrain.ros.node import Node


class Timer(Entity):
    """Calls back every period, on the grid of its start: periods missed while busy are coalesced into one call.

    The rule is that of rcl (``rcl_timer_call``): the next due time moves by one period from the last due
    time, then by as many whole periods as are needed not to lie in the past.
    """

    kind = "timer"

    def __init__(
        self,
        node: Node,
        period_sec: float,
        callback: Callable[[], Any],
        group: CallbackGroup | None = None,
        autostart: bool = True,
    ) -> None:
        name = getattr(callback, "__name__", None) or "timer"
        super().__init__(node, name, callback, group)
        self.timer_period_ns = period_sec_to_ns(period_sec)
        self._canceled = not autostart
        self._epoch = 0
        self._pending: Work | None = None
        self._last_call_ns = node.context.now_ns
        self._next_ns = node.context.now_ns + self.timer_period_ns
        if autostart:
            self._arm()

    def _arm(self) -> None:
        self._epoch += 1
        self.node.context.schedule(self._next_ns, self._due, self._epoch)

    def _due(self, epoch: int) -> None:
        if epoch != self._epoch or self._canceled or self.destroyed:
            return
        self._pending = Work(self, None, self.node.context.now_ns)
        self.node._enqueue(self._pending)

    def execute(self, work: Work) -> Any:
        """Call back; the next due time is fixed before, as rcl does."""
        self._pending = None
        now, period = self.node.context.now_ns, self.timer_period_ns
        self._last_call_ns = now
        self._next_ns += period
        if self._next_ns < now:
            self._next_ns += -(-(now - self._next_ns) // period) * period
        self._arm()
        assert self.callback is not None
        return self.callback()

    def cancel(self) -> None:
        """Stop until :meth:`reset`."""
        self._canceled = True
        self._drop_pending()

    def _drop_pending(self) -> None:
        self._epoch += 1
        if self._pending is not None:
            self._pending.alive = False
            self._pending = None

    def reset(self) -> None:
        """Start a new grid: due one period from now; restarts a cancelled timer."""
        self.check_usable()
        self._drop_pending()
        self._canceled = False
        self._next_ns = self.node.context.now_ns + self.timer_period_ns
        self._arm()

    def destroy(self) -> None:
        """Stop for good."""
        self._drop_pending()
        super().destroy()

    def is_canceled(self) -> bool:
        """Tell whether the timer is cancelled."""
        return self._canceled

    def is_ready(self) -> bool:
        """Tell whether a call is due."""
        return not self._canceled and self.node.context.now_ns >= self._next_ns

    def time_since_last_call(self) -> int:
        """Return the ns since the last call (or since creation)."""
        return self.node.context.now_ns - self._last_call_ns

    def time_until_next_call(self) -> int | None:
        """Return the ns until the next call is due, None when cancelled."""
        return None if self._canceled else self._next_ns - self.node.context.now_ns


def period_sec_to_ns(period_sec: float) -> int:
    """Return a period as ns.

    Raises:
        InputError: not a positive number of at least 1 ns.
    """
    try:
        period_ns = seconds_to_ns(float(period_sec))
    except (TypeError, ValueError, OverflowError):
        period_ns = 0
    if period_ns <= 0:
        raise InputError(
            "timer period", given=period_sec, expected="seconds > 0", fix="20 Hz is create_timer(0.05, callback)."
        )
    return period_ns
