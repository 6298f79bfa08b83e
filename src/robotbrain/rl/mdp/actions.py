"""Action terms: part of the policy's action, scaled and offset, as commands of an asset's joints.

Names, fields, defaults and arithmetic are those of ``isaaclab.envs.mdp.actions`` 3.0:
``processed = raw * scale + offset``, clipped, applied before each physics step.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch

from robotbrain.errors import InputError
from robotbrain.rl.configclass import MISSING, configclass
from robotbrain.rl.managers import ActionTerm, ActionTermCfg
from robotbrain.rl.scene.names import find_names

if TYPE_CHECKING:
    from robotbrain.rl.envs import ManagerBasedRLEnv

Tensor = torch.Tensor


class JointAction(ActionTerm):
    """Base of the joint actions: resolves the joints, scale, offset and clip of a :class:`JointActionCfg`.

    ``raw_actions`` is what the policy gave, ``processed_actions`` what is sent to the joints, both (num_envs, J).
    """

    cfg: JointActionCfg

    def __init__(self, cfg: JointActionCfg, env: ManagerBasedRLEnv) -> None:
        super().__init__(cfg, env)
        ids, self._joint_names = self._asset.find_joints(cfg.joint_names, preserve_order=cfg.preserve_order)
        every_joint = list(ids) == list(range(self._asset.num_joints))
        self._joint_ids: Any = slice(None) if every_joint else torch.as_tensor(ids, dtype=torch.long)
        self._num_joints = len(self._joint_names)
        self._raw_actions = torch.zeros(self.num_envs, self._num_joints, device=self.device)
        self._processed_actions = torch.zeros_like(self._raw_actions)
        self._scale = self._per_joint("scale", cfg.scale, 1.0)
        self._offset = self._per_joint("offset", cfg.offset, 0.0)
        self._clip = None if cfg.clip is None else self._bounds(cfg.clip)

    @property
    def action_dim(self) -> int:
        """Number of joints."""
        return self._num_joints

    @property
    def raw_actions(self) -> Tensor:
        """The policy's action for these joints, (num_envs, J)."""
        return self._raw_actions

    @property
    def processed_actions(self) -> Tensor:
        """Scaled, offset and clipped, in the joints' unit, (num_envs, J)."""
        return self._processed_actions

    @property
    def joint_names(self) -> list[str]:
        """The joints, in the order of the action's components."""
        return list(self._joint_names)

    def process_actions(self, actions: Tensor) -> None:
        """Store the policy's action and compute the command; once per control step."""
        self._raw_actions[:] = actions
        self._processed_actions = self._raw_actions * self._scale + self._offset
        if self._clip is not None:
            self._processed_actions = self._processed_actions.clamp(self._clip[..., 0], self._clip[..., 1])

    def reset(self, env_ids: Any = None) -> None:
        """Forget the action of these environments (all by default)."""
        self._raw_actions[slice(None) if env_ids is None else env_ids] = 0.0

    def _per_joint(self, what: str, value: float | Mapping[str, float], default: float) -> float | Tensor:
        if isinstance(value, Mapping):
            row = torch.full((1, self._num_joints), default, device=self.device)
            for pattern, number in value.items():
                row[:, find_names(pattern, self._joint_names, what="joint")[0]] = float(number)
            return row
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InputError(
                f"{type(self.cfg).__name__}.{what}",
                given=value,
                expected="a number, or a dictionary of numbers by joint name",
                fix="Give one of the two.",
            )
        return float(value)

    def _bounds(self, clip: Mapping[str, tuple[float, float]]) -> Tensor:
        bounds = torch.tensor([-torch.inf, torch.inf], device=self.device).repeat(1, self._num_joints, 1)
        for pattern, pair in clip.items():
            bounds[:, find_names(pattern, self._joint_names, what="joint")[0]] = torch.tensor(pair, device=self.device)
        return bounds


class JointPositionAction(JointAction):
    """The processed action is the joints' position target [rad]."""

    cfg: JointPositionActionCfg

    def __init__(self, cfg: JointPositionActionCfg, env: ManagerBasedRLEnv) -> None:
        super().__init__(cfg, env)
        if cfg.use_default_offset:
            self._offset = self._asset.data.default_joint_pos.torch[:, self._joint_ids].clone()

    def apply_actions(self) -> None:
        """Set the joints' position targets."""
        self._asset.set_joint_position_target_index(target=self.processed_actions, joint_ids=self._joint_ids)


class RelativeJointPositionAction(JointAction):
    """The position target is the joints' present position plus the processed action, anew at every physics step.

    The target therefore runs ahead of the joint during a control step. For a target that is computed once per control
    step see :class:`robotbrain.rl.mdp.HeldRelativeJointPositionActionCfg`.
    """

    cfg: RelativeJointPositionActionCfg
    apply_every_substep = True

    def __init__(self, cfg: RelativeJointPositionActionCfg, env: ManagerBasedRLEnv) -> None:
        super().__init__(cfg, env)
        if cfg.use_zero_offset:
            self._offset = 0.0

    def apply_actions(self) -> None:
        """Set the joints' position targets from where the joints are now."""
        target = self.processed_actions + self._asset.data.joint_pos.torch[:, self._joint_ids]
        self._asset.set_joint_position_target_index(target=target, joint_ids=self._joint_ids)


class JointVelocityAction(JointAction):
    """The processed action is the joints' velocity target [rad/s]."""

    cfg: JointVelocityActionCfg

    def __init__(self, cfg: JointVelocityActionCfg, env: ManagerBasedRLEnv) -> None:
        super().__init__(cfg, env)
        if cfg.use_default_offset:
            self._offset = self._asset.data.default_joint_vel.torch[:, self._joint_ids].clone()

    def apply_actions(self) -> None:
        """Set the joints' velocity targets."""
        self._asset.set_joint_velocity_target_index(target=self.processed_actions, joint_ids=self._joint_ids)


class JointEffortAction(JointAction):
    """The processed action is the joints' effort [N m]."""

    cfg: JointEffortActionCfg

    def apply_actions(self) -> None:
        """Set the joints' efforts."""
        self._asset.set_joint_effort_target_index(target=self.processed_actions, joint_ids=self._joint_ids)


@configclass
class JointActionCfg(ActionTermCfg):
    """Base of the joint actions' configurations.

    Attributes:
        joint_names: names or regular expressions; the action's components are in the asset's joint order.
        scale: factor of the action, one number or by joint name.
        offset: added after scaling, one number or by joint name.
        preserve_order: the action's components are in the order of ``joint_names`` instead.
    """

    joint_names: list[str] = MISSING
    scale: float | dict[str, float] = 1.0
    offset: float | dict[str, float] = 0.0
    preserve_order: bool = False


@configclass
class JointPositionActionCfg(JointActionCfg):
    """Position targets [rad]; ``use_default_offset`` puts the default joint positions in the place of ``offset``."""

    class_type: type[ActionTerm] = JointPositionAction
    use_default_offset: bool = True


@configclass
class RelativeJointPositionActionCfg(JointActionCfg):
    """Position targets relative to the present position [rad]; ``use_zero_offset`` sets ``offset`` to 0."""

    class_type: type[ActionTerm] = RelativeJointPositionAction
    use_zero_offset: bool = True


@configclass
class JointVelocityActionCfg(JointActionCfg):
    """Velocity targets [rad/s]; ``use_default_offset`` puts the default velocities in the place of ``offset``."""

    class_type: type[ActionTerm] = JointVelocityAction
    use_default_offset: bool = True


@configclass
class JointEffortActionCfg(JointActionCfg):
    """Efforts [N m, N]."""

    class_type: type[ActionTerm] = JointEffortAction
