"""Controller node with two ways to drive, a policy and pure pursuit, and a supervisor that chooses between them.

Ten times a second the node asks the policy, shows a supervisor how healthy everything is, and does what it says:
``policy`` drives by the policy, ``pursuit`` by the lab's path tracker (slowly where the camera is late, for what only
the camera sees may be anywhere), ``stop`` does not drive.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from sensor_msgs.msg import LaserScan, PointCloud2

from robotbrain.errors import InputError
from robotbrain.pipeline.control import ControlParams, PathTracker, lookahead_point
from robotbrain.pipeline.geometry import Pose
from robotbrain.pipeline.nodes.policy_controller import PolicyControllerNode
from robotbrain.rl.onnx_policy import OnnxPolicy
from robotbrain.ros import charge, charge_work
from robotbrain.ros.conversions import time_to_ns

MODES = ("policy", "pursuit", "stop")
"""What a supervisor may answer."""
CREEP = 0.25
"""Top speed of pure pursuit while the supervisor does not trust the policy, m/s."""

Observe = Callable[..., Any]
"""``observe(pose, velocity, waypoint, points, last_action)`` -> what the policy is shown, 43 numbers."""


@dataclass(frozen=True)
class Health:
    """What a supervisor is told before every command.

    Attributes:
        now_s: time, s.
        scan_age_s, pose_age_s, image_age_s: since the newest lidar scan, odometry and segmented image that the
            controller has were measured, s; inf as long as there is none.
        inputs: what the policy was shown.
        action: what it answered, as it came out of the network: forward speed and turning rate, not yet clipped or
            scaled; NaN where it could not be asked.
    """

    now_s: float
    scan_age_s: float
    pose_age_s: float
    image_age_s: float
    inputs: tuple[float, ...]
    action: tuple[float, ...]


class SupervisedControllerNode(PolicyControllerNode):
    """Drives along ``plan``, by policy or by pure pursuit as a supervisor decides.

    Args:
        policy: of the task ``navigation``.
        observe: makes the policy's input; see ``Observe``.
        decide: the supervisor: a :class:`Health` in, one of ``MODES`` out.
        latency_ns: simulated GPU time of one inference, ns.
        fails_at: from this time on the policy answers NaN, s; a fault to try a supervisor with.

    Attributes:
        modes: (time s, mode) of every change of mode.
    """

    def __init__(
        self,
        policy: OnnxPolicy,
        observe: Observe,
        decide: Callable[[Health], Any],
        latency_ns: int = 0,
        fails_at: float = float("inf"),
    ) -> None:
        super().__init__(policy, latency_ns)
        self.modes: list[tuple[float, str]] = []
        self._observe, self._decide, self._fails_at = observe, decide, fails_at
        self._tracker = PathTracker(ControlParams(max_speed=CREEP))
        self._stamps: dict[str, int] = {}

    def _on_odometry(self, msg: Odometry) -> None:
        self._stamps["pose"] = time_to_ns(msg.header.stamp)
        super()._on_odometry(msg)

    def _on_scan(self, msg: LaserScan) -> None:
        self._stamps["scan"] = time_to_ns(msg.header.stamp)
        super()._on_scan(msg)

    def _on_points(self, msg: PointCloud2) -> None:
        self._stamps["image"] = time_to_ns(msg.header.stamp)
        super()._on_points(msg)

    def _control(self) -> None:
        pose = self._poses.latest()
        now = self.get_clock().now().nanoseconds
        command = Twist()
        if pose is not None and len(self._path):
            command.linear.x, command.angular.z = self._supervised(pose, now)
        self._publisher.publish(command)

    def _supervised(self, pose: Pose, now: int) -> tuple[float, float]:
        obstacles = self._sightings.around(pose, now)
        charge_work("obstacles", len(obstacles))
        inputs, action = self._ask(pose, obstacles, now)
        age = {name: (now - self._stamps[name]) * 1e-9 if name in self._stamps else float("inf") for name in _INPUTS}
        shown, answered = (tuple(float(v) for v in values) for values in (inputs, action))
        mode = self._decide(Health(now * 1e-9, age["scan"], age["pose"], age["image"], shown, answered))
        if mode not in MODES:
            raise InputError("supervisor", given=mode, expected="one of " + ", ".join(MODES), fix="Return one of them.")
        if not self.modes or self.modes[-1][1] != mode:
            self.modes.append((now * 1e-9, mode))
        # Turning to a heading on the spot, and the last step to a path's end, are the tracker's in any case.
        near = np.linalg.norm(self._path[-1] - np.asarray(pose[:2])) < self._params.arrive
        if mode == "policy" and self._final_yaw is None and not near and np.isfinite(action).all():
            self._last_action = self._policy.meta.clip(action)
            speed, turn = self._policy.meta.commands(action)
            return float(speed), float(turn)
        self._last_action = np.zeros(2)
        # No motor takes NaN for a speed: a policy that is trusted and has no answer leaves the robot where it is.
        if mode == "stop" or (mode == "policy" and not np.isfinite(action).all()):
            return 0.0, 0.0
        chosen = self._tracker.command(now * 1e-9, pose, self._path, self._final_yaw, obstacles)
        charge_work("arcs", self._tracker.arcs)
        charge_work("distances", self._tracker.distances)
        return chosen.speed, chosen.turn

    def _ask(self, pose: Pose, obstacles: NDArray[np.float64], now: int) -> tuple[Any, NDArray[np.float64]]:
        """Return what the policy is shown, and what it answers; NaN where it cannot."""
        waypoint = lookahead_point(self._path, np.asarray(pose[:2]), self._params.lookahead)
        inputs = np.asarray(
            self._observe(pose, self._velocity, (float(waypoint[0]), float(waypoint[1])), obstacles, self._last_action),
            dtype=np.float64,
        ).ravel()
        charge(self._latency_ns, "gpu")
        unable = np.full(2, np.nan)
        if now * 1e-9 >= self._fails_at or not np.isfinite(inputs).all():
            return inputs, unable
        if len(inputs) != self._policy.meta.observation_dim:
            raise InputError(
                "policy input",
                given=f"{len(inputs)} numbers",
                expected=f"{self._policy.meta.observation_dim}",
                fix="Put all four groups into one array, in the order of OBSERVATIONS.",
            )
        try:
            return inputs, np.asarray(self._policy(inputs[None])[0], dtype=np.float64)
        except InputError:  # a network that answers NaN or infinity
            return inputs, unable


_INPUTS = ("scan", "pose", "image")
