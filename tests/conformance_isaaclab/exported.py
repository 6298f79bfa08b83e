"""Exported tasks, imported and built with the genuine classes: do the values arrive?"""

from __future__ import annotations

import dataclasses
import importlib
import importlib.util
import re
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium

from robotbrain.rl import registry
from robotbrain.rl.isaaclab.commands import _agent_of
from robotbrain.rl.isaaclab.export import export_isaaclab
from robotbrain.rl.isaaclab.names import NAMES
from tests.conformance_isaaclab.report import Report

TASKS = ("reach", "velocity")
CONTAINERS = ("observations", "actions", "commands", "rewards", "terminations", "events", "curriculum")


def check_exports(report: Report) -> None:
    """Every task of the kit that can be exported, and a student's with terms of its own."""
    for task in TASKS:
        cfg = registry.task_cfg(task)
        check_export(report, task, cfg, _agent_of(sys.modules[type(cfg).__module__]))
    from tests.conformance_isaaclab.student_task import StudentEnvCfg, StudentPPOCfg

    check_export(report, "student", StudentEnvCfg(), StudentPPOCfg())
    report.skip("export of the navigation task", "its terms move obstacles in MuJoCo; the exporter says so and refuses")
    report.skip("training with the exported file", "needs an NVIDIA GPU")


def check_export(report: Report, name: str, cfg: Any, agent: Any) -> None:
    """Export, import, build, validate, compare."""
    with tempfile.TemporaryDirectory() as folder:
        export_isaaclab(cfg, folder, name=name, agent=agent)
        sys.path.insert(0, folder)
        try:
            module = importlib.import_module(f"{name}_isaaclab")
        finally:
            sys.path.remove(folder)
        kind = "".join(part[:1].upper() + part[1:] for part in name.split("_"))
        genuine = getattr(module, f"{kind}EnvCfg")()
        genuine.validate()
        what = f"task {name}"
        report.check("export", what, isinstance(genuine, importlib.import_module("isaaclab.envs").ManagerBasedRLEnvCfg))
        report.check("export", what, module.TASK in gymnasium.registry and callable(module.register))
        report.check("export", what, Path(genuine.scene.robot.spawn.asset_path).is_file(), "no MJCF")
        for path, mine in flatten(cfg):
            theirs = _at(genuine, path)
            report.check("export", f"{what}: values", _alike(mine, theirs), f"{'.'.join(path)}: {mine!r} / {theirs!r}")
        for container in CONTAINERS:
            mine_terms = [k for k, v in _members(getattr(cfg, container, None)) if v is not None]
            their_terms = [k for k, v in _members(getattr(genuine, container, None)) if v is not None]
            if container == "events" and "reset_scene" not in mine_terms:
                their_terms = [k for k in their_terms if k != "reset_scene"]
            report.check("export", f"{what}: order of terms", mine_terms == their_terms, container)
        _check_scripts(report, what, name, module.TASK)
        if agent is not None:
            runner = getattr(module, f"{kind}PPORunnerCfg")()
            # its deprecated fields have no value, in genuine tasks neither: validate() is for environments only
            for path, mine in flatten(agent, roots=None):
                theirs = _at(runner, path)
                report.check("export", f"{what}: PPO", _alike(mine, theirs), f"{'.'.join(path)}: {mine!r} / {theirs!r}")


def _check_scripts(report: Report, what: str, name: str, task: str) -> None:
    """Isaac Lab's own way from the command line of ``isaaclab train`` to the configurations."""
    from isaaclab_rl.entrypoints.backends import train_rsl_rl
    from isaaclab_tasks.utils import load_cfg_from_registry, parse_env_cfg

    line = ["--task", task, "--external_callback", f"{name}_isaaclab.register", "--num_envs", "7"]
    report.check("export", f"{what}: isaaclab train", train_rsl_rl._parse_args(line).num_envs == 7)
    report.check("export", f"{what}: isaaclab train", parse_env_cfg(task, num_envs=5).scene.num_envs == 5)
    runner = load_cfg_from_registry(task, "rsl_rl_cfg_entry_point")
    report.check("export", f"{what}: isaaclab train", type(runner).__name__.endswith("PPORunnerCfg"))


def _members(thing: Any) -> list[tuple[str, Any]]:
    if thing is None:
        return []
    return list(thing.items() if isinstance(thing, dict) else vars(thing).items())


def flatten(
    cfg: Any, roots: Any = (*CONTAINERS, "decimation", "episode_length_s", "is_finite_horizon", "seed")
) -> Iterator[Any]:
    """(path, value) of every plain value of a configuration."""
    for name, value in _members(cfg):
        if roots is None or name in roots:
            yield from _leaves((name,), value)


def _leaves(path: tuple[str, ...], value: Any) -> Iterator[tuple[tuple[str, ...], Any]]:
    if path[-1] in ("debug_vis", "class_type", "marker_pos_offset"):
        return
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        for field in dataclasses.fields(value):
            yield from _leaves((*path, field.name), getattr(value, field.name))
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from _leaves((*path, str(key)), item)
    elif value is not None:
        yield path, value


def _at(genuine: Any, path: tuple[str, ...]) -> Any:
    for step in path:
        genuine = genuine.get(step, "missing") if isinstance(genuine, dict) else getattr(genuine, step, "missing")
    return genuine


def _alike(mine: Any, theirs: Any) -> bool:
    if callable(mine):
        return getattr(mine, "__name__", 1) == getattr(theirs, "__name__", 2)
    if isinstance(mine, list | tuple) and isinstance(theirs, list | tuple):
        return len(mine) == len(theirs) and all(map(_alike, mine, theirs))
    return bool(mine == theirs)


def check_names(report: Report) -> None:
    """Every new name of the page is in the wheel."""
    for entry in NAMES:
        for path in entry.found_as:
            module, _, dotted = path.partition(":")
            try:
                found: Any = importlib.import_module(module)
                for part in filter(None, dotted.split(".")):
                    found = getattr(found, part)
                ok, detail = True, ""
            except (ImportError, AttributeError) as error:
                # Some modules need OpenUSD or Isaac Sim to be imported: look for the definition instead.
                ok, detail = _is_defined(module, dotted), f"{path}: {error}"
            report.check("names", "today's names of the page", ok, detail)
        if entry.in_kit.startswith("robotbrain."):
            report.check("names", "the kit's names of the page", _in_kit(entry.in_kit), entry.in_kit)


def _is_defined(module: str, name: str) -> bool:
    spec = importlib.util.find_spec(module)
    for folder in spec.submodule_search_locations or [] if spec else []:
        for file in Path(folder).glob("*.py"):
            if re.search(rf"^(class|def) {name}\b", file.read_text("utf-8"), re.MULTILINE):
                return True
    return False


def _in_kit(dotted: str) -> bool:
    parts = dotted.split(".")
    for cut in range(len(parts), 0, -1):
        try:
            found: Any = importlib.import_module(".".join(parts[:cut]))
        except ImportError:
            continue
        for part in parts[cut:]:
            found = getattr(found, part, None)
        return found is not None
    return False
