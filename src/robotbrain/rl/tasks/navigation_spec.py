"""What a navigation policy sees and does, in one place for training and for the robot; without torch.

The task (:mod:`robotbrain.rl.tasks.navigation`) computes the same observation with terms over many simulations, the
controller node (:mod:`robotbrain.pipeline.nodes.policy_controller`) with the functions here from ROS messages.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robotbrain.errors import InputError
from robotbrain.rl.policy_meta import PolicyMeta
from robotbrain.sim.robot import CHASSIS_RADIUS

CONTROL_DT = 0.1
"""The lab's lidar gives ten scans a second (s)."""
SECTORS = 36
"""Equal sectors of the scan, the first from straight behind anticlockwise."""
LIDAR_RANGE, GOAL_RANGE = 3.0, 3.0
"""What lies further is seen at this distance (m)."""
LIDAR_NEAREST = CHASSIS_RADIUS
"""What is nearer is seen at this distance (m): the robot touches it."""
ACTION_SCALE, ACTION_OFFSET = (0.35, 1.2), (0.15, 0.0)
"""Command = offset + scale * action: -0.2 to 0.5 m/s and -1.2 to 1.2 rad/s, the limits of the lab's own controller."""
OBSERVATIONS = (("body_velocity", 2), ("goal", 3), ("lidar_log_range", SECTORS), ("last_action", 2))
"""What the policy sees, in order: 43 numbers."""
LIDAR_SCALE = 1.0 / math.log(LIDAR_RANGE / LIDAR_NEAREST)
"""Ranges are seen as ``log(range / LIDAR_NEAREST) * LIDAR_SCALE``, 0 to 1: a centimetre matters where it is near."""
OBSERVATION_SCALES = ((1.0,), (1.0, 1.0, 1.0 / GOAL_RANGE), (LIDAR_SCALE,), (1.0,))


def default_policy() -> Path:
    """Return the path of the shipped navigation policy."""
    return Path(__file__).parent.parent / "weights" / "navigation.onnx"


def policy_meta(provenance: Mapping[str, Any] | None = None) -> PolicyMeta:
    """Return what a policy of this task says about itself in its file."""
    return PolicyMeta(
        task="navigation",
        observation_names=OBSERVATIONS,
        observation_scales=OBSERVATION_SCALES,
        control_dt=CONTROL_DT,
        action_kind="body_velocity",
        action_names=("forward_speed", "turning_rate"),
        action_scale=ACTION_SCALE,
        action_offset=ACTION_OFFSET,
        action_low=(-1.0, -1.0),
        action_high=(1.0, 1.0),
        command_names=("goal",),
        provenance=dict(provenance or {}),
    )


def check_meta(meta: PolicyMeta) -> None:
    """Refuse a policy that sees or does something else.

    Raises:
        InputError: naming the difference.
    """
    wanted = policy_meta()
    for name in ("task", "observation_names", "observation_scales", "action_kind", "action_names"):
        if getattr(meta, name) != getattr(wanted, name):
            raise InputError(
                f"navigation policy, {name}",
                given=getattr(meta, name),
                expected=repr(getattr(wanted, name)),
                fix="Train the task 'navigation' and export it with policy_meta() of this module.",
            )


def sector_ranges(points: ArrayLike, half_width: float = math.radians(1.5)) -> NDArray[np.float64]:
    """Return the distance (m) of the nearest point in each sector, (SECTORS,); ``LIDAR_RANGE`` where there is none.

    Args:
        points: (M, 2) in the robot's frame, x forward (m).
        half_width: a point stands for a beam this wide to either side (rad), so that no sector between two beams of
            a surface looks empty; half the angle between the rays of the lab's lidar.
    """
    nearest = np.full(SECTORS, LIDAR_RANGE)
    xy = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    distance = np.hypot(xy[:, 0], xy[:, 1])
    bearing = np.arctan2(xy[:, 1], xy[:, 0])
    for edge in (-half_width, 0.0, half_width):
        sector = np.floor((bearing + edge + math.pi) * SECTORS / (2.0 * math.pi)).astype(np.int64) % SECTORS
        np.minimum.at(nearest, sector, distance)
    return nearest


def observation(
    body_velocity: ArrayLike, goal: ArrayLike, ranges: ArrayLike, last_action: ArrayLike
) -> NDArray[np.float32]:
    """Return the policy's observation, (1, 43).

    Args:
        body_velocity: forward speed (m/s) and turning rate (rad/s).
        goal: (x, y) in the robot's frame (m).
        ranges: of the sectors (m), (SECTORS,).
        last_action: the policy's last action within -1..1, (2,); zeros at first.
    """
    x, y = (float(value) for value in np.asarray(goal))
    bearing = math.atan2(y, x)
    polar = (math.cos(bearing), math.sin(bearing), min(math.hypot(x, y), GOAL_RANGE) / GOAL_RANGE)
    near = np.clip(np.asarray(ranges, dtype=np.float64), LIDAR_NEAREST, LIDAR_RANGE) / LIDAR_NEAREST
    scan = np.log(near) * LIDAR_SCALE
    return np.concatenate([np.asarray(body_velocity), polar, scan, np.asarray(last_action)]).astype(np.float32)[None]
