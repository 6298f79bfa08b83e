"""What lidar and camera saw of obstacles, remembered for a controller."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import LaserScan, PointCloud2

from robotbrain.pipeline.geometry import Pose, inverse, transform
from robotbrain.pipeline.nodes.perception import FLOOR_LABEL
from robotbrain.pipeline.nodes.poses import FrameCheck, StampedPoses
from robotbrain.ros import charge_work
from robotbrain.ros.conversions import cloud_to_points, scan_to_arrays, time_to_ns


def thin_out(points: NDArray[np.float64], spacing: float = 0.04) -> NDArray[np.float64]:
    """Return the middles of the squares of side ``spacing`` (m) that hold any of the (N, 2) points."""
    squares = np.floor(points / spacing).astype(np.int64)
    _, first = np.unique(squares[:, 0] * 100_003 + squares[:, 1], return_index=True)
    return np.asarray((squares[first] + 0.5) * spacing, dtype=np.float64)


@dataclass(frozen=True)
class _Sighting:
    stamp_ns: int
    points: NDArray[np.float64]


class Sightings:
    """The newest scan and the camera points of the last seconds, in the world's frame.

    Args:
        frames: checks the messages' frames.
        poses: says where the robot was when something was measured.
        scan_range, points_range: what is further away is left out, m.
        points_max_age: how long camera points are remembered, s.
    """

    def __init__(
        self, frames: FrameCheck, poses: StampedPoses, *, scan_range: float, points_range: float, points_max_age: float
    ) -> None:
        self._frames, self._poses = frames, poses
        self._scan_range, self._points_range, self._points_max_age = scan_range, points_range, points_max_age
        self._scan: _Sighting | None = None
        self._seen: list[_Sighting] = []

    def take_scan(self, msg: LaserScan) -> None:
        """Remember a scan instead of the one before, once the robot's pose at its time is known."""
        if not self._frames.sensor("scan", msg):
            return
        ranges, angles = scan_to_arrays(msg)
        # REP 117: -inf is too near to measure, +inf no return, NaN an error; none of them is a place.
        near = np.isfinite(ranges) & (ranges < self._scan_range)
        local = ranges[near, None] * np.stack([np.cos(angles[near]), np.sin(angles[near])], axis=1)
        stamp = time_to_ns(msg.header.stamp)
        charge_work("near_points", len(ranges))

        def keep(pose: Pose) -> None:
            self._scan = _Sighting(stamp, transform(pose, local))

        self._poses.when_known(stamp, keep)

    def take_points(self, msg: PointCloud2) -> None:
        """Remember labelled camera points that are no floor, likewise."""
        if not self._frames.expect("perception/points", msg, "base_link"):
            return
        points = cloud_to_points(msg).astype(np.float64)
        local = points[points[:, 2] != FLOOR_LABEL, :2]
        local = thin_out(local[np.hypot(local[:, 0], local[:, 1]) < self._points_range])
        charge_work("thin_out", len(points))
        stamp = time_to_ns(msg.header.stamp)
        if len(local):
            self._poses.when_known(stamp, lambda pose: self._seen.append(_Sighting(stamp, transform(pose, local))))

    def fresh(self, now: int, max_age: float) -> bool:
        """Whether the newest scan is younger than ``max_age`` (s) at ``now`` (ns)."""
        return self._scan is not None and now - self._scan.stamp_ns < max_age * 1e9

    def around(self, pose: Pose, now: int) -> NDArray[np.float64]:
        """Return all obstacles that are remembered at ``now`` (ns), (M, 2) in the frame of a robot at ``pose``."""
        self._seen = [s for s in self._seen if now - s.stamp_ns < self._points_max_age * 1e9]
        world = [s.points for s in self._seen]
        if self._scan is not None:
            world.append(self._scan.points)
        return transform(inverse(pose), np.concatenate(world)) if world else np.zeros((0, 2))
