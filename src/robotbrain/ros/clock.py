"""Clocks that read simulated time (``rclpy.clock``)."""

from __future__ import annotations

import enum
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from robotbrain.ros.exceptions import NotInitializedException
from robotbrain.ros.time import ClockType, Duration, Time

if TYPE_CHECKING:
    from robotbrain.ros.context import SimContext


class ClockChange(enum.IntEnum):
    """Why a clock jumped."""

    ROS_TIME_NO_CHANGE = 1
    ROS_TIME_ACTIVATED = 2
    ROS_TIME_DEACTIVATED = 3
    SYSTEM_TIME_NO_CHANGE = 4


class JumpThreshold:
    """Which jumps of a clock are worth a callback.

    Args:
        min_forward: smallest jump forward, > 0, or None for no jump.
        min_backward: smallest jump backward, < 0, or None for no jump.
        on_clock_change: also when ROS time is activated or deactivated.

    Raises:
        ValueError: a threshold of the wrong sign, or none at all.
    """

    def __init__(
        self, *, min_forward: Duration | None, min_backward: Duration | None, on_clock_change: bool = True
    ) -> None:
        if min_forward is not None and min_forward.nanoseconds <= 0:
            raise ValueError("min_forward must be a positive non-zero duration")
        if min_backward is not None and min_backward.nanoseconds >= 0:
            raise ValueError("min_backward must be a negative non-zero duration")
        if min_forward is None and min_backward is None and not on_clock_change:
            raise ValueError("At least one jump threshold must be enabled")
        self.min_forward, self.min_backward, self.on_clock_change = min_forward, min_backward, on_clock_change


class TimeJump:
    """A jump of a clock."""

    def __init__(self, clock_change: ClockChange, delta: Duration) -> None:
        if not isinstance(clock_change, ClockChange):
            raise TypeError("clock_change must be an instance of rclpy.clock.ClockChange")
        self._clock_change, self._delta = clock_change, delta

    @property
    def clock_change(self) -> ClockChange:
        """Why."""
        return self._clock_change

    @property
    def delta(self) -> Duration:
        """How far."""
        return self._delta


class JumpHandle:
    """A registered jump callback. Simulated time passes and does not jump, so the kit never calls it."""

    def __init__(
        self,
        *,
        clock: Clock,
        threshold: JumpThreshold,
        pre_callback: Callable[[], Any] | None,
        post_callback: Callable[[TimeJump], Any] | None,
    ) -> None:
        if pre_callback is None and post_callback is None:
            raise ValueError("One of pre_callback or post_callback must be callable")
        for name, callback in (("pre_callback", pre_callback), ("post_callback", post_callback)):
            if callback is not None and not callable(callback):
                raise ValueError(f"{name} must be callable if given")
        self._clock: Clock | None = clock
        self.threshold, self.pre_callback, self.post_callback = threshold, pre_callback, post_callback

    def unregister(self) -> None:
        """Remove the callback."""
        self._clock = None

    def __enter__(self) -> JumpHandle:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.unregister()


class Clock:
    """A clock of the simulation.

    Every clock type reads the same simulated time: wall-clock time has no place in a run that must be
    reproducible. Inside a callback the clock stands at the time the callback started.

    Args:
        clock_type: reported by the times it gives; ROS_TIME makes a :class:`ROSClock`.
        context: whose time; the default context when omitted.
    """

    def __new__(cls, *, clock_type: ClockType = ClockType.SYSTEM_TIME, context: SimContext | None = None) -> Clock:
        """Make a clock, or a ROSClock for ROS_TIME."""
        if not isinstance(clock_type, ClockType):
            raise TypeError("Clock type must be a ClockType enum")
        return super().__new__(ROSClock if clock_type == ClockType.ROS_TIME else cls)

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

    def sleep_for(self, rel_time: Duration, context: SimContext | None = None) -> bool:
        """Let simulated time pass; inside a callback the worker stays busy for that long (see ``charge``)."""
        self._check(context)
        return self._context.sleep(max(0, rel_time.nanoseconds))

    def sleep_until(self, until: Time, context: SimContext | None = None) -> bool:
        """Sleep until a time of this clock; return at once if it has passed.

        Raises:
            ValueError: a time of another type of clock.
        """
        self._check(context)
        if until.clock_type != self._type:
            raise ValueError("until's clock type does not match this clock's type")
        return self._context.sleep(max(0, until.nanoseconds - self._context.now_ns))

    def _check(self, context: SimContext | None) -> None:
        if not (context or self._context).ok():
            raise NotInitializedException

    def create_jump_callback(
        self,
        threshold: JumpThreshold,
        *,
        pre_callback: Callable[[], Any] | None = None,
        post_callback: Callable[[TimeJump], Any] | None = None,
    ) -> JumpHandle:
        """Register callbacks for jumps of the clock, which simulated time does not make."""
        return JumpHandle(clock=self, threshold=threshold, pre_callback=pre_callback, post_callback=post_callback)

    def __repr__(self) -> str:
        return f"Clock(clock_type={self._type.name})"


class ROSClock(Clock):
    """The clock a node reads: simulated time."""

    def __new__(cls, *, context: SimContext | None = None, clock_type: ClockType = ClockType.ROS_TIME) -> ROSClock:
        """Make a clock of ROS time."""
        return object.__new__(cls)

    def __init__(self, *, context: SimContext | None = None, clock_type: ClockType = ClockType.ROS_TIME) -> None:
        super().__init__(clock_type=ClockType.ROS_TIME, context=context)

    @property
    def ros_time_is_active(self) -> bool:
        """True: the kit's ROS time is always simulated."""
        return True

    def set_ros_time_override(self, time: Time) -> None:
        """Do nothing but check the type: the simulation alone sets the time (and ``/clock`` does not)."""
        if not isinstance(time, Time):
            raise TypeError(f"Time must be specified as rclpy.time.Time. Received type: {type(time)}")
