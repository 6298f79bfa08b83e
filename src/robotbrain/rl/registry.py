"""Tasks by name: ``make("velocity", num_envs=64, seed=0)``."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from robotbrain.errors import InputError
from robotbrain.rl.configclass import did_you_mean
from robotbrain.rl.envs.manager_based_rl_env_cfg import ManagerBasedRLEnvCfg

if TYPE_CHECKING:
    from robotbrain.rl.envs.gym import TaskVectorEnv
    from robotbrain.rl.envs.manager_based_rl_env import ManagerBasedRLEnv

TASKS: dict[str, str] = {
    "reach": "robotbrain.rl.tasks.reach:ReachEnvCfg",
    "velocity": "robotbrain.rl.tasks.velocity:VelocityEnvCfg",
    "navigation": "robotbrain.rl.tasks.navigation:NavigationEnvCfg",
}
"""Name -> ``module:class`` of the task's configuration; add your own."""


def task_cfg(name: str, **overrides: Any) -> ManagerBasedRLEnvCfg:
    """The configuration of a task.

    Args:
        name: one of :data:`TASKS`.
        overrides: fields to set; nested ones as dotted keys, ``**{"rewards.alive.weight": 1.0}``.

    Raises:
        InputError: no such task or field.
    """
    if name not in TASKS:
        raise InputError("task", given=name, expected="the name of a task", fix=did_you_mean(name, TASKS))
    module, _, attribute = TASKS[name].partition(":")
    cfg: ManagerBasedRLEnvCfg = getattr(import_module(module), attribute)()
    cfg.from_dict(overrides)
    return cfg


def make(
    task: str,
    *,
    num_envs: int | None = None,
    seed: int | None = None,
    num_threads: int | None = None,
    **overrides: Any,
) -> ManagerBasedRLEnv:
    """An environment of a task.

    Args:
        task: one of :data:`TASKS`.
        num_envs: number of environments; ``None``: as the task says.
        seed: of all random draws; ``None``: as the task says.
        num_threads: of the simulation; ``None``: all processors.
        overrides: as in :func:`task_cfg`.

    Raises:
        InputError: no such task or field, or a value that cannot work.
    """
    from robotbrain.rl.envs.manager_based_rl_env import ManagerBasedRLEnv

    return ManagerBasedRLEnv(_configured(task, num_envs, seed, overrides), num_threads=num_threads)


def make_vec(
    task: str,
    *,
    num_envs: int | None = None,
    seed: int | None = None,
    num_threads: int | None = None,
    action_limit: float | None = 1.0,
    **overrides: Any,
) -> TaskVectorEnv:
    """A task as a Gymnasium vector environment.

    Args:
        task: one of :data:`TASKS`.
        num_envs: number of environments; ``None``: as the task says.
        seed: of all random draws; ``None``: as the task says.
        num_threads: of the simulation; ``None``: all processors.
        action_limit: bound of the action space; ``None``: actions are unbounded.
        overrides: as in :func:`task_cfg`.

    Raises:
        InputError: no such task or field, or a value that cannot work.
    """
    from robotbrain.rl.envs.gym import TaskVectorEnv

    cfg = _configured(task, num_envs, seed, overrides)
    return TaskVectorEnv(cfg, num_threads=num_threads, action_limit=action_limit)


def _configured(task: str, num_envs: int | None, seed: int | None, overrides: dict[str, Any]) -> ManagerBasedRLEnvCfg:
    cfg = task_cfg(task, **overrides)
    if num_envs is not None:
        cfg.scene.num_envs = num_envs
    if seed is not None:
        cfg.seed = seed
    return cfg
