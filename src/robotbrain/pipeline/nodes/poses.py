"""Where was the robot when this was measured? Poses by stamp, and messages that wait for theirs."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np
from nav_msgs.msg import Odometry

from robotbrain.errors import InputError
from robotbrain.pipeline.geometry import Pose, PoseBuffer
from robotbrain.ros import charge_work
from robotbrain.ros.conversions import pose_to_xy_yaw, time_to_ns


def check_finite(topic: str, values: object) -> None:
    """Raise InputError, naming the topic, unless all ``values`` are finite numbers."""
    if not np.isfinite(np.asarray(values, dtype=float)).all():
        raise InputError(
            f"message on {topic}",
            given=values,
            expected="finite numbers",
            fix=f"Look at the node that publishes {topic}: it computes with NaN or infinity.",
        )


class StampedPoses:
    """Poses from ``odometry/filtered``, and actions that wait for one (what a tf2 message filter does).

    Args:
        limit: actions kept waiting at most; the oldest are dropped.
    """

    def __init__(self, limit: int = 20) -> None:
        self._poses = PoseBuffer()
        self._waiting: deque[tuple[int, Callable[[Pose], None]]] = deque(maxlen=limit)

    def on_odometry(self, msg: Odometry) -> None:
        """Store a pose (a subscription's callback) and run what waited for it."""
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
