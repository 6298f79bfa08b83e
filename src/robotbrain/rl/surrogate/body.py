"""The robot under a surrogate: its compiled model, which parameters go where in it, and forward kinematics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from robotbrain.errors import InputError
from robotbrain.rl.surrogate.parameters import Array, Robot, SurrogateParams

PAYLOAD_BODY: dict[Robot, str] = {"arm": "hand", "quadruped": "base"}
PAYLOAD_RADIUS = 0.03
"""A payload is a ball of this radius of gyration (m)."""


@dataclass(frozen=True, eq=False)
class Body:
    """A position-controlled robot's model and the addresses of its joints in it.

    Args:
        model: one position servo per hinge, in the order of the joints.
        joint_names: of the hinges.
        qpos, dof: addresses of each hinge, (J,).
        links: body that each hinge moves, (J,).
        payload: body that carries the payload.
        default_joint_pos: (rad), (J,).
        limits: (rad), (J, 2).
        torque: limit of each servo (N m), (J,).
    """

    model: mujoco.MjModel
    joint_names: tuple[str, ...]
    qpos: NDArray[np.int64]
    dof: NDArray[np.int64]
    links: NDArray[np.int64]
    payload: int
    default_joint_pos: Array
    limits: Array
    torque: Array

    @property
    def floating(self) -> bool:
        """Whether the robot's base is free."""
        return bool(self.model.nq > len(self.joint_names))


@cache
def load_body(robot: Robot) -> Body:
    """Return the kit's arm or quadruped.

    Raises:
        InputError: there is no such robot.
    """
    from robotbrain.rl.robots import arm_mjcf, quadruped_mjcf

    makers = {"arm": arm_mjcf, "quadruped": quadruped_mjcf}
    if robot not in makers:
        raise InputError("surrogate robot", given=robot, expected="one of " + ", ".join(makers), fix="Try 'arm'.")
    return read_body(mujoco.MjModel.from_xml_string(makers[robot]()), PAYLOAD_BODY[robot])


def read_body(model: mujoco.MjModel, payload: str) -> Body:
    """Return a robot of your own.

    Args:
        model: with one position servo per hinge.
        payload: name of the body that carries a payload.

    Raises:
        InputError: the model has no servos, one that drives no hinge, or no such body.
    """
    if payload not in [model.body(i).name for i in range(model.nbody)]:
        raise InputError("payload body", given=payload, expected="a body of the model", fix="Name the hand's body.")
    hinge = int(mujoco.mjtJoint.mjJNT_HINGE)
    driven = [int(model.actuator(i).trnid[0]) for i in range(model.nu)]
    if not driven or any(j < 0 or int(model.jnt_type[j]) != hinge or not model.jnt_limited[j] for j in driven):
        raise InputError(
            "robot model",
            given=f"{model.nu} actuators",
            expected="a position servo for each hinge, hinges with limits",
            fix="Leave grippers and wheels out.",
        )
    qpos = np.array([model.jnt_qposadr[j] for j in driven], dtype=np.int64)
    return Body(
        model=model,
        joint_names=tuple(model.joint(j).name for j in driven),
        qpos=qpos,
        dof=np.array([model.jnt_dofadr[j] for j in driven], dtype=np.int64),
        links=np.array([model.jnt_bodyid[j] for j in driven], dtype=np.int64),
        payload=int(model.body(payload).id),
        default_joint_pos=model.qpos0[qpos].copy(),
        limits=model.jnt_range[driven].copy(),
        torque=model.actuator_forcerange[:, 1].copy(),
    )


def apply_parameters(batch: Batch, body: Body, params: Sequence[SurrogateParams]) -> None:
    """Give each simulation of ``batch`` one surrogate's friction, masses and motors.

    Weight compensation (MuJoCo's ``gravcomp``, as a real arm's controller has it) keeps compensating the nominal
    weights: what was added is what it does not know.
    """
    model, joints = body.model, np.arange(len(body.joint_names))

    def stack(name: str) -> Array:
        return np.stack([np.asarray(getattr(p, name), float) for p in params])

    batch.expand("dof_frictionloss")[:, body.dof] += stack("dry_friction") * body.torque
    batch.expand("dof_damping")[:, body.dof] *= stack("viscous_friction")
    strength = stack("motor_strength")
    batch.expand("actuator_gainprm")[:, joints, 0] *= strength
    batch.expand("actuator_biasprm")[:, joints, 1:3] *= strength[:, :, None]
    batch.expand("actuator_forcerange")[:, joints] *= strength[:, :, None]
    mass, inertia, centre = (batch.expand(f"body_{name}") for name in ("mass", "inertia", "ipos"))
    mass[:, body.links] *= stack("link_mass")
    inertia[:, body.links] *= stack("link_mass")[:, :, None]
    centre[:, body.links] += stack("com_shift")
    _add_payload(mass, inertia, centre, body, stack("payload"), stack("payload_offset"))
    nominal = model.body_mass
    known = np.divide(nominal, mass, out=np.ones_like(mass), where=mass > 0.0)
    batch.expand("body_gravcomp")[:] *= known
    batch.set_const()


def _add_payload(mass: Array, inertia: Array, centre: Array, body: Body, payload: Array, offset: Array) -> None:
    """Merge a ball with the payload's body, parallel axes included; products of inertia are neglected."""
    i = body.payload
    before, at = mass[:, i].copy(), centre[:, i].copy()
    total = before + payload
    middle = (before[:, None] * at + payload[:, None] * offset) / total[:, None]

    def about_middle(m: Array, p: Array) -> Array:
        d = p - middle
        return np.asarray(m[:, None] * ((d * d).sum(1, keepdims=True) - d * d))

    ball = 0.4 * payload[:, None] * PAYLOAD_RADIUS**2
    inertia[:, i] += ball + about_middle(before, at) + about_middle(payload, offset)
    mass[:, i], centre[:, i] = total, middle


class Kinematics:
    """Where a site of a fixed-base robot is for given joint angles: pure NumPy, for the robot's own computer.

    Args:
        body: the robot.
        site: its name.
    """

    def __init__(self, body: Body, site: str = "ee") -> None:
        model = body.model
        joint_of = {int(link): j for j, link in enumerate(body.links)}
        axes = model.jnt_axis[[model.joint(name).id for name in body.joint_names]]
        self._zero = model.qpos0[body.qpos]
        self._tip = model.site(site).pos.copy()
        joints, offsets, turns = [], [], []  # of each link, from the tip to the base
        at = int(model.site(site).bodyid[0])
        while at:
            fixed, j = _rotation(model.body_quat[at]), joint_of.get(at)
            cross = _cross(axes[j]) if j is not None else np.zeros((3, 3))
            joints.append(j or 0)  # a link without a joint is turned by no angle: its cross product is 0
            offsets.append(model.body_pos[at].copy())
            turns.append([fixed.ravel(), (fixed @ cross).ravel(), (fixed @ cross @ cross).ravel()])
            at = int(model.body_parentid[at])
        self._joints, self._offsets, self._turns = joints, offsets, np.array(turns)

    def __call__(self, joint_pos: Array) -> Array:
        """Return the site's place in the base frame (m), (n, 3), for joint angles (rad), (n, J)."""
        angle = (joint_pos - self._zero).T[self._joints]
        # Each link's turn by q about its axis: R (I + sin q K + (1 - cos q) K^2) (Rodrigues), for all links at once.
        share = np.stack([np.ones_like(angle), np.sin(angle), 1.0 - np.cos(angle)], axis=-1)
        turns = (share @ self._turns).reshape(*angle.shape, 3, 3)
        place = np.broadcast_to(self._tip[:, None], (angle.shape[1], 3, 1))
        for offset, turn in zip(self._offsets, turns, strict=True):
            place = turn @ place + offset[:, None]
        return np.asarray(place[..., 0])


def _rotation(quaternion_wxyz: Array) -> Array:
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quaternion_wxyz)
    return matrix.reshape(3, 3)


def _cross(axis: Array) -> Array:
    """The matrix of the cross product with ``axis``."""
    x, y, z = axis
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
