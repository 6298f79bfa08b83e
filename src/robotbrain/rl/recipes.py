"""How each task is trained by default, and what its policies say about themselves."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any

from robotbrain.errors import InputError
from robotbrain.rl.configclass import did_you_mean
from robotbrain.rl.ppo_cfg import RslRlOnPolicyRunnerCfg, usual_runner_cfg
from robotbrain.rl.registry import TASKS

if TYPE_CHECKING:
    from robotbrain.rl.ddpg import DDPGConfig
    from robotbrain.rl.policy_meta import PolicyMeta

ALGORITHMS = ("ddpg", "ppo", "rsl-rl")


def check_task(task: str) -> None:
    """Raise InputError, with the nearest name, unless ``task`` is registered."""
    if task not in TASKS:
        raise InputError("task", given=task, expected="the name of a task", fix=did_you_mean(task, TASKS))


def default_algorithm(task: str) -> str:
    """Return what the course trains the task with."""
    return "ddpg" if task == "reach" else "ppo"


def ppo_recipe(task: str) -> RslRlOnPolicyRunnerCfg:
    """Return PPO's settings for a task: ``<Name>PPORunnerCfg`` beside ``<Name>EnvCfg``, usual ones where it has none.

    Raises:
        InputError: for an unknown task.
    """
    check_task(task)
    module, _, name = TASKS[task].partition(":")
    found = getattr(import_module(module), f"{name.removesuffix('EnvCfg')}PPORunnerCfg", None)
    if found is not None:
        cfg: RslRlOnPolicyRunnerCfg = found()
        return cfg
    usual = usual_runner_cfg(task, iterations=500, save_interval=25, init_std=0.6, gamma=0.98, entropy_coef=0.0)
    usual.clip_actions = 1.0
    return usual


def ddpg_recipe(task: str) -> DDPGConfig:
    """Return DDPG's settings for a task: ``<name>_ddpg_config()`` in its module, usual ones where it has none.

    Raises:
        InputError: for an unknown task.
    """
    from robotbrain.rl.ddpg import DDPGConfig

    check_task(task)
    make = getattr(import_module(TASKS[task].partition(":")[0]), f"{task}_ddpg_config", DDPGConfig)
    config: DDPGConfig = make()
    return config


def policy_meta(task: str, env: Any, provenance: Mapping[str, Any]) -> PolicyMeta:
    """Return what a policy file of this task says about itself.

    Args:
        task: its name.
        env: an environment of it.
        provenance: how the policy was trained (JSON types only).

    Raises:
        InputError: for a task whose policies nobody has described.
    """
    from robotbrain.rl.gap_variants import reach_meta
    from robotbrain.rl.tasks import navigation_spec, velocity

    if task == "reach":
        return reach_meta(env, **provenance)
    if task == "velocity":
        return velocity.policy_meta(dict(provenance))
    if task == "navigation":
        return navigation_spec.policy_meta(provenance)
    raise InputError(
        "task",
        given=task,
        expected="reach, velocity or navigation",
        fix="Describe your policy in a PolicyMeta and call robotbrain.rl.export.export_policy.",
    )
