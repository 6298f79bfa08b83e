"""Tiny environments with known answers, for the tests of PPO: the interface of a manager-based one, without physics."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from robotbrain.rl.ppo_cfg import RslRlMLPModelCfg, RslRlOnPolicyRunnerCfg, RslRlPpoAlgorithmCfg


def small_cfg(**changes: Any) -> RslRlOnPolicyRunnerCfg:
    """Return settings for a toy; ``changes`` are fields, dots for nested ones written as ``algorithm.gamma``."""
    cfg = RslRlOnPolicyRunnerCfg(
        seed=1,
        num_steps_per_env=16,
        max_iterations=4,
        obs_groups={"actor": ["policy"], "critic": ["policy"]},
        save_interval=2,
        experiment_name="toy",
        actor=RslRlMLPModelCfg(
            hidden_dims=[16],
            activation="elu",
            obs_normalization=True,
            distribution_cfg=RslRlMLPModelCfg.GaussianDistributionCfg(init_std=1.0),
        ),
        critic=RslRlMLPModelCfg(hidden_dims=[16], activation="elu", obs_normalization=True),
        algorithm=RslRlPpoAlgorithmCfg(
            num_learning_epochs=4,
            num_mini_batches=4,
            learning_rate=1e-3,
            schedule="adaptive",
            gamma=0.95,
            lam=0.95,
            entropy_coef=0.0,
            desired_kl=0.01,
            max_grad_norm=1.0,
            value_loss_coef=1.0,
            use_clipped_value_loss=True,
            clip_param=0.2,
        ),
    )
    cfg.from_dict(changes)
    return cfg


class PointEnv:
    """Points on a line that are pushed towards a goal; ``policy``: [goal - position, speed], (N, 2).

    Reward ``-|goal - position|`` each step; beyond 3 the episode is over, after ``limit`` steps the time is up.
    """

    def __init__(self, num_envs: int = 16, limit: int = 20, finite: bool = False) -> None:
        self.num_envs, self.max_episode_length = num_envs, limit
        self.cfg = SimpleNamespace(is_finite_horizon=finite, compute_final_obs=False)
        self.action_manager = SimpleNamespace(total_action_dim=1)
        self.observation_manager = object()
        self.generator = torch.Generator()
        self.device = torch.device("cpu")
        self.episode_length_buf = torch.zeros(num_envs, dtype=torch.long)
        self.state = torch.zeros(num_envs, 3)  # position, speed, goal
        self.obs_buf: dict[str, Tensor] = {}

    def _reset(self, rows: Tensor) -> None:
        self.state[rows] = torch.rand(len(rows), 3, generator=self.generator) * 2 - 1
        self.state[rows, 1] = 0
        self.episode_length_buf[rows] = 0

    def _obs(self) -> dict[str, Tensor]:
        self.obs_buf = {"policy": torch.stack([self.state[:, 2] - self.state[:, 0], self.state[:, 1]], dim=1)}
        return self.obs_buf

    def reset(self, seed: int | None = None) -> tuple[dict[str, Tensor], dict[str, Any]]:
        if seed is not None:
            self.generator.manual_seed(seed)
        self._reset(torch.arange(self.num_envs))
        return self._obs(), {}

    def step(self, action: Tensor) -> tuple[dict[str, Tensor], Tensor, Tensor, Tensor, dict[str, Any]]:
        self.state[:, 1] = 0.8 * self.state[:, 1] + 0.1 * action[:, 0].clamp(-2, 2)
        self.state[:, 0] += self.state[:, 1]
        self.episode_length_buf += 1
        distance = (self.state[:, 2] - self.state[:, 0]).abs()
        terminated = self.state[:, 0].abs() > 3
        time_outs = self.episode_length_buf >= self.max_episode_length
        extras: dict[str, Any] = {}
        done = terminated | time_outs
        if done.any():
            if self.cfg.compute_final_obs:
                extras["final_obs"] = {name: x.clone() for name, x in self._obs().items()}
            extras["log"] = {"distance": distance[done].mean()}
            self._reset(done.nonzero().squeeze(1))
        return self._obs(), -distance, terminated, time_outs, extras

    def state_dict(self) -> dict[str, Any]:
        return {
            "state": self.state.clone(),
            "clock": self.episode_length_buf.clone(),
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.state[:] = state["state"]
        self.episode_length_buf[:] = state["clock"]
        self.generator.set_state(state["generator"])


class ChainEnv(PointEnv):
    """A reward of 1 each step, whatever is done; ``policy`` is the number of steps so far, (N, 1)."""

    def _obs(self) -> dict[str, Tensor]:
        self.obs_buf = {"policy": self.episode_length_buf[:, None].float()}
        return self.obs_buf

    def step(self, action: Tensor) -> tuple[dict[str, Tensor], Tensor, Tensor, Tensor, dict[str, Any]]:
        obs, reward, terminated, time_outs, extras = super().step(torch.zeros_like(action))
        return obs, torch.ones_like(reward), torch.zeros_like(terminated), time_outs, extras


def mirror(env: Any, obs: Any, actions: Tensor | None) -> tuple[Any, Tensor | None]:
    """Left and right of :class:`PointEnv` swapped."""
    both = None if obs is None else {name: torch.cat([x, -x]) for name, x in obs.items()}
    return both, None if actions is None else torch.cat([actions, -actions])
