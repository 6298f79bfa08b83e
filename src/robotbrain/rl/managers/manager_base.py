"""What all managers share: reading a configuration of terms, checking it and preparing it for calls."""

from __future__ import annotations

import copy
import inspect
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import torch

from robotbrain.errors import InputError
from robotbrain.rl.configclass import deep_copy, did_you_mean
from robotbrain.rl.managers.manager_term_cfg import ManagerTermBaseCfg
from robotbrain.rl.managers.scene_entity_cfg import SceneEntityCfg
from robotbrain.rl.managers.snapshot import capture, restore
from robotbrain.rl.scene.names import find_names

if TYPE_CHECKING:
    from robotbrain.rl.envs.manager_based_rl_env import ManagerBasedRLEnv


class ManagerTermBase:
    """A term that is a class: created once per environment object, called like a function, with memory of its own.

    Tensors and numbers that it keeps as attributes are part of the environment's state (see ``env.state_dict``).

    Args:
        cfg: configuration of the term; ``cfg.params`` is complete, its scene entities are resolved.
        env: the environment.
    """

    def __init__(self, cfg: Any, env: ManagerBasedRLEnv) -> None:
        self.cfg, self._env = cfg, env

    @property
    def num_envs(self) -> int:
        """Number of environments."""
        return self._env.num_envs

    @property
    def device(self) -> torch.device:
        """Where the tensors live."""
        return self._env.device

    @property
    def __name__(self) -> str:
        return self.__class__.__qualname__

    def reset(self, env_ids: torch.Tensor | None = None) -> Any:
        """Forget what belongs to the ended episodes of these environments (``None``: all)."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """The value of the term; arguments as of a function term."""
        raise NotImplementedError(f"{type(self).__name__} has no __call__")


class ManagerBase:
    """A set of named terms.

    Args:
        cfg: object or dictionary with the terms' configurations (copied); ``None`` terms are left out.
        env: the environment.
    """

    kind = "term"

    def __init__(self, cfg: object, env: ManagerBasedRLEnv) -> None:
        self.cfg = deep_copy(cfg)
        self._env = env
        self._prepare_terms()

    @property
    def num_envs(self) -> int:
        """Number of environments."""
        return self._env.num_envs

    @property
    def device(self) -> torch.device:
        """Where the tensors live."""
        return self._env.device

    @property
    def active_terms(self) -> Any:
        """Names of the terms."""
        raise NotImplementedError

    def reset(self, env_ids: torch.Tensor | None = None) -> dict[str, Any]:
        """Reset the terms; returns what is to be logged."""
        return {}

    def find_terms(self, name_keys: str | Sequence[str]) -> list[str]:
        """Names of the terms whose whole name matches (regular expressions).

        Raises:
            InputError: a pattern matches nothing.
        """
        names = self.active_terms
        flat = [n for group in names.values() for n in group] if isinstance(names, dict) else list(names)
        return find_names(name_keys, flat, what=self.kind)[1]

    def state_dict(self) -> dict[str, Any]:
        """Everything that a later run needs to continue."""
        state: dict[str, Any] = capture(self)
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`."""
        restore(self, state)

    def _prepare_terms(self) -> None:
        raise NotImplementedError

    def _items(self, cfg: object, skip: frozenset[str] = frozenset()) -> Iterator[tuple[str, Any]]:
        """Name and configuration of each term that is there."""
        items = cfg.items() if isinstance(cfg, dict) else vars(cfg).items() if cfg is not None else ()
        for name, term in items:
            if term is not None and name not in skip:
                yield name, term

    def _check_type(self, name: str, cfg: object, kind: type) -> None:
        if not isinstance(cfg, kind):
            raise InputError(
                f"{self.kind} {name!r}",
                given=type(cfg).__name__,
                expected=kind.__name__,
                fix=f"Write {name} = {kind.__name__}(...).",
            )
        cfg.validate(name)  # type: ignore[attr-defined]

    def _resolve(self, name: str, cfg: ManagerTermBaseCfg, leading: int = 1) -> None:
        """Fill in default parameters, resolve scene entities, create the term if it is a class.

        Args:
            name: of the term.
            cfg: of the term; changed in place.
            leading: number of positional arguments that the manager gives.
        """
        func: Any = cfg.func
        if inspect.isclass(func) and not issubclass(func, ManagerTermBase):
            raise InputError(
                f"{self.kind} {name!r}.func",
                given=func.__name__,
                expected="a function or a subclass of ManagerTermBase",
                fix="Derive the class from robotbrain.rl.managers.ManagerTermBase.",
            )
        if not callable(func):
            raise InputError(
                f"{self.kind} {name!r}.func", given=func, expected="a function", fix="Give func=mdp.some_term."
            )
        self._fill_in_params(name, cfg, func, leading)
        for key, value in cfg.params.items():
            if isinstance(value, SceneEntityCfg):
                try:
                    value.resolve(self._env.scene)
                except InputError as error:
                    raise InputError(
                        f"{self.kind} {name!r}, parameter {key!r}: {error.what}",
                        given=error.given,
                        expected=error.expected,
                        fix=error.fix,
                    ) from error
        if inspect.isclass(func):
            create: Any = cfg.func
            cfg.func = create(cfg, self._env)

    def _fill_in_params(self, name: str, cfg: ManagerTermBaseCfg, func: Callable[..., Any], leading: int) -> None:
        static: Any = func
        if inspect.isclass(func):
            static = static.__call__
        parameters = list(inspect.signature(static).parameters.values())[leading + inspect.isclass(func) :]
        if any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters):
            return
        named = {p.name: p for p in parameters if p.kind is not inspect.Parameter.VAR_POSITIONAL}
        for key in cfg.params:
            if key not in named:
                raise InputError(
                    f"{self.kind} {name!r}, parameter",
                    given=key,
                    expected=f"a parameter of {getattr(func, '__name__', func)}",
                    fix=did_you_mean(key, named),
                )
        missing = [k for k, p in named.items() if p.default is p.empty and k not in cfg.params]
        if missing:
            raise InputError(
                f"{self.kind} {name!r}, params",
                given=sorted(cfg.params),
                expected=f"also {missing}",
                fix=f"{getattr(func, '__name__', func)} has no default for {missing[0]!r}.",
            )
        for key, parameter in named.items():
            if key not in cfg.params:
                cfg.params[key] = copy.deepcopy(parameter.default)

    def _unknown(self, name: str, known: Sequence[str]) -> InputError:
        return InputError(self.kind, given=name, expected=f"the name of a {self.kind}", fix=did_you_mean(name, known))


def check_rows(what: str, value: object, num_envs: int, dim: int | None = None) -> torch.Tensor:
    """``value`` if it is a tensor with one row per environment.

    Raises:
        InputError: it is not.
    """
    expected = f"a tensor ({num_envs},)" if dim == 1 else f"a tensor ({num_envs}, ...)"
    if not isinstance(value, torch.Tensor):
        raise InputError(what, given=type(value).__name__, expected=expected, fix="Return a torch tensor.")
    if value.ndim == 0 or value.shape[0] != num_envs or (dim is not None and value.ndim != dim):
        raise InputError(
            what, given=tuple(value.shape), expected=expected, fix="The first dimension is the environments'."
        )
    return value


def mean_of_rows(values: torch.Tensor, env_ids: torch.Tensor | None) -> torch.Tensor:
    """Mean over some environments."""
    return (values if env_ids is None else values[env_ids]).float().mean(0)
