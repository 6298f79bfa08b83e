"""Curriculum: terms that make the task harder, or change it otherwise, as training goes on."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from robotbrain.rl.managers.manager_base import ManagerBase, ManagerTermBase
from robotbrain.rl.managers.manager_term_cfg import CurriculumTermCfg

if TYPE_CHECKING:
    from robotbrain.rl.envs.manager_based_rl_env import ManagerBasedRLEnv


class CurriculumManager(ManagerBase):
    """Runs the curriculum terms before each reset.

    Args:
        cfg: object or dictionary of :class:`CurriculumTermCfg`; ``None``: no curriculum.
        env: the environment.
    """

    kind = "curriculum"

    def __init__(self, cfg: object, env: ManagerBasedRLEnv) -> None:
        self._terms: dict[str, CurriculumTermCfg] = {}
        super().__init__(cfg, env)
        self._last: dict[str, Any] = {}

    @property
    def active_terms(self) -> list[str]:
        """Names of the terms."""
        return list(self._terms)

    def get_term_cfg(self, term_name: str) -> CurriculumTermCfg:
        """The configuration of a term.

        Raises:
            InputError: no such term.
        """
        if term_name not in self._terms:
            raise self._unknown(term_name, list(self._terms))
        return self._terms[term_name]

    def compute(self, env_ids: torch.Tensor | None = None) -> None:
        """Run the terms for environments that are about to be reset."""
        ids = slice(None) if env_ids is None else env_ids
        for name, term in self._terms.items():
            self._last[name] = term.func(self._env, ids, **term.params)

    def reset(self, env_ids: torch.Tensor | None = None) -> dict[str, Any]:
        """What the terms returned last: ``Curriculum/<term>``, or ``Curriculum/<term>/<key>`` for dictionaries."""
        log: dict[str, Any] = {}
        for name, value in self._last.items():
            if isinstance(value, dict):
                log.update({f"Curriculum/{name}/{key}": item for key, item in value.items()})
            elif value is not None:
                log[f"Curriculum/{name}"] = value.clone() if isinstance(value, torch.Tensor) else value
        for term in self._terms.values():
            if isinstance(term.func, ManagerTermBase):
                term.func.reset(env_ids)
        return log

    def _prepare_terms(self) -> None:
        for name, term in self._items(self.cfg):
            self._check_type(name, term, CurriculumTermCfg)
            self._resolve(name, term, leading=2)
            self._terms[name] = term
