"""Terms of the kit's own. None of them is part of Isaac Lab.

They use only what Isaac Lab has too, so that ``robotbrain rl export-isaaclab`` can copy their source next to a
configuration for genuine Isaac Lab. See :mod:`robotbrain.rl.mdp.extra_actions` for the actions.
"""

# ruff: noqa: B008  (a SceneEntityCfg as default: the managers copy it for each term)
from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from robotbrain.rl import math_utils
from robotbrain.rl.managers import SceneEntityCfg
from robotbrain.rl.mdp.rewards import position_command_error

if TYPE_CHECKING:
    from robotbrain.rl.envs import ManagerBasedRLEnv


def body_pos_b(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")) -> torch.Tensor:
    """Positions of the chosen bodies in the root's frame [m], (num_envs, 3 * B). Not in Isaac Lab."""
    data = env.scene[asset_cfg.name].data
    offset: torch.Tensor = data.body_pos_w.torch[:, asset_cfg.body_ids]
    if getattr(data, "root_is_world", False):  # known of a robot that stands fixed at the origin; not in Isaac Lab
        return offset.reshape(env.num_envs, -1)
    offset = offset - data.root_pos_w.torch.unsqueeze(1)
    root = data.root_quat_w.torch.unsqueeze(1).expand(-1, offset.shape[1], -1)
    return math_utils.quat_apply_inverse(root, offset).reshape(env.num_envs, -1)


def body_to_command_b(env: ManagerBasedRLEnv, command_name: str, asset_cfg: SceneEntityCfg) -> torch.Tensor:
    """From the chosen body to the commanded position, in the root's frame [m], (num_envs, 3). Not in Isaac Lab."""
    return env.command_manager.get_command(command_name)[:, :3] - body_pos_b(env, asset_cfg)[:, :3]


def position_command_error_gauss(
    env: ManagerBasedRLEnv, std: float, command_name: str, asset_cfg: SceneEntityCfg
) -> torch.Tensor:
    """``1 - exp(-(d / std)^2)`` of the distance from the commanded position, (num_envs,). Not in Isaac Lab.

    A penalty (give it a negative weight) for the last centimetres: it hardly changes far away, and its slope is
    largest at 0.7 ``std`` [m].
    """
    distance = position_command_error(env, command_name, asset_cfg)
    return 1.0 - torch.exp(-torch.square(distance / std))


def lidar_ranges(
    env: ManagerBasedRLEnv, sensor_cfg: SceneEntityCfg = SceneEntityCfg("lidar"), max_distance: float = 10.0
) -> torch.Tensor:
    """Distances that a lidar measures, divided by ``max_distance`` [m] and at most 1, (num_envs, R). Not in Isaac Lab.

    The kit's ``Lidar`` has the distances, Isaac Lab's ``RayCaster`` the points that the rays hit.
    """
    data = env.scene.sensors[sensor_cfg.name].data
    if hasattr(data, "ranges"):
        distance = data.ranges.torch
    else:
        distance = (data.ray_hits_w.torch - data.pos_w.torch.unsqueeze(1)).norm(dim=-1)
    return torch.nan_to_num(distance / max_distance, nan=1.0, posinf=1.0).clamp(max=1.0)
