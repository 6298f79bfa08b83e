"""The safety node against closed forms, in simulated time."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import robotbrain.ros  # noqa: F401 - makes rclpy importable
from robotbrain.errors import InputError
from robotbrain.pipeline.nodes.safety import RATE_HZ, SafetyLimits, SafetyNode, TwistLimiter, approach, limits_from
from robotbrain.ros import SimContext
from robotbrain.ros.logging import LogRecord

LIMITS = SafetyLimits()
PERIOD = 1.0 / RATE_HZ
SPEEDS = st.floats(-3.0, 3.0)


class Bench:
    """A safety node, a hand on its commands and an eye on its output."""

    def __init__(self, limits: SafetyLimits | None = None) -> None:
        from geometry_msgs.msg import Twist
        from rclpy.node import Node
        from rclpy.qos import DurabilityPolicy, QoSProfile
        from std_msgs.msg import Bool
        from std_srvs.srv import SetBool

        self.context = SimContext()
        self.log: list[LogRecord] = []
        self.context.log_sink = self.log.append
        self.out: list[tuple[float, float, float]] = []
        self.states: list[bool] = []
        with self.context.as_default():
            self.safety = SafetyNode(limits)
            self.node = Node("bench")
            self.publisher = self.node.create_publisher(Twist, "cmd_vel", 10)
            self.node.create_subscription(Twist, "cmd_vel_safe", self._take, 10)
            latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            self.node.create_subscription(
                Bool, "emergency_stop/state", lambda msg: self.states.append(bool(msg.data)), latched
            )
            self.client = self.node.create_client(SetBool, "emergency_stop")
        self.twist, self.request = Twist, SetBool.Request

    def _take(self, msg: Any) -> None:
        self.out.append((self.context.now_ns * 1e-9, msg.linear.x, msg.angular.z))

    def send(self, v: float, w: float, **others: float) -> None:
        msg = self.twist()
        msg.linear.x, msg.angular.z = v, w
        msg.linear.y = others.get("y", 0.0)
        self.publisher.publish(msg)

    def hold(self, v: float, w: float, seconds: float, every: float = 0.05) -> None:
        for _ in range(round(seconds / every)):
            self.send(v, w)
            self.context.run_for(every)

    def stop(self, on: bool) -> Any:
        future = self.client.call_async(self.request(data=on))
        self.context.run_for(0.001)
        return future.result()

    def table(self) -> np.ndarray:
        return np.array(self.out)


def test_speeding_up_is_a_ramp_of_the_acceleration_limit() -> None:
    bench = Bench()
    bench.hold(0.5, 0.0, 1.0)
    t, v, _ = bench.table().T
    # The first command comes at t = 0; v(t) = a t until the wanted speed.
    np.testing.assert_allclose(v, np.minimum(LIMITS.max_acceleration * t, 0.5), atol=1e-9)


def test_slowing_down_uses_the_deceleration_limit() -> None:
    bench = Bench()
    bench.hold(0.6, 0.0, 1.0)
    bench.out.clear()
    start = bench.context.now_ns * 1e-9
    bench.hold(0.1, 0.0, 0.5)
    t, v, _ = bench.table().T
    np.testing.assert_allclose(v, np.maximum(0.6 - LIMITS.max_deceleration * (t - start), 0.1), atol=1e-9)


def test_reversing_goes_through_zero_in_the_closed_form_time() -> None:
    limiter, dt = TwistLimiter(LIMITS), 1e-3
    limiter.v = 0.4
    steps = 0
    while limiter.v > -0.3:
        limiter.follow(-0.3, 0.0, dt)
        steps += 1
    assert steps * dt == pytest.approx(0.4 / LIMITS.max_deceleration + 0.3 / LIMITS.max_acceleration, abs=2 * dt)


@given(SPEEDS, SPEEDS, st.floats(0.0, 0.1), st.floats(1e-3, 0.2))
def test_approach_does_not_depend_on_how_time_is_cut(now: float, wanted: float, dt: float, part: float) -> None:
    up, down = 1.0, 2.0
    whole = approach(now, wanted, up * dt, down * dt) if dt else now
    first = approach(now, wanted, up * dt * part, down * dt * part) if dt * part else now
    rest = dt * (1 - part)
    assert approach(first, wanted, up * rest, down * rest) == pytest.approx(whole, abs=1e-9)


@given(SPEEDS, SPEEDS)
def test_speed_limits_keep_the_arc(v: float, w: float) -> None:
    a, b = LIMITS.within(v, w)
    assert abs(a) <= LIMITS.max_speed + 1e-12 and abs(b) <= LIMITS.max_yaw_rate + 1e-12
    assert a * w == pytest.approx(b * v, abs=1e-9)
    if abs(v) <= LIMITS.max_speed and abs(w) <= LIMITS.max_yaw_rate:
        assert (a, b) == (v, w)


@given(st.floats(-0.6, 0.6), st.floats(-1.8, 1.8))
def test_stopping_keeps_the_arc_and_takes_the_ramp_s_time(v: float, w: float) -> None:
    limiter, dt = TwistLimiter(LIMITS), 0.005
    limiter.v, limiter.w = v, w
    ramp = max(abs(v) / LIMITS.max_deceleration, abs(w) / LIMITS.max_yaw_deceleration)
    elapsed = 0.0
    while elapsed < ramp - dt:
        before = limiter.v, limiter.w
        limiter.stop(dt)
        elapsed += dt
        assert limiter.v == pytest.approx(v * (1 - elapsed / ramp), abs=1e-9)
        assert limiter.w == pytest.approx(w * (1 - elapsed / ramp), abs=1e-9)
        assert abs(before[0] - limiter.v) <= LIMITS.max_deceleration * dt + 1e-9
        assert abs(before[1] - limiter.w) <= LIMITS.max_yaw_deceleration * dt + 1e-9
    limiter.stop(dt + 1e-9)
    assert limiter.v == pytest.approx(0.0, abs=1e-9) and limiter.w == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(("v", "w"), [(0.6, 0.0), (0.3, 1.2), (-0.5, 0.4), (0.0, 1.8), (0.05, 0.0)])
@pytest.mark.parametrize("timeout", [0.5, 1.0])
def test_watchdog_commands_zero_by_its_timeout_and_not_early(v: float, w: float, timeout: float) -> None:
    limits = SafetyLimits(timeout_s=timeout)
    bench = Bench(limits)
    bench.hold(v, w, 1.5)
    bench.send(v, w)
    last = bench.context.now_ns * 1e-9
    bench.out.clear()
    bench.context.run_for(timeout + 0.5)
    t, linear, angular = bench.table().T
    moving = (np.abs(linear) > 1e-9) | (np.abs(angular) > 1e-9)
    zero = t[np.flatnonzero(moving)[-1] + 1]
    assert zero <= last + timeout + PERIOD + 1e-9
    # Until the ramp must begin, the command stays in force.
    begin = last + timeout - limits.ramp_s(v, w)
    held = t < begin - PERIOD
    np.testing.assert_allclose(linear[held], v, atol=1e-9)
    # No step: each change stays within the deceleration limit, but for the rounding of one period at the end.
    assert np.all(np.abs(np.diff(linear)) <= limits.max_deceleration * PERIOD * 1.01 + 1e-9)
    assert np.all(np.abs(np.diff(angular)) <= limits.max_yaw_deceleration * PERIOD * 1.01 + 1e-9)


def test_watchdog_recovers_with_the_next_command() -> None:
    bench = Bench()
    bench.hold(0.4, 0.0, 1.0)
    bench.context.run_for(2.0)
    assert bench.out[-1][1:] == (0.0, 0.0)
    bench.hold(0.4, 0.0, 1.0)
    assert bench.out[-1][1] == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("v", "w", "reason"),
    [
        (math.nan, 0.0, "not finite"),
        (0.0, math.inf, "not finite"),
        (3.1, 0.0, "m/s"),
        (0.0, -9.1, "rad/s"),
    ],
)
def test_faulty_commands_are_refused_with_a_reason_and_do_not_feed_the_watchdog(
    v: float, w: float, reason: str
) -> None:
    bench = Bench()
    bench.hold(0.4, 0.0, 1.0)
    bench.out.clear()
    bench.hold(v, w, 0.1)
    assert bench.out[0][1] == pytest.approx(0.4), "the last good command stays in force"
    bench.hold(v, w, 0.9)
    assert bench.safety.refused == 20
    assert bench.out[-1][1:] == (0.0, 0.0)
    assert any("refused" in record.message and reason in record.message for record in bench.log)
    assert np.isfinite(bench.table()).all()


def test_sideways_commands_are_refused() -> None:
    bench = Bench()
    bench.send(0.1, 0.0, y=0.2)
    bench.context.run_for(0.1)
    assert bench.safety.refused == 1 and all(row[1:] == (0.0, 0.0) for row in bench.out)


def test_emergency_stop_latches_until_released() -> None:
    bench = Bench()
    bench.hold(0.6, 0.0, 1.0)
    answer = bench.stop(True)
    assert answer.success and bench.states == [False, True]
    begin = bench.context.now_ns * 1e-9
    bench.out.clear()
    bench.hold(0.6, 0.0, 1.0)
    t, v, _ = bench.table().T
    np.testing.assert_allclose(v, np.maximum(0.6 - LIMITS.max_deceleration * (t - begin), 0.0), atol=0.05)
    assert v[-1] == 0.0, "commands move nothing while it is set"
    bench.stop(False)
    assert bench.states == [False, True, False]
    bench.out.clear()
    bench.context.run_for(0.3)
    assert all(row[1:] == (0.0, 0.0) for row in bench.out), "releasing moves nothing by itself"
    bench.hold(0.6, 0.0, 1.0)
    assert bench.out[-1][1] == pytest.approx(0.6)


def test_emergency_stop_is_told_to_latecomers() -> None:
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from std_msgs.msg import Bool

    bench = Bench()
    bench.stop(True)
    seen: list[bool] = []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    bench.node.create_subscription(Bool, "emergency_stop/state", lambda msg: seen.append(bool(msg.data)), latched)
    bench.context.run_for(0.1)
    assert seen == [True]


@pytest.mark.parametrize("bad", [{"timeout_s": 0.0}, {"max_speed": math.nan}, {"timeout_s": 0.3}, {"max_speed": True}])
def test_impossible_limits(bad: dict[str, float]) -> None:
    with pytest.raises(InputError, match="safety"):
        SafetyLimits(**bad)


def test_limits_by_name() -> None:
    assert limits_from({"max_speed": 0.22}) == SafetyLimits(max_speed=0.22)
    with pytest.raises(InputError, match="safety limit"):
        limits_from({"speed": 1.0})
