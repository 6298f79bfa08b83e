"""Termination terms: (num_envs,) bool tensors; those of ``isaaclab.envs.mdp.terminations`` 3.0.

A term in a configuration with ``time_out=True`` cuts the episode off (the future still has value); any other ends it.
"""

# ruff: noqa: B008  (a SceneEntityCfg as default: the managers copy it for each term)
from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from robotbrain.errors import InputError
from robotbrain.rl.managers import ManagerTermBase, SceneEntityCfg
from robotbrain.rl.mdp._read import largest_contact, robot, state

if TYPE_CHECKING:
    from robotbrain.rl.envs import ManagerBasedRLEnv

Tensor = torch.Tensor


def time_out(env: ManagerBasedRLEnv) -> Tensor:
    """The episode has lasted its full length."""
    return env.episode_length_buf >= env.max_episode_length


def command_resample(env: ManagerBasedRLEnv, command_name: str, num_resamples: int = 1) -> Tensor:
    """The command is about to be drawn anew for the ``num_resamples``-th time."""
    command = env.command_manager.get_term(command_name)
    return (command.time_left <= env.step_dt) & (command.command_counter == num_resamples)


def pose_command_success(env: ManagerBasedRLEnv, command_name: str) -> Tensor:
    """The commanded pose is reached within every threshold that the command's configuration sets."""
    command: Any = env.command_manager.get_term(command_name)
    if not hasattr(command, "compute_success"):
        raise InputError(
            "pose_command_success: command_name",
            given=command_name,
            expected="a pose command (UniformPoseCommandCfg)",
            fix="Name the task's pose command.",
        )
    success: Tensor = command.compute_success()
    return success


def bad_orientation(
    env: ManagerBasedRLEnv, limit_angle: float, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")
) -> Tensor:
    """The root is tilted from upright by more than ``limit_angle`` [rad]."""
    return state(env, asset_cfg).projected_gravity_b.torch[:, 2] > -math.cos(limit_angle)  # acos falls


def root_height_below_minimum(
    env: ManagerBasedRLEnv, minimum_height: float, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")
) -> Tensor:
    """The root is lower than ``minimum_height`` [m] above the world's origin (for flat ground)."""
    return state(env, asset_cfg).root_pos_w.torch[:, 2] < minimum_height


def _any_outside(position: Tensor, lower: Tensor | float, upper: Tensor | float) -> Tensor:
    return ((position < lower) | (position > upper)).any(dim=1)


def joint_pos_out_of_limit(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")) -> Tensor:
    """A chosen joint is beyond its soft limits."""
    data = state(env, asset_cfg)
    limits = data.soft_joint_pos_limits.columns(asset_cfg.joint_ids)
    return _any_outside(data.joint_pos.columns(asset_cfg.joint_ids), limits[..., 0], limits[..., 1])


def joint_pos_out_of_manual_limit(
    env: ManagerBasedRLEnv, bounds: tuple[float, float], asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")
) -> Tensor:
    """A chosen joint is outside ``bounds`` [rad]."""
    return _any_outside(state(env, asset_cfg).joint_pos.columns(asset_cfg.joint_ids), bounds[0], bounds[1])


class joint_vel_out_of_limit(ManagerTermBase):  # noqa: N801  (Isaac Lab's name)
    """A chosen joint is faster than its soft limit."""

    def __call__(self, env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")) -> Tensor:
        """Which environments, (num_envs,) bool."""
        data = state(env, asset_cfg)
        limits = data.soft_joint_vel_limits.columns(asset_cfg.joint_ids)
        return (data.joint_vel.columns(asset_cfg.joint_ids).abs() > limits).any(dim=1)


def joint_vel_out_of_manual_limit(
    env: ManagerBasedRLEnv, max_velocity: float, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")
) -> Tensor:
    """A chosen joint is faster than ``max_velocity`` [rad/s], or its velocity is not a finite number."""
    speed = state(env, asset_cfg).joint_vel.columns(asset_cfg.joint_ids).abs()
    return ~(speed <= max_velocity).all(dim=1)  # a comparison with NaN is false: this way it counts as too fast


def joint_effort_out_of_limit(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")) -> Tensor:
    """An actuator of a chosen joint was asked for more effort than it can give."""
    actuators = robot(env, asset_cfg).actuators
    asked = actuators.computed_effort.columns(asset_cfg.joint_ids)
    return (~torch.isclose(asked, actuators.applied_effort.columns(asset_cfg.joint_ids))).any(dim=1)


def illegal_contact(env: ManagerBasedRLEnv, threshold: float, sensor_cfg: SceneEntityCfg) -> Tensor:
    """One of the chosen bodies was touched with more than ``threshold`` [N]."""
    touched = largest_contact(env, sensor_cfg).numpy() > threshold
    return torch.from_numpy(np.logical_or.reduce(touched, 1))
