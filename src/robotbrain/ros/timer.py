"""Timers on simulated time (``rclpy.timer``)."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from robotbrain.errors import InputError
from robotbrain.ros.callback_groups import CallbackGroup
from robotbrain.ros.clock import Clock
from robotbrain.ros.entity import Entity
from robotbrain.ros.executors import Work
from robotbrain.ros.rate import Rate
from robotbrain.ros.time import ClockType, Time, seconds_to_ns

__all__ = ["Rate", "Timer", "TimerInfo"]

if TYPE_CHECKING:
    from robotbrain.ros.node import Node


class TimerPeriodError(InputError, RuntimeError):
    """A timer's period is no time > 0 (genuine rclpy raises a RuntimeError, and lets 0 spin)."""


class TimerInfo:
    """When a timer's call was due and when it came; given to callbacks with a parameter annotated ``TimerInfo``.

    Args:
        expected_call_time, actual_call_time: ns.
        clock_type: of these times.
    """

    def __init__(
        self,
        *,
        expected_call_time: int = 0,
        actual_call_time: int = 0,
        clock_type: ClockType = ClockType.SYSTEM_TIME,
    ) -> None:
        if expected_call_time < 0 or actual_call_time < 0:
            raise ValueError("call time values must not be negative")
        self._expected = Time(nanoseconds=expected_call_time, clock_type=clock_type)
        self._actual = Time(nanoseconds=actual_call_time, clock_type=clock_type)

    @property
    def expected_call_time(self) -> Time:
        """When the call was due."""
        return self._expected

    @property
    def actual_call_time(self) -> Time:
        """When it came."""
        return self._actual


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
        clock: Clock | None = None,
    ) -> None:
        name = getattr(callback, "__name__", None) or "timer"
        super().__init__(node, name, callback, group)
        self._clock = clock
        self._period_ns = period_sec_to_ns(period_sec)
        self._info = info_parameter(callback)
        self._canceled = not autostart
        self._epoch = 0
        self._pending: Work | None = None
        self._last_call_ns = node.context.now_ns
        self._next_ns = node.context.now_ns + self._period_ns
        if autostart:
            self._arm()

    @property
    def clock(self) -> Clock:
        """The clock it was made with: all of them tell simulated time."""
        return self._clock or self.node.get_clock()

    @property
    def timer_period_ns(self) -> int:
        """The period in ns; a new one counts from the next call on."""
        return self._period_ns

    @timer_period_ns.setter
    def timer_period_ns(self, value: int) -> None:
        period_sec_to_ns(value * 1e-9)
        self._period_ns = int(value)

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
        now, period = self.node.context.now_ns, self._period_ns
        self._last_call_ns = now
        due = self._next_ns
        self._next_ns += period
        if self._next_ns < now:
            self._next_ns += -(-(now - self._next_ns) // period) * period
        self._arm()
        assert self.callback is not None
        if self._info is None:
            return self.callback()
        info = TimerInfo(expected_call_time=due, actual_call_time=now, clock_type=self.clock.clock_type)
        return self.callback(**{self._info: info})

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
        self._next_ns = self.node.context.now_ns + self._period_ns
        self._arm()

    def destroy(self) -> None:
        """Stop for good."""
        self._drop_pending()
        super().destroy()

    def __enter__(self) -> Timer:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.destroy()

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


def info_parameter(callback: Callable[..., Any]) -> str | None:
    """Return the name of the parameter that wants a :class:`TimerInfo`, or None."""
    try:
        parameters = inspect.signature(callback).parameters
    except (TypeError, ValueError):
        return None
    return next((name for name, parameter in parameters.items() if parameter.annotation is TimerInfo), None)


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
        raise TimerPeriodError(
            "timer period", given=period_sec, expected="seconds > 0", fix="20 Hz is create_timer(0.05, callback)."
        )
    return period_ns
