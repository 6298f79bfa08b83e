"""Events: what changes the simulation from outside, once at the start, at resets, or at intervals."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from robotbrain.errors import InputError
from robotbrain.rl.managers.manager_base import ManagerBase, ManagerTermBase
from robotbrain.rl.managers.manager_term_cfg import EventTermCfg

if TYPE_CHECKING:
    from robotbrain.rl.envs.manager_based_rl_env import ManagerBasedRLEnv

_ROUNDING_S = 1.0e-6


class EventManager(ManagerBase):
    """Applies events by mode.

    Args:
        cfg: object or dictionary of :class:`EventTermCfg`; ``None``: no events.
        env: the environment.

    Raises:
        InputError: an interval event without ``interval_range_s``, or one that makes no sense.
    """

    kind = "event"

    def __init__(self, cfg: object, env: ManagerBasedRLEnv) -> None:
        self._modes: dict[str, dict[str, EventTermCfg]] = {}
        self._clock = 0.0  # [s]; timers are absolute, so that a step in which none is due costs next to nothing
        self._due: dict[str, torch.Tensor] = {}
        self._next_due: dict[str, float] = {}
        self._last_step: dict[str, torch.Tensor] = {}
        super().__init__(cfg, env)

    @property
    def active_terms(self) -> dict[str, list[str]]:
        """Names of the terms of each mode."""
        return {mode: list(terms) for mode, terms in self._modes.items()}

    @property
    def available_modes(self) -> list[str]:
        """The modes that have terms."""
        return list(self._modes)

    def get_term_cfg(self, term_name: str) -> EventTermCfg:
        """The configuration of a term.

        Raises:
            InputError: no such term.
        """
        for terms in self._modes.values():
            if term_name in terms:
                return terms[term_name]
        raise self._unknown(term_name, [n for terms in self._modes.values() for n in terms])

    def set_term_cfg(self, term_name: str, cfg: EventTermCfg) -> None:
        """Replace the configuration of a term (with one that is resolved, of the same mode).

        Raises:
            InputError: no such term.
        """
        self._modes[self.get_term_cfg(term_name).mode][term_name] = cfg

    def reset(self, env_ids: torch.Tensor | None = None) -> dict[str, Any]:
        """Reset class terms and draw the interval timers of these environments anew."""
        for terms in self._modes.values():
            for term in terms.values():
                if isinstance(term.func, ManagerTermBase):
                    term.func.reset(env_ids)
        for name, term in self._modes.get("interval", {}).items():
            if term.resample_interval_on_reset and not term.is_global_time:
                count = self.num_envs if env_ids is None else len(env_ids)
                self._due[name][slice(None) if env_ids is None else env_ids] = self._draw(term, count)
                self._next_due[name] = self._due[name].min().item()
        return {}

    def apply(
        self,
        mode: str,
        env_ids: torch.Tensor | None = None,
        dt: float | None = None,
        global_env_step_count: int | None = None,
    ) -> None:
        """Run the events of a mode.

        Args:
            mode: ``"startup"``, ``"reset"``, ``"interval"``, or one of your own.
            env_ids: the environments; ``None``: all. Interval events find theirs themselves.
            dt: time since the last call [s] (``"interval"``).
            global_env_step_count: control steps so far (``"reset"``).

        Raises:
            InputError: an argument that the mode needs is missing.
        """
        if mode == "interval":
            if dt is None:
                raise InputError("dt", given=None, expected="seconds", fix="Give dt for interval events.")
            self._clock += dt
        for name, term in self._modes.get(mode, {}).items():
            if mode == "interval":
                if self._next_due[name] < self._clock + _ROUNDING_S:
                    self._apply_interval(name, term)
            elif mode == "reset":
                if global_env_step_count is None:
                    raise InputError(
                        "global_env_step_count", given=None, expected="a number", fix="Give it for reset events."
                    )
                self._apply_reset(name, term, env_ids, global_env_step_count)
            else:
                term.func(self._env, env_ids, **term.params)

    def _apply_interval(self, name: str, term: EventTermCfg) -> None:
        timers = self._due[name]
        due = (timers < self._clock + _ROUNDING_S).nonzero().flatten()
        timers[due] = self._draw(term, len(due))
        self._next_due[name] = timers.min().item()
        term.func(self._env, None if term.is_global_time else due, **term.params)

    def _apply_reset(self, name: str, term: EventTermCfg, env_ids: torch.Tensor | None, step: int) -> None:
        if term.min_step_count_between_reset > 0:
            ids = torch.arange(self.num_envs) if env_ids is None else env_ids
            last = self._last_step[name]
            env_ids = ids[(last[ids] < 0) | (step - last[ids] >= term.min_step_count_between_reset)]
            if not len(env_ids):
                return
            last[env_ids] = step
        term.func(self._env, env_ids, **term.params)

    def _draw(self, term: EventTermCfg, count: int) -> torch.Tensor:
        assert term.interval_range_s is not None
        low, high = term.interval_range_s
        draws = torch.rand(count, generator=self._env.generator, dtype=torch.float64)
        return draws * (high - low) + (low + self._clock)

    def _prepare_terms(self) -> None:
        for name, term in self._items(self.cfg):
            self._check_type(name, term, EventTermCfg)
            if term.mode == "interval" and (
                term.interval_range_s is None or not 0 < term.interval_range_s[0] <= term.interval_range_s[1]
            ):
                raise InputError(
                    f"event {name!r}.interval_range_s",
                    given=term.interval_range_s,
                    expected="two times with 0 < low <= high [s]",
                    fix="Give e.g. interval_range_s=(10.0, 15.0).",
                )
            if term.min_step_count_between_reset < 0:
                raise InputError(
                    f"event {name!r}.min_step_count_between_reset",
                    given=term.min_step_count_between_reset,
                    expected="0 or more",
                    fix="0 applies the event at every reset.",
                )
            self._resolve(name, term, leading=2)
            self._modes.setdefault(term.mode, {})[name] = term
            if term.mode == "interval":
                self._due[name] = self._draw(term, 1 if term.is_global_time else self.num_envs)
                self._next_due[name] = self._due[name].min().item()
            elif term.mode == "reset":
                self._last_step[name] = torch.full((self.num_envs,), -1, dtype=torch.long)
