"""What the sensors return. Every reading carries the time it was taken and the time it reaches the computer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robotbrain.sim.geometry import Array


@dataclass(frozen=True, slots=True)
class WheelReading:
    """Wheel encoders; index 0 is the left wheel.

    Args:
        stamp_ns: when it was taken.
        position: rolled angle since the start, rounded to ticks (rad), (2,).
        velocity: rad/s, (2,).
    """

    stamp_ns: int
    position: Array
    velocity: Array


@dataclass(frozen=True, slots=True)
class ImuReading:
    """Inertial unit at the origin of ``base_link``, axes parallel to it.

    Args:
        stamp_ns: when it was taken.
        angular_velocity: rad/s, (3,).
        linear_acceleration: specific force (m/s^2), (3,): +9.81 along z at rest; mean since the last reading.
    """

    stamp_ns: int
    angular_velocity: Array
    linear_acceleration: Array


@dataclass(frozen=True, slots=True)
class LidarReading:
    """One scan.

    Args:
        stamp_ns: when it was taken (the whole scan at once).
        available_ns: when it reaches the computer.
        ranges: m, float32 (rays,); +inf for no return.
        angle_min: angle of the first ray (rad).
        angle_increment: rad.
        range_min: m.
        range_max: m.
    """

    stamp_ns: int
    available_ns: int
    ranges: NDArray[np.float32]
    angle_min: float
    angle_increment: float
    range_min: float
    range_max: float


@dataclass(frozen=True, slots=True)
class CameraReading:
    """One RGB-D frame. True classes are not part of it: they belong to ``sim.truth``.

    Args:
        stamp_ns: when it was taken.
        available_ns: when it reaches the computer.
        rgb: uint8 (height, width, 3).
        depth: metres along the optical axis, float32 (height, width); +inf for no return.
    """

    stamp_ns: int
    available_ns: int
    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
