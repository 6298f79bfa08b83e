"""State estimation node: encoders, gyro and lidar in, filtered odometry out."""

from __future__ import annotations

import numpy as np
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Imu, JointState, LaserScan

from robotbrain.pipeline.estimation import PoseFilter, ScanMatcher
from robotbrain.pipeline.geometry import Pose, PoseBuffer, wrap
from robotbrain.pipeline.nodes.poses import FrameCheck
from robotbrain.ros import charge_work
from robotbrain.ros.conversions import ns_to_time, scan_to_arrays, time_to_ns, yaw_to_quaternion

STILL_RATE = 0.01
"""Wheels slower than this (rad/s) for a while count as standing still."""


class EstimatorNode(Node):
    """Extended Kalman filter fed by ``joint_states``, ``imu`` and ``scan``; publishes ``odometry/filtered``.

    The map frame is the robot's pose at the first wheel reading.

    Args:
        wheel_radius, track: of the robot, m, as its data sheet says.
    """

    def __init__(self, wheel_radius: float = 0.06, track: float = 0.30) -> None:
        super().__init__("estimator")
        self._wheel_radius, self._track = wheel_radius, track
        self._frames = FrameCheck(self)
        self._filter = PoseFilter()
        self._matcher = ScanMatcher()
        self._history = PoseBuffer()
        self._wheels: tuple[int, float, float] | None = None
        self._gyro: list[float] = []
        self._last_rate = 0.0
        self._still = 0
        self._publisher = self.create_publisher(Odometry, "odometry/filtered", 10)
        self.create_subscription(Imu, "imu", self._on_imu, qos_profile_sensor_data)
        self.create_subscription(JointState, "joint_states", self._on_wheels, 10)
        self.create_subscription(LaserScan, "scan", self._on_scan, 2)

    def _on_imu(self, msg: Imu) -> None:
        if not self._frames.sensor("imu", msg):
            return
        self._gyro.append(float(msg.angular_velocity.z))

    def _on_wheels(self, msg: JointState) -> None:
        stamp = time_to_ns(msg.header.stamp)
        left, right = (float(msg.position[msg.name.index(f"{side}_wheel_joint")]) for side in ("left", "right"))
        if self._gyro:
            self._last_rate = float(np.mean(self._gyro))
            self._gyro.clear()
        if self._wheels is not None:
            before, left_before, right_before = self._wheels
            dt = (stamp - before) * 1e-9
            travel = self._wheel_radius * ((left - left_before) + (right - right_before)) / 2
            self._filter.predict(travel, self._last_rate, dt)
            moving = max(abs(left - left_before), abs(right - right_before)) > STILL_RATE * dt
            self._still = 0 if moving else self._still + 1
            if self._still > 5:
                self._filter.observe_standstill(self._last_rate)
            self._publish(stamp, travel / dt if dt > 0 else 0.0)
        self._wheels = (stamp, left, right)
        self._history.add(stamp, self._filter.pose)
        charge_work("wheel_update", 1)

    def _on_scan(self, msg: LaserScan) -> None:
        if not self._frames.sensor("scan", msg):
            return
        stamp = time_to_ns(msg.header.stamp)
        guess = self._history.at(stamp)
        if guess is None:
            return
        ranges, angles = scan_to_arrays(msg)
        valid = np.isfinite(ranges)
        points = ranges[valid, None] * np.stack([np.cos(angles[valid]), np.sin(angles[valid])], axis=1)
        match = self._matcher.match(points, guess)
        before = self._filter.pose
        if match is not None:
            innovation = np.subtract(match.pose, guess)
            self._filter.observe_pose(innovation, match.covariance)
        charge_work("scan_match", self._matcher.queries)
        after = self._filter.pose
        corrected: Pose = (
            guess[0] + after[0] - before[0],
            guess[1] + after[1] - before[1],
            wrap(guess[2] + after[2] - before[2]),
        )
        # A keyframe taken while turning fast would be smeared by its own time stamp.
        if abs(self._last_rate - self._filter.bias) < 0.4:
            kept = self._matcher.keep(points, corrected)
            charge_work("keyframe", self._matcher.point_count if kept else 0)

    def _publish(self, stamp: int, speed: float) -> None:
        x, y, yaw = self._filter.pose
        msg = Odometry()
        msg.header.stamp = ns_to_time(stamp)
        msg.header.frame_id, msg.child_frame_id = "map", "base_link"
        msg.pose.pose.position.x, msg.pose.pose.position.y = x, y
        msg.pose.pose.orientation = yaw_to_quaternion(yaw)
        covariance = np.zeros((6, 6))
        planar = np.ix_((0, 1, 5), (0, 1, 5))
        covariance[planar] = self._filter.covariance[:3, :3]
        msg.pose.covariance = covariance.ravel()
        msg.twist.twist.linear.x = speed
        msg.twist.twist.angular.z = self._last_rate - self._filter.bias
        self._publisher.publish(msg)
