"""A policy as a ROS 2 node at a fixed rate: joint states and a goal in, joint trajectories out.

Runs unchanged on the kit's rclpy, in simulated and in wall-clock time, and on genuine ROS 2. Topics are those of an
arm under ros2_control: ``joint_states`` (``joint_state_broadcaster``) and
``joint_trajectory_controller/joint_trajectory``. A trajectory, and not the ``Float64MultiArray`` of
``forward_position_controller``, because it names its joints, so that a mix-up is refused and not executed; because arms
ship with that controller; and because it interpolates between targets that come 25 times a second.

On a physical arm whose controller has another name, remap the topic when you start the node:

    --ros-args -r joint_trajectory_controller/joint_trajectory:=/scaled_joint_trajectory_controller/joint_trajectory

Before that: train on that arm's own MJCF and start ``robotbrain rl policy`` with ``--mjcf``, so that joint names,
limits and kinematics are its own; begin with a small ``--max-step``, a goal near the hand, and the emergency stop in
reach.

Age is judged by this node's own clock, from a joint state's receipt: the arm's computer may have another clock, and
its stamps, even from the future, only say in which order states were made. A state that is stamped before the last one
is therefore refused, but only until that one is ``stale_s`` old: then the arm's clock has been set back, or that one
was wrong, and the newer state counts.

In Isaac Lab the same file runs with ONNX Runtime on ``obs["policy"]`` of the task that ``robotbrain rl
export-isaaclab`` writes: terms, order and scales are the same, and its output is what ``env.step`` takes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from geometry_msgs.msg import PoseStamped
from numpy.typing import ArrayLike
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from robotbrain.errors import InputError
from robotbrain.rl.deployment import (
    Array,
    NodeOptions,
    Policy,
    PolicyRunner,
    check_joint_pos,
    joint_order,
    reach_bound,
)
from robotbrain.ros.conversions import ns_to_time, time_to_ns

TRAJECTORY_TOPIC = "joint_trajectory_controller/joint_trajectory"
WARN_S = 2.0
SHORTEST_NS = 1_000_000
"""Positions closer in time than this tell no velocity (ns)."""


@dataclass(frozen=True, eq=False)
class _State:
    received_ns: int
    stamp_ns: int
    position: Array
    velocity: Array


class PolicyNode(Node):
    """Runs a policy on one arm.

    Args:
        policy: with metadata: :class:`robotbrain.rl.export.OnnxPolicy`.
        limits: joint limits (rad), (J, 2), in the order of the metadata's joints.
        hand: place of the hand in the base frame (m), (n, 3), for joint angles (n, J) in that order; needed by
            policies that observe it. With it, goals that are out of reach are refused.
        options: see there.

    Attributes:
        commands: sent so far.
        refused: joint states and goals that could not be used.
        stale_periods: how often the data ran dry.

    Raises:
        InputError: the policy cannot run on such a robot.
    """

    def __init__(
        self,
        policy: Policy,
        limits: ArrayLike,
        hand: Callable[[Array], Array] | None = None,
        options: NodeOptions | None = None,
    ) -> None:
        super().__init__("policy")
        self.options = options or NodeOptions()
        self._runner = PolicyRunner(policy, limits, hand=hand, max_step=self.options.max_step)
        self.joint_names = policy.meta.joint_names
        self._reach = np.inf if hand is None else reach_bound(hand, self._runner.limits)
        period = policy.meta.control_dt
        given = self.options.time_from_start_s
        self._ahead_ns = round((period / 2 if given is None else given) * 1e9)
        self._state: _State | None = None
        self._goal: Array | None = None
        self._running = False
        self.commands = self.refused = self.stale_periods = 0
        self._publisher = self.create_publisher(JointTrajectory, TRAJECTORY_TOPIC, 1)
        self.create_subscription(JointState, "joint_states", self._on_joints, qos_profile_sensor_data)
        self.create_subscription(PoseStamped, "goal_pose", self._on_goal, 1)
        # A timer of rclpy is due at multiples of its period: a late call does not shift the next.
        self.create_timer(period, self._tick)

    @property
    def ready(self) -> bool:
        """Whether a usable joint state has come."""
        return self._state is not None

    def _now_ns(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _refuse(self, reason: str) -> None:
        self.refused += 1
        self.get_logger().error(reason, throttle_duration_sec=WARN_S)

    def _on_joints(self, msg: JointState) -> None:
        wanted = self.joint_names
        if not any(name in wanted for name in msg.name):
            return  # of another part of the robot, such as a gripper
        try:
            order = joint_order(wanted, msg.name)
        except InputError as error:
            self._refuse(f"joint_states: {error}")
            return
        if len(msg.position) != len(msg.name) or len(msg.velocity) not in (0, len(msg.name)):
            self._refuse("joint_states: as many positions as names are needed, and as many velocities or none")
            return
        now, before = self._now_ns(), self._state
        stamp = time_to_ns(msg.header.stamp) or now  # without a stamp: made when it came
        if before is not None and time_to_ns(msg.header.stamp) and not self._in_order(stamp, before):
            return
        position = np.asarray(msg.position, float)[order]
        if len(msg.velocity):
            velocity = np.asarray(msg.velocity, float)[order]
        elif before is None or stamp < before.stamp_ns:
            velocity = np.zeros(len(wanted))
        elif stamp - before.stamp_ns < SHORTEST_NS:
            velocity = before.velocity
        else:
            velocity = (position - before.position) / ((stamp - before.stamp_ns) * 1e-9)
        if not (np.isfinite(position).all() and np.isfinite(velocity).all()):
            self._refuse("joint_states: positions or velocities that are not finite")
            return
        try:
            check_joint_pos(wanted, position, self._runner.limits)
        except InputError as error:
            self._refuse(f"joint_states: {error}")
            return
        self._state = _State(now, stamp, position, velocity)

    def _in_order(self, stamp: int, before: _State) -> bool:
        """Whether a stamp follows the last one, or that one is too old to matter; if not, say so."""
        behind, stale = before.stamp_ns - stamp, self._is_stale(before)
        if behind < 0 or (behind > 0 and stale):
            return True
        if behind > 0:
            self._refuse(f"joint_states: stamped {behind * 1e-9:.3f} s before the last one; is a clock wrong?")
        elif stale:
            self._refuse("joint_states: the same stamp again and again; has the driver stopped reading the joints?")
        return False  # with the same stamp soon after: a copy

    def _is_stale(self, state: _State) -> bool:
        # An age below zero: this node's own clock has been set back.
        return not 0 <= self._now_ns() - state.received_ns <= self.options.stale_s * 1e9

    def _on_goal(self, msg: PoseStamped) -> None:
        place, turn = msg.pose.position, msg.pose.orientation
        goal = np.array([place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w], float)
        if msg.header.frame_id != self.options.base_frame:
            self._refuse(
                f"goal_pose: in frame {msg.header.frame_id!r}; expected {self.options.base_frame!r}: transform it first"
            )
        elif not np.isfinite(goal).all():
            self._refuse("goal_pose: not finite")
        elif (away := float(np.linalg.norm(goal[:3]))) > self._reach:
            self._refuse(
                f"goal_pose: {away:.2f} m from the base, but the hand reaches {self._reach:.2f} m; the last goal stays"
            )
        else:
            self._goal = goal
            self._runner.reset()

    def _tick(self) -> None:
        state, goal = self._state, self._goal
        if state is None or goal is None:
            return
        if self._is_stale(state):
            self._run_dry(state)
            return
        self._running = True
        size = dict(self._runner.meta.observation_names)
        whole = any(dim == 7 for dim in size.values())
        try:
            target = self._runner.act(
                state.position[None], state.velocity[None], goal[None] if whole else goal[None, :3]
            )
        except InputError as error:
            self._refuse(f"no command: {error}")
            return
        self._send(target[0])

    def _run_dry(self, state: _State) -> None:
        """Joint states are too old: hold the arm, once, and say so."""
        if not self._running:
            return
        self._running = False
        self.stale_periods += 1
        self.get_logger().error(f"no joint states for {self.options.stale_s:g} s: the arm holds its position")
        self._send(state.position)
        self._runner.reset()
        if self.options.on_stale == "stop":
            self._goal = None

    def _send(self, target: Array) -> None:
        point = JointTrajectoryPoint()
        point.positions = [float(v) for v in target]
        ahead = ns_to_time(self._ahead_ns)
        point.time_from_start.sec, point.time_from_start.nanosec = ahead.sec, ahead.nanosec
        msg = JointTrajectory()
        # A header without a time means "now" to the controller: its clock may differ from ours.
        msg.joint_names, msg.points = list(self.joint_names), [point]
        self._publisher.publish(msg)
        self.commands += 1
