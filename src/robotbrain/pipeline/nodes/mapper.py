"""Mapping node: scans and labelled camera points in, occupancy grid out."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import LaserScan, PointCloud2

from robotbrain.pipeline.geometry import Pose, PoseBuffer
from robotbrain.pipeline.grid import GridFrame
from robotbrain.pipeline.mapping import OccupancyMapper
from robotbrain.pipeline.nodes.grids import grid_to_msg
from robotbrain.pipeline.nodes.perception import FLOOR_LABEL
from robotbrain.ros.conversions import cloud_to_points, quaternion_to_yaw, scan_to_arrays, time_to_ns

MAP_HALF_EXTENT, MAP_RESOLUTION = 11.0, 0.05
"""The map reaches this far from the start, m, whatever way the robot first faced."""


class Waiting:
    """Messages waiting until the pose at their stamp is known (what a tf2 message filter does).

    Args:
        poses: filled by the caller.
        limit: messages kept at most; the oldest are dropped.
    """

    def __init__(self, poses: PoseBuffer, limit: int = 20) -> None:
        self._poses = poses
        self._queue: deque[tuple[int, Callable[[Pose], None]]] = deque(maxlen=limit)

    def add(self, stamp_ns: int, action: Callable[[Pose], None]) -> None:
        """Call ``action`` with the pose at ``stamp_ns``, now or once it is known."""
        self._queue.append((stamp_ns, action))
        self.flush()

    def flush(self) -> None:
        """Run every action whose pose is known by now; drop those too old to ever have one."""
        latest = self._poses.latest_stamp()
        if latest is None:
            return
        remaining = []
        for stamp, action in self._queue:
            if stamp > latest:
                remaining.append((stamp, action))
                continue
            pose = self._poses.at(stamp)
            if pose is not None:
                action(pose)
        self._queue.clear()
        self._queue.extend(remaining)


class MapperNode(Node):
    """Fuses ``scan`` and ``perception/points`` along ``odometry/filtered`` into ``map``, published twice a second."""

    def __init__(self) -> None:
        super().__init__("mapper")
        self._mapper = OccupancyMapper(GridFrame.centred(MAP_HALF_EXTENT, MAP_RESOLUTION))
        self._poses = PoseBuffer()
        self._waiting = Waiting(self._poses)
        self._publisher = self.create_publisher(
            OccupancyGrid, "map", QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        )
        self.create_subscription(Odometry, "odometry/filtered", self._on_odometry, 10)
        self.create_subscription(LaserScan, "scan", self._on_scan, 2)
        self.create_subscription(PointCloud2, "perception/points", self._on_points, 2)
        self.create_timer(0.5, self._publish)

    def _on_odometry(self, msg: Odometry) -> None:
        position = msg.pose.pose.position
        self._poses.add(
            time_to_ns(msg.header.stamp), (position.x, position.y, quaternion_to_yaw(msg.pose.pose.orientation))
        )
        self._waiting.flush()

    def _on_scan(self, msg: LaserScan) -> None:
        ranges, angles = scan_to_arrays(msg)
        self._waiting.add(time_to_ns(msg.header.stamp), lambda pose: self._mapper.add_scan(pose, ranges, angles))

    def _on_points(self, msg: PointCloud2) -> None:
        points = cloud_to_points(msg).astype(np.float64)
        floor = points[:, 2] == FLOOR_LABEL
        self._waiting.add(
            time_to_ns(msg.header.stamp),
            lambda pose: self._mapper.add_points(pose, points[floor, :2], points[~floor, :2]),
        )

    def _publish(self) -> None:
        if self._poses.latest() is None:
            return
        now = self.get_clock().now().to_msg()
        self._publisher.publish(grid_to_msg(self._mapper.occupancy(), self._mapper.frame, now))
