"""A surrogate arm behind the topics of a physical one: ``joint_states`` out, joint trajectories in.

It does what ``joint_state_broadcaster`` and ``joint_trajectory_controller`` of ros2_control do for streamed targets:
a new trajectory replaces the old one, and its last point is reached on a straight line at ``time_from_start``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from robotbrain.errors import InputError
from robotbrain.rl.deployment import joint_order
from robotbrain.rl.policy_node import TRAJECTORY_TOPIC
from robotbrain.rl.surrogate.fleet import SurrogateFleet
from robotbrain.ros.conversions import ns_to_time

STATES_HZ = 100.0
CATCH_UP_NS = 500_000_000
"""After a longer pause the world has stood still for the rest of it (ns)."""


class SurrogateArmNode(Node):
    """One surrogate arm. Its true state is not on any topic.

    Args:
        fleet: of one robot.
        watch: called after every advance; for judges and replays.

    Attributes:
        refused: trajectories that were not obeyed.
    """

    def __init__(self, fleet: SurrogateFleet, watch: Callable[[SurrogateFleet], Any] | None = None) -> None:
        if len(fleet) != 1:
            raise InputError(
                "surrogate", given=f"{len(fleet)} robots", expected="one", fix="Use Surrogate(serial=...)."
            )
        super().__init__("surrogate_arm")
        self._fleet, self._watch = fleet, watch or (lambda _: None)
        self._step_ns = round(fleet.step_s * 1e9)
        self._epoch_ns = int(self.get_clock().now().nanoseconds) - fleet.elapsed_steps * self._step_ns
        self._target = fleet.joint_pos
        self._ramp = 0
        self.refused = 0
        self._publisher = self.create_publisher(JointState, "joint_states", 10)
        self.create_subscription(JointTrajectory, TRAJECTORY_TOPIC, self._on_trajectory, 1)
        self.create_timer(1.0 / STATES_HZ, self._publish)

    def _advance(self) -> None:
        due_ns = int(self.get_clock().now().nanoseconds) - self._epoch_ns
        behind = due_ns - self._fleet.elapsed_steps * self._step_ns
        if behind > CATCH_UP_NS:
            self.get_logger().warning(f"the world stood still for {(behind - CATCH_UP_NS) * 1e-9:.1f} s")
            self._epoch_ns += behind - CATCH_UP_NS
            behind = CATCH_UP_NS
        steps = behind // self._step_ns
        if steps > 0:
            self._fleet.advance(self._target, steps, self._ramp)
            self._ramp = max(0, self._ramp - steps)
            self._watch(self._fleet)

    def _on_trajectory(self, msg: JointTrajectory) -> None:
        self._advance()
        names = self._fleet.body.joint_names
        try:
            order = joint_order(names, msg.joint_names)
            if not msg.points:
                raise InputError("trajectory", given="no points", expected="one or more", fix="Send a point.")
            point = msg.points[-1]
            position = np.asarray(point.positions, float)
            if len(position) != len(msg.joint_names) or not np.isfinite(position).all():
                raise InputError(
                    "trajectory positions", given=position.tolist(), expected="one finite angle per joint", fix="Check."
                )
        except InputError as error:
            self.refused += 1
            self.get_logger().error(f"trajectory refused: {error}", throttle_duration_sec=2.0)
            return
        self._target = position[order][None]
        ahead_ns = int(point.time_from_start.sec) * 1_000_000_000 + int(point.time_from_start.nanosec)
        self._ramp = max(0, ahead_ns // self._step_ns)

    def _publish(self) -> None:
        self._advance()
        readings = self._fleet.read()
        if not readings.fresh[0]:
            return
        msg = JointState()
        msg.header.stamp = ns_to_time(self._epoch_ns + self._fleet.elapsed_steps * self._step_ns)
        msg.name = list(self._fleet.body.joint_names)
        msg.position = [float(v) for v in readings.joint_pos[0]]
        msg.velocity = [float(v) for v in readings.joint_vel[0]]
        self._publisher.publish(msg)
