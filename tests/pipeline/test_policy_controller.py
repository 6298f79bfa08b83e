"""The controller node with a policy inside: what it shows the policy, what it makes of the answer, when it stops."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robotbrain.errors import InputError
from robotbrain.jetson import load_profile
from robotbrain.pipeline.brain import drive
from robotbrain.pipeline.nodes.policy_controller import PolicyControllerNode, PolicyControlParams, policy_controller
from robotbrain.rl.policy_meta import PolicyMeta
from robotbrain.rl.tasks.navigation_spec import LIDAR_NEAREST, LIDAR_SCALE, SECTORS, policy_meta
from robotbrain.ros import CallbackError, DeviceResources, SimContext

GOAL, LIDAR, LAST = slice(2, 5), slice(5, 5 + SECTORS), slice(5 + SECTORS, 7 + SECTORS)


def metres(obs: np.ndarray) -> np.ndarray:
    """Ranges of the sectors in an observation."""
    return np.asarray(LIDAR_NEAREST * np.exp(obs[LIDAR] / LIDAR_SCALE))


class Spy:
    """A policy that always answers the same and keeps what it was shown."""

    def __init__(self, action: tuple[float, float] = (0.5, -0.25), meta: PolicyMeta | None = None) -> None:
        self.meta, self.action = meta or policy_meta(), action
        self.shown: list[np.ndarray] = []

    def __call__(self, obs: Any) -> np.ndarray:
        self.shown.append(np.array(obs[0]))
        return np.array([self.action], dtype=np.float32)


class Bench:
    """The node alone in simulated time; the test plays the rest of the brain."""

    def __init__(self, spy: Spy, latency_ns: int = 0, **params: Any) -> None:
        import rclpy
        from geometry_msgs.msg import Twist
        from nav_msgs.msg import Odometry, Path
        from sensor_msgs.msg import LaserScan, PointCloud2

        self.context = SimContext(resources=DeviceResources(cpu_cores=2, gpu=1, dla=0))
        self.commands: list[tuple[float, float, float]] = []
        with self.context.as_default():
            self.node = PolicyControllerNode(spy, latency_ns, PolicyControlParams(**params))  # type: ignore[arg-type]
            self.world = rclpy.create_node("world")
            types = {"odometry/filtered": Odometry, "scan": LaserScan, "perception/points": PointCloud2, "plan": Path}
            self.out = {topic: self.world.create_publisher(kind, topic, 10) for topic, kind in types.items()}
            self.world.create_subscription(Twist, "cmd_vel", self._on_command, 10)

    def _on_command(self, msg: Any) -> None:
        self.commands.append((self.context.now_ns * 1e-9, msg.linear.x, msg.angular.z))

    def odometry(self, x: float = 0.0, y: float = 0.0, yaw: float = 0.0, v: float = 0.0, w: float = 0.0) -> None:
        from nav_msgs.msg import Odometry

        from robotbrain.ros.conversions import ns_to_time, pose_2d

        msg = Odometry()
        msg.header.stamp, msg.header.frame_id = ns_to_time(self.context.now_ns), "map"
        msg.pose.pose = pose_2d(x, y, yaw)
        msg.twist.twist.linear.x, msg.twist.twist.angular.z = v, w
        self.out["odometry/filtered"].publish(msg)

    def scan(self, **ranges: float) -> None:
        """Publish a scan of 120 rays, all +inf but those given by index, e.g. ``r60=1.0``."""
        from sensor_msgs.msg import LaserScan

        from robotbrain.ros.conversions import ns_to_time

        msg = LaserScan()
        msg.header.stamp, msg.header.frame_id = ns_to_time(self.context.now_ns), "lidar_link"
        msg.angle_min, msg.angle_increment = -math.pi, math.tau / 120
        msg.range_min, msg.range_max = 0.05, 8.0
        values = np.full(120, np.inf, np.float32)
        for name, distance in ranges.items():
            values[int(name[1:])] = distance
        msg.ranges = values
        self.out["scan"].publish(msg)

    def plan(self, *points: tuple[float, float], yaw: float | None = None) -> None:
        from robotbrain.ros.conversions import numpy_to_path, yaw_to_quaternion

        msg = numpy_to_path(np.array(points).reshape(-1, 2), stamp=0)
        if yaw is not None:
            msg.poses[0].pose.orientation = yaw_to_quaternion(yaw)
        self.out["plan"].publish(msg)

    def run(self, seconds: float) -> tuple[float, float]:
        """Let time pass; return the last command."""
        self.context.run_for(seconds)
        return self.commands[-1][1:]


def ready(spy: Spy, **params: Any) -> Bench:
    bench = Bench(spy, **params)
    bench.odometry()
    bench.scan()
    bench.plan((0.0, 0.0), (5.0, 0.0))
    return bench


def test_the_policys_answer_is_clipped_scaled_and_published_at_its_own_rate() -> None:
    bench = ready(Spy((2.0, -0.25)))
    assert bench.run(0.35) == pytest.approx((0.5, -0.3))  # 0.15 + 0.35 * 1, 1.2 * -0.25
    assert np.diff([t for t, *_ in bench.commands]) == pytest.approx(0.1)


def test_the_policy_is_shown_velocity_waypoint_scan_and_its_last_action() -> None:
    spy = Spy()
    bench = Bench(spy, lookahead=1.0)
    bench.odometry(1.0, 2.0, math.pi / 2, v=0.3, w=-0.5)
    bench.scan(r60=1.2, r30=0.6, r61=7.0)  # straight ahead, to the right, and one beyond what the policy sees
    bench.plan((1.0, 2.0), (4.0, 2.0))  # along the map's x axis: to the robot's right
    bench.run(0.25)
    first, second = spy.shown[:2]
    assert first[:2] == pytest.approx((0.3, -0.5))
    assert first[GOAL] == pytest.approx((0.0, -1.0, 1.0 / 3.0), abs=1e-6)
    scan = metres(first)
    assert scan[[17, 18]] == pytest.approx(1.2) and scan[[8, 9]] == pytest.approx(0.6)
    assert np.delete(scan, [8, 9, 17, 18]) == pytest.approx(3.0)
    assert first[LAST] == pytest.approx(0.0) and second[LAST] == pytest.approx(spy.action)


def test_an_old_scan_is_seen_from_where_the_robot_stands_now() -> None:
    spy = Spy()
    bench = ready(spy)
    bench.scan(r60=2.0)
    bench.run(0.15)
    bench.odometry(x=0.5)
    bench.run(0.1)
    assert metres(spy.shown[-1]).min() == pytest.approx(1.5, abs=1e-5)


def test_what_only_the_camera_saw_is_an_obstacle_and_the_floor_is_none() -> None:
    from robotbrain.ros.conversions import ns_to_time, points_to_cloud

    spy = Spy()
    bench = ready(spy, points_max_age=1.0)
    cloud = np.array([[0.7, 0.02, 1.0], [0.4, 0.02, 0.0]], np.float32)  # an obstacle, and floor before it
    bench.out["perception/points"].publish(points_to_cloud(cloud, stamp=ns_to_time(0), frame_id="base_link"))
    bench.run(0.15)
    assert metres(spy.shown[-1]).min() == pytest.approx(0.7, abs=0.03)
    bench.context.run_for(1.0)
    bench.odometry()
    bench.scan()
    bench.run(0.15)
    assert spy.shown[-1][LIDAR].min() == pytest.approx(1.0)  # forgotten


def test_it_stops_without_a_path_at_its_end_and_when_the_scan_grows_stale() -> None:
    spy = Spy()
    bench = Bench(spy)
    assert bench.run(0.15) == (0.0, 0.0)
    bench.odometry()
    bench.scan()
    assert bench.run(0.1) == (0.0, 0.0) and not spy.shown
    bench.plan((0.0, 0.0), (0.05, 0.0))
    assert bench.run(0.1) == (0.0, 0.0) and not spy.shown
    bench.plan((0.0, 0.0), (5.0, 0.0))
    assert bench.run(0.1)[0] > 0.0
    assert bench.run(0.6) == (0.0, 0.0)  # no scan for more than half a second


def test_a_path_of_one_pose_turns_the_robot_on_the_spot() -> None:
    spy = Spy()
    bench = Bench(spy)
    bench.odometry()
    bench.scan()
    bench.plan((0.3, 0.0), yaw=-1.0)
    speed, turn = bench.run(0.15)
    assert speed == 0.0 and turn == pytest.approx(-1.2) and not spy.shown
    bench.odometry(yaw=-0.95)
    assert bench.run(0.1) == (0.0, 0.0)


def test_inference_takes_its_time_on_the_gpu() -> None:
    released = []
    for latency_ns in (0, 20_000_000):
        bench = Bench(Spy(), latency_ns)
        bench.odometry()
        bench.scan()
        bench.plan((0.0, 0.0), (5.0, 0.0))
        bench.run(0.35)
        released.append(np.array([t for t, v, _ in bench.commands if v > 0.0][:2]))
    assert released[1] - released[0] == pytest.approx(0.02)


def test_frames_of_others_and_numbers_that_are_none_are_not_obeyed() -> None:
    spy = Spy()
    bench = ready(spy)
    with pytest.raises(CallbackError, match="odometry"):
        bench.odometry(v=float("nan"))
        bench.run(0.15)


def test_a_policy_of_another_task_is_refused() -> None:
    meta = policy_meta()
    for other in (
        dataclasses.replace(meta, task="reach"),
        dataclasses.replace(meta, observation_names=(*meta.observation_names[:-1], ("wheel_speed", 2))),
        dataclasses.replace(meta, action_kind="joint_velocity"),
    ):
        with SimContext().as_default(), pytest.raises(InputError, match="navigation policy"):
            PolicyControllerNode(Spy(meta=other))  # type: ignore[arg-type]
    with pytest.raises(InputError, match="policy"):
        policy_controller(Path("nowhere.onnx"))


def test_the_shipped_policy_drives_the_labs_brain_to_the_goal() -> None:
    run = drive(101, parts={"controller": policy_controller(profile=load_profile("orin-nano-8gb"))})
    assert run.success and not run.collisions, run.reason
    assert run.control_hz == pytest.approx(10.0, abs=0.2)
    assert run.deadline_misses["controller"] == 0
