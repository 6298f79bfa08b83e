"""``robotbrain rl export-isaaclab TASK --out FOLDER``."""

from __future__ import annotations

import argparse
import importlib
import sys
from pathlib import Path
from typing import Any

from robotbrain.errors import InputError


def export_isaaclab_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        "task",
        help="a task of the kit (reach, velocity, navigation), or MODULE:CLASS of a configuration of your own, "
        "MODULE being a module or a .py file",
    )
    parser.add_argument("--out", type=Path, default=Path("isaaclab_export"), help="folder for the files")
    parser.add_argument("--name", help="name of the task (default: that of the task or the class)")
    parser.add_argument(
        "--agent", help="MODULE:CLASS of a PPO configuration (default: the task's own, or a common one)"
    )


def export_isaaclab_main(args: argparse.Namespace) -> int:
    """Run the command; returns the exit status."""
    from robotbrain.rl.isaaclab.export import export_isaaclab

    name, cfg, agent = _load(args.task)
    if args.agent:
        agent = _object(args.agent)()
    written = export_isaaclab(cfg, args.out, name=args.name or name, agent=agent)
    for path in written:
        print(path)
    print(f"The first lines of {written[0].name} say how to train with it.")
    return 0


def _load(task: str) -> tuple[str, Any, Any]:
    """Name, configuration and PPO configuration (or None) of a task."""
    if ":" in task:
        kind = _object(task)
        name = kind.__name__.removesuffix("EnvCfg").removesuffix("Cfg").lower() or "task"
        return name, kind(), _agent_of(sys.modules[kind.__module__])
    from robotbrain.rl import registry
    from robotbrain.rl.recipes import ppo_recipe

    return task, registry.task_cfg(task), ppo_recipe(task)


def _agent_of(module: Any) -> Any:
    """The PPO configuration that a task's module defines, None if it has none or several."""
    from robotbrain.rl.ppo_cfg import RslRlOnPolicyRunnerCfg

    found = [
        value
        for value in vars(module).values()
        if isinstance(value, type) and issubclass(value, RslRlOnPolicyRunnerCfg) and value is not RslRlOnPolicyRunnerCfg
    ]
    return found[0]() if len(found) == 1 else None


def _object(path: str) -> Any:
    module_name, _, attribute = path.rpartition(":")
    if module_name.endswith(".py"):
        file = Path(module_name)
        if not file.is_file():
            raise InputError("task", given=path, expected="a file that exists", fix="Check the path before the colon.")
        sys.path.insert(0, str(file.resolve().parent))
        module_name = file.stem
    try:
        return getattr(importlib.import_module(module_name), attribute)
    except (ImportError, AttributeError) as error:
        raise InputError(
            "task",
            given=path,
            expected="MODULE:CLASS of something that can be imported",
            fix=f"Python says: {error}.",
        ) from error
