"""``robotbrain rl evaluate`` and ``robotbrain rl export``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from robotbrain.errors import InputError
from robotbrain.rl.evaluate import bootstrap, clopper_pearson, run_episodes
from robotbrain.rl.overrides import apply_overrides, split_overrides
from robotbrain.rl.policies import LoadedPolicy, load_policy
from robotbrain.rl.ppo_env import Step
from robotbrain.rl.recipes import check_task, policy_meta
from robotbrain.rl.registry import task_cfg

if TYPE_CHECKING:
    from robotbrain.rl.envs.manager_based_rl_env_cfg import ManagerBasedRLEnvCfg

UNSEEN_SEED = 20_260_000
"""Of evaluations; no training uses it."""


def evaluate_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``robotbrain rl evaluate``."""
    parser.add_argument("policy", type=Path, help="folder of a run, checkpoint, or ONNX file")
    parser.add_argument("--task", help="where it is tried; where it was trained by default")
    parser.add_argument("--episodes", type=int, default=200, help="default 200")
    parser.add_argument("--seed", type=int, default=UNSEEN_SEED, help=f"of the episodes (default {UNSEEN_SEED})")
    parser.add_argument("--randomised", action="store_true", help="with the noise and randomisation of the training")
    parser.add_argument("--set", action="append", default=[], metavar="env.PATH=VALUE", help="change the task")
    parser.add_argument("--threads", type=int, help="of the simulation; all processors by default")


def evaluate_main(arguments: argparse.Namespace) -> int:
    """Try a policy and print what came of it."""
    _require(arguments.episodes >= 1, "--episodes", arguments.episodes, "1 or more")
    _require(not split_overrides(arguments.set)["agent"], "--set", arguments.set, "env.PATH=VALUE: nothing learns here")
    policy = load_policy(arguments.policy)
    task = _task(policy, arguments.task)
    trained = [text for text in policy.command.get("set", []) if text.startswith("env.")]
    if task != policy.command.get("task"):
        trained = []  # they are settings of another task
    cfg = _trained_cfg(task, [*trained, *arguments.set])
    cfg.seed = arguments.seed
    if not arguments.randomised:
        cfg.play_mode()
    print(f"{arguments.policy}: {task}, {arguments.episodes} episodes, 95 % intervals")
    if trained:
        print(f"  as in its training: {', '.join(trained)}")
    if policy.module is None and (named := policy.provenance.get("set")):
        # Of a stranger: shortened, and escaped for the terminal.
        print(f"  not taken over from the file: {ascii(', '.join(named))[:200]} (--set does)")
    rows = (_reach if task == "reach" else _any)(policy, cfg, arguments)
    width = max(len(name) for name, _ in rows)
    print("\n".join(f"  {name:{width}}  {value}" for name, value in rows))
    return 0


def _reach(policy: LoadedPolicy, cfg: Any, arguments: argparse.Namespace) -> list[tuple[str, str]]:
    from robotbrain.rl.tasks.reach import LAST_STEPS, TOLERANCE_M, ReachEvaluation, reached

    judge = ReachEvaluation(cfg, episodes=arguments.episodes, seed=arguments.seed, num_threads=arguments.threads)
    distances = judge.distances(policy.act)
    success = reached(distances)
    return [
        (f"within {100 * TOLERANCE_M:g} cm in the last {LAST_STEPS} steps", _share(int(success.sum()), len(success))),
        ("distance over these, cm", str(bootstrap(100 * distances[:, -LAST_STEPS:].mean(axis=1)))),
    ]


def _any(policy: LoadedPolicy, cfg: ManagerBasedRLEnvCfg, arguments: argparse.Namespace) -> list[tuple[str, str]]:
    from robotbrain.rl.envs.manager_based_rl_env import ManagerBasedRLEnv

    cfg.scene.num_envs = min(arguments.episodes, 200)
    env = ManagerBasedRLEnv(cfg, num_threads=arguments.threads)
    ends = env.termination_manager
    commands = {name: env.command_manager.get_term(name) for name in env.command_manager.active_terms}
    velocity = [name for name, term in commands.items() if "error_vel_xy" in getattr(term, "metrics", {})]

    def measure(env: Any, step: Step) -> dict[str, torch.Tensor]:
        from robotbrain.rl.evaluate import velocity_errors

        found = {f"ended by {name}": ends.get_term(name).float() for name in ends.active_terms}
        return found | (velocity_errors(env, step, velocity[0]) if velocity else {})

    table = run_episodes(env, policy.act, arguments.episodes, seed=arguments.seed, measure=measure, tail=1)
    rows = [
        ("return", str(bootstrap(table.returns))),
        ("length, s", str(bootstrap(table.lengths * env.step_dt))),
    ]
    for name in ends.active_terms:
        rows.append((f"ended by {name}", _share(int(table.tail[f"ended by {name}"].sum()), len(table))))
    for name, unit in (("error_xy", "m/s"), ("error_yaw", "rad/s")) if velocity else ():
        values = table.mean[name][np.isfinite(table.mean[name])]
        rows.append((f"{name}, {unit}", str(bootstrap(values))))
    return rows


def _require(holds: bool, what: str, given: object, expected: str) -> None:
    if not holds:
        raise InputError(what, given=given, expected=expected, fix="See robotbrain rl evaluate --help.")


def _share(number: int, of: int) -> str:
    exact = clopper_pearson(number, of)
    return f"{100 * exact.value:.1f} % ({100 * exact.low:.1f} to {100 * exact.high:.1f})"


def export_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``robotbrain rl export``."""
    parser.add_argument("run", type=Path, help="folder of a run, or its checkpoint")
    parser.add_argument("--out", type=Path, metavar="FILE", help="or folder; default: policy.onnx in the run's folder")


def export_main(arguments: argparse.Namespace) -> int:
    """Write a policy as ONNX, with its observations, joints and origin in the metadata."""
    from robotbrain.rl.envs.manager_based_rl_env import ManagerBasedRLEnv
    from robotbrain.rl.export import export_policy

    policy = load_policy(arguments.run)
    if policy.module is None:
        raise InputError("run", given=str(arguments.run), expected="a run, not ONNX", fix="It is exported already.")
    task = _task(policy, None)
    changed = policy.command.get("set", [])
    if task != "reach" and (
        stale := [text for text in changed if text.startswith(("env.actions", "env.observations"))]
    ):
        raise InputError(
            "run",
            given=stale,
            expected="the observations and actions of the task",
            fix="Describe them in a PolicyMeta and call robotbrain.rl.export.export_policy.",
        )
    cfg = _trained_cfg(task, changed)
    cfg.scene.num_envs = 1
    meta = policy_meta(task, ManagerBasedRLEnv(cfg, num_threads=1), {**policy.provenance, "set": changed})
    out = arguments.out or (arguments.run if arguments.run.is_dir() else arguments.run.parent)
    path = export_policy(policy.module, out / "policy.onnx" if out.is_dir() else out, meta)
    print(f"Wrote {path}: {meta.observation_dim} observations, {meta.action_dim} actions, every {meta.control_dt:g} s")
    return 0


def _task(policy: LoadedPolicy, wanted: str | None) -> str:
    task: str | None = wanted or policy.command.get("task")
    if task is None:
        raise InputError(
            "policy",
            given="no task",
            expected="a run of `robotbrain rl train`, or ONNX",
            fix="A checkpoint alone does not name it: robotbrain rl evaluate --task TASK.",
        )
    check_task(task)
    return task


def _trained_cfg(task: str, changed: list[str]) -> ManagerBasedRLEnvCfg:
    cfg: ManagerBasedRLEnvCfg = apply_overrides(task_cfg(task), split_overrides(changed)["env"], "env")
    return cfg
