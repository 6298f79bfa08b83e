"""Events of the kit's own. None of them is part of Isaac Lab; ``robotbrain rl export-isaaclab`` copies their source."""

# ruff: noqa: B008  (a SceneEntityCfg as default: the managers copy it for each term)
from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from robotbrain.rl.managers import ManagerTermBase, SceneEntityCfg

if TYPE_CHECKING:
    from robotbrain.rl.envs import ManagerBasedRLEnv


class randomize_motor_strength(ManagerTermBase):  # noqa: N801  (named like Isaac Lab's events)
    """Scale what the chosen joints' servos can do: stiffness, damping and the largest torque, by one factor per joint.

    Not in Isaac Lab. A motor whose winding is hot or whose battery is low gives less torque for the same command. The
    factor is uniform over ``strength_range``, each environment and joint its own, and starts from the model's values.
    """

    def __init__(self, cfg: Any, env: ManagerBasedRLEnv) -> None:
        super().__init__(cfg, env)
        low, high = cfg.params["strength_range"]
        if not 0 < low <= high:
            raise ValueError(f"strength_range: got {(low, high)}; expected (low, high) with 0 < low <= high")
        data: Any = env.scene[cfg.params["asset_cfg"].name].data
        self._stiffness = data.joint_stiffness.torch.clone()
        self._damping = data.joint_damping.torch.clone()
        self._effort = data.joint_effort_limits.torch.clone()

    def __call__(
        self,
        env: ManagerBasedRLEnv,
        env_ids: Any,
        strength_range: tuple[float, float],
        asset_cfg: SceneEntityCfg = SceneEntityCfg("robot"),
    ) -> None:
        """Draw and write the servos' parameters."""
        asset: Any = env.scene[asset_cfg.name]
        rows = torch.arange(env.num_envs, device=env.device) if env_ids is None else env_ids
        low, high = strength_range
        default = self._stiffness[rows][:, asset_cfg.joint_ids]
        share = torch.rand(default.shape, generator=getattr(env, "generator", None), device=env.device)
        strength = low + (high - low) * share
        where = {"joint_ids": asset_cfg.joint_ids, "env_ids": rows}
        asset.write_joint_stiffness_to_sim_index(stiffness=default * strength, **where)
        damping = self._damping[rows][:, asset_cfg.joint_ids] * strength
        asset.write_joint_damping_to_sim_index(damping=damping, **where)
        effort = self._effort[rows][:, asset_cfg.joint_ids] * strength
        asset.write_joint_effort_limit_to_sim_index(limits=effort, **where)
