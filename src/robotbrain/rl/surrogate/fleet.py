"""Surrogate robots in physics: commands in, readings out, and the truth for the judge alone.

A fleet steps many surrogates at once, each with parameters and noise of its own; what one does never depends on who
else is in the fleet, nor on the number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import ArrayLike, NDArray

from robotbrain.errors import InputError
from robotbrain.rl.surrogate.body import apply_parameters, load_body
from robotbrain.rl.surrogate.drive import DelayLine, Drive
from robotbrain.rl.surrogate.parameters import Array, Robot, SurrogateParams, draw
from robotbrain.sim.checks import check_seed

_NOISE_BLOCK = 64
_POSITION = int(mujoco.mjtStage.mjSTAGE_POS)
_CONTROL = int(mujoco.mjtState.mjSTATE_CTRL)


@dataclass(frozen=True, eq=False)
class Readings:
    """What the robots' encoders say.

    Args:
        joint_pos: on the motor's side of the play, with bias and noise (rad), (n, J).
        joint_vel: (rad/s), (n, J).
        fresh: whether a new reading arrived, (n,); where not, values are those of the last that did.
    """

    joint_pos: Array
    joint_vel: Array
    fresh: NDArray[np.bool_]


class SurrogateFleet:
    """Surrogates stepping together.

    Args:
        serials: their serial numbers.
        robot: ``"arm"`` or ``"quadruped"``.
        params: parameters instead of those that follow from the serials, one for each.
        seed: of the sensor noise; with a robot's serial it decides its noise.
        num_threads: of the physics; results do not depend on it.

    Attributes:
        serials: as given.
        body: the robot's model and joints.
        step_s: physics step (s).
        params: of each surrogate. For judges and plots; a student's program does not look.
        elapsed_steps: physics steps since the start.

    Raises:
        InputError: no serials, a serial that is no integer >= 0, or parameters that do not match.
    """

    def __init__(
        self,
        serials: Sequence[int],
        robot: Robot = "arm",
        *,
        params: Sequence[SurrogateParams] | None = None,
        seed: int = 0,
        num_threads: int = 1,
    ) -> None:
        self.serials = tuple(check_seed("surrogate serial", s) for s in serials)
        if not self.serials:
            raise InputError("surrogate serials", given=(), expected="at least one", fix="Try serials=range(10).")
        self.body = load_body(robot)
        joints = len(self.body.joint_names)
        self.params = tuple(params) if params is not None else tuple(draw(s, robot, joints) for s in self.serials)
        if len(self.params) != len(self.serials) or any(len(p.play) != joints for p in self.params):
            raise InputError(
                "surrogate params",
                given=f"{len(self.params)} for {len(self.serials)} serials",
                expected=f"one for each serial, with {joints} joints",
                fix="Leave params out to draw them by serial.",
            )
        self.step_s = float(self.body.model.opt.timestep)
        self.elapsed_steps = 0
        n = len(self.serials)
        self._batch = Batch(self.body.model, n, num_threads)
        apply_parameters(self._batch, self.body, self.params)
        self._sites = self._batch.bind("site_xpos")
        self._drive = Drive(
            self.step_s, self._steps("command_delay_s"), self._each("motor_lag_s"), self._each("play") / 2
        )
        self._past = DelayLine(self._steps("measurement_delay_s"), 2 * joints)
        self._bias, self._dropped = self._each("encoder_bias"), self._each("frame_drop")
        sequence = [np.random.SeedSequence([0x5E2507, check_seed("seed", seed), s]) for s in self.serials]
        self._rngs = [np.random.default_rng(s) for s in sequence]
        self._noise: tuple[Array, Array] = (np.zeros((0, n, 2 * joints)), np.zeros((0, n)))
        self._delayed = np.zeros((n, 2 * joints))
        self._reading = np.zeros((n, 2 * joints))
        self.reset()

    def __len__(self) -> int:
        return len(self.serials)

    def _each(self, name: str) -> Array:
        return np.stack([np.asarray(getattr(p, name), float) for p in self.params])

    def _steps(self, name: str) -> NDArray[np.int64]:
        return np.rint(self._each(name) / self.step_s).astype(np.int64)

    def reset(self, ids: ArrayLike | None = None, joint_pos: ArrayLike | None = None) -> None:
        """Put robots at rest.

        Args:
            ids: which, integers; all by default.
            joint_pos: (rad), (len(ids), J); the default pose by default.
        """
        rows = np.arange(len(self)) if ids is None else np.asarray(ids, np.int64).ravel()
        joints = len(self.body.joint_names)
        start = np.broadcast_to(
            self.body.default_joint_pos if joint_pos is None else np.asarray(joint_pos, float), (len(rows), joints)
        )
        if not np.isfinite(start).all():
            raise InputError("joint_pos", given=joint_pos, expected="finite angles (rad)", fix="Check for NaN.")
        self._batch.reset(rows, keyframe=-1, stage=0)
        self._batch.qpos[np.ix_(rows, self.body.qpos)] = start
        self._batch.ctrl[rows] = start
        self._batch.forward(rows, stage=_POSITION)
        self._drive.settle(rows, start)
        at_rest = np.concatenate([start, np.zeros_like(start)], axis=1)
        self._past.fill(rows, at_rest)
        self._delayed[rows] = at_rest
        # The first reading after a reset always arrives: nobody starts a robot that says nothing.
        self._reading[rows] = at_rest + np.concatenate([self._bias[rows], np.zeros_like(start)], axis=1)

    def advance(self, target: ArrayLike, steps: int, ramp_steps: int = 0) -> None:
        """Command joint angles and let ``steps`` physics steps pass.

        Args:
            target: (rad), (n, J); clipped to the joint limits.
            steps: >= 1.
            ramp_steps: physics steps in which the robot's trajectory controller goes there in a straight line.

        Raises:
            InputError: a target that is not finite or has the wrong shape.
        """
        wanted = np.asarray(target, float)
        if wanted.shape != self._drive.motor.shape or not np.isfinite(wanted).all():
            raise InputError(
                "joint targets",
                given=wanted.shape if wanted.shape != self._drive.motor.shape else "NaN or infinity",
                expected=f"finite angles (rad) of shape {self._drive.motor.shape}",
                fix="Check the policy's output.",
            )
        low, high = self.body.limits.T
        points = self._drive.run(np.clip(wanted, low, high), steps, ramp_steps)
        record = self._batch.rollout(steps, points, control_spec=_CONTROL, record=("qpos", "qvel"))
        self._batch.forward(stage=_POSITION)
        states = np.concatenate([record["qpos"][..., self.body.qpos], record["qvel"][..., self.body.dof]], axis=2)
        self._delayed = self._past.push(states)[:, -1].copy()
        self.elapsed_steps += steps

    def read(self) -> Readings:
        """Return the encoders' next reading; every call is a new frame with new noise."""
        if not len(self._noise[1]):
            self._draw_noise()
        noise, uniform = self._noise[0][0], self._noise[1][0]
        self._noise = (self._noise[0][1:], self._noise[1][1:])
        joints = len(self.body.joint_names)
        fresh = uniform >= self._dropped
        reading = self._delayed + noise
        # Encoders sit on the motors: what the gears' play hides from the link shows here.
        reading[:, :joints] += self._drive.motor - self._drive.link + self._bias
        self._reading[fresh] = reading[fresh]
        return Readings(self._reading[:, :joints].copy(), self._reading[:, joints:].copy(), fresh)

    def _draw_noise(self) -> None:
        joints = len(self.body.joint_names)
        normal = np.stack([r.standard_normal((_NOISE_BLOCK, 2 * joints)) for r in self._rngs], axis=1)
        normal[..., :joints] *= self._each("encoder_noise")[:, None]
        normal[..., joints:] *= self._each("velocity_noise")[:, None]
        self._noise = (normal, np.stack([r.random(_NOISE_BLOCK) for r in self._rngs], axis=1))

    # ------------------------------------------------------------ the judge's view

    @property
    def qpos(self) -> Array:
        """True generalised positions, (n, nq); for the judge and for replays."""
        return np.array(self._batch.qpos)

    @property
    def joint_pos(self) -> Array:
        """True joint angles on the link's side (rad), (n, J); for the judge."""
        return np.array(self._batch.qpos[:, self.body.qpos])

    @property
    def base_state(self) -> tuple[Array, Array, Array]:
        """Velocity (m/s), turning rate (rad/s) and direction of gravity in a floating base's own frame, (n, 3) each.

        The truth, for the judge; a robot gets it with noise from its state estimator.

        Raises:
            InputError: the robot stands on a fixed base.
        """
        if not self.body.floating:
            raise InputError("base_state", given="a fixed base", expected="a floating base", fix="Use the quadruped.")
        turn = np.zeros((len(self), 3, 3))
        for row, quaternion in enumerate(np.asarray(self._batch.qpos[:, 3:7])):
            matrix = np.zeros(9)
            mujoco.mju_quat2Mat(matrix, quaternion)
            turn[row] = matrix.reshape(3, 3)
        velocity = np.array(self._batch.qvel[:, :6])
        # MuJoCo has a free joint's linear velocity in the world frame and its angular velocity in the body's.
        return np.einsum("nji,nj->ni", turn, velocity[:, :3]), velocity[:, 3:], -turn[:, 2]

    def site_pos(self, site: str = "ee") -> Array:
        """True place of a site in the world frame (m), (n, 3); for the judge."""
        return np.array(self._sites[:, self.body.model.site(site).id])


class Surrogate(SurrogateFleet):
    """One surrogate: a fleet of one, by its serial number.

    Args:
        serial: its number, an integer >= 0.
        robot: ``"arm"`` or ``"quadruped"``.
        seed: of the sensor noise.
    """

    def __init__(self, serial: int, robot: Robot = "arm", *, seed: int = 0) -> None:
        super().__init__([serial], robot, seed=seed)
