"""Terminations: which episodes have ended, at a terminal state or because time is up."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from robotbrain.rl.managers.manager_base import ManagerBase, ManagerTermBase, check_rows
from robotbrain.rl.managers.manager_term_cfg import TerminationTermCfg

if TYPE_CHECKING:
    from robotbrain.rl.envs.manager_based_rl_env import ManagerBasedRLEnv


class TerminationManager(ManagerBase):
    """Computes the signals that end episodes.

    Args:
        cfg: object or dictionary of :class:`TerminationTermCfg`.
        env: the environment.
    """

    kind = "termination"

    def __init__(self, cfg: object, env: ManagerBasedRLEnv) -> None:
        self._terms: dict[str, TerminationTermCfg] = {}
        super().__init__(cfg, env)
        self._log_names = tuple(f"Episode_Termination/{name}" for name in self._terms)
        n = env.num_envs
        self._term_dones = torch.zeros(len(self._terms), n, dtype=torch.bool)
        self._last_episode_dones = torch.zeros(len(self._terms), n, dtype=torch.bool)
        self._terminated = torch.zeros(n, dtype=torch.bool)
        self._time_outs = torch.zeros(n, dtype=torch.bool)
        self._checked = False

    @property
    def active_terms(self) -> list[str]:
        """Names of the terms."""
        return list(self._terms)

    @property
    def terminated(self) -> torch.Tensor:
        """Which environments reached a terminal state, (num_envs,) bool."""
        return self._terminated

    @property
    def time_outs(self) -> torch.Tensor:
        """Which environments were cut off, (num_envs,) bool."""
        return self._time_outs

    @property
    def dones(self) -> torch.Tensor:
        """Which environments ended either way, (num_envs,) bool."""
        return self._terminated | self._time_outs

    def get_term(self, name: str) -> torch.Tensor:
        """A term's value at the last step, (num_envs,) bool.

        Raises:
            InputError: no such term.
        """
        self.get_term_cfg(name)
        return self._term_dones[list(self._terms).index(name)]

    def get_term_cfg(self, term_name: str) -> TerminationTermCfg:
        """The configuration of a term.

        Raises:
            InputError: no such term.
        """
        if term_name not in self._terms:
            raise self._unknown(term_name, list(self._terms))
        return self._terms[term_name]

    def set_term_cfg(self, term_name: str, cfg: TerminationTermCfg) -> None:
        """Replace the configuration of a term (with one that is resolved).

        Raises:
            InputError: no such term.
        """
        self.get_term_cfg(term_name)
        self._terms[term_name] = cfg

    def compute(self, diverged: torch.Tensor | None = None) -> torch.Tensor:
        """Which episodes have ended, (num_envs,) bool; diverged environments always terminate."""
        values = [term.func(self._env, **term.params) for term in self._terms.values()]
        if not self._checked:
            for name, value in zip(self._terms, values, strict=True):
                check_rows(f"termination {name!r}", value, self.num_envs, 1)
            self._checked = True
        if values:
            torch.stack(values, out=self._term_dones)
        kinds = [term.time_out for term in self._terms.values()]
        self._time_outs = self._any([v for v, is_time_out in zip(values, kinds, strict=True) if is_time_out])
        self._terminated = self._any([v for v, is_time_out in zip(values, kinds, strict=True) if not is_time_out])
        if diverged is not None:
            self._terminated = self._terminated | diverged
        return self.dones

    def _any(self, values: list[torch.Tensor]) -> torch.Tensor:
        """Where any of the values holds: a tensor of its own."""
        if not values:
            return torch.zeros(self.num_envs, dtype=torch.bool)
        found = values[0] | values[-1]
        for value in values[1:-1]:
            found |= value
        return found

    def end(self, env_ids: torch.Tensor) -> None:
        """Terminate environments for a reason that is no term's."""
        self._terminated[env_ids] = True

    def reset(self, env_ids: torch.Tensor | None = None) -> dict[str, Any]:
        """For each term the part of all environments whose last episode it ended."""
        dones, last = self._term_dones.numpy(), self._last_episode_dones.numpy()  # a third of torch's cost per call
        rows = slice(None) if env_ids is None else np.asarray(env_ids)
        fired = dones[:, rows]
        last[:, rows] = np.where(fired.any(0), fired, last[:, rows])
        rates = self._last_episode_dones.float().mean(1)
        for term in self._terms.values():
            if isinstance(term.func, ManagerTermBase):
                term.func.reset(env_ids)
        return dict(zip(self._log_names, rates.unbind(), strict=True))

    def _prepare_terms(self) -> None:
        for name, term in self._items(self.cfg):
            self._check_type(name, term, TerminationTermCfg)
            self._resolve(name, term)
            self._terms[name] = term
