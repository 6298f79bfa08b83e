"""The reach task on surrogates: many at once, for statistics, for the gap study and for judging homework.

Everything runs as on a robot: the encoders' readings, forward kinematics on them, the policy, joint targets through
the robot's trajectory controller. Only success is measured at the true hand, by the judge.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robotbrain.errors import InputError
from robotbrain.rl.deployment import Policy, PolicyRunner, joint_order
from robotbrain.rl.surrogate.body import Kinematics
from robotbrain.rl.surrogate.fleet import Readings, SurrogateFleet
from robotbrain.rl.surrogate.parameters import Array, SurrogateParams

TOLERANCE_M = 0.02
"""A target is reached if the hand stays within this distance (m) ..."""
LAST_STEPS = 5
"""... for so many control steps at the episode's end."""
EPISODE_STEPS = 50
START_SPREAD = 0.25
"""Joint angles at the start are the default ones plus or minus so much (rad)."""
RAMP_S = 0.02
"""A trajectory controller goes to a new target within half a control period (s): no jumps, and little delay."""


@dataclass(frozen=True, eq=False)
class ReachEpisodes:
    """How episodes went, one row per episode.

    Args:
        serial: of the surrogate, (E,).
        target: (m), (E, 3).
        distance: of the true hand from the target after each control step (m), (E, T).
        qpos: true generalised positions after each step, (E, T, nq); None unless asked for.
    """

    serial: NDArray[np.int64]
    target: Array
    distance: Array
    qpos: Array | None = None

    @property
    def success(self) -> NDArray[np.bool_]:
        """Whether the hand stayed within the tolerance over the last steps, (E,)."""
        return np.asarray((self.distance[:, -LAST_STEPS:] < TOLERANCE_M).all(axis=1))

    @property
    def final_error(self) -> Array:
        """Mean distance over the last steps (m), (E,)."""
        return np.asarray(self.distance[:, -LAST_STEPS:].mean(axis=1))


class SurrogateReachEnv:
    """The reach task on a fleet of surrogate arms, stepped together.

    Args:
        serials: of the arms; one may come more than once.
        seed: of start poses, targets and sensor noise.
        params: instead of those that follow from the serials.
        control_dt: time from one action to the next (s).
        ramp_s: the robot's trajectory controller goes to a new target in this time (s); 0: at once.
        num_threads: of the physics; results do not depend on it.

    Attributes:
        fleet: the arms.
        target: what to reach in the base frame (m), (n, 3).
    """

    def __init__(
        self,
        serials: Sequence[int],
        seed: int = 0,
        *,
        params: Sequence[SurrogateParams] | None = None,
        control_dt: float = 0.04,
        ramp_s: float = RAMP_S,
        num_threads: int = 1,
    ) -> None:
        self.fleet = SurrogateFleet(serials, "arm", params=params, seed=seed, num_threads=num_threads)
        self.steps = round(control_dt / self.fleet.step_s)
        self._ramp = round(ramp_s / self.fleet.step_s)
        if self.steps < 1 or abs(self.steps * self.fleet.step_s - control_dt) > 1e-9:
            raise InputError(
                "control_dt",
                given=control_dt,
                expected=f"a multiple of the physics step, {self.fleet.step_s:g} s",
                fix="The kit's reach task uses 0.04 s.",
            )
        self.target = np.zeros((len(self.fleet), 3))
        self.kinematics = Kinematics(self.fleet.body)
        self._seed, self._episode = seed, 0

    def reset(self, *, start: ArrayLike | None = None, target: ArrayLike | None = None) -> Readings:
        """Begin an episode on every arm and return the first readings.

        Start and target are drawn, uniformly around the default pose and in the workspace, unless given (rad, (n, J);
        m, (n, 3)). Episode k of arm i is the same whoever else is in the fleet.
        """
        from robotbrain.rl.robots.arm import WORKSPACE

        n, joints = len(self.fleet), len(self.fleet.body.joint_names)
        low, high = np.array(WORKSPACE, float).T
        rngs = [np.random.default_rng([0x7A26E7, self._seed, i, self._episode]) for i in range(n)]
        drawn = np.stack([r.random(joints + 3) for r in rngs])
        self._episode += 1
        spread = self.fleet.body.default_joint_pos + START_SPREAD * (2.0 * drawn[:, :joints] - 1.0)
        self.target = low + drawn[:, joints:] * (high - low) if target is None else np.array(target, float)
        if self.target.shape != (n, 3) or not np.isfinite(self.target).all():
            raise InputError("target", given=self.target.shape, expected=f"finite, ({n}, 3), m", fix="One per arm.")
        self.fleet.reset(joint_pos=spread if start is None else start)
        return self.fleet.read()

    def step(self, joint_target: ArrayLike) -> tuple[Readings, Array]:
        """Command joint angles (rad), (n, J), for one control step; return readings and true distances (m), (n,)."""
        self.fleet.advance(joint_target, self.steps, self._ramp)
        distance = np.linalg.norm(self.fleet.site_pos("ee") - self.target, axis=1)
        return self.fleet.read(), np.asarray(distance)

    def runner(self, policy: Policy, max_step: float = 0.5) -> PolicyRunner:
        """Return what runs ``policy`` on this fleet.

        Raises:
            InputError: the policy is for other joints, or observes what an arm does not measure.
        """
        order = joint_order(policy.meta.joint_names, self.fleet.body.joint_names)
        back = np.argsort(order)
        return PolicyRunner(
            policy,
            self.fleet.body.limits[order],
            hand=lambda q: self.kinematics(q[:, back]),
            count=len(self.fleet),
            max_step=max_step,
        )

    def run(self, policy: Policy, episodes: int = 1, *, record: bool = False) -> ReachEpisodes:
        """Let ``policy`` reach ``episodes`` targets with every arm.

        Args:
            policy: with metadata.
            episodes: per arm, one after the other; each begins anew.
            record: keep the true positions, for replays.

        Raises:
            InputError: the policy does not fit the robot.
        """
        runner = self.runner(policy)
        order = joint_order(policy.meta.joint_names, self.fleet.body.joint_names)
        back = np.argsort(order)
        distances, targets, positions = [], [], []
        for _ in range(episodes):
            readings = self.reset()
            runner.reset()
            targets.append(self.target)
            row, states = [], []
            for _ in range(EPISODE_STEPS):
                command = runner.act(readings.joint_pos[:, order], readings.joint_vel[:, order], self.target)
                readings, distance = self.step(command[:, back])
                row.append(distance)
                if record:
                    states.append(self.fleet.qpos)
            distances.append(np.stack(row, axis=1))
            if record:
                positions.append(np.stack(states, axis=1))
        return ReachEpisodes(
            np.tile(np.array(self.fleet.serials, np.int64), episodes),
            np.concatenate(targets),
            np.concatenate(distances),
            np.concatenate(positions) if record else None,
        )
