"""What a report of a run needs, collected from the messages that pass and the callbacks that end."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robotbrain.monitoring.trace import stamp_of

if TYPE_CHECKING:
    from robotbrain.pipeline.costs import ProfileCosts
    from robotbrain.ros.context import CallbackRecord, MessageRecord
    from robotbrain.sim import RobotSim

STAMPED = ("/scan", "/perception/points", "/odometry/filtered")
"""Topics whose stamps are followed from sensor to command."""

PERIODS_MS = {
    ("controller", "timer", "_control"): ("controller", 50.0),
    ("perception", "subscription", "/camera/image"): ("perception", 100.0),
    ("estimator", "subscription", "/scan"): ("estimator_scan", 100.0),
    ("estimator", "subscription", "/joint_states"): ("estimator_wheels", 20.0),
}
"""Callbacks with a deadline: (role, kind, name) -> (short name, period of the timer or sensor, ms)."""


class Watch:
    """Collects latencies, plans and the truth while a run goes on.

    How old the inputs of a command are is found by following stamps: the estimator's newest matched scan travels with
    the odometry that it publishes; the controller's newest odometry and camera points are those whose callbacks have
    ended when its command is released. This holds for nodes of anybody, as long as each runs one callback at a time.

    Args:
        context: the simulation.
        costs: knows the nodes' roles.
    """

    def __init__(self, context: Any, costs: ProfileCosts) -> None:
        self._costs = costs
        self.perception_ms: list[float] = []
        self.planning_ms: list[float] = []
        self.camera_age_ms: list[float] = []
        self.scan_age_ms: list[float] = []
        self.deadline_misses: Counter[str] = Counter({name: 0 for name, _ in PERIODS_MS.values()})
        self.plans: list[tuple[float, NDArray[np.float64]]] = []
        self.trajectory: list[tuple[float, float, float, float]] = []
        self.boxes: list[list[tuple[float, float, float]]] = []
        self.marker: tuple[float, float] | None = None
        self.reached = False
        self._commands = 0
        self._first_command_ns = self._last_command_ns = 0
        # What a message stands for, by its id: its own stamp, for odometry that of the scan behind it.
        self._origin_ns: dict[int, int | None] = {}
        self._estimator_scan_ns: int | None = None
        self._controller_scan_ns: int | None = None
        self._controller_image_ns: int | None = None
        context.add_message_tap(self._on_message)
        context.add_callback_tap(self._on_callback)

    @property
    def control_hz(self) -> float:
        """Commands per second between the first and the last."""
        span = self._last_command_ns - self._first_command_ns
        return (self._commands - 1) * 1e9 / span if span else 0.0

    def finish(self, context: Any) -> None:
        """Count the messages that never met their callback as missed deadlines, too."""
        for (role, kind, name), (short, _) in PERIODS_MS.items():
            if kind == "subscription" and name in context.topics:
                for subscription in context.topics[name].subscriptions:
                    if self._costs.role(subscription.node.get_fully_qualified_name()) == role:
                        self.deadline_misses[short] += subscription.dropped

    def sample(self, sim: RobotSim, now: float) -> None:
        """Record where everything truly is."""
        pose = sim.truth.pose
        self.trajectory.append((now, pose.x, pose.y, pose.yaw))
        self.boxes.append([(p.x, p.y, p.yaw) for p in sim.truth.obstacle_poses()])

    def _on_message(self, record: MessageRecord, cdr: bytes) -> None:
        time_ns, topic = record.released_ns, record.name
        if record.kind != "topic":
            return
        if topic == "/cmd_vel":
            self._on_command(time_ns)
        elif topic == "/odometry/filtered":
            self._origin_ns[record.id] = self._estimator_scan_ns
        elif topic in STAMPED:
            self._origin_ns[record.id] = stamp_of(cdr)
        elif topic == "/perception/segmentation":
            self.perception_ms.append((time_ns - stamp_of(cdr)) * 1e-6)
        elif topic in ("/plan", "/goal_pose", "/goal_reached"):
            self._on_decision(time_ns, topic, record.type_name, cdr)

    def _on_command(self, time_ns: int) -> None:
        if not self._commands:
            self._first_command_ns = time_ns
        self._commands += 1
        self._last_command_ns = time_ns
        if self._controller_image_ns is not None and self._controller_scan_ns is not None:
            self.camera_age_ms.append((time_ns - self._controller_image_ns) * 1e-6)
            self.scan_age_ms.append((time_ns - self._controller_scan_ns) * 1e-6)

    def _on_decision(self, time_ns: int, topic: str, type_name: str, cdr: bytes) -> None:
        from rclpy.serialization import deserialize_message

        from robotbrain.ros.conversions import msg_class

        message: Any = deserialize_message(cdr, msg_class(type_name))
        if topic == "/plan":
            points = np.array([(p.pose.position.x, p.pose.position.y) for p in message.poses]).reshape(-1, 2)
            self.plans.append((time_ns * 1e-9, points))
        elif topic == "/goal_reached":
            self.reached |= bool(message.data)
        else:
            self.marker = (message.pose.position.x, message.pose.position.y)

    def _on_callback(self, record: CallbackRecord) -> None:
        role = self._costs.role(record.node)
        if not role:
            return
        if record.kind == "subscription":
            if role == "estimator" and record.name == "/scan":
                self._estimator_scan_ns = self._origin_ns.get(record.message)
            elif role == "controller" and record.name in STAMPED:
                origin = self._origin_ns.get(record.message)
                if origin is None:
                    pass
                elif record.name == "/odometry/filtered":
                    self._controller_scan_ns = origin
                elif record.name == "/perception/points":
                    self._controller_image_ns = origin
        elif record.kind == "service" and record.name == "/plan":
            self.planning_ms.append((record.end_ns - record.ready_ns) * 1e-6)
        deadline = PERIODS_MS.get((role, record.kind, record.name))
        if deadline is not None and record.end_ns - record.ready_ns > deadline[1] * 1e6:
            self.deadline_misses[deadline[0]] += 1
