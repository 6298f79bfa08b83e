"""Observations: groups of terms, each computed, corrupted, clipped, scaled, delayed and remembered, in this order."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import torch

from robotbrain.errors import InputError
from robotbrain.rl.configclass import did_you_mean
from robotbrain.rl.managers.buffers import DelayBuffer, HistoryBuffer
from robotbrain.rl.managers.manager_base import ManagerBase, ManagerTermBase, check_rows
from robotbrain.rl.managers.manager_term_cfg import ObservationGroupCfg, ObservationTermCfg
from robotbrain.rl.noise_cfg import NoiseCfg, UniformNoiseCfg

if TYPE_CHECKING:
    from robotbrain.rl.envs.manager_based_rl_env import ManagerBasedRLEnv

_SETTINGS = frozenset(f.name for f in fields(ObservationGroupCfg))
Observation = torch.Tensor | dict[str, torch.Tensor]


class ObservationManager(ManagerBase):
    """Computes the groups of observations.

    Args:
        cfg: object or dictionary of :class:`ObservationGroupCfg`.
        env: the environment.

    Raises:
        InputError: no groups, a term without a row per environment, terms that cannot be concatenated, or a scale
            of another length than its term.
    """

    kind = "observation"

    def __init__(self, cfg: object, env: ManagerBasedRLEnv) -> None:
        self._groups: dict[str, _Group] = {}
        super().__init__(cfg, env)
        if not self._groups:
            raise InputError(
                "observations", given=cfg, expected="at least one group", fix="Add a group, usually named 'policy'."
            )

    @property
    def active_terms(self) -> dict[str, list[str]]:
        """Names of the terms of each group."""
        return {name: list(group.terms) for name, group in self._groups.items()}

    @property
    def group_obs_dim(self) -> dict[str, tuple[int, ...] | list[tuple[int, ...]]]:
        """Shape of each group's observation for one environment (a list of them where it is a dictionary)."""
        return {
            name: group.shape if group.cfg.concatenate_terms else group.shapes for name, group in self._groups.items()
        }

    @property
    def group_obs_term_dim(self) -> dict[str, list[tuple[int, ...]]]:
        """Shapes of each group's terms for one environment."""
        return {name: list(group.shapes) for name, group in self._groups.items()}

    @property
    def group_obs_concatenate(self) -> dict[str, bool]:
        """Whether each group is one tensor."""
        return {name: group.cfg.concatenate_terms for name, group in self._groups.items()}

    def get_term_cfg(self, group_name: str, term_name: str) -> ObservationTermCfg:
        """The configuration of a term.

        Raises:
            InputError: no such term.
        """
        terms = self._group(group_name).terms
        if term_name not in terms:
            raise self._unknown(term_name, list(terms))
        return terms[term_name]

    def reset(self, env_ids: torch.Tensor | None = None) -> dict[str, Any]:
        """Reset class terms, delays and histories."""
        for group in self._groups.values():
            group.reset(env_ids)
        return {}

    def compute(self, update_history: bool = False) -> dict[str, Observation]:
        """All groups; only with ``update_history`` delays and histories take the present sample in."""
        return {name: self.compute_group(name, update_history) for name in self._groups}

    def peek(self) -> dict[str, Observation]:
        """All groups as a step would return them, the present sample taken in, and nothing remembered of it.

        The last observation of an episode: with a delay or a history :meth:`compute` alone returns the previous step's.
        """
        if not any(group.has_memory for group in self._groups.values()):
            return self.compute()
        kept = self.state_dict()
        seen = self.compute(update_history=True)
        self.load_state_dict(kept)
        return seen

    def compute_group(self, group_name: str, update_history: bool = False) -> Observation:
        """One group: (num_envs, dim), or a dictionary where it is not concatenated; new tensors each time.

        Raises:
            InputError: no such group, or a term that is not finite.
        """
        return self._group(group_name).compute(self._env, update_history)

    def _group(self, name: str) -> _Group:
        if name not in self._groups:
            raise InputError("observation group", given=name, expected="a group", fix=did_you_mean(name, self._groups))
        return self._groups[name]

    def _prepare_terms(self) -> None:
        for group_name, group_cfg in self._items(self.cfg):
            self._check_type(group_name, group_cfg, ObservationGroupCfg)
            terms: dict[str, ObservationTermCfg] = {}
            for name, term in self._items(group_cfg, _SETTINGS):
                label = f"{group_name}/{name}"
                self._check_type(label, term, ObservationTermCfg)
                term.validate_config()
                if not group_cfg.enable_corruption:
                    term.noise = None
                if group_cfg.history_length is not None:
                    term.history_length = group_cfg.history_length
                    term.flatten_history_dim = group_cfg.flatten_history_dim
                self._resolve(label, term)
                terms[name] = term
            if not terms:
                raise InputError(
                    f"observation group {group_name!r}", given={}, expected="at least one term", fix="Add one."
                )
            self._groups[group_name] = _Group(group_name, group_cfg, terms, self._env)

    def state_dict(self) -> dict[str, Any]:
        """Memory of terms, delays and histories."""
        from robotbrain.rl.managers.snapshot import capture

        return {name: capture(group) for name, group in self._groups.items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`."""
        from robotbrain.rl.managers.snapshot import restore

        for name, group in self._groups.items():
            restore(group, state[name])


class _Group:
    """The terms of a group and what they need between steps."""

    def __init__(
        self, name: str, cfg: ObservationGroupCfg, terms: dict[str, ObservationTermCfg], env: ManagerBasedRLEnv
    ) -> None:
        self.name, self.cfg, self.terms = name, cfg, terms
        self.delays: dict[str, DelayBuffer] = {}
        self.histories: dict[str, HistoryBuffer] = {}
        self.shapes: list[tuple[int, ...]] = []
        raw_shapes = {}
        for term_name, term in terms.items():
            value = check_rows(f"observation {name}/{term_name}", term.func(env, **term.params), env.num_envs)
            raw_shapes[term_name] = shape = tuple(value.shape[1:])
            self._prepare_scale(term_name, term, shape)
            if term.delay_max_lag > 0:
                self.delays[term_name] = DelayBuffer(
                    term.delay_min_lag, term.delay_max_lag, term.delay_hold_prob, env.num_envs, shape, env.generator
                )
            if term.history_length > 0:
                self.histories[term_name] = HistoryBuffer(term.history_length, env.num_envs, shape)
                shape = (term.history_length, *shape)
                shape = (math.prod(shape),) if term.flatten_history_dim else shape
            self.shapes.append(shape)
            if isinstance(term.func, ManagerTermBase):
                term.func.reset()
        self._dim = cfg.concatenate_dim + 1 if cfg.concatenate_dim >= 0 else cfg.concatenate_dim
        self.shape = self._joint_shape()
        simple = cfg.concatenate_terms and not self.has_memory and all(len(s) == 1 for s in raw_shapes.values())
        self._fused = _Fused(terms, raw_shapes) if simple else None

    def reset(self, env_ids: torch.Tensor | None) -> None:
        for name, term in self.terms.items():
            if isinstance(term.func, ManagerTermBase):
                term.func.reset(env_ids)
            if name in self.delays:
                self.delays[name].reset(env_ids)
            if name in self.histories:
                self.histories[name].reset(env_ids)

    def compute(self, env: ManagerBasedRLEnv, record: bool) -> Observation:
        if self._fused is not None:
            values, joint = self._fused.compute(env)
            if not math.isfinite(joint.sum().item()):
                self._complain(dict(zip(self.terms, values, strict=True)))
            return joint
        values_by_name = {name: self._process(name, term, env, record) for name, term in self.terms.items()}
        if not math.isfinite(sum(v.sum().item() for v in values_by_name.values())):
            self._complain(values_by_name)
        if not self.cfg.concatenate_terms:
            return values_by_name
        if self._time_major():
            length = self.cfg.history_length or 1
            parts = [v.reshape(env.num_envs, length, -1) for v in values_by_name.values()]
            return torch.cat(parts, -1).reshape(env.num_envs, -1)
        return torch.cat(list(values_by_name.values()), self._dim)

    def _process(self, name: str, term: ObservationTermCfg, env: ManagerBasedRLEnv, record: bool) -> torch.Tensor:
        source: torch.Tensor = term.func(env, **term.params)
        value = source
        if term.noise is not None:
            value = term.noise.func(value, term.noise, env.generator)
        if term.clip is not None:
            value = value.clamp(*term.clip)
        if term.scale is not None:
            value = value * torch.as_tensor(term.scale)
        if name in self.delays:
            value = self.delays[name].compute(value, record)
        if name in self.histories:
            value = self.histories[name].compute(value, record)
            if term.flatten_history_dim:
                value = value.flatten(1)
        return value.clone() if value is source else value

    def _prepare_scale(self, name: str, term: ObservationTermCfg, shape: tuple[int, ...]) -> None:
        if term.scale is None:
            return
        scale = torch.as_tensor(term.scale, dtype=torch.float32)
        if scale.ndim > 1 or (scale.ndim == 1 and scale.shape[0] != (shape[-1] if shape else 0)):
            raise InputError(
                f"observation {self.name}/{name}.scale",
                given=term.scale,
                expected=f"one number, or {shape[-1] if shape else 0} of them",
                fix="The term has this many components.",
            )
        term.scale = scale  # type: ignore[assignment]

    @property
    def has_memory(self) -> bool:
        """Whether a term of the group has a delay or a history."""
        return bool(self.delays or self.histories)

    def _time_major(self) -> bool:
        cfg = self.cfg
        return bool(cfg.history_order == "time" and cfg.history_length and cfg.flatten_history_dim)

    def _joint_shape(self) -> tuple[int, ...]:
        if not self.cfg.concatenate_terms:
            return ()
        axis = self._dim - 1 if self._dim > 0 else self._dim
        joint = list(self.shapes[0])
        try:
            others = [s[:axis] + s[axis:][1:] for s in ([*shape, 0][:-1] for shape in self.shapes)]
            if any(o != others[0] for o in others) or not joint:
                raise IndexError
            joint[axis] = sum(shape[axis] for shape in self.shapes)
        except IndexError:
            raise InputError(
                f"observation group {self.name!r}",
                given=dict(zip(self.terms, self.shapes, strict=True)),
                expected="terms (num_envs, dim) that can be concatenated",
                fix="Return 2-D tensors, or set concatenate_terms = False.",
            ) from None
        return tuple(joint)

    def _complain(self, values: dict[str, torch.Tensor]) -> None:
        for name, value in values.items():
            bad = ~torch.isfinite(value.flatten(1)).all(1)
            if bad.any():
                raise InputError(
                    f"observation {self.name}/{name}",
                    given=f"values that are not finite in environment {int(bad.nonzero()[0])}",
                    expected="finite numbers",
                    fix="The state is finite: look for divisions, roots and logarithms in this term.",
                )


class _Fused:
    """Noise, clip and scale of all terms of a group at once, on the concatenated tensor (same result, fewer calls).

    Noise that is not added uniform noise is applied term by term, before that.
    """

    def __init__(self, terms: dict[str, ObservationTermCfg], shapes: dict[str, tuple[int, ...]]) -> None:
        self._terms = [(term, self._noise_of_its_own(term)) for term in terms.values()]
        columns: list[list[torch.Tensor]] = []
        for (name, term), (_, own) in zip(terms.items(), self._terms, strict=True):
            uniform = term.noise if isinstance(term.noise, UniformNoiseCfg) and own is None else None
            bounds = (uniform.n_min, uniform.n_max) if uniform else (0.0, 0.0)
            clip = term.clip or (-math.inf, math.inf)
            scale = 1.0 if term.scale is None else torch.as_tensor(term.scale)
            columns.append([torch.ones(shapes[name]) * value for value in (*bounds, *clip, scale)])
        low, high, least, most, factor = (torch.cat(column) for column in zip(*columns, strict=True))
        is_noisy = bool(low.any()) or bool(high.any())
        is_clipped = not bool(torch.isinf(torch.cat((least, most))).all())
        self._noise = torch.stack((low, high - low)) if is_noisy else None
        self._clip = torch.stack((least, most)) if is_clipped else None
        self._scale = factor if bool((factor != 1).any()) else None

    @staticmethod
    def _noise_of_its_own(term: ObservationTermCfg) -> NoiseCfg | None:
        noise = term.noise
        return None if noise is None or (isinstance(noise, UniformNoiseCfg) and noise.operation == "add") else noise

    def compute(self, env: ManagerBasedRLEnv) -> tuple[list[torch.Tensor], torch.Tensor]:
        """The terms as they are, and the group's observation."""
        values: list[torch.Tensor] = [term.func(env, **term.params) for term, _ in self._terms]
        noisy = [
            v if own is None else own.func(v, own, env.generator)
            for v, (_, own) in zip(values, self._terms, strict=True)
        ]
        return values, self._process(torch.cat(noisy, 1), env.generator)

    def _process(self, joint: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        if self._noise is not None:
            draws = torch.empty_like(joint).uniform_(generator=generator)
            joint += draws.mul_(self._noise[1]).add_(self._noise[0])
        if self._clip is not None:
            torch.clamp(joint, self._clip[0], self._clip[1], out=joint)
        if self._scale is not None:
            joint *= self._scale
        return joint
