"""Controller node with a trained policy inside: path, odometry and obstacles in, velocity commands out.

It has the topics of :class:`robotbrain.pipeline.nodes.controller.ControllerNode` and takes its place::

    drive(7, parts={"controller": policy_controller(profile="orin-nano-8gb")})

The planner's path says where to go: the policy's goal is the point of it some way ahead. How to get there between the
obstacles is the policy's affair. It sees what the lidar sees and, for things too low for the lidar, what the camera saw
lately, as the nearest obstacle in each of 36 sectors around the robot.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path as FilePath

import numpy as np
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry, Path
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import LaserScan, PointCloud2

from robotbrain.jetson.engine import OnnxEngine
from robotbrain.jetson.profiles import JetsonProfile, load_profile
from robotbrain.pipeline.control import lookahead_point
from robotbrain.pipeline.geometry import Pose, inverse, transform, wrap
from robotbrain.pipeline.nodes.controller import thin_out
from robotbrain.pipeline.nodes.perception import FLOOR_LABEL
from robotbrain.pipeline.nodes.poses import FrameCheck, StampedPoses, check_finite
from robotbrain.rl.onnx_policy import OnnxPolicy
from robotbrain.rl.tasks.navigation_spec import (
    LIDAR_RANGE,
    check_meta,
    default_policy,
    observation,
    sector_ranges,
)
from robotbrain.ros import charge, charge_work
from robotbrain.ros.conversions import cloud_to_points, path_to_numpy, quaternion_to_yaw, scan_to_arrays, time_to_ns


@dataclass(frozen=True)
class PolicyControlParams:
    """What the node decides around the policy.

    Attributes:
        lookahead: distance along the path of the policy's goal, m.
        arrive: distance to the path's end at which the robot stops, m.
        arrive_yaw: heading error that counts as arrived where only a heading is asked for, rad.
        turn_gain, max_turn: of turning on the spot to that heading, 1/s and rad/s.
        scan_max_age: without a younger scan the robot stops, s.
        points_max_age: how long obstacles seen by the camera are remembered, s.
        points_range: camera points further away are not remembered, m.
    """

    lookahead: float = 0.8
    arrive: float = 0.08
    arrive_yaw: float = 0.15
    turn_gain: float = 2.0
    max_turn: float = 1.2
    scan_max_age: float = 0.5
    points_max_age: float = 3.0
    points_range: float = 1.5


@dataclass(frozen=True)
class _Sighting:
    stamp_ns: int
    points: NDArray[np.float64]


def policy_controller(
    model: str | FilePath | None = None,
    profile: str | JetsonProfile | None = None,
    params: PolicyControlParams | None = None,
) -> Callable[[], PolicyControllerNode]:
    """Return what ``drive(..., parts={"controller": ...})`` takes.

    Args:
        model: ONNX file of a navigation policy; the shipped one by default.
        profile: the Jetson whose time an inference takes: that of ``drive``. None: inference takes no simulated time.
        params: see PolicyControlParams.

    Raises:
        InputError: for a file that is no navigation policy, or an unknown profile.
    """
    path = FilePath(model) if model is not None else default_policy()
    policy = OnnxPolicy(path)
    check_meta(policy.meta)
    chosen = load_profile(profile) if isinstance(profile, str) else profile
    latency_ns = OnnxEngine(path, chosen).latency_ns
    return lambda: PolicyControllerNode(policy, latency_ns, params)


class PolicyControllerNode(Node):
    """Drives along ``plan`` by a navigation policy and publishes ``cmd_vel``; stops when its inputs grow stale.

    It runs at the rate for which the policy was trained. A path of one pose asks for a heading: the robot turns to it
    on the spot, which is no matter for the policy.

    Args:
        policy: of the task ``navigation``.
        latency_ns: simulated GPU time of one inference, ns.
        params: see PolicyControlParams.

    Raises:
        InputError: for a policy of another task.
    """

    def __init__(self, policy: OnnxPolicy, latency_ns: int = 0, params: PolicyControlParams | None = None) -> None:
        super().__init__("controller")
        check_meta(policy.meta)
        self._policy, self._latency_ns = policy, latency_ns
        self._params = params or PolicyControlParams()
        self._frames = FrameCheck(self)
        self._poses = StampedPoses(frames=self._frames)
        self._velocity = (0.0, 0.0)
        self._last_action = np.zeros(2)
        self._path: NDArray[np.float64] = np.zeros((0, 2))
        self._final_yaw: float | None = None
        self._scan: _Sighting | None = None
        self._seen: list[_Sighting] = []
        self._publisher = self.create_publisher(Twist, "cmd_vel", 10)
        self.create_subscription(Odometry, "odometry/filtered", self._on_odometry, 10)
        self.create_subscription(LaserScan, "scan", self._on_scan, 2)
        self.create_subscription(PointCloud2, "perception/points", self._on_points, 2)
        self.create_subscription(Path, "plan", self._on_path, 1)
        self.create_timer(policy.meta.control_dt, self._control)

    def _on_odometry(self, msg: Odometry) -> None:
        velocity = (float(msg.twist.twist.linear.x), float(msg.twist.twist.angular.z))
        check_finite("odometry/filtered", velocity)
        self._velocity = velocity
        self._poses.on_odometry(msg)

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
        near = np.isfinite(ranges) & (ranges < LIDAR_RANGE)
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
        local = thin_out(local[np.hypot(local[:, 0], local[:, 1]) < self._params.points_range])
        charge_work("thin_out", len(points))
        stamp = time_to_ns(msg.header.stamp)
        if len(local):
            self._poses.when_known(stamp, lambda pose: self._seen.append(_Sighting(stamp, transform(pose, local))))

    def _obstacles(self, pose: Pose, now: int) -> NDArray[np.float64]:
        """Return what was seen of obstacles, (M, 2) in the robot's frame as it stands now."""
        self._seen = [s for s in self._seen if now - s.stamp_ns < self._params.points_max_age * 1e9]
        world = [s.points for s in self._seen]
        if self._scan is not None:
            world.append(self._scan.points)
        return transform(inverse(pose), np.concatenate(world)) if world else np.zeros((0, 2))

    def _control(self) -> None:
        pose = self._poses.latest()
        now = self.get_clock().now().nanoseconds
        speed = turn = 0.0
        fresh = self._scan is not None and now - self._scan.stamp_ns < self._params.scan_max_age * 1e9
        if pose is not None and fresh and len(self._path):
            speed, turn = self._command(pose, now)
        else:
            self._last_action = np.zeros(2)
        command = Twist()
        command.linear.x, command.angular.z = speed, turn
        self._publisher.publish(command)

    def _command(self, pose: Pose, now: int) -> tuple[float, float]:
        params, position = self._params, np.asarray(pose[:2])
        if self._final_yaw is not None or np.linalg.norm(self._path[-1] - position) < params.arrive:
            self._last_action = np.zeros(2)
            error = 0.0 if self._final_yaw is None else wrap(self._final_yaw - pose[2])
            if abs(error) < params.arrive_yaw:
                return 0.0, 0.0
            return 0.0, float(np.clip(params.turn_gain * error, -params.max_turn, params.max_turn))
        obstacles = self._obstacles(pose, now)
        charge_work("obstacles", len(obstacles))
        goal = transform(inverse(pose), lookahead_point(self._path, position, params.lookahead))
        seen = observation(self._velocity, goal, sector_ranges(obstacles), self._last_action)
        action = self._policy(seen)[0]
        charge(self._latency_ns, "gpu")
        self._last_action = self._policy.meta.clip(action)
        speed, turn = self._policy.meta.commands(action)
        return float(speed), float(turn)
