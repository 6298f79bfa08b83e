"""``robotbrain rl train`` and ``robotbrain rl resume``."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import robotbrain
from robotbrain.errors import InputError
from robotbrain.files import write_text
from robotbrain.rl.overrides import apply_overrides, split_overrides
from robotbrain.rl.policies import COMMAND_FILE, read_command
from robotbrain.rl.recipes import ALGORITHMS, check_task, ddpg_recipe, default_algorithm, ppo_recipe

if TYPE_CHECKING:
    from robotbrain.rl.envs.manager_based_rl_env_cfg import ManagerBasedRLEnvCfg

CHECKPOINT_FILE = "checkpoint.pt"
_LENGTHS = ("steps", "iterations", "minutes")


def train_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``robotbrain rl train``."""
    parser.add_argument("task", help="its name, see `robotbrain rl list`")
    parser.add_argument("--algorithm", choices=ALGORITHMS, help="ddpg for reach, ppo for the others by default")
    parser.add_argument("--seed", type=int, default=0, help="of everything random (default 0)")
    parser.add_argument("--envs", type=int, metavar="N", help="environments side by side; as the task says by default")
    parser.add_argument("--run-dir", type=Path, metavar="FOLDER", help="default: runs/TASK-ALGORITHM-SEED")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="PATH=VALUE",
        help="change a setting of the task (env.episode_length_s=10) or of the learner (agent.algorithm.gamma=0.98)",
    )
    _length_arguments(parser)


def resume_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``robotbrain rl resume``."""
    parser.add_argument("run_dir", type=Path, metavar="FOLDER", help="of the run")
    _length_arguments(parser)


def _length_arguments(parser: argparse.ArgumentParser) -> None:
    group = parser.add_mutually_exclusive_group()
    group.add_argument("--steps", type=_count, help="environment steps in all, of all environments together")
    group.add_argument("--iterations", type=_count, help="iterations in all (PPO and rsl-rl)")
    parser.add_argument("--minutes", type=_minutes, help="stop after this time of training")
    parser.add_argument("--threads", type=int, help="of simulation and networks; all processors by default")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def _count(text: str) -> int:
    """Return a whole number; 1e6 and 200k are fine too."""
    factor = {"k": 1e3, "m": 1e6}.get(text[-1:].lower(), 1.0)
    try:
        value = float(text if factor == 1 else text[:-1]) * factor
    except ValueError:
        value = math.nan
    if not (value >= 1 and value == int(value)):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of 1 or more, such as 200k or 1e6")
    return int(value)


def _minutes(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not value > 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a time of more than 0 minutes")
    return value


def train_main(arguments: argparse.Namespace) -> int:
    """Train a policy, or go on with the same training."""
    check_task(arguments.task)
    algorithm = arguments.algorithm or default_algorithm(arguments.task)
    folder = arguments.run_dir or Path("runs") / f"{arguments.task}-{algorithm}-{arguments.seed}"
    command = {
        "task": arguments.task,
        "algorithm": algorithm,
        "seed": arguments.seed,
        "num_envs": arguments.envs,
        "set": list(arguments.set),
    }
    if (folder / COMMAND_FILE).is_file():
        before = read_command(folder)
        differ = {name: before.get(name) for name, value in command.items() if before.get(name) != value}
        if differ:
            raise InputError(
                "run folder",
                given=str(folder),
                expected=f"a training with {', '.join(f'{n} = {command[n]}' for n in differ)}; it has {differ}",
                fix="Choose another --run-dir, or go on with it: robotbrain rl resume FOLDER.",
            )
        command = before
    return _train(command, folder, arguments)


def resume_main(arguments: argparse.Namespace) -> int:
    """Go on with the training in a folder."""
    return _train(read_command(arguments.run_dir), arguments.run_dir, arguments)


def _train(command: dict[str, Any], folder: Path, arguments: argparse.Namespace) -> int:
    from robotbrain.rl.registry import task_cfg

    task, algorithm = command["task"], command["algorithm"]
    # A length given once holds when the training is resumed without one; another one takes the place of all.
    given = {name: getattr(arguments, name) for name in _LENGTHS if getattr(arguments, name) is not None}
    if given:
        command = {name: value for name, value in command.items() if name not in _LENGTHS} | given
    values = split_overrides(command["set"])
    env_cfg: ManagerBasedRLEnvCfg = apply_overrides(task_cfg(task), values["env"], "env")
    env_cfg.seed = command["seed"]
    if command["num_envs"] is not None:
        env_cfg.scene.num_envs = command["num_envs"]
    recipe = ddpg_recipe(task) if algorithm == "ddpg" else ppo_recipe(task)
    recipe = apply_overrides(recipe, values["agent"], "agent")
    resumed = (folder / CHECKPOINT_FILE).is_file()
    # Settings that cannot work stop here, before there is a folder.
    run = _ddpg if algorithm == "ddpg" else _ppo
    trained = run(command, env_cfg, recipe, folder, resumed, arguments)
    print(f"Trained: {trained}. Policy and log: {folder}")
    print(f"  robotbrain rl evaluate {folder}\n  robotbrain rl export {folder}\n  tensorboard --logdir {folder}")
    return 0


def _begin(command: dict[str, Any], folder: Path, resumed: bool, envs: int, length: str) -> None:
    write_text(folder / COMMAND_FILE, json.dumps({**command, "kit_version": robotbrain.__version__}, indent=2) + "\n")
    print(
        f"{'Going on with' if resumed else 'Training'} {command['task']}: {command['algorithm']}, {envs} environments, "
        f"seed {command['seed']}, {length}.\nRun folder: {folder}. Ctrl-C saves and stops; "
        f"`robotbrain rl resume {folder}` goes on.",
        flush=True,
    )


def _ppo(
    command: dict[str, Any],
    env_cfg: ManagerBasedRLEnvCfg,
    cfg: Any,
    folder: Path,
    resumed: bool,
    arguments: argparse.Namespace,
) -> str:
    from robotbrain.rl.envs.manager_based_rl_env import ManagerBasedRLEnv
    from robotbrain.rl.ppo_cfg import check_ppo_cfg
    from robotbrain.rl.ppo_train import train_ppo
    from robotbrain.rl.rsl_rl_runner import require_rsl_rl, train_rsl_rl

    genuine = command["algorithm"] == "rsl-rl"
    if genuine:
        require_rsl_rl()
    cfg.seed = command["seed"]
    env = ManagerBasedRLEnv(env_cfg, num_threads=arguments.threads)
    if not genuine:
        check_ppo_cfg(cfg, dict.fromkeys(env.observation_manager.group_obs_dim, 0))
    per_iteration = env.num_envs * cfg.num_steps_per_env
    iterations = command.get("iterations") or cfg.max_iterations
    if command.get("steps"):
        iterations = math.ceil(command["steps"] / per_iteration)
    _begin(command, folder, resumed, env.num_envs, f"{iterations} iterations, {iterations * per_iteration:,} steps")
    result = (train_rsl_rl if genuine else train_ppo)(
        env,
        cfg,
        run_dir=folder,
        resume=resumed,
        iterations=iterations,
        minutes=command.get("minutes"),
        torch_threads=arguments.threads,
        settings={"task": command["task"], "seed": command["seed"], "threads": arguments.threads},
        progress=not arguments.quiet,
    )
    if result.interrupted:
        raise KeyboardInterrupt
    return f"{result.iteration} iterations, {result.steps:,} steps in {result.elapsed_s / 60:.1f} min"


def _ddpg(
    command: dict[str, Any],
    env_cfg: ManagerBasedRLEnvCfg,
    config: Any,
    folder: Path,
    resumed: bool,
    arguments: argparse.Namespace,
) -> str:
    import dataclasses

    from robotbrain.rl.ddpg import train_ddpg
    from robotbrain.rl.envs.gym import TaskVectorEnv

    if command.get("iterations"):
        raise InputError("--iterations", given=command["iterations"], expected="--steps with ddpg", fix="Give --steps.")
    if command.get("steps"):
        config = dataclasses.replace(config, total_steps=command["steps"])
    # Nobody should lose more than some seconds.
    config = dataclasses.replace(config, checkpoint_every=min(config.checkpoint_every, 25_000))
    env = TaskVectorEnv(env_cfg, num_threads=arguments.threads)
    evaluate = None
    if command["task"] == "reach":
        from robotbrain.rl.tasks.reach import ReachEnvCfg, ReachEvaluation

        assert isinstance(env_cfg, ReachEnvCfg)
        evaluate = ReachEvaluation(env_cfg, episodes=200, num_threads=arguments.threads)
    limit = command.get("minutes")
    _begin(command, folder, resumed, env.num_envs, f"{config.total_steps:,} steps")
    result = train_ddpg(
        lambda: env,
        config,
        seed=command["seed"],
        run_dir=folder,
        resume=resumed,
        evaluate=evaluate,
        callback=None if limit is None else lambda point: point["seconds"] >= 60 * limit,
        progress=not arguments.quiet,
    )
    last = result.curve[-1] if result.curve else {}
    shown = ", ".join(f"{name} {last[name]:.3g}" for name in ("success", "error_m", "train_return") if name in last)
    return f"{int(last.get('step', 0)):,} steps in {last.get('seconds', 0.0) / 60:.1f} min; {shown}"
