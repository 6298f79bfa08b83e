"""Old data: how old it is, whether to act on it, and how fast a robot may drive on it.

Every stamped message says when what it describes was true. A node that acts on the newest message it has, without
looking at its age, drives on blindly when a sensor, a network or a node upstream stops: nothing calls it back to say
so. A :class:`Freshest` keeps the newest message of a topic; a :class:`StaleGuard` judges its age each time it is used.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Generic, Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robotbrain.errors import InputError
from robotbrain.pipeline.geometry import Pose, wrap
from robotbrain.pipeline.patterns.stages import NS_PER_S
from robotbrain.ros.conversions import time_ns

MessageT = TypeVar("MessageT")

Policy = Literal["stop", "slow", "extrapolate"]
POLICIES: tuple[Policy, ...] = ("stop", "slow", "extrapolate")
"""What to do as data grows old, see :class:`StaleGuard`."""

State = Literal["fresh", "ageing", "stale", "future", "missing"]


@dataclass(frozen=True)
class Verdict:
    """What a guard says about a message.

    Attributes:
        state: ``fresh``; ``ageing`` (usable with care); ``stale`` (too old); ``future`` (its clock and ours differ);
            ``missing`` (there is none).
        age_s: s; NaN if there is none.
        speed_scale: factor for the robot's speed, 0 (stop) to 1.
        predict_s: how far ahead to extrapolate what the message says, s; 0 if not at all.
        reason: in words, for a log; empty if fresh.
    """

    state: State
    age_s: float
    speed_scale: float
    predict_s: float = 0.0
    reason: str = ""

    @property
    def usable(self) -> bool:
        """Whether to act on the message at all."""
        return self.state in ("fresh", "ageing")

    def __bool__(self) -> bool:
        return self.usable


class StaleGuard:
    """Judges the age of data each time it is used.

    Policies:

    - ``stop``: full speed up to ``max_age``, then none.
    - ``slow``: full speed up to ``fresh_age``, then less in proportion, none from ``max_age`` on.
    - ``extrapolate``: as stop, and ``predict_s`` is the age, for :func:`extrapolate` and the like.

    Args:
        max_age: older data is not acted upon, s.
        fresh_age: data up to that age is as good as new, s; half of ``max_age`` if None. ``stop`` has no use for it.
        policy: one of POLICIES.
        future: how far stamps may lie ahead of our clock (clocks of two computers never agree), s.

    Attributes:
        counts: how often it gave each state.

    Raises:
        InputError: unless 0 <= fresh_age <= max_age and 0 < max_age, or for an unknown policy.
    """

    def __init__(
        self, max_age: float, *, fresh_age: float | None = None, policy: Policy = "stop", future: float = 0.005
    ) -> None:
        fresh = max_age / 2 if fresh_age is None else fresh_age
        if policy not in POLICIES:
            raise InputError("policy", given=policy, expected="one of " + ", ".join(POLICIES), fix="Choose one.")
        if not (0 < max_age < float("inf") and 0 <= fresh <= max_age and future >= 0):
            raise InputError(
                "ages",
                given={"max_age": max_age, "fresh_age": fresh_age, "future": future},
                expected="0 <= fresh_age <= max_age, max_age > 0 and future >= 0, in seconds",
                fix="For a camera at 10 Hz max_age=0.3 tolerates two lost frames.",
            )
        self.max_age, self.fresh_age, self.policy, self.future = max_age, fresh, policy, future
        self.counts: dict[State, int] = {"fresh": 0, "ageing": 0, "stale": 0, "future": 0, "missing": 0}

    def judge(self, stamp: Any, now: Any) -> Verdict:
        """Return the verdict on data of a time.

        Args:
            stamp: of the data, or its message (see :func:`time_ns`); None: there is none.
            now: by the clock that the data was stamped with, e.g. ``self.get_clock().now()``.
        """
        verdict = self._judge(None if stamp is None else (time_ns(now) - time_ns(stamp)) / NS_PER_S)
        self.counts[verdict.state] += 1
        return verdict

    def _judge(self, age: float | None) -> Verdict:
        if age is None:
            return Verdict("missing", float("nan"), 0.0, reason="nothing has come yet")
        if age < -self.future:
            reason = (
                f"stamped {-age * 1e3:.0f} ms in the future: are the clocks synchronised, is use_sim_time the same?"
            )
            return Verdict("future", age, 0.0, reason=reason)
        if age > self.max_age:
            return Verdict("stale", age, 0.0, reason=f"{age * 1e3:.0f} ms old, {self.max_age * 1e3:.0f} ms allowed")
        if self.policy == "stop" or age <= self.fresh_age:
            return Verdict("fresh", age, 1.0, max(0.0, age) if self.policy == "extrapolate" else 0.0)
        if self.policy == "extrapolate":
            return Verdict("ageing", age, 1.0, age, f"{age * 1e3:.0f} ms old: extrapolated")
        scale = (self.max_age - age) / (self.max_age - self.fresh_age)
        return Verdict("ageing", age, scale, reason=f"{age * 1e3:.0f} ms old: slowed down to {100 * scale:.0f} %")


class Freshest(Generic[MessageT]):
    """The newest message of a topic, by its stamp.

    ``create_subscription(LaserScan, "scan", freshest.put, 1)`` fills it; the control timer looks at it. A message that
    is older than the one kept (overtaken on its way, or from a bag that was rewound) is not taken.

    Args:
        guard: judges its age when it is used; None: it may have any age.
    """

    def __init__(self, guard: StaleGuard | None = None) -> None:
        self.guard = guard
        self.message: MessageT | None = None
        self.overtaken = 0
        self._stamp_ns = -1

    def put(self, message: MessageT) -> bool:
        """Keep a message if it is the newest; return whether it is."""
        stamp = time_ns(message)
        if stamp < self._stamp_ns:
            self.overtaken += 1
            return False
        self.message, self._stamp_ns = message, stamp
        return True

    def clear(self) -> None:
        """Forget the message, as after a jump of the clock."""
        self.message, self._stamp_ns = None, -1

    def get(self, now: Any) -> tuple[MessageT | None, Verdict]:
        """Return the message if it may be acted upon (else None), and the verdict.

        Args:
            now: see :meth:`StaleGuard.judge`.
        """
        if self.guard is None:
            if self.message is None:
                return None, Verdict("missing", float("nan"), 0.0, reason="nothing has come yet")
            return self.message, Verdict("fresh", (time_ns(now) - self._stamp_ns) / NS_PER_S, 1.0)
        verdict = self.guard.judge(self.message, now)
        return (self.message if verdict.usable else None), verdict


# ------------------------------------------------------------ what age costs


def stopping_distance(speed: ArrayLike, age: ArrayLike, a_max: float) -> NDArray[np.float64]:
    """Return how far a robot still goes from where the data was taken: blind for ``age``, then braking, m.

    d = v age + v² / (2 a).

    Args:
        speed: m/s, >= 0.
        age: of the data when the brakes bite: sensing, computing and acting, s, >= 0.
        a_max: deceleration, m/s², > 0.
    """
    v, t = _checked(speed, "speed"), _checked(age, "age")
    return np.asarray(v * t + v * v / (2 * _positive(a_max)), dtype=float)


def safe_speed(age: ArrayLike, distance: ArrayLike, a_max: float) -> NDArray[np.float64]:
    """Return the largest speed from which a robot stops within ``distance``, m/s.

    The root of :func:`stopping_distance`: v = 2 d / (t + sqrt(t² + 2 d / a)), written so that nothing cancels.

    Args:
        age: of the data when the brakes bite, s, >= 0. Take the peak age, not the mean.
        distance: free, as the data says, m, >= 0; take the map's error and a margin off first.
        a_max: deceleration, m/s², > 0.

    Raises:
        InputError: for a negative or missing number.
    """
    t, d = _checked(age, "age"), _checked(distance, "distance")
    root = t + np.sqrt(t * t + 2 * d / _positive(a_max))
    return np.asarray(np.divide(2 * d, root, out=np.zeros(np.broadcast(t, d).shape), where=root > 0), dtype=float)


def _checked(values: ArrayLike, what: str) -> NDArray[np.float64]:
    found = np.asarray(values, dtype=float)
    if not np.all(found >= 0):
        raise InputError(what, given=values, expected="numbers >= 0", fix="Check the clocks: an age is not negative.")
    return found


def _positive(a_max: float) -> float:
    if not 0 < a_max < float("inf"):
        raise InputError("a_max", given=a_max, expected="m/s² > 0", fix="The kit's robot brakes with 1 m/s².")
    return float(a_max)


def extrapolate(pose: Pose, v: float, w: float, seconds: float) -> Pose:
    """Return where a robot is that has kept its speeds since ``pose``: an arc, exactly.

    Args:
        pose: x m, y m, yaw rad.
        v: forward speed, m/s.
        w: yaw rate, rad/s.
        seconds: since then.
    """
    x, y, yaw = pose
    turn = w * seconds
    # sin(a / 2) / (a / 2) in chord and direction: no division by a yaw rate of zero.
    chord = v * seconds * float(np.sinc(turn / (2 * np.pi)))
    return (x + chord * float(np.cos(yaw + turn / 2)), y + chord * float(np.sin(yaw + turn / 2)), wrap(yaw + turn))
