"""Controller node: path, odometry and obstacles in, velocity commands out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry, Path
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import LaserScan, PointCloud2

from robotbrain.pipeline.control import ControlParams, PathTracker
from robotbrain.pipeline.geometry import Pose, inverse, transform
from robotbrain.pipeline.nodes.perception import FLOOR_LABEL
from robotbrain.pipeline.nodes.poses import FrameCheck, StampedPoses, check_finite
from robotbrain.ros import charge_work
from robotbrain.ros.conversions import cloud_to_points, path_to_numpy, quaternion_to_yaw, scan_to_arrays, time_to_ns

RATE_HZ = 20.0
SCAN_MAX_AGE, POINTS_MAX_AGE = 0.5, 2.0
"""How long obstacles seen by the lidar and by the camera are remembered, s."""


def thin_out(points: NDArray[np.float64], spacing: float = 0.04) -> NDArray[np.float64]:
    """Return the middles of the squares of side ``spacing`` (m) that hold any of the (N, 2) points."""
    squares = np.floor(points / spacing).astype(np.int64)
    _, first = np.unique(squares[:, 0] * 100_003 + squares[:, 1], return_index=True)
    return np.asarray((squares[first] + 0.5) * spacing, dtype=np.float64)


@dataclass(frozen=True)
class _Sighting:
    stamp_ns: int
    points: NDArray[np.float64]


class ControllerNode(Node):
    """Tracks ``plan`` at 20 Hz and publishes ``cmd_vel``; stops when its inputs grow stale.

    Args:
        params: limits and gains.
    """

    def __init__(self, params: ControlParams | None = None) -> None:
        super().__init__("controller")
        self._tracker = PathTracker(params)
        self._frames = FrameCheck(self)
        self._poses = StampedPoses(frames=self._frames)
        self._path: NDArray[np.float64] = np.zeros((0, 2))
        self._final_yaw: float | None = None
        self._scan: _Sighting | None = None
        self._seen: list[_Sighting] = []
        self._publisher = self.create_publisher(Twist, "cmd_vel", 10)
        self.create_subscription(Odometry, "odometry/filtered", self._poses.on_odometry, 10)
        self.create_subscription(LaserScan, "scan", self._on_scan, 2)
        self.create_subscription(PointCloud2, "perception/points", self._on_points, 2)
        self.create_subscription(Path, "plan", self._on_path, 1)
        self.create_timer(1.0 / RATE_HZ, self._control)

    def _on_path(self, msg: Path) -> None:
        path = path_to_numpy(msg)
        check_finite("plan", path)
        self._path = path
        # A path of one pose asks for its heading too; a longer one leaves the last heading open.
        self._final_yaw = quaternion_to_yaw(msg.poses[0].pose.orientation) if len(msg.poses) == 1 else None

    def _on_scan(self, msg: LaserScan) -> None:
        if not self._frames.sensor("scan", msg):
            return
        ranges, angles = scan_to_arrays(msg)
        # REP 117: -inf is too near to measure, +inf no return, NaN an error; none of them is a place.
        near = np.isfinite(ranges) & (ranges < 2.0)
        local = ranges[near, None] * np.stack([np.cos(angles[near]), np.sin(angles[near])], axis=1)
        stamp = time_to_ns(msg.header.stamp)
        charge_work("near_points", len(ranges))

        def keep(pose: Pose) -> None:
            self._scan = _Sighting(stamp, transform(pose, local))

        self._poses.when_known(stamp, keep)

    def _on_points(self, msg: PointCloud2) -> None:
        if not self._frames.expect("perception/points", msg, "base_link"):
            return
        points = cloud_to_points(msg).astype(np.float64)
        local = points[points[:, 2] != FLOOR_LABEL, :2]
        local = thin_out(local[np.hypot(local[:, 0], local[:, 1]) < 1.5])
        charge_work("thin_out", len(points))
        stamp = time_to_ns(msg.header.stamp)
        if len(local):
            self._poses.when_known(stamp, lambda pose: self._seen.append(_Sighting(stamp, transform(pose, local))))

    def _obstacles(self, pose: Pose, now: int) -> NDArray[np.float64]:
        self._seen = [s for s in self._seen if now - s.stamp_ns < POINTS_MAX_AGE * 1e9]
        world = [s.points for s in self._seen]
        if self._scan is not None:
            world.append(self._scan.points)
        if not world:
            return np.zeros((0, 2))
        return transform(inverse(pose), np.concatenate(world))

    def _control(self) -> None:
        pose = self._poses.latest()
        now = self.get_clock().now().nanoseconds
        command = Twist()
        if pose is not None and self._scan is not None and now - self._scan.stamp_ns < SCAN_MAX_AGE * 1e9:
            obstacles = self._obstacles(pose, now)
            charge_work("obstacles", len(obstacles))
            chosen = self._tracker.command(now * 1e-9, pose, self._path, self._final_yaw, obstacles)
            charge_work("arcs", self._tracker.arcs)
            charge_work("distances", self._tracker.distances)
            command.linear.x, command.angular.z = chosen.speed, chosen.turn
        self._publisher.publish(command)
