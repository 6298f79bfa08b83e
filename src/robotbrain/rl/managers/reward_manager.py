"""Rewards: the weighted sum of terms, and each term's sum over the episode."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from robotbrain.rl.managers.manager_base import ManagerBase, ManagerTermBase, check_rows, mean_of_rows
from robotbrain.rl.managers.manager_term_cfg import RewardTermCfg

if TYPE_CHECKING:
    from robotbrain.rl.envs.manager_based_rl_env import ManagerBasedRLEnv


class RewardManager(ManagerBase):
    """Computes the reward of a step: the sum of ``term * weight * dt``; terms with weight 0 are not evaluated.

    Args:
        cfg: object or dictionary of :class:`RewardTermCfg`.
        env: the environment.

    Raises:
        InputError: a term that is none, or that does not return (num_envs,).
    """

    kind = "reward"

    def __init__(self, cfg: object, env: ManagerBasedRLEnv) -> None:
        self._terms: dict[str, RewardTermCfg] = {}
        super().__init__(cfg, env)
        self._log_names = tuple(f"Episode_Reward/{name}" for name in self._terms)
        n = env.num_envs
        self._weights: tuple[float, ...] = ()
        self._dt = 0.0
        self._weight_column = torch.zeros(0, 1)
        self._step_terms = torch.zeros(len(self._terms), n)
        self._episode_sums = torch.zeros(len(self._terms), n)
        self._reward = torch.zeros(n)

    @property
    def active_terms(self) -> list[str]:
        """Names of the terms."""
        return list(self._terms)

    @property
    def step_reward(self) -> torch.Tensor:
        """Weighted terms of the last step per second, i.e. without ``dt``, (num_envs, terms)."""
        return self._step_terms.T

    @property
    def episode_sums(self) -> dict[str, torch.Tensor]:
        """Sum of ``term * weight * dt`` over the episode so far, (num_envs,) each."""
        return {name: self._episode_sums[i] for i, name in enumerate(self._terms)}

    def get_term_cfg(self, term_name: str) -> RewardTermCfg:
        """The configuration of a term; a changed weight counts from the next step.

        Raises:
            InputError: no such term.
        """
        if term_name not in self._terms:
            raise self._unknown(term_name, list(self._terms))
        return self._terms[term_name]

    def set_term_cfg(self, term_name: str, cfg: RewardTermCfg) -> None:
        """Replace the configuration of a term (with one that is resolved, as :meth:`get_term_cfg` gives it).

        Raises:
            InputError: no such term.
        """
        self.get_term_cfg(term_name)
        self._terms[term_name] = cfg

    def compute(self, dt: float) -> torch.Tensor:
        """The reward of a step of ``dt`` seconds, (num_envs,); a new tensor each time."""
        env = self._env
        self._dt = dt
        weights, values, rows = [], [], []
        for row, term in enumerate(self._terms.values()):
            weight = term.weight
            if weight != 0.0:
                weights.append(weight)
                values.append(term.func(env, **term.params))
                rows.append(row)
        if not values:
            self._reward = torch.zeros(self.num_envs)
            return self._reward
        if (*rows, *weights) != self._weights:
            self._adopt(rows, weights, values)
        if len(rows) == len(self._terms):
            torch.mul(torch.stack(values), self._weight_column, out=self._step_terms)
        else:
            self._step_terms.zero_()
            self._step_terms[rows] = torch.stack(values) * self._weight_column
        self._reward = torch.sum(self._step_terms, 0).mul_(dt)
        self._episode_sums.add_(self._step_terms, alpha=dt)
        return self._reward

    def forget(self, env_ids: torch.Tensor) -> list[str]:
        """Take back the last step's reward of environments whose state or reward was not finite.

        Returns:
            The names of the terms that were not finite.
        """
        terms = self._step_terms[:, env_ids]
        bad = ~torch.isfinite(terms).all(1)
        self._step_terms[:, env_ids] = 0.0
        self._reward[env_ids] = 0.0
        sums = self._episode_sums[:, env_ids] - self._dt * terms
        self._episode_sums[:, env_ids] = torch.where(torch.isfinite(sums), sums, 0.0)
        return [name for name, is_bad in zip(self._terms, bad.tolist(), strict=True) if is_bad]

    def reset(self, env_ids: torch.Tensor | None = None) -> dict[str, Any]:
        """Mean episode sums of the ended episodes per second of the longest episode; then start again at zero."""
        sums = mean_of_rows(self._episode_sums.T, env_ids)
        sums /= self._env.max_episode_length_s
        self._episode_sums[:, slice(None) if env_ids is None else env_ids] = 0.0
        for term in self._terms.values():
            if isinstance(term.func, ManagerTermBase):
                term.func.reset(env_ids)
        return dict(zip(self._log_names, sums.unbind(), strict=True))

    def _adopt(self, rows: list[int], weights: list[float], values: list[Any]) -> None:
        names = list(self._terms)
        for row, value in zip(rows, values, strict=True):
            check_rows(f"reward {names[row]!r}", value, self.num_envs, 1)
        self._weights = (*rows, *weights)
        self._weight_column = torch.tensor(weights, dtype=torch.float32).unsqueeze(1)

    def _prepare_terms(self) -> None:
        for name, term in self._items(self.cfg):
            self._check_type(name, term, RewardTermCfg)
            self._resolve(name, term)
            self._terms[name] = term
