"""Reward terms: (num_envs,) tensors; a configuration gives each its weight, and with it its sign.

Names, arguments, units and frames are those of ``isaaclab.envs.mdp.rewards`` 3.0. The reward manager multiplies each
by ``weight * step_dt``.
"""

# ruff: noqa: B008  (a SceneEntityCfg as default: the managers copy it for each term)
from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from robotbrain.errors import InputError
from robotbrain.rl import math_utils
from robotbrain.rl.managers import ManagerTermBase, SceneEntityCfg
from robotbrain.rl.mdp._read import largest_contact, length, robot, squares, state

if TYPE_CHECKING:
    from robotbrain.rl.envs import ManagerBasedRLEnv
    from robotbrain.rl.managers import RewardTermCfg

Tensor = torch.Tensor
_XY = slice(0, 2)


def is_alive(env: ManagerBasedRLEnv) -> Tensor:
    """1 where the episode has not terminated (being cut off counts as alive)."""
    return (~env.termination_manager.terminated).float()


def is_terminated(env: ManagerBasedRLEnv) -> Tensor:
    """1 where the episode has terminated; being cut off by the time limit does not count."""
    return env.termination_manager.terminated.float()


class is_terminated_term(ManagerTermBase):  # noqa: N801  (Isaac Lab's name)
    """Number of the chosen termination terms that fired, 0 where the time limit cut the episode off.

    ``term_keys``: name or names of termination terms, regular expressions; the default takes all.
    """

    def __init__(self, cfg: RewardTermCfg, env: ManagerBasedRLEnv) -> None:
        super().__init__(cfg, env)
        self._names = env.termination_manager.find_terms(cfg.params["term_keys"])

    def __call__(self, env: ManagerBasedRLEnv, term_keys: str | list[str] = ".*") -> Tensor:
        """Count, (num_envs,)."""
        fired = torch.zeros(env.num_envs, device=env.device)
        for name in self._names:
            fired += env.termination_manager.get_term(name)
        return fired * ~env.termination_manager.time_outs


def terminated_penalty(env: ManagerBasedRLEnv) -> Tensor:
    """``1 / step_dt`` where the episode has terminated: with it a weight is the penalty itself, whatever the rate."""
    return env.termination_manager.terminated.float() / env.step_dt


def lin_vel_z_l2(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")) -> Tensor:
    """Square of the root's vertical velocity in its own frame [m2/s2]."""
    return torch.square(state(env, asset_cfg).root_lin_vel_b.torch[:, 2])


def ang_vel_xy_l2(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")) -> Tensor:
    """Sum of squares of the root's roll and pitch rates in its own frame [rad2/s2]."""
    return squares(state(env, asset_cfg).root_ang_vel_b.columns(_XY))


def flat_orientation_l2(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")) -> Tensor:
    """Square of the sine of the root's tilt: the horizontal part of gravity's direction in its own frame."""
    return squares(state(env, asset_cfg).projected_gravity_b.columns(_XY))


def base_height_l2(
    env: ManagerBasedRLEnv,
    target_height: float,
    asset_cfg: SceneEntityCfg = SceneEntityCfg("robot"),
    sensor_cfg: SceneEntityCfg | None = None,
) -> Tensor:
    """Square of the root's height above ``target_height`` [m2].

    Args:
        sensor_cfg: in Isaac Lab a ray caster that measures rough ground; the kit's ground is flat and takes None.
    """
    if sensor_cfg is not None:
        raise InputError(
            "base_height_l2: sensor_cfg",
            given=sensor_cfg.name,
            expected="None",
            fix="The kit's ground is flat: leave sensor_cfg out.",
        )
    return torch.from_numpy(np.square(state(env, asset_cfg).root_pos_w.torch.numpy()[:, 2] - float(target_height)))


def joint_torques_l2(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")) -> Tensor:
    """Sum of squares of the effort on the chosen joints [N2 m2]."""
    return robot(env, asset_cfg).actuators.applied_effort.columns(asset_cfg.joint_ids).square().sum(dim=1)


def joint_vel_l1(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg) -> Tensor:
    """Sum of the chosen joints' speeds [rad/s]."""
    return state(env, asset_cfg).joint_vel.columns(asset_cfg.joint_ids).abs().sum(dim=1)


def joint_vel_l2(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")) -> Tensor:
    """Sum of squares of the chosen joints' velocities [rad2/s2]."""
    return state(env, asset_cfg).joint_vel.columns(asset_cfg.joint_ids).square().sum(dim=1)


def joint_acc_l2(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")) -> Tensor:
    """Sum of squares of the chosen joints' accelerations [rad2/s4]."""
    return state(env, asset_cfg).joint_acc.columns(asset_cfg.joint_ids).square().sum(dim=1)


def joint_deviation_l1(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")) -> Tensor:
    """Sum of the chosen joints' distances from their default positions [rad]."""
    data = state(env, asset_cfg)
    away = data.joint_pos.columns(asset_cfg.joint_ids) - data.default_joint_pos.columns(asset_cfg.joint_ids)
    return away.abs().sum(dim=1)


def joint_pos_target_l2(env: ManagerBasedRLEnv, target: float, asset_cfg: SceneEntityCfg) -> Tensor:
    """Sum of squares of the chosen joints' distances from ``target`` [rad2], positions wrapped to -pi..pi first."""
    position = state(env, asset_cfg).joint_pos.columns(asset_cfg.joint_ids)
    return torch.square(math_utils.wrap_to_pi(position) - target).sum(dim=1)


def joint_pos_limits(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")) -> Tensor:
    """Sum over the chosen joints of how far they are beyond their soft limits [rad]."""
    data = state(env, asset_cfg)
    position = data.joint_pos.columns(asset_cfg.joint_ids)
    limits = data.soft_joint_pos_limits.columns(asset_cfg.joint_ids)
    return ((limits[..., 0] - position).clip(min=0.0) + (position - limits[..., 1]).clip(min=0.0)).sum(dim=1)


def joint_vel_limits(
    env: ManagerBasedRLEnv, soft_ratio: float, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")
) -> Tensor:
    """Sum over the chosen joints of their speed above ``soft_ratio`` times the limit, at most 1 rad/s each."""
    data = state(env, asset_cfg)
    limit = data.soft_joint_vel_limits.columns(asset_cfg.joint_ids) * soft_ratio
    return (data.joint_vel.columns(asset_cfg.joint_ids).abs() - limit).clip(min=0.0, max=1.0).sum(dim=1)


def applied_torque_limits(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")) -> Tensor:
    """Sum over the chosen joints of the effort that the actuators' limits cut off [N m]."""
    actuators = robot(env, asset_cfg).actuators
    cut = actuators.applied_effort.torch - actuators.computed_effort.torch
    return cut[:, asset_cfg.joint_ids].abs().sum(dim=1)


def action_rate_l2(env: ManagerBasedRLEnv) -> Tensor:
    """Sum of squares of the change of the action since the last step."""
    return (env.action_manager.action - env.action_manager.prev_action).square_().sum(dim=1)


def action_l2(env: ManagerBasedRLEnv) -> Tensor:
    """Sum of squares of the action."""
    return env.action_manager.action.square().sum(dim=1)


def undesired_contacts(env: ManagerBasedRLEnv, threshold: float, sensor_cfg: SceneEntityCfg) -> Tensor:
    """Number of the chosen bodies touched with more than ``threshold`` [N]."""
    touched = largest_contact(env, sensor_cfg).numpy() > threshold
    return torch.from_numpy(np.add.reduce(touched, 1, dtype=np.int64))


def desired_contacts(env: ManagerBasedRLEnv, sensor_cfg: SceneEntityCfg, threshold: float = 1.0) -> Tensor:
    """1 where none of the chosen bodies is touched with more than ``threshold`` [N]."""
    return (largest_contact(env, sensor_cfg) <= threshold).all(dim=1).float()


def contact_forces(env: ManagerBasedRLEnv, threshold: float, sensor_cfg: SceneEntityCfg) -> Tensor:
    """Sum over the chosen bodies of the contact force above ``threshold`` [N]."""
    return (largest_contact(env, sensor_cfg) - threshold).clip(min=0.0).sum(dim=1)


def track_lin_vel_xy_exp(
    env: ManagerBasedRLEnv, std: float, command_name: str, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")
) -> Tensor:
    """``exp(-e^2 / std^2)`` of the error of the horizontal velocity in the root's frame [m/s]."""
    velocity = state(env, asset_cfg).root_lin_vel_b.torch.numpy()
    error = np.square(env.command_manager.get_command(command_name).numpy()[:, :2] - velocity[:, :2])
    return torch.from_numpy((error[:, 0] + error[:, 1]) * float(-1.0 / std**2)).exp_()


def track_ang_vel_z_exp(
    env: ManagerBasedRLEnv, std: float, command_name: str, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")
) -> Tensor:
    """``exp(-e^2 / std^2)`` of the error of the yaw rate in the root's frame [rad/s]."""
    rate = state(env, asset_cfg).root_ang_vel_b.torch.numpy()[:, 2]
    error = np.square(env.command_manager.get_command(command_name).numpy()[:, 2] - rate)
    return torch.from_numpy(-error / float(std**2)).exp_()


def position_command_error(env: ManagerBasedRLEnv, command_name: str, asset_cfg: SceneEntityCfg) -> Tensor:
    """Distance of the chosen body from the commanded position [m]; the command is in the root's frame."""
    data = state(env, asset_cfg)
    command = env.command_manager.get_command(command_name)
    goal = command[:, :3]
    if not data.root_is_world:
        goal, _ = math_utils.combine_frame_transforms(data.root_pos_w.torch, data.root_quat_w.torch, goal)
    return length(data.body_pos_w.columns(asset_cfg.body_ids)[:, 0] - goal)


def position_command_error_tanh(
    env: ManagerBasedRLEnv, std: float, command_name: str, asset_cfg: SceneEntityCfg
) -> Tensor:
    """``1 - tanh(d / std)`` of the distance of the chosen body from the commanded position [m]."""
    return 1.0 - torch.tanh(position_command_error(env, command_name, asset_cfg) / std)


def orientation_command_error(env: ManagerBasedRLEnv, command_name: str, asset_cfg: SceneEntityCfg) -> Tensor:
    """Angle between the chosen body's orientation and the commanded one [rad]; the command is in the root's frame."""
    data = state(env, asset_cfg)
    command = env.command_manager.get_command(command_name)
    goal = math_utils.quat_mul(data.root_quat_w.torch, command[:, 3:7])
    return math_utils.quat_error_magnitude(data.body_quat_w.columns(asset_cfg.body_ids)[:, 0], goal)
