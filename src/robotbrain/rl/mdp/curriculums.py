"""Curriculum terms: change the task as training goes on; those of ``isaaclab.envs.mdp.curriculums`` 3.0."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

from robotbrain.errors import InputError
from robotbrain.rl.managers import ManagerTermBase

if TYPE_CHECKING:
    from robotbrain.rl.envs import ManagerBasedRLEnv
    from robotbrain.rl.managers import CurriculumTermCfg


class modify_reward_weight(ManagerTermBase):  # noqa: N801  (Isaac Lab's name)
    """After ``num_steps`` environment steps give the reward term ``term_name`` another weight."""

    def __init__(self, cfg: CurriculumTermCfg, env: ManagerBasedRLEnv) -> None:
        super().__init__(cfg, env)
        self._term_cfg = env.reward_manager.get_term_cfg(cfg.params["term_name"])

    def __call__(self, env: ManagerBasedRLEnv, env_ids: Any, term_name: str, weight: float, num_steps: int) -> float:
        """Return the term's weight, for the log."""
        if env.common_step_counter > num_steps:
            self._term_cfg.weight = weight
            env.reward_manager.set_term_cfg(term_name, self._term_cfg)
        return float(self._term_cfg.weight)


class modify_env_param(ManagerTermBase):  # noqa: N801  (Isaac Lab's name)
    """Replace something inside the environment by what a function makes of it.

    ``address`` is a path from the environment on: attributes, keys of dictionaries and ``name[index]``, e.g.
    ``"event_manager.cfg.push.params"``. ``modify_fn(env, env_ids, old, **modify_params)`` returns the new value, or
    ``modify_env_param.NO_CHANGE``.
    """

    NO_CHANGE: ClassVar[object] = object()

    def __init__(self, cfg: CurriculumTermCfg, env: ManagerBasedRLEnv) -> None:
        super().__init__(cfg, env)
        if "address" not in cfg.params:
            raise InputError(
                f"{type(self).__name__}: params",
                given=sorted(cfg.params),
                expected="'address', 'modify_fn' and perhaps 'modify_params'",
                fix="Say with address= what shall change.",
            )
        self._address = str(cfg.params["address"])
        self._path: list[str | int] | None = None

    def __call__(
        self,
        env: ManagerBasedRLEnv,
        env_ids: Any,
        address: str,
        modify_fn: Callable[..., Any],
        modify_params: dict[str, Any] | None = None,
    ) -> None:
        """Read, modify, write back."""
        if self._path is None:  # resolved late: the managers exist by now
            self._path = _parse(self._address)
        *way, last = self._path
        holder: Any = env
        for step in way:
            holder = _get(holder, step, self._address)
        new = modify_fn(env, env_ids, _get(holder, last, self._address), **(modify_params or {}))
        if new is not self.NO_CHANGE:
            _set(holder, last, new, self._address)


class modify_term_cfg(modify_env_param):  # noqa: N801  (Isaac Lab's name)
    """:class:`modify_env_param` for a term's configuration, e.g. ``"commands.pose.ranges.pos_x"``."""

    def __init__(self, cfg: CurriculumTermCfg, env: ManagerBasedRLEnv) -> None:
        super().__init__(cfg, env)
        self._address = self._address.replace("s.", "_manager.cfg.", 1)


def _parse(address: str) -> list[str | int]:
    path: list[str | int] = []
    for part in address.split("."):
        name, *indices = re.findall(r"\w+", part)
        path += [name, *(int(i) for i in indices)]
    return path


def _get(holder: Any, step: str | int, address: str) -> Any:
    try:
        return holder[step] if isinstance(step, int) or isinstance(holder, dict) else getattr(holder, step)
    except (AttributeError, KeyError, IndexError, TypeError) as error:
        raise InputError(
            "curriculum address", given=address, expected="a path that exists", fix=f"{step!r} is not there: {error}."
        ) from error


def _set(holder: Any, step: str | int, value: Any, address: str) -> None:
    if isinstance(holder, tuple):
        raise InputError(
            "curriculum address",
            given=address,
            expected="a path to something that can be replaced",
            fix="Address the whole tuple instead of one of its elements.",
        )
    if isinstance(step, int) or isinstance(holder, dict):
        holder[step] = value
    else:
        setattr(holder, step, value)
