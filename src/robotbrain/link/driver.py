"""What stands beside the brain's nodes while they drive: it hears their decisions and stops the robot at the end."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from robotbrain.link.realtime import FollowedClock
from robotbrain.link.runtime import Runtime

HALTS = 3
"""Times that zero velocity is commanded at the end."""


class Driver:
    """A node beside the brain's: hears what the brain decides and when it has arrived, and tells the robot to stop.

    Args:
        runtime: runs it.
        log: file for the decisions.
    """

    def __init__(self, runtime: Runtime, log: Path | None = None) -> None:
        self.reached = False
        self.decisions: Counter[str] = Counter()
        self._runtime = runtime
        self._log = log.open("w", encoding="utf-8", buffering=1) if log is not None else None
        self._publisher: Any = None
        runtime.make(self._make)

    def _make(self) -> Any:
        from geometry_msgs.msg import PoseStamped, Twist
        from nav_msgs.msg import Path as PathMsg
        from rclpy.node import Node
        from rclpy.qos import DurabilityPolicy, QoSProfile
        from std_msgs.msg import Bool

        node = Node("drive")
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        for kind, topic, qos in (
            (Twist, "cmd_vel", 10),
            (PathMsg, "plan", 10),
            (PoseStamped, "goal_pose", 10),
            (Bool, "goal_reached", latched),
        ):
            node.create_subscription(kind, topic, self._listener(node, topic), qos)
        self._publisher = node.create_publisher(Twist, "cmd_vel", 10)
        return node

    def _listener(self, node: Any, topic: str) -> Callable[[Any], None]:
        def listen(msg: Any) -> None:
            self.decisions[topic] += 1
            self.reached = self.reached or (topic == "goal_reached" and bool(msg.data))
            if self._log is not None:
                seconds = int(node.get_clock().now().nanoseconds) * 1e-9
                self._log.write(json.dumps({"t": seconds, "topic": topic, **_in_words(msg)}) + "\n")

        return listen

    def close(self) -> None:
        """Close the log."""
        if self._log is not None:
            log, self._log = self._log, None
            log.close()

    def halt(self) -> None:
        """Command zero velocity, more than once: the wire may be bad. The brain's nodes must be gone by then."""
        from geometry_msgs.msg import Twist

        for _ in range(HALTS):
            self._publisher.publish(Twist())
            self._runtime.run(lambda: False, 0.02)


def _in_words(msg: Any) -> dict[str, Any]:
    """Return what matters of a decision: a twist, the points of a path, a place, or an answer."""
    if hasattr(msg, "linear"):
        return {"v": float(msg.linear.x), "w": float(msg.angular.z)}
    if hasattr(msg, "poses"):
        return {"points": [[p.pose.position.x, p.pose.position.y] for p in msg.poses]}
    if hasattr(msg, "pose"):
        return {"x": msg.pose.position.x, "y": msg.pose.position.y}
    return {"data": bool(msg.data)}


def clock_node(clock: FollowedClock) -> Any:
    """Return a node that sets ``clock`` by ``/clock``."""
    from rclpy.node import Node
    from rclpy.qos import qos_profile_sensor_data
    from rosgraph_msgs.msg import Clock

    from robotbrain.ros.conversions import time_to_ns

    node = Node("clock")
    node.create_subscription(Clock, "/clock", lambda msg: clock.set(time_to_ns(msg.clock)), qos_profile_sensor_data)
    return node
