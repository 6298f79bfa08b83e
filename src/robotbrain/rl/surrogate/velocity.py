"""The velocity task on surrogate quadrupeds: how well a walking policy follows commands, and how often it falls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robotbrain.errors import InputError
from robotbrain.rl.deployment import Policy, PolicyRunner, joint_order
from robotbrain.rl.surrogate.fleet import SurrogateFleet
from robotbrain.rl.surrogate.parameters import Array, SurrogateParams

BASE_TERMS = ("base_lin_vel", "base_ang_vel", "projected_gravity", "velocity_commands")
SPEED_NOISE, RATE_NOISE, GRAVITY_NOISE = 0.05, 0.03, 0.02
"""Standard deviations of the state estimator's speed (m/s), of the gyro (rad/s), and of the direction of gravity."""
FALLEN_HEIGHT, FALLEN_TILT = 0.15, 0.5
"""A robot has fallen when its trunk is lower than this (m), or its z axis has less than this share of the vertical."""
SETTLE_S = 1.0
"""Speed is judged after this time (s)."""


@dataclass(frozen=True, eq=False)
class Walks:
    """How commands were followed, one row per robot.

    Args:
        command: forward and sideways speed (m/s), turning rate (rad/s), (n, 3).
        velocity: mean of what was walked after the first second, same units, (n, 3).
        error: mean distance of forward and sideways speed from the command (m/s), (n,).
        fell: (n,).
        qpos: true generalised positions, (n, T, nq); None unless asked for.
    """

    command: Array
    velocity: Array
    error: Array
    fell: NDArray[np.bool_]
    qpos: Array | None = None


def walk(
    policy: Policy,
    serials: Sequence[int],
    commands: ArrayLike,
    *,
    seconds: float = 5.0,
    seed: int = 0,
    params: Sequence[SurrogateParams] | None = None,
    record: bool = False,
) -> Walks:
    """Let surrogate quadrupeds walk, each as its command says, from standing.

    Args:
        policy: with metadata; its observations as in the kit's velocity task.
        serials: of the robots.
        commands: (vx, vy, yaw rate) in m/s and rad/s, (n, 3), one for each robot.
        seconds: more than one.
        seed: of the sensors' noise.
        params: instead of those that follow from the serials.
        record: keep the true positions, for replays.

    Raises:
        InputError: the policy does not fit the robot, or commands that do not fit the serials.
    """
    fleet = SurrogateFleet(serials, "quadruped", params=params, seed=seed)
    wanted = np.asarray(commands, float)
    if wanted.shape != (len(fleet), 3) or not np.isfinite(wanted).all():
        raise InputError("commands", given=wanted.shape, expected=f"finite, ({len(fleet)}, 3)", fix="One per robot.")
    order = joint_order(policy.meta.joint_names, fleet.body.joint_names)
    back = np.argsort(order)
    runner = PolicyRunner(policy, fleet.body.limits[order], count=len(fleet), max_step=np.pi, extra_terms=BASE_TERMS)
    dt = policy.meta.control_dt
    steps, count = round(dt / fleet.step_s), round(seconds / dt)
    settled = round(SETTLE_S / dt)
    if count <= settled:
        raise InputError("seconds", given=seconds, expected=f"more than {SETTLE_S:g}", fix="Try 5.")
    rng = np.random.default_rng([0x9A1C, seed])
    fell = np.zeros(len(fleet), bool)
    walked, states = [], []
    readings = fleet.read()
    for _ in range(count):
        speed, rate, down = fleet.base_state
        sensed = {
            "base_lin_vel": speed + SPEED_NOISE * rng.standard_normal(speed.shape),
            "base_ang_vel": rate + RATE_NOISE * rng.standard_normal(rate.shape),
            "projected_gravity": down + GRAVITY_NOISE * rng.standard_normal(down.shape),
            "velocity_commands": wanted,
        }
        target = runner.act(readings.joint_pos[:, order], readings.joint_vel[:, order], None, sensed)
        fleet.advance(target[:, back], steps)
        readings = fleet.read()
        speed, rate, down = fleet.base_state
        walked.append(np.column_stack([speed[:, :2], rate[:, 2]]))
        fell |= (fleet.qpos[:, 2] < FALLEN_HEIGHT) | (-down[:, 2] < FALLEN_TILT)
        if record:
            states.append(fleet.qpos)
    judged = np.stack(walked[settled:], axis=1)
    error = np.linalg.norm(judged[..., :2] - wanted[:, None, :2], axis=2).mean(axis=1)
    return Walks(wanted, judged.mean(axis=1), error, fell, np.stack(states, axis=1) if record else None)
