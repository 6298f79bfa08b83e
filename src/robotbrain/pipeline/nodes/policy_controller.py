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
from robotbrain.pipeline.nodes.poses import FrameCheck, StampedPoses, check_finite, read_plan
from robotbrain.pipeline.nodes.sightings import Sightings
from robotbrain.rl.onnx_policy import OnnxPolicy
from robotbrain.rl.tasks.navigation_spec import (
    LIDAR_RANGE,
    check_meta,
    default_policy,
    observation,
    sector_ranges,
)
from robotbrain.ros import charge, charge_work


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
        self._sightings = Sightings(
            self._frames,
            self._poses,
            scan_range=LIDAR_RANGE,
            points_range=self._params.points_range,
            points_max_age=self._params.points_max_age,
        )
        self._velocity = (0.0, 0.0)
        self._last_action = np.zeros(2)
        self._path: NDArray[np.float64] = np.zeros((0, 2))
        self._final_yaw: float | None = None
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
        self._path, self._final_yaw = read_plan(msg)

    def _on_scan(self, msg: LaserScan) -> None:
        self._sightings.take_scan(msg)

    def _on_points(self, msg: PointCloud2) -> None:
        self._sightings.take_points(msg)

    def _control(self) -> None:
        pose = self._poses.latest()
        now = self.get_clock().now().nanoseconds
        speed = turn = 0.0
        fresh = self._sightings.fresh(now, self._params.scan_max_age)
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
        obstacles = self._sightings.around(pose, now)
        charge_work("obstacles", len(obstacles))
        goal = transform(inverse(pose), lookahead_point(self._path, position, params.lookahead))
        seen = observation(self._velocity, goal, sector_ranges(obstacles), self._last_action)
        action = self._policy(seen)[0]
        charge(self._latency_ns, "gpu")
        self._last_action = self._policy.meta.clip(action)
        speed, turn = self._policy.meta.commands(action)
        return float(speed), float(turn)
