"""A robot of the scene: its data, its names, and writing to its state, its targets and its model parameters."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from robotbrain.errors import InputError
from robotbrain.rl.configclass import did_you_mean
from robotbrain.rl.scene.articulation_data import ArticulationData
from robotbrain.rl.scene.layout import find_layout
from robotbrain.rl.scene.names import find_names
from robotbrain.rl.scene.properties import ArticulationProperties, PropertyView
from robotbrain.rl.scene.scene_cfg import ArticulationCfg
from robotbrain.rl.scene.world import EnvIds, TensorView, World
from robotbrain.rl.scene.wrench import WrenchComposer

_WXYZ = [3, 0, 1, 2]
_YZX, _ZXY = [1, 2, 0], [2, 0, 1]
_POSE_FROM_XYZW = [0, 1, 2, 6, 3, 4, 5]
_KEPT = (
    "joint_pos_limits",
    "joint_pos_target",
    "joint_vel_target",
    "joint_effort_target",
    "default_joint_pos",
    "default_joint_vel",
    "default_root_pose",
    "default_root_vel",
)
JointIds = slice | torch.Tensor | Sequence[int] | None


class Actuators:
    """What the articulation's actuators do.

    Attributes:
        applied_effort: torque or force of all actuators at each joint, (num_envs, joints) [N m or N].
        computed_effort: what they would apply without their limits, (num_envs, joints) [N m or N].
    """

    def __init__(self, applied_effort: TensorView, computed_effort: PropertyView) -> None:
        self.applied_effort, self.computed_effort = applied_effort, computed_effort


class Articulation(ArticulationProperties):
    """One robot in every environment.

    Args:
        cfg: its configuration.
        world: the simulations.

    Attributes:
        data: its state as tensors, :class:`ArticulationData`.
        actuators: see :class:`Actuators`.
        permanent_wrench_composer: external forces, see :class:`WrenchComposer`.
    """

    def __init__(self, cfg: ArticulationCfg, world: World) -> None:
        self.cfg, self._world = cfg, world
        self.layout = find_layout(world.model, cfg)
        self.data = ArticulationData(world, self.layout, cfg.soft_joint_pos_limit_factor)
        self._init_properties()
        self.actuators = Actuators(self.data.applied_torque, PropertyView(self._computed_effort))
        self.permanent_wrench_composer = WrenchComposer(world, self._bodies)
        self._ctrl = torch.from_numpy(world.ctrl)
        self._joint_qpos = torch.from_numpy(self.layout.joint_qpos)
        self._joint_dof = torch.from_numpy(self.layout.joint_dof)
        layout = self.layout
        self._actuators = np.concatenate(
            [c[1] for c in (layout.position_ctrl, layout.velocity_ctrl, layout.effort_ctrl)]
        )
        self._targets = {
            "position": (self.data.joint_pos_target.torch, *self._channel(self.layout.position_ctrl)),
            "velocity": (self.data.joint_vel_target.torch, *self._channel(self.layout.velocity_ctrl)),
            "effort": (self.data.joint_effort_target.torch, *self._channel(self.layout.effort_ctrl)),
        }

    @property
    def num_instances(self) -> int:
        """Number of environments."""
        return self._world.num_envs

    @property
    def device(self) -> torch.device:
        """The CPU."""
        return torch.device("cpu")

    @property
    def joint_names(self) -> list[str]:
        """Names of the hinges and slides, in the order of the data."""
        return self.layout.joint_names

    @property
    def body_names(self) -> list[str]:
        """Names of the bodies, the root first."""
        return self.layout.body_names

    @property
    def num_joints(self) -> int:
        """Number of hinges and slides."""
        return self.layout.num_joints

    @property
    def num_bodies(self) -> int:
        """Number of bodies."""
        return len(self.layout.body_names)

    @property
    def is_fixed_base(self) -> bool:
        """Whether the root cannot move."""
        return self.layout.free_qpos is None

    @property
    def body_ids_in_model(self) -> list[int]:
        """MuJoCo's ids of the bodies, in the order of ``body_names`` (for model parameters)."""
        return [int(body) for body in self.layout.body_ids]

    def find_joints(self, name_keys: str | Sequence[str], preserve_order: bool = False) -> tuple[list[int], list[str]]:
        """Indices and names of the joints whose whole name matches (regular expressions).

        Raises:
            InputError: a pattern matches nothing.
        """
        return find_names(name_keys, self.joint_names, what="joint", preserve_order=preserve_order)

    def find_bodies(self, name_keys: str | Sequence[str], preserve_order: bool = False) -> tuple[list[int], list[str]]:
        """Indices and names of the bodies whose whole name matches (regular expressions).

        Raises:
            InputError: a pattern matches nothing.
        """
        return find_names(name_keys, self.body_names, what="body", preserve_order=preserve_order)

    # -- state

    def write_root_pose_to_sim_index(self, *, root_pose: torch.Tensor, env_ids: EnvIds = None) -> None:
        """Set the root's pose in the world, (n, 7): position [m], quaternion xyzw.

        Raises:
            InputError: the root is fixed.
        """
        ids = self._rows(env_ids)
        at = self._free_address("qpos")
        pose = root_pose.to(torch.float64)
        self._world.qpos[ids, at : at + 3] = pose[:, :3].numpy()
        quat = pose[:, 3:] / pose[:, 3:].norm(dim=1, keepdim=True)
        self._world.qpos[ids, at + 3 : at + 7] = quat.numpy()[:, _WXYZ]
        self._world.mark_written(ids)

    def write_root_velocity_to_sim_index(self, *, root_velocity: torch.Tensor, env_ids: EnvIds = None) -> None:
        """Set the root's linear and angular velocity in the world, (n, 6) [m/s, rad/s].

        Raises:
            InputError: the root is fixed.
        """
        ids = self._rows(env_ids)
        at, q = self._free_address("qvel"), self._free_address("qpos")
        velocity = root_velocity.to(torch.float64).numpy()
        quat = self._world.qpos[ids, q + 3 : q + 7]
        self._world.qvel[ids, at : at + 3] = velocity[:, :3]
        self._world.qvel[ids, at + 3 : at + 6] = _to_body(quat, velocity[:, 3:])
        self._world.mark_written(ids)

    def write_joint_state_to_sim(
        self, pos: torch.Tensor, vel: torch.Tensor, joint_ids: JointIds = None, env_ids: EnvIds = None
    ) -> None:
        """Set positions and velocities of joints, (n, joints)."""
        self.write_joint_position_to_sim_index(position=pos, joint_ids=joint_ids, env_ids=env_ids)
        self.write_joint_velocity_to_sim_index(velocity=vel, joint_ids=joint_ids, env_ids=env_ids)

    def write_joint_position_to_sim_index(
        self, *, position: torch.Tensor, joint_ids: JointIds = None, env_ids: EnvIds = None
    ) -> None:
        """Set positions of joints, (n, joints) [rad or m]."""
        self._write_joints(self._world.qpos, self._joint_qpos, position, joint_ids, env_ids)

    def write_joint_velocity_to_sim_index(
        self, *, velocity: torch.Tensor, joint_ids: JointIds = None, env_ids: EnvIds = None
    ) -> None:
        """Set velocities of joints, (n, joints) [rad/s or m/s]."""
        self._write_joints(self._world.qvel, self._joint_dof, velocity, joint_ids, env_ids)

    def _write_joints(
        self,
        state: np.ndarray[tuple[int, int], np.dtype[np.float64]],
        address: torch.Tensor,
        values: torch.Tensor,
        joint_ids: JointIds,
        env_ids: EnvIds,
    ) -> None:
        ids = self._rows(env_ids)
        columns = address if joint_ids is None else address[joint_ids]
        state[ids[:, None], columns.numpy()] = values.numpy()
        self._world.mark_written(ids)

    # -- targets of the actuators

    def set_joint_position_target(
        self, target: torch.Tensor, joint_ids: JointIds = None, env_ids: EnvIds = None
    ) -> None:
        """Set the set-points of position actuators, (n, joints) [rad or m]; MuJoCo clips them to their ctrlrange."""
        self._set_target("position", target, joint_ids, env_ids)

    def set_joint_velocity_target(
        self, target: torch.Tensor, joint_ids: JointIds = None, env_ids: EnvIds = None
    ) -> None:
        """Set the set-points of velocity actuators, (n, joints) [rad/s or m/s]."""
        self._set_target("velocity", target, joint_ids, env_ids)

    def set_joint_effort_target(self, target: torch.Tensor, joint_ids: JointIds = None, env_ids: EnvIds = None) -> None:
        """Set the torques or forces of motors, (n, joints) [N m or N]."""
        self._set_target("effort", target, joint_ids, env_ids)

    def set_joint_position_target_index(
        self, *, target: torch.Tensor, joint_ids: JointIds = None, env_ids: EnvIds = None
    ) -> None:
        """As :meth:`set_joint_position_target` (Isaac Lab's name)."""
        self._set_target("position", target, joint_ids, env_ids)

    def set_joint_velocity_target_index(
        self, *, target: torch.Tensor, joint_ids: JointIds = None, env_ids: EnvIds = None
    ) -> None:
        """As :meth:`set_joint_velocity_target` (Isaac Lab's name)."""
        self._set_target("velocity", target, joint_ids, env_ids)

    def set_joint_effort_target_index(
        self, *, target: torch.Tensor, joint_ids: JointIds = None, env_ids: EnvIds = None
    ) -> None:
        """As :meth:`set_joint_effort_target` (Isaac Lab's name)."""
        self._set_target("effort", target, joint_ids, env_ids)

    def _set_target(self, kind: str, target: torch.Tensor, joint_ids: JointIds, env_ids: EnvIds) -> None:
        buffer, joints, ctrl, whole = self._targets[kind]
        every_joint = joint_ids is None or (isinstance(joint_ids, slice) and joint_ids == slice(None))
        if env_ids is None or (isinstance(env_ids, slice) and env_ids == slice(None)):
            if every_joint:
                buffer.copy_(target)
            else:
                buffer[:, joint_ids] = target
            if whole is not None:
                whole.copy_(buffer)
            elif len(joints):
                self._ctrl[:, ctrl] = buffer[:, joints].double()
            return
        rows = torch.from_numpy(self._rows(env_ids)).unsqueeze(1)
        columns = torch.arange(self.num_joints) if joint_ids is None else torch.arange(self.num_joints)[joint_ids]
        buffer[rows, columns] = target
        if len(joints):
            self._ctrl[rows, ctrl] = buffer[rows, joints].double()

    def _channel(self, pairs: tuple[object, object]) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]:
        joints, ctrl = (torch.as_tensor(p) for p in pairs)
        every = torch.arange(self.num_joints)
        whole = None
        if len(ctrl) and torch.equal(joints, every) and torch.equal(ctrl - ctrl[0], every):
            whole = self._ctrl[:, int(ctrl[0]) : int(ctrl[0]) + len(ctrl)]
        return joints, ctrl, whole

    # -- reset

    def reset(self, env_ids: EnvIds = None) -> None:
        """Put the articulation into its default state, with targets that hold it there."""
        ids = self._rows(env_ids)
        data, layout, world = self.data, self.layout, self._world
        rows, joint_pos = ids[:, None], data.default_joint_pos.torch.numpy()[ids]
        world.qpos[rows, layout.joint_qpos] = joint_pos
        world.qvel[rows, layout.joint_dof] = data.default_joint_vel.torch.numpy()[ids]
        data.joint_pos_target.torch.numpy()[ids] = joint_pos
        data.joint_vel_target.torch.numpy()[ids] = 0.0
        data.joint_effort_target.torch.numpy()[ids] = 0.0
        world.ctrl[rows, self._actuators] = 0.0
        joints, servos = layout.position_ctrl
        world.ctrl[rows, servos] = joint_pos[:, joints]
        if layout.free_qpos is not None and layout.free_dof is not None:
            pose, velocity = data.default_root_pose.torch.numpy()[ids], data.default_root_vel.torch.numpy()[ids]
            quat = pose[:, _POSE_FROM_XYZW[3:]].astype(np.float64)
            quat /= np.linalg.norm(quat, axis=1, keepdims=True)
            at, dof = layout.free_qpos, layout.free_dof
            world.qpos[ids, at : at + 3], world.qpos[ids, at + 3 : at + 7] = pose[:, :3], quat
            world.qvel[ids, dof : dof + 3] = velocity[:, :3]
            world.qvel[ids, dof + 3 : dof + 6] = _to_body(quat, velocity[:, 3:]) if velocity.any() else 0.0
        self.permanent_wrench_composer.reset(ids)
        world.mark_written(ids)

    # -- model parameters

    def model_param(self, name: str) -> torch.Tensor:
        """A live (num_envs, ...) tensor of a model field that every environment then has its own values of.

        Indices are MuJoCo's, e.g. of all geoms of the model (see ``body_ids_in_model``). After writing to masses,
        inertias, positions and the like call :meth:`mark_const_dirty`.

        Raises:
            InputError: no such field, or one that cannot differ between environments.
        """
        try:
            return torch.from_numpy(self._world.expand(name))
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            from mujoco.batch import MODEL_FIELDS

            raise InputError(
                "model parameter",
                given=name,
                expected="a field of MjModel that may differ between environments",
                fix=did_you_mean(name, sorted(MODEL_FIELDS)),
            ) from error

    def default_model_param(self, name: str) -> torch.Tensor:
        """The model's own value of a field, without the environments' dimension.

        Raises:
            InputError: no such field.
        """
        source: object = self._world.model
        for part in name.split("."):
            if not hasattr(source, part):
                raise InputError(
                    "model parameter", given=name, expected="a field of MjModel", fix=did_you_mean(name, dir(source))
                )
            source = getattr(source, part)
        return torch.from_numpy(np.array(source))

    def mark_const_dirty(self, env_ids: EnvIds = None) -> None:
        """Have MuJoCo's derived constants recomputed before they are needed next."""
        self._world.mark_const_dirty(env_ids)

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Targets and defaults (the physical state is the scene's)."""
        kept = {name: getattr(self.data, name).torch.clone() for name in _KEPT}
        return kept | self.permanent_wrench_composer.state_dict()

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Continue from :meth:`state_dict`."""
        for name in _KEPT:
            getattr(self.data, name).torch.copy_(state[name])
        self.permanent_wrench_composer.load_state_dict(state)

    def _rows(self, env_ids: EnvIds) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
        return self._world.ids(env_ids)

    def _free_address(self, field: str) -> int:
        address = self.layout.free_qpos if field == "qpos" else self.layout.free_dof
        if address is None:
            raise InputError(
                "root state",
                given="a fixed-base robot",
                expected="a robot with a free joint",
                fix="Leave out the events that move this robot's root.",
            )
        return address


def _to_body(quat_wxyz: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Turn world vectors (n, 3) into the frame with these orientations (n, 4, wxyz)."""
    w, u = quat_wxyz[:, :1], -quat_wxyz[:, 1:]
    t = 2.0 * _cross(u, vector)
    result: np.ndarray = vector + w * t + _cross(u, t)
    return result


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products of rows of three: ``np.cross`` takes several times as long for a few rows."""
    found: np.ndarray = a[:, _YZX] * b[:, _ZXY] - a[:, _ZXY] * b[:, _YZX]
    return found
