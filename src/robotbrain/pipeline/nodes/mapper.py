"""Mapping node: scans and labelled camera points in, occupancy grid out."""

from __future__ import annotations

import numpy as np
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import LaserScan, PointCloud2

from robotbrain.pipeline.geometry import Pose
from robotbrain.pipeline.grid import GridFrame
from robotbrain.pipeline.mapping import OccupancyMapper
from robotbrain.pipeline.nodes.grids import grid_to_msg
from robotbrain.pipeline.nodes.perception import FLOOR_LABEL
from robotbrain.pipeline.nodes.poses import FrameCheck, StampedPoses
from robotbrain.ros import charge_work
from robotbrain.ros.conversions import cloud_to_points, scan_to_arrays, time_to_ns

MAP_HALF_EXTENT, MAP_RESOLUTION = 11.0, 0.05
"""The map reaches this far from the start, m, whatever way the robot first faced."""


class MapperNode(Node):
    """Fuses ``scan`` and ``perception/points`` along ``odometry/filtered`` into ``map``, published twice a second."""

    def __init__(self) -> None:
        super().__init__("mapper")
        self._mapper = OccupancyMapper(GridFrame.centred(MAP_HALF_EXTENT, MAP_RESOLUTION))
        self._frames = FrameCheck(self)
        self._poses = StampedPoses(frames=self._frames)
        self._publisher = self.create_publisher(
            OccupancyGrid, "map", QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        )
        self.create_subscription(Odometry, "odometry/filtered", self._poses.on_odometry, 10)
        self.create_subscription(LaserScan, "scan", self._on_scan, 2)
        self.create_subscription(PointCloud2, "perception/points", self._on_points, 2)
        self.create_timer(0.5, self._publish)

    def _on_scan(self, msg: LaserScan) -> None:
        if not self._frames.sensor("scan", msg):
            return
        ranges, angles = scan_to_arrays(msg)

        def add(pose: Pose) -> None:
            self._mapper.add_scan(pose, ranges, angles)
            charge_work("map_scan", self._mapper.written)

        self._poses.when_known(time_to_ns(msg.header.stamp), add)

    def _on_points(self, msg: PointCloud2) -> None:
        if not self._frames.expect("perception/points", msg, "base_link"):
            return
        points = cloud_to_points(msg).astype(np.float64)
        floor = points[:, 2] == FLOOR_LABEL

        def add(pose: Pose) -> None:
            self._mapper.add_points(pose, points[floor, :2], points[~floor, :2])
            charge_work("map_points", self._mapper.written)

        self._poses.when_known(time_to_ns(msg.header.stamp), add)

    def _publish(self) -> None:
        if self._poses.latest() is None:
            return
        occupancy = self._mapper.occupancy()
        msg = grid_to_msg(occupancy, self._mapper.frame, self.get_clock().now().to_msg())
        charge_work("map_render", occupancy.size)
        self._publisher.publish(msg)
