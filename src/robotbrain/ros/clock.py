"""Clocks that read simulated time (``rclpy.clock``)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from robotbrain.ros.time import ClockType, Duration, Time

if TYPE_CHECKING:
    from robotbrain.ros.context import SimContext


class Clock:
    """A clock of the simulation.

    Every clock type reads the same simulated time: wall-clock time has no place in a run that must be
    reproducible. Inside a callback the clock stands at the time the callback started.

    Args:
        clock_type: reported by the times it gives.
        context: whose time; the default context when omitted.
    """

    def __init__(self, *, clock_type: ClockType = ClockType.SYSTEM_TIME, context: SimContext | None = None) -> None:
        from robotbrain.ros.context import get_default_context

        self._type = ClockType(clock_type)
        self._context = context if context is not None else get_default_context()

    @property
    def clock_type(self) -> ClockType:
        """The type of this clock."""
        return self._type

    def now(self) -> Time:
        """Return the simulated time."""
        return Time(nanoseconds=self._context.now_ns, clock_type=self._type)

    def sleep_for(self, rel_time: Duration, context: object = None) -> bool:
        """Let simulated time pass; inside a callback the worker stays busy for that long (see ``charge``)."""
        return self._context.sleep(rel_time.nanoseconds)

    def sleep_until(self, until: Time, context: object = None) -> bool:
        """Sleep until a time of this clock; return at once if it has passed."""
        return self._context.sleep(max(0, until.nanoseconds - self._context.now_ns))

    def __repr__(self) -> str:
        return f"Clock(clock_type={self._type.name})"


class ROSClock(Clock):
    """The clock a node reads: simulated time."""

    def __init__(self, *, context: SimContext | None = None) -> None:
        super().__init__(clock_type=ClockType.ROS_TIME, context=context)

    @property
    def ros_time_is_active(self) -> bool:
        """True: the kit's ROS time is always simulated."""
        return True
