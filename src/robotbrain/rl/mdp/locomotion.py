"""Reward terms of walking robots; those of ``isaaclab_tasks.core.velocity.mdp.rewards`` 3.0."""

# ruff: noqa: B008  (a SceneEntityCfg as default: the managers copy it for each term)
from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import torch

from robotbrain.errors import InputError
from robotbrain.rl import math_utils
from robotbrain.rl.managers import SceneEntityCfg
from robotbrain.rl.mdp._read import contacts, largest_contact, length, state
from robotbrain.rl.mdp.rewards import joint_deviation_l1

if TYPE_CHECKING:
    from robotbrain.rl.envs import ManagerBasedRLEnv

Tensor = torch.Tensor


def _commanded_speed(env: ManagerBasedRLEnv, command_name: str) -> npt.NDArray[np.float32]:
    """Magnitude of the commanded horizontal velocity [m/s], (num_envs,)."""
    velocity = np.square(env.command_manager.get_command(command_name).numpy())
    speed: npt.NDArray[np.float32] = np.sqrt(velocity[:, 0] + velocity[:, 1])
    return speed


def _wants_to_walk(env: ManagerBasedRLEnv, command_name: str) -> Tensor:
    """Where the commanded horizontal speed is above 0.1 m/s, (num_envs,) bool."""
    return torch.from_numpy(_commanded_speed(env, command_name) > 0.1)


def feet_air_time(env: ManagerBasedRLEnv, command_name: str, sensor_cfg: SceneEntityCfg, threshold: float) -> Tensor:
    """Sum over the feet that just touched down of (time in the air - ``threshold``) [s]; 0 when told to stand."""
    sensor = contacts(env, sensor_cfg)
    landed = sensor.compute_first_contact(env.step_dt).columns(sensor_cfg.body_ids)
    air_time = sensor.data.last_air_time.columns(sensor_cfg.body_ids)
    gain = torch.from_numpy((air_time.numpy() - float(threshold)) * landed.numpy()).sum(dim=1)
    return gain.mul_(_wants_to_walk(env, command_name))


def feet_air_time_positive_biped(
    env: ManagerBasedRLEnv, command_name: str, threshold: float, sensor_cfg: SceneEntityCfg
) -> Tensor:
    """While one foot stands: the shorter of its stance and the others' swing times, at most ``threshold`` [s]."""
    data = contacts(env, sensor_cfg).data
    stance_time = data.current_contact_time.columns(sensor_cfg.body_ids)
    standing = stance_time > 0.0
    phase_time = torch.where(standing, stance_time, data.current_air_time.columns(sensor_cfg.body_ids))
    one_foot = standing.sum(dim=1) == 1
    return (phase_time.amin(dim=1) * one_foot).clamp(max=threshold) * _wants_to_walk(env, command_name)


def feet_air_time_variance(
    env: ManagerBasedRLEnv, command_name: str, sensor_cfg: SceneEntityCfg, max_time: float = 0.5
) -> Tensor:
    """Variance over the feet of their last swing and stance times, each at most ``max_time`` [s2]; 0 to stand."""
    data = contacts(env, sensor_cfg).data
    swing = data.last_air_time.columns(sensor_cfg.body_ids).clip(max=max_time)
    stance = data.last_contact_time.columns(sensor_cfg.body_ids).clip(max=max_time)
    if swing.shape[1] < 2:
        raise InputError(
            "feet_air_time_variance: sensor_cfg",
            given=sensor_cfg.body_names,
            expected="at least two feet (a variance over one is undefined)",
            fix="Widen body_names so that it matches every foot.",
        )
    return (swing.var(dim=1) + stance.var(dim=1)) * _wants_to_walk(env, command_name)


def feet_slide(
    env: ManagerBasedRLEnv, sensor_cfg: SceneEntityCfg, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")
) -> Tensor:
    """Sum of the horizontal speeds of the feet that press on the ground with more than 1 N [m/s]."""
    pressing = largest_contact(env, sensor_cfg) > 1.0
    speed = length(state(env, asset_cfg).body_lin_vel_w.torch[:, asset_cfg.body_ids, :2])
    return (speed * pressing).sum(dim=1)


def track_lin_vel_xy_yaw_frame_exp(
    env: ManagerBasedRLEnv, std: float, command_name: str, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")
) -> Tensor:
    """``exp(-e^2 / std^2)`` of the error of the horizontal velocity in the root's heading frame [m/s]."""
    data = state(env, asset_cfg)
    heading = math_utils.yaw_quat(data.root_quat_w.torch)
    velocity = math_utils.quat_apply_inverse(heading, data.root_lin_vel_w.torch)[:, :2]
    error = torch.square(env.command_manager.get_command(command_name)[:, :2] - velocity).sum(dim=1)
    return torch.exp(-error / std**2)


def track_ang_vel_z_world_exp(
    env: ManagerBasedRLEnv, command_name: str, std: float, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")
) -> Tensor:
    """``exp(-e^2 / std^2)`` of the error of the yaw rate about the world's vertical [rad/s]."""
    rate = state(env, asset_cfg).root_ang_vel_w.torch[:, 2]
    return torch.exp(-torch.square(env.command_manager.get_command(command_name)[:, 2] - rate) / std**2)


def stand_still_joint_deviation_l1(
    env: ManagerBasedRLEnv,
    command_name: str,
    command_threshold: float = 0.06,
    asset_cfg: SceneEntityCfg = SceneEntityCfg("robot"),
) -> Tensor:
    """:func:`joint_deviation_l1` where the commanded horizontal speed is below ``command_threshold`` [m/s], else 0."""
    told_to_stand = torch.from_numpy(_commanded_speed(env, command_name) < command_threshold)
    return joint_deviation_l1(env, asset_cfg) * told_to_stand
