"""Observation terms: (num_envs, dim) tensors for the policy.

Names, arguments, units and frames are those of ``isaaclab.envs.mdp.observations`` 3.0. Frames: ``_w`` world, ``_b``
the root link's own frame. Quaternions are (x, y, z, w).
"""

# ruff: noqa: B008  (a SceneEntityCfg as default: the managers copy it for each term)
from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from robotbrain.errors import InputError
from robotbrain.rl import math_utils
from robotbrain.rl.managers import SceneEntityCfg
from robotbrain.rl.mdp._read import robot, state

if TYPE_CHECKING:
    from robotbrain.rl.envs import ManagerBasedRLEnv

Tensor = torch.Tensor


def base_pos_z(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")) -> Tensor:
    """Height of the root above the world's origin [m], (num_envs, 1)."""
    return state(env, asset_cfg).root_pos_w.torch[:, 2:3]


def base_lin_vel(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")) -> Tensor:
    """Linear velocity of the root in its own frame [m/s], (num_envs, 3)."""
    return state(env, asset_cfg).root_lin_vel_b.torch


def base_ang_vel(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")) -> Tensor:
    """Angular velocity of the root in its own frame [rad/s], (num_envs, 3)."""
    return state(env, asset_cfg).root_ang_vel_b.torch


def projected_gravity(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")) -> Tensor:
    """Unit vector of gravity in the root's frame, (num_envs, 3); (0, 0, -1) when the robot is level."""
    return state(env, asset_cfg).projected_gravity_b.torch


def root_pos_w(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")) -> Tensor:
    """Position of the root relative to the environment's origin [m], (num_envs, 3)."""
    return state(env, asset_cfg).root_pos_w.torch - env.scene.env_origins


def root_quat_w(
    env: ManagerBasedRLEnv, make_quat_unique: bool = False, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")
) -> Tensor:
    """Orientation of the root as a quaternion (x, y, z, w), (num_envs, 4).

    Args:
        make_quat_unique: of the two quaternions of a rotation take the one with w >= 0.
    """
    quat = state(env, asset_cfg).root_quat_w.torch
    return math_utils.quat_unique(quat) if make_quat_unique else quat


def root_lin_vel_w(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")) -> Tensor:
    """Linear velocity of the root in the world frame [m/s], (num_envs, 3)."""
    return state(env, asset_cfg).root_lin_vel_w.torch


def root_ang_vel_w(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")) -> Tensor:
    """Angular velocity of the root in the world frame [rad/s], (num_envs, 3)."""
    return state(env, asset_cfg).root_ang_vel_w.torch


def body_pose_w(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")) -> Tensor:
    """Poses (x, y, z, qx, qy, qz, qw) of the chosen bodies relative to the environment's origin, (num_envs, 7 * B)."""
    data = state(env, asset_cfg)
    position = data.body_pos_w.columns(asset_cfg.body_ids) - env.scene.env_origins.unsqueeze(1)
    quat = data.body_quat_w.columns(asset_cfg.body_ids)
    return torch.cat([position, quat], dim=-1).reshape(env.num_envs, -1)


def body_projected_gravity_b(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")) -> Tensor:
    """Unit vector of gravity in the frame of each chosen body, (num_envs, 3 * B)."""
    data = state(env, asset_cfg)
    quat = data.body_quat_w.columns(asset_cfg.body_ids)
    down = torch.nn.functional.normalize(data.GRAVITY_VEC_W.torch, dim=-1).unsqueeze(1).expand(-1, quat.shape[1], -1)
    return math_utils.quat_apply_inverse(quat, down).reshape(env.num_envs, -1)


def joint_pos(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")) -> Tensor:
    """Positions of the chosen joints [rad, m], (num_envs, J)."""
    return state(env, asset_cfg).joint_pos.columns(asset_cfg.joint_ids)


def joint_pos_rel(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")) -> Tensor:
    """Positions of the chosen joints minus their default positions [rad, m], (num_envs, J)."""
    data = state(env, asset_cfg)
    return data.joint_pos.columns(asset_cfg.joint_ids) - data.default_joint_pos.columns(asset_cfg.joint_ids)


def joint_pos_limit_normalized(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")) -> Tensor:
    """Positions of the chosen joints, their soft limits mapped to -1 and 1, (num_envs, J)."""
    data = state(env, asset_cfg)
    limits = data.soft_joint_pos_limits.columns(asset_cfg.joint_ids)
    return math_utils.scale_transform(data.joint_pos.columns(asset_cfg.joint_ids), limits[..., 0], limits[..., 1])


def joint_vel(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")) -> Tensor:
    """Velocities of the chosen joints [rad/s, m/s], (num_envs, J)."""
    return state(env, asset_cfg).joint_vel.columns(asset_cfg.joint_ids)


def joint_vel_rel(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")) -> Tensor:
    """Velocities of the chosen joints minus their default velocities [rad/s, m/s], (num_envs, J)."""
    data = state(env, asset_cfg)
    return data.joint_vel.columns(asset_cfg.joint_ids) - data.default_joint_vel.columns(asset_cfg.joint_ids)


def joint_effort(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")) -> Tensor:
    """Effort the actuators apply to the chosen joints [N m, N], (num_envs, J)."""
    return robot(env, asset_cfg).actuators.applied_effort.columns(asset_cfg.joint_ids)


def last_action(env: ManagerBasedRLEnv, action_name: str | None = None) -> Tensor:
    """The policy's last action as it gave it, whole or of one action term, (num_envs, A)."""
    if action_name is None:
        return env.action_manager.action
    return env.action_manager.get_term(action_name).raw_actions


def generated_commands(env: ManagerBasedRLEnv, command_name: str | None = None) -> Tensor:
    """The current command of a command term, (num_envs, C)."""
    if command_name is None:
        raise InputError(
            "generated_commands: command_name", given=None, expected="a command's name", fix="Name the task's command."
        )
    return env.command_manager.get_command(command_name)


def current_time_s(env: ManagerBasedRLEnv) -> Tensor:
    """Time since the episode began [s], (num_envs, 1)."""
    return env.episode_length_buf.unsqueeze(1) * env.step_dt


def remaining_time_s(env: ManagerBasedRLEnv) -> Tensor:
    """Time until the episode is cut off [s], (num_envs, 1)."""
    return env.max_episode_length_s - env.episode_length_buf.unsqueeze(1) * env.step_dt
