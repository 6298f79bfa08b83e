"""Physical properties of an articulation that may differ between environments: masses, gains, friction and others.

The methods have Isaac Lab's names and arguments, so that an event written for one runs on the other. Values are float32
(num_envs or n, bodies or joints, ...). A property that was never written is read from the model and costs nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from robotbrain.errors import InputError
from robotbrain.rl.scene.articulation_data import ArticulationData
from robotbrain.rl.scene.layout import ArticulationLayout
from robotbrain.rl.scene.world import EnvIds, TensorView, World

Tensor = torch.Tensor
Ids = slice | torch.Tensor | Sequence[int] | None


class PropertyView:
    """A property; ``.torch`` is a fresh copy of its present values."""

    __slots__ = ("_read",)

    def __init__(self, read: Callable[[], Tensor]) -> None:
        self._read = read

    @property
    def torch(self) -> Tensor:
        """The present values."""
        return self._read()

    def columns(self, ids: slice | Tensor) -> Tensor:
        """``torch[:, ids]``."""
        return self._read()[:, ids]


class ArticulationProperties:
    """Reads and writes the properties; a base of :class:`robotbrain.rl.scene.Articulation`.

    Needs ``_world``, ``layout`` and ``data``, on which :meth:`_init_properties` puts the views
    ``body_mass`` [kg], ``body_inertia`` (num_envs, B, 9) [kg m^2] and ``body_com_pose_b`` (num_envs, B, 7) in the
    body's frame, ``joint_stiffness`` [N m/rad], ``joint_damping`` [N m s/rad] and ``joint_effort_limits`` [N m] of the
    servos, ``joint_armature`` [kg m^2], ``joint_friction_coeff`` [N m] (MuJoCo's dry friction, a torque) and
    ``joint_viscous_friction_coeff`` [N m s/rad].
    """

    _world: World
    layout: ArticulationLayout
    data: ArticulationData

    def _init_properties(self) -> None:
        layout, model = self.layout, self._world.model
        self._bodies = torch.from_numpy(layout.body_ids)
        self._dofs = torch.from_numpy(layout.joint_dof.astype(np.int64))
        self._jnts = torch.from_numpy(layout.joint_ids.astype(np.int64))
        self._servo_of = torch.full((layout.num_joints,), -1, dtype=torch.long)
        for joints, actuators in (layout.effort_ctrl, layout.velocity_ctrl, layout.position_ctrl):
            self._servo_of[torch.from_numpy(joints)] = torch.from_numpy(actuators)
        self._is_position = torch.zeros(model.nu, dtype=torch.bool)
        self._is_position[torch.from_numpy(layout.position_ctrl[1])] = True
        data = self.data
        data.body_mass = PropertyView(lambda: self._read("body_mass")[:, self._bodies])
        data.body_inertia = PropertyView(self._inertia)
        data.body_com_pose_b = PropertyView(self._com)
        data.joint_stiffness = PropertyView(lambda: self._servo(-self._read("actuator_biasprm")[..., 1]))
        data.joint_damping = PropertyView(lambda: self._servo(-self._read("actuator_biasprm")[..., 2]))
        data.joint_effort_limits = PropertyView(lambda: self._servo(self._force_limits(), without=torch.inf))
        data.joint_armature = PropertyView(lambda: self._read("dof_armature")[:, self._dofs])
        data.default_joint_armature = PropertyView(
            lambda: self._default("dof_armature")[self._dofs].expand(self._world.num_envs, -1)
        )
        data.joint_friction_coeff = PropertyView(lambda: self._read("dof_frictionloss")[:, self._dofs])
        data.joint_viscous_friction_coeff = PropertyView(lambda: self._read("dof_damping")[:, self._dofs])
        unlimited = torch.full((self._world.num_envs, layout.num_joints), torch.inf)
        data.joint_vel_limits = data.soft_joint_vel_limits = TensorView(unlimited)  # MuJoCo has none
        data.body_pose_w = PropertyView(lambda: torch.cat((data.body_pos_w.torch, data.body_quat_w.torch), -1))
        data.GRAVITY_VEC_W = PropertyView(lambda: self._read("opt.gravity"))

    # -- bodies

    def set_masses_index(self, *, masses: Tensor, body_ids: Ids = None, env_ids: EnvIds = None) -> None:
        """Set masses, (n, bodies) [kg]; inertias stay."""
        self._write("body_mass", self._bodies, masses, body_ids, env_ids, derived=True)

    def set_inertias_index(self, *, inertias: Tensor, body_ids: Ids = None, env_ids: EnvIds = None) -> None:
        """Set inertia matrices about the centres of mass in the bodies' frames, (n, bodies, 9) [kg m^2].

        Raises:
            InputError: the principal axes differ from those of the model (MuJoCo keeps these fixed).
        """
        axes = _rotation(self._read("body_iquat")[:, self._bodies])[self._rows(env_ids)][:, self._every(body_ids)]
        principal = axes.transpose(-1, -2) @ inertias.reshape(*inertias.shape[:2], 3, 3) @ axes
        diagonal = principal.diagonal(dim1=-2, dim2=-1)
        if (principal - torch.diag_embed(diagonal)).abs().max() > 1e-4 * float(diagonal.abs().max()):
            raise InputError(
                "inertias",
                given="a matrix with other principal axes",
                expected="the model's principal axes (scale or stretch along them)",
                fix="Scale the inertia instead of adding to some of its elements.",
            )
        self._write("body_inertia", self._bodies, diagonal, body_ids, env_ids, derived=True)

    def set_coms_index(self, *, coms: Tensor, body_ids: Ids = None, env_ids: EnvIds = None) -> None:
        """Set centres of mass in the bodies' frames, (n, bodies, 3 or 7) [m]; orientations are left as they are.

        Raises:
            InputError: a body that MuJoCo compiled as one whose centre of mass stays at its frame's origin.
        """
        bodies, model = self._bodies[self._every(body_ids)], self._world.model
        simple = [model.body(b).name for b in bodies.tolist() if int(model.body_simple[b])]
        if simple:
            raise InputError(
                "centre of mass",
                given=simple,
                expected="bodies that MuJoCo did not compile as simple",
                fix="Write <body simple='false' ...> in their MJCF.",
            )
        self._write("body_ipos", self._bodies, coms[..., :3], body_ids, env_ids, derived=True)

    # -- joints and their servos

    def write_joint_stiffness_to_sim_index(
        self, *, stiffness: Tensor, joint_ids: Ids = None, env_ids: EnvIds = None
    ) -> None:
        """Set the servos' stiffness, (n, joints) [N m/rad].

        Raises:
            InputError: a joint without a position servo.
        """
        servos = self._servos(joint_ids, position=True)
        rows = torch.from_numpy(self._rows(env_ids)).unsqueeze(1)
        self._param("actuator_gainprm")[rows, servos, 0] = stiffness.double()
        self._param("actuator_biasprm")[rows, servos, 1] = -stiffness.double()

    def write_joint_damping_to_sim_index(
        self, *, damping: Tensor, joint_ids: Ids = None, env_ids: EnvIds = None
    ) -> None:
        """Set the servos' damping, (n, joints) [N m s/rad]; a velocity servo's gain.

        Raises:
            InputError: a joint without a servo.
        """
        servos = self._servos(joint_ids)
        rows = torch.from_numpy(self._rows(env_ids)).unsqueeze(1)
        self._param("actuator_biasprm")[rows, servos, 2] = -damping.double()
        velocity = ~self._is_position[servos]
        if velocity.any():
            self._param("actuator_gainprm")[rows, servos[velocity], 0] = damping[:, velocity].double()

    def write_joint_effort_limit_to_sim_index(
        self, *, limits: Tensor, joint_ids: Ids = None, env_ids: EnvIds = None
    ) -> None:
        """Set the servos' largest torque or force either way, (n, joints) [N m or N].

        Raises:
            InputError: a joint without an actuator.
        """
        servos = self._servos(joint_ids, servo=False)
        rows = torch.from_numpy(self._rows(env_ids)).unsqueeze(1)
        limited = torch.isfinite(limits)
        finite = torch.where(limited, limits, 0.0)
        self._param("actuator_forcelimited")[rows, servos] = limited
        self._param("actuator_forcerange")[rows, servos] = torch.stack((-finite, finite), -1).double()

    def write_joint_armature_to_sim_index(
        self, *, armature: Tensor, joint_ids: Ids = None, env_ids: EnvIds = None
    ) -> None:
        """Set the rotors' inertia at the joints, (n, joints) [kg m^2]."""
        self._write("dof_armature", self._dofs, armature, joint_ids, env_ids, derived=True)

    def write_joint_armature_to_sim(self, armature: Tensor, joint_ids: Ids = None, env_ids: EnvIds = None) -> None:
        """As :meth:`write_joint_armature_to_sim_index`."""
        self.write_joint_armature_to_sim_index(armature=armature, joint_ids=joint_ids, env_ids=env_ids)

    def write_joint_friction_coefficient_to_sim_index(
        self,
        *,
        joint_friction_coeff: Tensor,
        joint_dynamic_friction_coeff: Tensor | None = None,
        joint_viscous_friction_coeff: Tensor | None = None,
        joint_ids: Ids = None,
        env_ids: EnvIds = None,
    ) -> None:
        """Set the joints' dry friction [N m] and viscous friction [N m s/rad], (n, joints).

        MuJoCo's dry friction has one value: the dynamic one is not used.
        """
        self._write("dof_frictionloss", self._dofs, joint_friction_coeff, joint_ids, env_ids)
        if joint_viscous_friction_coeff is not None:
            self._write("dof_damping", self._dofs, joint_viscous_friction_coeff, joint_ids, env_ids)

    def write_joint_position_limit_to_sim_index(
        self, *, limits: Tensor, joint_ids: Ids = None, env_ids: EnvIds = None, warn_limit_violation: bool = True
    ) -> None:
        """Set the joints' limits, (n, joints, 2) [rad or m], in the simulation and in ``data.joint_pos_limits``."""
        self._write("jnt_range", self._jnts, limits, joint_ids, env_ids)
        rows = torch.from_numpy(self._rows(env_ids)).unsqueeze(1)
        self.data.joint_pos_limits.torch[rows, torch.arange(self.layout.num_joints)[self._every(joint_ids)]] = limits

    # -- inside

    def _rows(self, env_ids: EnvIds) -> Any:
        return self._world.ids(env_ids)

    def _param(self, name: str) -> Tensor:
        return torch.from_numpy(self._world.expand(name))

    def _default(self, name: str) -> Tensor:
        source: Any = self._world.model
        for part in name.split("."):
            source = getattr(source, part)
        return torch.from_numpy(np.array(source)).float()

    def _read(self, name: str) -> Tensor:
        found = self._world.batch.expanded(name)
        if found is None:
            default = self._default(name)
            return default.expand(self._world.num_envs, *default.shape).clone()
        return torch.from_numpy(found.astype(np.float32))

    def _write(
        self, name: str, address: Tensor, values: Tensor, ids: Ids, env_ids: EnvIds, derived: bool = False
    ) -> None:
        rows = self._rows(env_ids)
        self._param(name)[torch.from_numpy(rows).unsqueeze(1), address[self._every(ids)]] = values.double()
        if derived:
            self._world.mark_const_dirty(rows)
        else:
            self._world.mark_written(rows)

    @staticmethod
    def _every(ids: Ids) -> Any:
        if ids is None:
            return slice(None)
        return ids if isinstance(ids, slice) else torch.as_tensor(ids, dtype=torch.long)

    def _servos(self, joint_ids: Ids, position: bool = False, servo: bool = True) -> Tensor:
        joints = torch.arange(self.layout.num_joints)[self._every(joint_ids)]
        servos = self._servo_of[joints]
        wrong = servos < 0
        if servo:
            motors = torch.isin(servos, torch.from_numpy(self.layout.effort_ctrl[1]))
            wrong |= motors | (position & ~self._is_position[servos.clamp(min=0)])
        if wrong.any():
            raise InputError(
                "joint_ids",
                given=[self.layout.joint_names[i] for i in joints[wrong].tolist()],
                expected=f"joints with a {'position servo' if position else 'servo' if servo else 'actuator'}",
                fix="Choose joints with joint_names=...",
            )
        return servos

    def _servo(self, values: Tensor, without: float = 0.0) -> Tensor:
        """Values by actuator, as values by joint."""
        found = values[:, self._servo_of.clamp(min=0)] if values.shape[1] else values.new_zeros(len(values), 0)
        if not values.shape[1]:
            return values.new_full((len(values), self.layout.num_joints), without)
        return torch.where(self._servo_of >= 0, found, without)

    def _force_limits(self) -> Tensor:
        upper = self._read("actuator_forcerange")[..., 1]
        return torch.where(self._read("actuator_forcelimited") > 0, upper, torch.inf)

    def _computed_effort(self) -> Tensor:
        """What is applied, plus what the force limits cut off in the present state."""
        data, low, high = self.data, *self._read("actuator_ctrlrange").unbind(-1)
        limited = self._read("actuator_ctrllimited") > 0
        ctrl = torch.from_numpy(self._world.ctrl).float()
        ctrl = self._servo(torch.where(limited, ctrl.clamp(low, high), ctrl))
        bias = self._read("actuator_biasprm")
        effort = self._servo(self._read("actuator_gainprm")[..., 0]) * ctrl
        effort += self._servo(bias[..., 1]) * data.joint_pos.torch + self._servo(bias[..., 2]) * data.joint_vel.torch
        limit = data.joint_effort_limits.torch
        return data.applied_torque.torch + (effort - effort.clamp(-limit, limit))

    def _inertia(self) -> Tensor:
        axes = _rotation(self._read("body_iquat")[:, self._bodies])
        diagonal = torch.diag_embed(self._read("body_inertia")[:, self._bodies])
        return (axes @ diagonal @ axes.transpose(-1, -2)).flatten(-2)

    def _com(self) -> Tensor:
        quat = self._read("body_iquat")[:, self._bodies]
        return torch.cat((self._read("body_ipos")[:, self._bodies], quat[..., [1, 2, 3, 0]]), -1)


def _rotation(quat_wxyz: Tensor) -> Tensor:
    """Rotation matrices of unit quaternions, (..., 4) to (..., 3, 3)."""
    w, x, y, z = quat_wxyz.unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, -1) for row in rows], -2)
