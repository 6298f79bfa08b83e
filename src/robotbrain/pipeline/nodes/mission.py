"""Mission node: finds the marker, asks for plans, hands paths to the controller."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import PointStamped, PoseStamped
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from nav_msgs.srv import GetPlan
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.task import Future
from std_msgs.msg import Bool

from robotbrain.pipeline.exploration import MarkerTracker, ViewMemory
from robotbrain.pipeline.geometry import Pose, transform
from robotbrain.pipeline.nodes.grids import grid_from_msg
from robotbrain.pipeline.nodes.poses import FrameCheck, StampedPoses, check_finite
from robotbrain.ros import charge_work
from robotbrain.ros.conversions import numpy_to_path, time_to_ns, yaw_to_quaternion

RATE_HZ = 4.0
REPLAN_AFTER = 1.5
"""A path is planned again after this long, s: the map has grown."""
GIVE_UP_AFTER = 8.0
"""A target that has not been viewed after this long is dropped, s."""
PATIENCE = 5
"""A marker to which this many requests in a row found no route is taken for a mistake."""
NEAR, NEAR_PATIENCE = 0.7, 8.0
"""A marker that is this near, m, for this long, s, without the robot arriving is taken for a mistake, too."""
ARRIVED = 0.15
"""Distance to the marker's estimated centre that counts as arrived, m."""


class MissionNode(Node):
    """Explores with the camera until the marker is confirmed, then drives to it.

    Subscribes ``perception/marker``, ``odometry/filtered``, ``map``; calls the service ``plan``; publishes ``plan``,
    ``goal_pose`` (only for a confirmed marker) and, once there, ``goal_reached``.

    Args:
        replan_after: how old a path may grow before another is asked for, s.
    """

    def __init__(self, replan_after: float = REPLAN_AFTER) -> None:
        super().__init__("mission")
        self._replan_after = replan_after
        self._frames = FrameCheck(self)
        self._poses = StampedPoses(frames=self._frames)
        self._marker = MarkerTracker()
        self._views: ViewMemory | None = None
        self._occupancy: NDArray[np.int8] | None = None
        self._target: tuple[float, float] | None = None
        self._target_since = 0.0
        self._planned_for: tuple[float, float] | None = None
        self._planned_at = -np.inf
        self._pending: Future | None = None
        self._refusals = 0
        self._near_since = np.inf
        self._done = False
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._plan_pub = self.create_publisher(Path, "plan", 10)
        self._goal_pub = self.create_publisher(PoseStamped, "goal_pose", 10)
        self._reached_pub = self.create_publisher(Bool, "goal_reached", latched)
        self._client = self.create_client(GetPlan, "plan")
        self.create_subscription(Odometry, "odometry/filtered", self._poses.on_odometry, 10)
        self.create_subscription(OccupancyGrid, "map", self._on_map, latched)
        self.create_subscription(PointStamped, "perception/marker", self._on_marker, 10)
        self.create_timer(1.0 / RATE_HZ, self._decide)

    def _on_map(self, msg: OccupancyGrid) -> None:
        self._occupancy, frame = grid_from_msg(msg)
        if self._views is None:
            self._views = ViewMemory(frame)
        elif self._views.frame != frame:
            self._views = self._views.moved_to(frame)
        charge_work("map_read", self._occupancy.size)

    def _on_marker(self, msg: PointStamped) -> None:
        if not self._frames.expect("perception/marker", msg, "base_link"):
            return
        seen = np.array([msg.point.x, msg.point.y])
        check_finite("perception/marker", seen)
        # Where the robot was when the image was taken, not where it is now that the network has answered.
        self._poses.when_known(
            time_to_ns(msg.header.stamp),
            lambda pose: self._marker.add(transform(pose, seen), float(np.hypot(*seen))),
        )

    def _decide(self) -> None:
        pose = self._poses.latest()
        if pose is None or self._done or self._occupancy is None or self._views is None:
            return
        now = self.get_clock().now().nanoseconds * 1e-9
        self._views.look(pose, self._occupancy)
        charge_work("view", self._views.looked)
        goal = self._marker.estimate()
        if goal is not None:
            self._target = None
            distance = float(np.hypot(goal[0] - pose[0], goal[1] - pose[1]))
            if distance < ARRIVED:
                self._finish()
                return
            # As near as the map lets it come, and still not there: whatever was seen is no mat to stand on.
            self._near_since = min(self._near_since, now) if distance < NEAR else np.inf
            if now - self._near_since > NEAR_PATIENCE:
                self._give_up_marker()
                return
            self._goal_pub.publish(self._pose_stamped(goal, 0.0))
            self._request(pose, goal, now)
            return
        self._explore(pose, now)

    def _explore(self, pose: Pose, now: float) -> None:
        assert self._views is not None and self._occupancy is not None
        if self._target is not None:
            cell = self._views.frame.to_cell(*self._target)
            if self._views.viewed[cell]:
                self._target = None
            elif now - self._target_since > GIVE_UP_AFTER:
                self._views.reject(*self._target)
                self._target = None
        if self._target is None:
            self._target = self._views.next_target(pose, self._occupancy)
            charge_work("explore", self._views.searched)
            self._target_since = now
        if self._target is None:
            # All that can be reached was viewed, and there was no marker: it must have been overlooked.
            self._views.look_again()
            self._marker.forgive()
            self._look_around(pose)
            return
        self._request(pose, self._target, now)

    def _look_around(self, pose: Pose) -> None:
        """Turn on the spot while there is no better place to look."""
        # A path of one pose asks the controller for that heading; it is here, so nothing is left to drive.
        path = numpy_to_path(np.array([pose[:2]]), stamp=self.get_clock().now().to_msg())
        path.poses[0].pose.orientation = yaw_to_quaternion(pose[2] + 2.0)
        self._planned_for = None
        self._plan_pub.publish(path)

    def _request(self, pose: Pose, goal: tuple[float, float], now: float) -> None:
        moved = self._planned_for is None or float(np.hypot(*np.subtract(goal, self._planned_for))) > 0.1
        if self._pending is not None or not (moved or now - self._planned_at > self._replan_after):
            return
        if not self._client.service_is_ready():
            return
        request = GetPlan.Request()
        request.start = self._pose_stamped(pose[:2], pose[2])
        request.goal = self._pose_stamped(goal, 0.0)
        request.tolerance = 0.4
        self._planned_for, self._planned_at = goal, now
        target = self._target
        self._pending = self._client.call_async(request)
        self._pending.add_done_callback(lambda future: self._on_plan(future, target))

    def _on_plan(self, future: Future, target: tuple[float, float] | None) -> None:
        """Take the answer to a request made for ``target`` (None: for the marker)."""
        self._pending = None
        if self._done:
            return
        path = future.result().plan
        if target != self._target:
            # The slow planner's answer to a question that is no longer asked.
            self._planned_for = None
            return
        if len(path.poses):
            self._refusals = 0
        elif target is None:
            self._refusals += 1
            if self._refusals >= PATIENCE:
                self._give_up_marker()
        else:
            assert self._views is not None
            self._views.reject(*target)
            self._target = None
        self._plan_pub.publish(path)

    def _give_up_marker(self) -> None:
        self._marker.discard()
        self._refusals = 0
        self._near_since = np.inf

    def _finish(self) -> None:
        self._done = True
        self._plan_pub.publish(numpy_to_path(np.zeros((0, 2)), stamp=self.get_clock().now().to_msg()))
        self._reached_pub.publish(Bool(data=True))

    def _pose_stamped(self, point: tuple[float, float], yaw: float) -> PoseStamped:
        msg = PoseStamped()
        msg.header.stamp = self.get_clock().now().to_msg()
        msg.header.frame_id = "map"
        msg.pose.position.x, msg.pose.position.y = float(point[0]), float(point[1])
        msg.pose.orientation = yaw_to_quaternion(yaw)
        return msg
