"""Actions: the policy's output is split among terms that turn it into commands of joints."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import torch

from robotbrain.errors import InputError
from robotbrain.rl.managers.manager_base import ManagerBase, ManagerTermBase
from robotbrain.rl.managers.manager_term_cfg import ActionTermCfg

if TYPE_CHECKING:
    from robotbrain.rl.envs.manager_based_rl_env import ManagerBasedRLEnv


class ActionTerm(ManagerTermBase):
    """Part of the action.

    Args:
        cfg: its configuration.
        env: the environment.

    Attributes:
        apply_every_substep: whether ``apply_actions`` has to run before every physics step. Else it runs once per
            control step and the physics steps of that one are computed in one go, which is faster.
    """

    apply_every_substep: bool = False

    def __init__(self, cfg: ActionTermCfg, env: ManagerBasedRLEnv) -> None:
        super().__init__(cfg, env)
        self._asset = env.scene[cfg.asset_name]

    @property
    def action_dim(self) -> int:
        """Number of the action's components that this term takes."""
        raise NotImplementedError

    @property
    def raw_actions(self) -> torch.Tensor:
        """The action as given, (num_envs, action_dim)."""
        raise NotImplementedError

    @property
    def processed_actions(self) -> torch.Tensor:
        """The action as applied (scaled, offset, clipped), (num_envs, joints)."""
        raise NotImplementedError

    def process_actions(self, actions: torch.Tensor) -> None:
        """Take (num_envs, action_dim); called once per control step. Copy what you keep."""
        raise NotImplementedError

    def apply_actions(self) -> None:
        """Write the commands to the asset."""
        raise NotImplementedError


class ActionManager(ManagerBase):
    """Splits actions among the terms.

    Args:
        cfg: object or dictionary of :class:`ActionTermCfg`.
        env: the environment.

    Raises:
        InputError: no terms.
    """

    kind = "action"

    def __init__(self, cfg: object, env: ManagerBasedRLEnv) -> None:
        self._terms: dict[str, ActionTerm] = {}
        super().__init__(cfg, env)
        if not self._terms:
            raise InputError("actions", given=cfg, expected="at least one term", fix="Add e.g. JointPositionActionCfg.")
        self._dims = [term.action_dim for term in self._terms.values()]
        self._action = torch.zeros(env.num_envs, sum(self._dims))
        self._prev_action = torch.zeros_like(self._action)
        self._parts = torch.split(self._action, self._dims, 1)

    @property
    def active_terms(self) -> list[str]:
        """Names of the terms."""
        return list(self._terms)

    @property
    def apply_every_substep(self) -> bool:
        """Whether a term has to run before every physics step (an event that brings latency may change that)."""
        return any(term.apply_every_substep for term in self._terms.values())

    @property
    def total_action_dim(self) -> int:
        """Number of components of the action."""
        return self._action.shape[1]

    @property
    def action_term_dim(self) -> list[int]:
        """Number of components of each term."""
        return list(self._dims)

    @property
    def action(self) -> torch.Tensor:
        """The last action as given, (num_envs, total_action_dim); zero after a reset."""
        return self._action

    @property
    def prev_action(self) -> torch.Tensor:
        """The action before the last, (num_envs, total_action_dim); zero after a reset."""
        return self._prev_action

    def get_term(self, name: str) -> ActionTerm:
        """A term.

        Raises:
            InputError: no such term.
        """
        found = self._terms.get(name)
        if found is None:
            raise self._unknown(name, list(self._terms))
        return found

    def process_action(self, action: torch.Tensor) -> None:
        """Take the action of a control step, (num_envs, total_action_dim).

        Raises:
            InputError: another shape, or components that are not finite.
        """
        if action.shape != self._action.shape:
            raise InputError(
                "action",
                given=tuple(action.shape),
                expected=f"{tuple(self._action.shape)}: one row per environment",
                fix="Check the policy's output and the number of environments.",
            )
        if not math.isfinite(action.sum().item()):
            self._check_finite(action)
        self._prev_action.copy_(self._action)
        self._action.copy_(action)
        for term, part in zip(self._terms.values(), self._parts, strict=True):
            term.process_actions(part)

    def apply_action(self) -> None:
        """Write the commands to the assets."""
        for term in self._terms.values():
            term.apply_actions()

    def reset(self, env_ids: torch.Tensor | None = None) -> dict[str, Any]:
        """Forget the actions of these environments."""
        index = slice(None) if env_ids is None else env_ids
        self._action[index] = 0.0
        self._prev_action[index] = 0.0
        for term in self._terms.values():
            term.reset(env_ids)
        return {}

    def _check_finite(self, action: torch.Tensor) -> None:
        for (name, part), start in zip(
            zip(self._terms, torch.split(action, self._dims, 1), strict=True),
            torch.tensor([0, *self._dims]).cumsum(0).tolist(),
            strict=False,
        ):
            bad = (~torch.isfinite(part)).nonzero()
            if len(bad):
                env, column = bad[0].tolist()
                raise InputError(
                    f"action of environment {env}, term {name!r}, component {start + column}",
                    given=float(part[env, column]),
                    expected="a finite number",
                    fix="The policy's weights or its observations are not finite: look for a training that diverged.",
                )

    def _prepare_terms(self) -> None:
        for name, cfg in self._items(self.cfg):
            self._check_type(name, cfg, ActionTermCfg)
            self._terms[name] = cfg.class_type(cfg, self._env)
