"""A plane lidar by ray casting."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robotbrain.sim.checks import check_range
from robotbrain.sim.geometry import Array
from robotbrain.sim.rays import RayCaster, rotation_from_quaternion
from robotbrain.sim.robot import LIDAR_HEIGHT, SensorParams
from robotbrain.sim.scene import GROUP_SOLID, Scene


@dataclass(frozen=True, slots=True)
class LidarSpec:
    """Geometry of a scan; the lidar stands above the origin of ``base_link``.

    Args:
        rays: per revolution.
        range_min: shortest range reported (m).
        range_max: longest range reported (m).
        height: of the scan plane above the floor (m).
    """

    rays: int = 120
    range_min: float = 0.05
    range_max: float = 8.0
    height: float = LIDAR_HEIGHT

    def __post_init__(self) -> None:
        check_range("lidar rays", self.rays, 1, 100_000)
        check_range("lidar range_min", self.range_min, 0.0, self.range_max)
        check_range("lidar height", self.height, 0.0, 10.0)

    @property
    def angle_min(self) -> float:
        """Angle of the first ray (rad), anticlockwise from straight ahead."""
        return -math.pi

    @property
    def angle_increment(self) -> float:
        """Angle from one ray to the next (rad)."""
        return 2.0 * math.pi / self.rays

    @property
    def angles(self) -> Array:
        """Angle of every ray (rad), (rays,)."""
        return self.angle_min + self.angle_increment * np.arange(self.rays, dtype=np.float64)


class RayLidar:
    """Lidar on the robot of a scene. It sees floor-standing things that reach its plane, not the marker.

    Args:
        scene: what it looks at.
        spec: the scan's geometry.
    """

    def __init__(self, scene: Scene, spec: LidarSpec | None = None) -> None:
        self.spec = spec or LidarSpec()
        self._caster = RayCaster(scene.model, (GROUP_SOLID,))
        angles = self.spec.angles
        self._rays = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], -1)

    def scan(
        self, qpos: Array, sensors: SensorParams | None = None, rng: np.random.Generator | None = None
    ) -> NDArray[np.float32]:
        """Return the ranges (m), float32 (rays,); +inf where nothing is met within ``range_max``.

        Args:
            qpos: state of the scene's model; the robot's pose comes first.
            sensors: noise and dropout; a perfect lidar by default.
            rng: source of the noise; without it there is none.
        """
        base = rotation_from_quaternion(qpos[3:7])
        origin = qpos[:3] + base[:, 2] * self.spec.height
        distance, geom, _ = self._caster.cast(qpos, origin, self._rays @ base.T)
        hit = geom >= 0
        if sensors is not None and rng is not None:
            distance = distance + sensors.lidar_noise * rng.standard_normal(distance.shape)
            hit &= rng.random(distance.shape) >= sensors.lidar_dropout
        hit &= (distance >= self.spec.range_min) & (distance <= self.spec.range_max)
        return np.where(hit, distance, np.inf).astype(np.float32)
