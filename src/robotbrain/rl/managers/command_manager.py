"""Commands: what the robot shall do, drawn anew from time to time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from robotbrain.rl.managers.manager_base import ManagerBase, ManagerTermBase
from robotbrain.rl.managers.manager_term_cfg import CommandTermCfg

if TYPE_CHECKING:
    from robotbrain.rl.envs.manager_based_rl_env import ManagerBasedRLEnv


class CommandTerm(ManagerTermBase):
    """A command; subclasses give ``command``, ``_resample_command``, ``_update_command`` and ``_update_metrics``.

    Args:
        cfg: its configuration.
        env: the environment.

    Attributes:
        metrics: quantities to log, (num_envs,) each; set to zero at resets, after their mean has been logged.
        time_left: until the command is drawn anew, (num_envs,) [s].
        command_counter: how often it was drawn in the episode, (num_envs,).
    """

    def __init__(self, cfg: CommandTermCfg, env: ManagerBasedRLEnv) -> None:
        super().__init__(cfg, env)
        self.metrics: dict[str, torch.Tensor] = {}
        self.time_left = torch.zeros(env.num_envs)
        self.command_counter = torch.zeros(env.num_envs, dtype=torch.long)

    @property
    def command(self) -> torch.Tensor:
        """The command, (num_envs, d)."""
        raise NotImplementedError

    def reset(self, env_ids: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
        """Draw new commands; returns the means of the metrics."""
        index = slice(None) if env_ids is None else np.asarray(env_ids)
        log: dict[str, torch.Tensor] = {}
        if metrics := self.metrics:
            values = [metric.numpy() for metric in metrics.values()]
            ended = torch.from_numpy(np.stack([value[index] for value in values]))
            log = dict(zip(metrics, ended.mean(1).unbind(), strict=True))
            for value in values:
                value[index] = 0.0
        self.command_counter.numpy()[index] = 0
        self._resample(torch.arange(self.num_envs) if env_ids is None else env_ids)
        return log

    def compute(self, dt: float) -> None:
        """Update metrics and command after ``dt`` seconds; draw anew where the time is up."""
        self._update_metrics()
        left = self.time_left.numpy()  # the same memory; numpy's calls on it cost a third of torch's
        left -= dt
        if np.minimum.reduce(left) <= 0.0:
            self._resample(torch.from_numpy(np.flatnonzero(left <= 0.0)))
        self._update_command()

    def _resample(self, env_ids: torch.Tensor) -> None:
        if len(env_ids):
            low, high = self.cfg.resampling_time_range
            draws = torch.rand(len(env_ids), generator=self._env.generator)
            rows = env_ids.numpy()
            self.time_left.numpy()[rows] = draws.numpy() * (high - low) + low
            self._resample_command(env_ids)
            self.command_counter.numpy()[rows] += 1

    def _resample_command(self, env_ids: torch.Tensor) -> None:
        raise NotImplementedError

    def _update_command(self) -> None:
        raise NotImplementedError

    def _update_metrics(self) -> None:
        raise NotImplementedError


class CommandManager(ManagerBase):
    """Keeps the commands.

    Args:
        cfg: object or dictionary of :class:`CommandTermCfg`; ``None``: no commands.
        env: the environment.
    """

    kind = "command"

    def __init__(self, cfg: object, env: ManagerBasedRLEnv) -> None:
        self._terms: dict[str, CommandTerm] = {}
        super().__init__(cfg, env)

    @property
    def active_terms(self) -> list[str]:
        """Names of the terms."""
        return list(self._terms)

    def get_term(self, name: str) -> CommandTerm:
        """A term.

        Raises:
            InputError: no such term.
        """
        found = self._terms.get(name)
        if found is None:
            raise self._unknown(name, list(self._terms))
        return found

    def get_command(self, name: str) -> torch.Tensor:
        """A command, (num_envs, d).

        Raises:
            InputError: no such term.
        """
        return self.get_term(name).command

    def get_term_cfg(self, name: str) -> CommandTermCfg:
        """The configuration of a term.

        Raises:
            InputError: no such term.
        """
        cfg: CommandTermCfg = self.get_term(name).cfg
        return cfg

    def reset(self, env_ids: torch.Tensor | None = None) -> dict[str, Any]:
        """Draw new commands; returns ``Metrics/<term>/<metric>``."""
        return {
            f"Metrics/{name}/{metric}": value
            for name, term in self._terms.items()
            for metric, value in term.reset(env_ids).items()
        }

    def compute(self, dt: float) -> None:
        """Update the commands after ``dt`` seconds."""
        for term in self._terms.values():
            term.compute(dt)

    def _prepare_terms(self) -> None:
        for name, cfg in self._items(self.cfg):
            self._check_type(name, cfg, CommandTermCfg)
            self._terms[name] = cfg.class_type(cfg, self._env)
