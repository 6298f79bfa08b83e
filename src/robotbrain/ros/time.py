"""``Time`` and ``Duration`` with nanosecond integers (``rclpy.time``, ``rclpy.duration``, ``rclpy.clock_type``)."""

from __future__ import annotations

import enum
from functools import total_ordering
from typing import Any

from robotbrain.errors import InputError
from robotbrain.ros.messages import message_class

NS_PER_S = 1_000_000_000
_MAX_NS = 2**63 - 1


class ClockType(enum.IntEnum):
    """Which clock a time was read from."""

    UNINITIALIZED = 0
    ROS_TIME = 1
    SYSTEM_TIME = 2
    STEADY_TIME = 3


def seconds_to_ns(seconds: float) -> int:
    """Return seconds as whole nanoseconds, cut off as genuine rclpy does (0.1 s is 100 000 000 ns).

    Raises:
        InputError: not a number.
    """
    given: Any = seconds
    if isinstance(given, (str, bytes)):
        raise InputError("seconds", given=given, expected="a number", fix="Convert it with float(...).")
    return int(given * NS_PER_S)


def _message_ns(msg: Any, typename: str) -> int:
    if getattr(msg, "__msgtype__", None) != typename:
        raise TypeError(f"Must pass a {typename} object, got {getattr(msg, '__msgtype__', type(msg).__name__)}")
    return int(msg.sec * NS_PER_S + msg.nanosec)


@total_ordering
class Duration:
    """A signed span of simulated time.

    Args:
        seconds: span in seconds (float or int).
        nanoseconds: added to ``seconds``, in nanoseconds.
    """

    __slots__ = ("_ns",)

    def __init__(self, *, seconds: float = 0, nanoseconds: float = 0) -> None:
        total = seconds_to_ns(seconds) + int(nanoseconds)
        if not -_MAX_NS - 1 <= total <= _MAX_NS:
            raise OverflowError(f"Duration of {total} ns does not fit 64 bits (292 years)")
        self._ns = total

    @property
    def nanoseconds(self) -> int:
        """The span in nanoseconds."""
        return self._ns

    def to_msg(self) -> Any:
        """Return a ``builtin_interfaces/msg/Duration``."""
        sec, nanosec = divmod(self._ns, NS_PER_S)
        return message_class("builtin_interfaces/msg/Duration")(sec=sec, nanosec=nanosec)

    @classmethod
    def from_msg(cls, msg: Any) -> Duration:
        """Build from a ``builtin_interfaces/msg/Duration``."""
        return cls(nanoseconds=_message_ns(msg, "builtin_interfaces/msg/Duration"))

    def __add__(self, other: object) -> Any:
        if isinstance(other, Duration):
            return Duration(nanoseconds=self._ns + other._ns)
        return NotImplemented

    def __sub__(self, other: object) -> Any:
        if isinstance(other, Duration):
            return Duration(nanoseconds=self._ns - other._ns)
        return NotImplemented

    def __mul__(self, factor: object) -> Any:
        if isinstance(factor, (int, float)):
            return Duration(nanoseconds=round(self._ns * factor))
        return NotImplemented

    def __eq__(self, other: object) -> bool:
        return self._ns == other._ns if isinstance(other, Duration) else NotImplemented

    def __lt__(self, other: object) -> bool:
        return self._ns < other._ns if isinstance(other, Duration) else NotImplemented

    __hash__ = None  # type: ignore[assignment]

    def __str__(self) -> str:
        return f"{self._ns} nanoseconds"

    def __repr__(self) -> str:
        return f"Duration(nanoseconds={self._ns})"


Infinite = Duration(nanoseconds=_MAX_NS)


@total_ordering
class Time:
    """A point in time of one clock.

    Args:
        seconds: seconds since the clock's zero (not negative).
        nanoseconds: added to ``seconds``.
        clock_type: clock it belongs to; times of different clocks do not compare (TypeError), as in rclpy.
    """

    __slots__ = ("_clock_type", "_ns")

    def __init__(
        self,
        *,
        seconds: float = 0,
        nanoseconds: float = 0,
        clock_type: ClockType = ClockType.SYSTEM_TIME,
    ) -> None:
        if seconds < 0 or nanoseconds < 0:
            raise InputError(
                "Time",
                given=(seconds, nanoseconds),
                expected="seconds and nanoseconds >= 0",
                fix="Use Duration for a span that may be negative.",
            )
        total = seconds_to_ns(seconds) + int(nanoseconds)
        if total > _MAX_NS:
            raise OverflowError(f"Time of {total} ns does not fit 64 bits (292 years)")
        self._ns, self._clock_type = total, ClockType(clock_type)

    @property
    def nanoseconds(self) -> int:
        """Nanoseconds since the clock's zero."""
        return self._ns

    @property
    def clock_type(self) -> ClockType:
        """The clock it belongs to."""
        return self._clock_type

    def seconds_nanoseconds(self) -> tuple[int, int]:
        """Return whole seconds and the remaining nanoseconds."""
        return divmod(self._ns, NS_PER_S)

    def to_msg(self) -> Any:
        """Return a ``builtin_interfaces/msg/Time``."""
        sec, nanosec = divmod(self._ns, NS_PER_S)
        return message_class("builtin_interfaces/msg/Time")(sec=sec, nanosec=nanosec)

    @classmethod
    def from_msg(cls, msg: Any, clock_type: ClockType = ClockType.ROS_TIME) -> Time:
        """Build from a ``builtin_interfaces/msg/Time``."""
        return cls(nanoseconds=_message_ns(msg, "builtin_interfaces/msg/Time"), clock_type=clock_type)

    def __add__(self, other: object) -> Any:
        if isinstance(other, Duration):
            return Time(nanoseconds=self._ns + other.nanoseconds, clock_type=self._clock_type)
        return NotImplemented

    __radd__ = __add__

    def __sub__(self, other: object) -> Any:
        if isinstance(other, Time):
            self._same_clock(other, "subtract")
            return Duration(nanoseconds=self._ns - other._ns)
        if isinstance(other, Duration):
            return Time(nanoseconds=self._ns - other.nanoseconds, clock_type=self._clock_type)
        return NotImplemented

    def _same_clock(self, other: Time, verb: str) -> None:
        if self._clock_type != other._clock_type:
            raise TypeError(
                f"cannot {verb} times of different clocks ({self._clock_type.name} and {other._clock_type.name}); "
                "Time.from_msg gives ROS_TIME, as node.get_clock().now() does; Time() alone gives SYSTEM_TIME"
            )

    def __eq__(self, other: object) -> bool:
        if isinstance(other, Time):
            self._same_clock(other, "compare")
            return self._ns == other._ns
        return NotImplemented

    def __lt__(self, other: object) -> bool:
        if isinstance(other, Time):
            self._same_clock(other, "compare")
            return self._ns < other._ns
        return NotImplemented

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return f"Time(nanoseconds={self._ns}, clock_type={self._clock_type.name})"
