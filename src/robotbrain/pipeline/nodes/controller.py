"""Controller node: path, odometry and obstacles in, velocity commands out."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry, Path
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import LaserScan, PointCloud2

from robotbrain.pipeline.control import ControlParams, PathTracker
from robotbrain.pipeline.nodes.poses import FrameCheck, StampedPoses, read_plan
from robotbrain.pipeline.nodes.sightings import Sightings
from robotbrain.ros import charge_work

RATE_HZ = 20.0
SCAN_MAX_AGE, POINTS_MAX_AGE = 0.5, 2.0
"""How long obstacles seen by the lidar and by the camera are remembered, s."""
SCAN_RANGE, POINTS_RANGE = 2.0, 1.5
"""What lidar and camera see further away is left out, m."""


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
        self._sightings = Sightings(
            self._frames,
            self._poses,
            scan_range=SCAN_RANGE,
            points_range=POINTS_RANGE,
            points_max_age=POINTS_MAX_AGE,
        )
        self._path: NDArray[np.float64] = np.zeros((0, 2))
        self._final_yaw: float | None = None
        self._publisher = self.create_publisher(Twist, "cmd_vel", 10)
        self.create_subscription(Odometry, "odometry/filtered", self._poses.on_odometry, 10)
        self.create_subscription(LaserScan, "scan", self._on_scan, 2)
        self.create_subscription(PointCloud2, "perception/points", self._on_points, 2)
        self.create_subscription(Path, "plan", self._on_path, 1)
        self.create_timer(1.0 / RATE_HZ, self._control)

    def _on_path(self, msg: Path) -> None:
        self._path, self._final_yaw = read_plan(msg)

    def _on_scan(self, msg: LaserScan) -> None:
        self._sightings.take_scan(msg)

    def _on_points(self, msg: PointCloud2) -> None:
        self._sightings.take_points(msg)

    def _control(self) -> None:
        pose = self._poses.latest()
        now = self.get_clock().now().nanoseconds
        command = Twist()
        if pose is not None and self._sightings.fresh(now, SCAN_MAX_AGE):
            obstacles = self._sightings.around(pose, now)
            charge_work("obstacles", len(obstacles))
            chosen = self._tracker.command(now * 1e-9, pose, self._path, self._final_yaw, obstacles)
            charge_work("arcs", self._tracker.arcs)
            charge_work("distances", self._tracker.distances)
            command.linear.x, command.angular.z = chosen.speed, chosen.turn
        self._publisher.publish(command)
