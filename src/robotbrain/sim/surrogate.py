"""The surrogate robot: a stand-in for the physical one whose parameters nobody is told.

It is the same robot in the same simulator with another body, other motors and worse sensors, drawn from the
ranges below. Brains tuned to the nominal robot meet in it what they would meet on a real one.
"""

from __future__ import annotations

import numpy as np

from robotbrain.sim.checks import check_seed
from robotbrain.sim.robot import RobotParams, SensorParams

SURROGATE_RANGES: dict[str, tuple[float, float]] = {
    "mass": (4.0, 6.5),  # kg: battery and payload differ
    "wheel_radius_error": (-0.015, 0.015),  # tyre wear and load, each wheel its own
    "wheel_friction": (0.6, 1.1),  # polished concrete to rubber mat
    "box_friction": (0.35, 0.7),
    "motor_lag_s": (0.04, 0.10),
    "backlash_rad": (0.005, 0.03),
    "command_delay_s": (0.01, 0.05),
    "encoder_slip": (0.002, 0.01),  # rad per square root of a rad
    "gyro_noise": (0.003, 0.010),  # rad/s
    "gyro_bias": (-0.02, 0.02),  # rad/s, each axis its own: a MEMS part without calibration
    "accelerometer_noise": (0.05, 0.2),  # m/s^2
    "lidar_noise": (0.008, 0.02),  # m
    "lidar_dropout": (0.005, 0.03),
    "camera_noise": (2.0, 6.0),  # grey levels
    "camera_tint": (0.9, 1.1),  # each channel its own
    "camera_exposure": (0.8, 1.2),
    "depth_noise": (0.002, 0.008),  # m at 1 m
    "camera_drop": (0.0, 0.08),
    "lidar_drop": (0.0, 0.03),
    "camera_latency_s": (0.01, 0.05),
    "lidar_latency_s": (0.0, 0.02),
}
"""Range of every parameter that differs from the nominal robot; each is drawn uniformly."""


def surrogate_robot(seed: int) -> tuple[RobotParams, SensorParams]:
    """Draw a surrogate's body and sensors from ``SURROGATE_RANGES``; one seed is always one surrogate.

    Raises:
        InputError: the seed is not an integer >= 0.
    """
    rng = np.random.default_rng(np.random.SeedSequence([0x5066A7E, check_seed("surrogate seed", seed)]))
    draws = {name: rng.uniform(low, high, 3) for name, (low, high) in SURROGATE_RANGES.items()}

    def one(*names: str) -> dict[str, float]:
        return {name: float(draws[name][0]) for name in names}

    def three(name: str) -> tuple[float, float, float]:
        a, b, c = (float(value) for value in draws[name])
        return a, b, c

    left, right, _ = three("wheel_radius_error")
    body = one("mass", "wheel_friction", "box_friction", "motor_lag_s", "backlash_rad", "command_delay_s")
    errors = one(
        "encoder_slip",
        "gyro_noise",
        "accelerometer_noise",
        "lidar_noise",
        "lidar_dropout",
        "camera_noise",
        "camera_exposure",
        "depth_noise",
        "camera_drop",
        "lidar_drop",
        "camera_latency_s",
        "lidar_latency_s",
    )
    return (
        RobotParams(wheel_radius_error=(left, right), **body),
        SensorParams(gyro_bias=three("gyro_bias"), camera_tint=three("camera_tint"), **errors),  # type: ignore[arg-type]
    )
