"""Safety node: the last one before the motors. Limits commands, stops when they stop, and has an emergency stop.

It belongs on the robot's computer, so that it goes on when the brain, its computer or the network fails.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass

from geometry_msgs.msg import Twist
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Bool
from std_srvs.srv import SetBool

from robotbrain.errors import InputError

RATE_HZ = 50.0
ABSURD = 5.0
"""A command of more than so many times the largest speed is a fault, not a wish: it is refused, not limited."""


@dataclass(frozen=True)
class SafetyLimits:
    """What the motors may be asked for.

    Args:
        timeout_s: this long after the last accepted command the commanded velocity is zero, the ramp included.
        max_speed, max_yaw_rate: m/s and rad/s; a faster command is slowed down in both, so that it keeps its arc.
        max_acceleration, max_yaw_acceleration: while speeding up, m/s^2 and rad/s^2.
        max_deceleration, max_yaw_deceleration: while slowing down; also of the ramps of watchdog and emergency stop.

    Raises:
        InputError: a value that is not positive and finite, or a ramp from full speed that takes longer than 3/4 of
            ``timeout_s``: the watchdog would brake between any two commands.
    """

    timeout_s: float = 0.5
    max_speed: float = 0.6
    max_yaw_rate: float = 1.8
    max_acceleration: float = 1.0
    max_yaw_acceleration: float = 4.0
    max_deceleration: float = 2.0
    max_yaw_deceleration: float = 8.0

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < math.inf:
                raise InputError(
                    f"safety.{field.name}", given=value, expected="a number > 0", fix="See SafetyLimits for the units."
                )
        longest = self.ramp_s(self.max_speed, self.max_yaw_rate)
        if longest > 0.75 * self.timeout_s:
            raise InputError(
                "safety.timeout_s",
                given=self.timeout_s,
                expected=f"at least {longest / 0.75:.3g} s: stopping from full speed takes {longest:.3g} s",
                fix="Allow more deceleration, less speed, or a longer timeout.",
            )

    def ramp_s(self, v: float, w: float) -> float:
        """Return how long it takes to stop from ``v`` m/s and ``w`` rad/s, s."""
        return max(abs(v) / self.max_deceleration, abs(w) / self.max_yaw_deceleration)

    def within(self, v: float, w: float) -> tuple[float, float]:
        """Return the velocity with the same curvature within the speed limits."""
        scale = 1.0 / max(1.0, abs(v) / self.max_speed, abs(w) / self.max_yaw_rate)
        return v * scale, w * scale


def limits_from(values: Mapping[str, float]) -> SafetyLimits:
    """Return the limits with some fields replaced.

    Raises:
        InputError: unknown fields or impossible values.
    """
    known = {field.name for field in dataclasses.fields(SafetyLimits)}
    for name in values:
        if name not in known:
            raise InputError(
                "safety limit", given=name, expected="one of " + ", ".join(sorted(known)), fix="Check the spelling."
            )
    return SafetyLimits(**values)


class TwistLimiter:
    """The velocity to command now, given the one wanted: pure arithmetic, no clock.

    Args:
        limits: of the robot.

    Attributes:
        v, w: the velocity last returned, m/s and rad/s.
    """

    def __init__(self, limits: SafetyLimits) -> None:
        self.limits = limits
        self.v = self.w = 0.0

    def follow(self, v: float, w: float, dt: float) -> tuple[float, float]:
        """Move towards the velocity wanted as fast as the limits allow; ``dt`` s have passed since the last call."""
        limits = self.limits
        v, w = limits.within(v, w)
        self.v = approach(self.v, v, limits.max_acceleration * dt, limits.max_deceleration * dt)
        self.w = approach(self.w, w, limits.max_yaw_acceleration * dt, limits.max_yaw_deceleration * dt)
        return self.v, self.w

    def stop(self, dt: float) -> tuple[float, float]:
        """Brake: both speeds fall along straight lines that reach zero together, so that the robot keeps its arc."""
        ramp = self.limits.ramp_s(self.v, self.w)
        # What is left after dt; less than a nanosecond of ramp is no motion.
        keep = max(0.0, 1.0 - dt / ramp) if ramp > 1e-9 else 0.0
        # Adding zero turns a negative zero into a positive one.
        self.v, self.w = self.v * keep + 0.0, self.w * keep + 0.0
        return self.v, self.w


def approach(now: float, wanted: float, up: float, down: float) -> float:
    """Return ``now`` moved towards ``wanted`` by at most ``up`` away from zero and ``down`` towards it.

    A change of sign goes through zero: it slows down with ``down`` first, and speeds up with the rest of the time.
    """
    if now * wanted < 0.0:
        if abs(now) >= down:
            return now - math.copysign(down, now)
        left = 1.0 - abs(now) / down
        return math.copysign(min(abs(wanted), up * left), wanted)
    if abs(wanted) > abs(now):
        return math.copysign(min(abs(wanted), abs(now) + up), wanted)
    return math.copysign(max(abs(wanted), abs(now) - down), now)


def refusal(msg: Twist, limits: SafetyLimits) -> str:
    """Return why a command cannot be obeyed, or ``""``."""
    linear, angular = msg.linear, msg.angular
    values = (linear.x, linear.y, linear.z, angular.x, angular.y, angular.z)
    if not all(math.isfinite(value) for value in values):
        return f"it is not finite: linear {values[:3]}, angular {values[3:]}"
    if abs(linear.x) > ABSURD * limits.max_speed:
        return f"{linear.x:g} m/s is more than {ABSURD:g} times the largest speed, {limits.max_speed:g} m/s"
    if abs(angular.z) > ABSURD * limits.max_yaw_rate:
        return f"{angular.z:g} rad/s is more than {ABSURD:g} times the largest rate, {limits.max_yaw_rate:g} rad/s"
    if linear.y or linear.z or angular.x or angular.y:
        return f"a robot on two wheels moves by linear.x and angular.z only: linear {values[:3]}, angular {values[3:]}"
    return ""


class SafetyNode(Node):
    """Subscribes ``cmd_vel`` and publishes ``cmd_vel_safe`` (both Twist, in base_link) for the motor driver.

    - Limits speed and acceleration. Commands that are not finite, absurdly fast, or not for a robot on two wheels are
      refused with the reason in the log; the last good command stays in force.
    - Watchdog: when no good command came, it ramps down in time to command zero ``timeout_s`` after the last one.
    - ``emergency_stop`` (std_srvs/srv/SetBool): true stops and stays; false releases, and the robot moves again with
      the next command. ``emergency_stop/state`` (std_msgs/msg/Bool, latched) tells.

    Ages are reckoned from the arrival of commands on this node's clock; the brain's clock plays no part.

    Args:
        limits: of the robot.

    Attributes:
        refused: commands refused so far.
        stopped: whether the emergency stop is set.
    """

    def __init__(self, limits: SafetyLimits | None = None) -> None:
        super().__init__("safety")
        self.limits = limits or SafetyLimits()
        self.refused = 0
        self.stopped = False
        self._limiter = TwistLimiter(self.limits)
        self._wanted: tuple[float, float] | None = None
        self._heard_ns = self._last_ns = self._now_ns()
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._publisher = self.create_publisher(Twist, "cmd_vel_safe", 1)
        self._state_pub = self.create_publisher(Bool, "emergency_stop/state", latched)
        self.create_subscription(Twist, "cmd_vel", self._on_command, 1)
        self.create_service(SetBool, "emergency_stop", self._on_emergency_stop)
        self.create_timer(1.0 / RATE_HZ, self._tick)
        self._state_pub.publish(Bool(data=False))

    def _now_ns(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _on_command(self, msg: Twist) -> None:
        reason = refusal(msg, self.limits)
        if reason:
            self.refused += 1
            self.get_logger().error(f"refused a command: {reason}", throttle_duration_sec=1.0)
            return
        if self.stopped:
            return
        self._wanted = (float(msg.linear.x), float(msg.angular.z))
        self._heard_ns = self._now_ns()
        # Not at the next tick: that would make every command 10 ms older on average.
        self._tick()

    def _on_emergency_stop(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if request.data != self.stopped:
            self.get_logger().warning("emergency stop " + ("set" if request.data else "released"))
        self.stopped = bool(request.data)
        self._wanted = None
        self._state_pub.publish(Bool(data=self.stopped))
        response.success = True
        response.message = "stopped until released" if self.stopped else "released: the next command moves the robot"
        return response

    def _tick(self) -> None:
        now = self._now_ns()
        # A tick that comes late must not allow a jump, and a clock that went back no motion at all.
        dt = min(max(0.0, (now - self._last_ns) * 1e-9), 2.0 / RATE_HZ)
        self._last_ns = now
        age = (now - self._heard_ns) * 1e-9
        ramp = self.limits.ramp_s(self._limiter.v, self._limiter.w)
        if self._wanted is not None and not -1.0 <= age < self.limits.timeout_s - ramp:
            if any(self._wanted):
                self.get_logger().warning(
                    f"watchdog: no command for {age:.2f} s; braking now, to stand at {self.limits.timeout_s:g} s",
                    throttle_duration_sec=1.0,
                )
            self._wanted = None
        if self._wanted is not None:
            v, w = self._limiter.follow(*self._wanted, dt)
        elif age >= self.limits.timeout_s and not self.stopped:
            # Only where ticks came too late for the ramp: the promise goes first.
            v, w = self._limiter.stop(math.inf)
        else:
            v, w = self._limiter.stop(dt)
        command = Twist()
        command.linear.x, command.angular.z = v, w
        self._publisher.publish(command)
