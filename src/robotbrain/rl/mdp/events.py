"""Events that set or disturb the state: resets, pushes, external forces; those of ``isaaclab.envs.mdp.events`` 3.0.

``env_ids`` is a ``torch.long`` tensor of environments, a slice, or None for all. The events that change physical
parameters are in :mod:`robotbrain.rl.mdp.randomisation`.
"""

# ruff: noqa: B008  (a SceneEntityCfg as default: the managers copy it for each term)
from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from robotbrain.rl import math_utils
from robotbrain.rl.managers import ManagerTermBase, SceneEntityCfg
from robotbrain.rl.mdp._names import AXES
from robotbrain.rl.mdp._sampling import Bounds, uniform, uniform_axes

if TYPE_CHECKING:
    from robotbrain.rl.envs import ManagerBasedRLEnv
    from robotbrain.rl.scene import Articulation

Tensor = torch.Tensor
EnvIds = torch.Tensor | slice | None


def resolve_env_ids(env: ManagerBasedRLEnv, env_ids: EnvIds) -> Tensor:
    """The environments as a ``torch.long`` tensor."""
    if env_ids is None or isinstance(env_ids, slice):
        return torch.arange(env.num_envs, device=env.device)[slice(None) if env_ids is None else env_ids]
    return torch.as_tensor(env_ids, dtype=torch.long, device=env.device)


def reset_scene_to_default(env: ManagerBasedRLEnv, env_ids: EnvIds, reset_joint_targets: bool = False) -> None:
    """Put every asset into its default state.

    Args:
        reset_joint_targets: set the joints' targets to their defaults too (action terms usually do that).
    """
    ids = resolve_env_ids(env, env_ids)
    for asset in env.scene.articulations.values():
        data = asset.data
        pose = data.default_root_pose.torch[ids].clone()
        pose[:, :3] += env.scene.env_origins[ids]
        asset.write_root_pose_to_sim_index(root_pose=pose, env_ids=ids)
        asset.write_root_velocity_to_sim_index(root_velocity=data.default_root_vel.torch[ids], env_ids=ids)
        position, velocity = data.default_joint_pos.torch[ids], data.default_joint_vel.torch[ids]
        asset.write_joint_state_to_sim(position, velocity, env_ids=ids)
        if reset_joint_targets:
            asset.set_joint_position_target_index(target=position, env_ids=ids)


class reset_root_state_uniform(ManagerTermBase):  # noqa: N801  (Isaac Lab's name)
    """Put the root at its default pose and velocity plus uniform draws.

    ``pose_range`` has ranges of ``x, y, z`` [m] and ``roll, pitch, yaw`` [rad], the rotation in the root's own frame;
    ``velocity_range`` of ``x, y, z`` [m/s] and ``roll, pitch, yaw`` [rad/s] in the world frame. An axis that is not
    given is left at its default.
    """

    def __call__(
        self,
        env: ManagerBasedRLEnv,
        env_ids: EnvIds,
        pose_range: dict[str, Bounds],
        velocity_range: dict[str, Bounds],
        asset_cfg: SceneEntityCfg = SceneEntityCfg("robot"),
    ) -> None:
        """Draw and write the root's state."""
        ids = resolve_env_ids(env, env_ids)
        asset = env.scene[asset_cfg.name]
        default = asset.data.default_root_pose.torch[ids]
        offset = uniform_axes(env, "reset_root_state_uniform: pose_range", pose_range, len(ids), AXES)
        turn = math_utils.quat_from_euler_xyz(offset[:, 3], offset[:, 4], offset[:, 5])
        position = default[:, :3] + env.scene.env_origins[ids] + offset[:, :3]
        pose = torch.cat([position, math_utils.quat_mul(default[:, 3:7], turn)], dim=-1)
        extra = uniform_axes(env, "reset_root_state_uniform: velocity_range", velocity_range, len(ids), AXES)
        velocity = asset.data.default_root_vel.torch[ids] + extra
        asset.write_root_pose_to_sim_index(root_pose=pose, env_ids=ids)
        asset.write_root_velocity_to_sim_index(root_velocity=velocity, env_ids=ids)


def _reset_joints(
    env: ManagerBasedRLEnv,
    env_ids: EnvIds,
    position_range: Bounds,
    velocity_range: Bounds,
    asset_cfg: SceneEntityCfg,
    combine: Any,
) -> None:
    ids = resolve_env_ids(env, env_ids)
    asset: Articulation = env.scene[asset_cfg.name]
    data, joints, rows = asset.data, asset_cfg.joint_ids, ids.numpy()
    columns = joints if isinstance(joints, slice) else joints.numpy()
    position, velocity, limits, speed = (
        view.torch.numpy()[rows][:, columns]  # in numpy: fewer microseconds for the few rows of a reset
        for view in (
            data.default_joint_pos,
            data.default_joint_vel,
            data.soft_joint_pos_limits,
            data.soft_joint_vel_limits,
        )
    )
    position = combine(position, uniform(env, position_range, position.shape).numpy())
    velocity = combine(velocity, uniform(env, velocity_range, velocity.shape).numpy())
    position = np.minimum(np.maximum(position, limits[..., 0]), limits[..., 1])
    velocity = np.minimum(np.maximum(velocity, -speed), speed)
    asset.write_joint_state_to_sim(
        torch.from_numpy(position), torch.from_numpy(velocity), joint_ids=joints, env_ids=ids
    )


def reset_joints_by_scale(
    env: ManagerBasedRLEnv,
    env_ids: EnvIds,
    position_range: Bounds,
    velocity_range: Bounds,
    asset_cfg: SceneEntityCfg = SceneEntityCfg("robot"),
) -> None:
    """Put the chosen joints at their default positions and velocities times uniform draws, within their soft limits."""
    _reset_joints(env, env_ids, position_range, velocity_range, asset_cfg, np.multiply)


def reset_joints_by_offset(
    env: ManagerBasedRLEnv,
    env_ids: EnvIds,
    position_range: Bounds,
    velocity_range: Bounds,
    asset_cfg: SceneEntityCfg = SceneEntityCfg("robot"),
) -> None:
    """Put the chosen joints at their default positions and velocities plus uniform draws, within their soft limits."""
    _reset_joints(env, env_ids, position_range, velocity_range, asset_cfg, np.add)


def push_by_setting_velocity(
    env: ManagerBasedRLEnv,
    env_ids: EnvIds,
    velocity_range: Mapping[str, Bounds],
    asset_cfg: SceneEntityCfg = SceneEntityCfg("robot"),
) -> None:
    """Add uniform draws to the root's velocity, as a blow would.

    Args:
        velocity_range: ranges of ``x, y, z`` [m/s] and ``roll, pitch, yaw`` [rad/s] in the world frame.
    """
    ids = resolve_env_ids(env, env_ids)
    asset = env.scene[asset_cfg.name]
    push = uniform_axes(env, "push_by_setting_velocity: velocity_range", velocity_range, len(ids), AXES)
    asset.write_root_velocity_to_sim_index(root_velocity=asset.data.root_vel_w.torch[ids] + push, env_ids=ids)


def apply_external_force_torque(
    env: ManagerBasedRLEnv,
    env_ids: EnvIds,
    force_range: Bounds,
    torque_range: Bounds,
    asset_cfg: SceneEntityCfg = SceneEntityCfg("robot"),
) -> None:
    """Apply a drawn force and torque to each chosen body, in the body's frame, until the next call.

    Args:
        force_range: bounds of each component of the force [N].
        torque_range: bounds of each component of the torque [N m]. With all four bounds 0 nothing is changed.
    """
    if not any((*force_range, *torque_range)):
        return
    ids = resolve_env_ids(env, env_ids)
    asset = env.scene[asset_cfg.name]
    bodies = (
        len(range(asset.num_bodies)[asset_cfg.body_ids])
        if isinstance(asset_cfg.body_ids, slice)
        else len(asset_cfg.body_ids)
    )
    forces = uniform(env, force_range, (len(ids), bodies, 3))
    torques = uniform(env, torque_range, (len(ids), bodies, 3))
    asset.permanent_wrench_composer.set_forces_and_torques_index(
        forces=forces, torques=torques, body_ids=asset_cfg.body_ids, env_ids=ids
    )
