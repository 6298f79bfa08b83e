"""The differential-drive robot: its parameters and the firmware that turns a twist into wheel torque.

Frames: ``base_link`` has its origin on the floor beneath the middle of the axle, x forward, y left, z up.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

from robotbrain.sim.checks import check_each, check_range

CHASSIS_RADIUS = 0.18
"""Radius of the robot's footprint (m)."""
CHASSIS_BOTTOM, CHASSIS_TOP = 0.03, 0.15
LIDAR_HEIGHT = 0.20
"""Height of the lidar plane above the floor (m)."""
NOMINAL_WHEEL_RADIUS = 0.06
NOMINAL_TRACK = 0.30


@dataclass(frozen=True, slots=True)
class RobotParams:
    """The body and drive of one robot.

    Args:
        mass: whole robot (kg).
        wheel_radius: what firmware and odometry believe (m).
        track: distance between the wheels (m).
        wheel_radius_error: relative error of the (left, right) real wheel radius: real = believed * (1 + error).
        wheel_friction: sliding friction coefficient between wheel and floor.
        box_friction: sliding friction coefficient between boxes and floor.
        motor_lag_s: time constant of the wheel speed behind its set point (first order).
        backlash_rad: play between motor and wheel.
        max_torque: of one wheel (N m).
        max_speed: forward speed limit (m/s).
        max_yaw_rate: turning limit (rad/s).
        max_acceleration: forward acceleration limit (m/s^2).
        max_yaw_acceleration: turning acceleration limit (rad/s^2).
        command_delay_s: from ``set_twist`` to the firmware seeing it.
        command_timeout_s: the watchdog stops the robot when no command came for this long.

    Raises:
        InputError: a value outside its physical range.
    """

    mass: float = 5.0
    wheel_radius: float = NOMINAL_WHEEL_RADIUS
    track: float = NOMINAL_TRACK
    wheel_radius_error: tuple[float, float] = (0.0, 0.0)
    wheel_friction: float = 1.0
    box_friction: float = 0.5
    motor_lag_s: float = 0.04
    backlash_rad: float = 0.0
    max_torque: float = 1.0
    max_speed: float = 0.6
    max_yaw_rate: float = 1.8
    max_acceleration: float = 1.0
    max_yaw_acceleration: float = 4.0
    command_delay_s: float = 0.0
    command_timeout_s: float = 0.5

    def __post_init__(self) -> None:
        zero_allowed = {"motor_lag_s", "backlash_rad", "command_delay_s"}
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.name == "wheel_radius_error":
                check_each("robot.wheel_radius_error", value, 2, -0.2, 0.2)
            else:
                low = 0.0 if field.name in zero_allowed else 1e-6
                check_range(f"robot.{field.name}", value, low, math.inf)
        check_range("robot.wheel_radius", self.wheel_radius, 0.04, 0.08)
        check_range("robot.track", self.track, 0.2, 0.34)

    @property
    def max_wheel_speed(self) -> float:
        """Wheel speed limit (rad/s): full speed ahead in the tightest turn that the limits allow."""
        return (self.max_speed + self.max_yaw_rate * self.track / 2.0) / self.wheel_radius


@dataclass(frozen=True, slots=True)
class SensorParams:
    """Errors and timing of every sensor. Standard deviations are per reading.

    Args:
        encoder_ticks: per wheel revolution; positions are rounded to ticks.
        encoder_slip: random-walk slip, standard deviation in rad per square root of a rad rolled.
        encoder_velocity_noise: rad/s.
        gyro_noise: rad/s.
        gyro_bias: constant bias of the (x, y, z) rates (rad/s).
        accelerometer_noise: m/s^2.
        lidar_noise: of a range (m).
        lidar_dropout: probability that a ray returns nothing (+inf).
        camera_noise: of a pixel, in grey levels of 255.
        camera_tint: colour response (r, g, b), multiplied into every pixel.
        camera_exposure: brightness factor.
        depth_noise: of a depth at 1 m; it grows with the square of depth, as stereo depth does.
        camera_drop: probability that a frame is lost.
        lidar_drop: probability that a scan is lost.
        camera_latency_s: from taking a frame to its arrival.
        lidar_latency_s: from taking a scan to its arrival.

    Raises:
        InputError: a value outside its range.
    """

    encoder_ticks: int = 2048
    encoder_slip: float = 0.002
    encoder_velocity_noise: float = 0.02
    gyro_noise: float = 0.003
    gyro_bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    accelerometer_noise: float = 0.05
    lidar_noise: float = 0.01
    lidar_dropout: float = 0.005
    camera_noise: float = 3.0
    camera_tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    camera_exposure: float = 1.0
    depth_noise: float = 0.002
    camera_drop: float = 0.0
    lidar_drop: float = 0.0
    camera_latency_s: float = 0.0
    lidar_latency_s: float = 0.0

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            where = f"sensors.{field.name}"
            if field.name == "gyro_bias":
                check_each(where, value, 3, -1.0, 1.0)
            elif field.name == "camera_tint":
                check_each(where, value, 3, 0.1, 10.0)
            elif field.name in ("lidar_dropout", "camera_drop", "lidar_drop"):
                check_range(where, value, 0.0, 1.0)
            else:
                check_range(where, value, 0.0, math.inf)
        check_range("sensors.encoder_ticks", self.encoder_ticks, 1, math.inf)


IDEAL_SENSORS = SensorParams(
    encoder_ticks=1_000_000,
    encoder_slip=0.0,
    encoder_velocity_noise=0.0,
    gyro_noise=0.0,
    accelerometer_noise=0.0,
    lidar_noise=0.0,
    lidar_dropout=0.0,
    camera_noise=0.0,
    depth_noise=0.0,
)
"""Sensors without noise, for tests and for learning."""


class BaseFirmware:
    """What runs on the base's own controller: limits, ramps, watchdog, wheel set points, motors.

    Each call of ``step`` is one control period. The wheel servo is a proportional speed loop; the motor speed
    follows its set point with a first-order lag, and the wheel follows the motor through the gearbox's play:
    inside the play no torque passes.

    Args:
        params: the robot.
        period_s: control period (s), the physics time step.
    """

    def __init__(self, params: RobotParams, period_s: float) -> None:
        self.params, self.period_s = params, period_s
        lag = params.motor_lag_s
        self._follow = 1.0 if lag == 0.0 else 1.0 - math.exp(-period_s / lag)
        self._target = (0.0, 0.0)
        self._v = self._w = 0.0
        self._motor = [0.0, 0.0]
        self.play = [0.0, 0.0]
        """Motor angle ahead of wheel angle (rad), left and right, within half the backlash."""

    @property
    def setpoint(self) -> tuple[float, float]:
        """The ramped twist (m/s, rad/s) that the wheels are told now."""
        return self._v, self._w

    def command(self, v: float, w: float) -> None:
        """Take a twist (m/s, rad/s), clamped to the robot's limits."""
        p = self.params
        self._target = (
            min(max(v, -p.max_speed), p.max_speed),
            min(max(w, -p.max_yaw_rate), p.max_yaw_rate),
        )

    def step(self, left_speed: float, right_speed: float) -> tuple[float, float]:
        """Return the (left, right) servo set points (rad/s) for the coming period.

        Args:
            left_speed: measured speed of the left wheel (rad/s).
            right_speed: measured speed of the right wheel (rad/s).
        """
        p, dt = self.params, self.period_s
        dv, dw = p.max_acceleration * dt, p.max_yaw_acceleration * dt
        self._v += min(max(self._target[0] - self._v, -dv), dv)
        self._w += min(max(self._target[1] - self._w, -dw), dw)
        turn = self._w * p.track / 2.0
        wanted = ((self._v - turn) / p.wheel_radius, (self._v + turn) / p.wheel_radius)
        return self._drive(0, wanted[0], left_speed), self._drive(1, wanted[1], right_speed)

    def _drive(self, side: int, wanted: float, wheel_speed: float) -> float:
        motor = self._motor[side] + self._follow * (wanted - self._motor[side])
        self._motor[side] = motor
        half = self.params.backlash_rad / 2.0
        if half == 0.0:
            return motor
        play = self.play[side] + (motor - wheel_speed) * self.period_s
        self.play[side] = min(max(play, -half), half)
        engaged = play >= half or play <= -half
        return motor if engaged else wheel_speed
