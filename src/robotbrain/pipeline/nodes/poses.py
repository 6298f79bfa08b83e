"""Where was the robot when this was measured? Poses by stamp, and messages that wait for theirs."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from nav_msgs.msg import Odometry, Path
from numpy.typing import NDArray
from rclpy.node import Node

from robotbrain.errors import InputError
from robotbrain.pipeline.geometry import Pose, PoseBuffer
from robotbrain.ros import charge_work
from robotbrain.ros.conversions import path_to_numpy, pose_to_xy_yaw, quaternion_to_yaw, time_to_ns


def check_finite(topic: str, values: object) -> None:
    """Raise InputError, naming the topic, unless all ``values`` are finite numbers."""
    if not np.isfinite(np.asarray(values, dtype=float)).all():
        raise InputError(
            f"message on {topic}",
            given=values,
            expected="finite numbers",
            fix=f"Look at the node that publishes {topic}: it computes with NaN or infinity.",
        )


def read_plan(msg: Path) -> tuple[NDArray[np.float64], float | None]:
    """Return the points of a plan, (N, 2) in m, and the heading it asks for at its end (rad), if it asks for one.

    A path of one pose asks for its heading too; a longer one leaves the last heading open.

    Raises:
        InputError: points that are not finite.
    """
    path = path_to_numpy(msg)
    check_finite("plan", path)
    return path, quaternion_to_yaw(msg.poses[0].pose.orientation) if len(msg.poses) == 1 else None


FIXED_FRAMES = ("map", "odom", "world", "earth")
"""Frames that do not move with the robot (REP 105): no sensor on it measures in one of them."""


class FrameCheck:
    """Messages whose frame is not what a node takes it for are dropped, and it says so once.

    The kit's nodes know where their inputs are measured and ask no tf tree. A message in another frame would be used
    all the same: obstacles in the wrong place, without a word. An empty ``frame_id`` says nothing and passes.

    Args:
        node: that takes the messages.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._first: dict[str, str] = {}
        self._said: set[tuple[str, str]] = set()

    def expect(self, topic: str, msg: Any, frame: str) -> bool:
        """Tell whether a message is in ``frame``."""
        given = msg.header.frame_id
        if given in ("", frame):
            return True
        self._complain(topic, given, f"{frame!r}", f"transform it to {frame!r} before it is published")
        return False

    def sensor(self, topic: str, msg: Any) -> bool:
        """Tell whether a measurement is in a frame of its sensor: one that moves with the robot, always the same."""
        given = msg.header.frame_id
        if given in FIXED_FRAMES:
            self._complain(topic, given, "the sensor's own frame", "set frame_id in the sensor's driver")
            return False
        first = self._first.setdefault(topic, given)
        if given != first:
            self._complain(topic, given, f"{first!r}, as before", "let one sensor only publish on this topic")
            return False
        return True

    def _complain(self, topic: str, given: str, expected: str, fix: str) -> None:
        if (topic, given) not in self._said:
            self._said.add((topic, given))
            self._node.get_logger().error(
                f"{topic}: frame_id is {given!r}, expected {expected}; such messages are dropped, for what they say "
                f"would be put in the wrong place. To mend it: {fix}."
            )


class StampedPoses:
    """Poses from ``odometry/filtered``, and actions that wait for one (what a tf2 message filter does).

    Args:
        limit: actions kept waiting at most; the oldest are dropped.
        frames: says whether odometry is in the map's frame; None: it is not checked.
    """

    def __init__(self, limit: int = 20, frames: FrameCheck | None = None) -> None:
        self._frames = frames
        self._poses = PoseBuffer()
        self._waiting: deque[tuple[int, Callable[[Pose], None]]] = deque(maxlen=limit)

    def on_odometry(self, msg: Odometry) -> None:
        """Store a pose (a subscription's callback) and run what waited for it."""
        if self._frames is not None and not self._frames.expect("odometry/filtered", msg, "map"):
            return
        pose = pose_to_xy_yaw(msg.pose.pose)
        check_finite("odometry/filtered", pose)
        self._poses.add(time_to_ns(msg.header.stamp), pose)
        charge_work("pose", 1)
        self._flush()

    def latest(self) -> Pose | None:
        """Return the newest pose, or None."""
        return self._poses.latest()

    def when_known(self, stamp_ns: int, action: Callable[[Pose], None]) -> None:
        """Call ``action`` with the pose at ``stamp_ns``: now, or once odometry has come that far."""
        self._waiting.append((stamp_ns, action))
        self._flush()

    def _flush(self) -> None:
        latest = self._poses.latest_stamp()
        if latest is None:
            return
        remaining = []
        for stamp, action in self._waiting:
            if stamp > latest:
                remaining.append((stamp, action))
                continue
            # None for a stamp from before the first pose: that message is dropped.
            pose = self._poses.at(stamp)
            if pose is not None:
                action(pose)
        self._waiting.clear()
        self._waiting.extend(remaining)
