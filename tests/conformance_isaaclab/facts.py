"""Signatures of terms and fields of configurations as plain facts: names, order, defaults."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import re
from types import ModuleType
from typing import Any

from robotbrain.rl import mdp
from robotbrain.rl.isaaclab._source import is_genuine_term

Facts = dict[str, list[list[str]]]

MODULES = {  # part: (module of the kit, genuine module)
    "mdp": ("robotbrain.rl.mdp", "isaaclab_tasks.core.velocity.mdp"),
    "managers": ("robotbrain.rl.managers", "isaaclab.managers"),
    "noise": ("robotbrain.rl.noise_cfg", "isaaclab.utils.noise"),
    "ppo": ("robotbrain.rl.ppo_cfg", "isaaclab_rl.rsl_rl"),
    "env": ("robotbrain.rl.envs", "isaaclab.envs"),
    "scene": ("robotbrain.rl.scene", "isaaclab.scene"),
    "sim": ("robotbrain.rl.scene", "isaaclab.sim"),
    "math": ("robotbrain.rl.math_utils", "isaaclab.utils.math"),
}
CONFIGS = {
    "managers": (
        "SceneEntityCfg", "ObservationTermCfg", "ObservationGroupCfg", "RewardTermCfg", "TerminationTermCfg",
        "CurriculumTermCfg", "EventTermCfg", "ActionTermCfg", "CommandTermCfg",
    ),
    "noise": ("NoiseCfg", "ConstantNoiseCfg", "UniformNoiseCfg", "GaussianNoiseCfg"),
    "ppo": (
        "RslRlMLPModelCfg", "RslRlMLPModelCfg.GaussianDistributionCfg", "RslRlSymmetryCfg", "RslRlPpoAlgorithmCfg",
        "RslRlOnPolicyRunnerCfg",
    ),
    "env": ("ManagerBasedRLEnvCfg",),
    "scene": ("InteractiveSceneCfg",),
    "sim": ("SimulationCfg",),
}  # fmt: skip

ONLY_GENUINE = {
    "marker": r".*visualizer(_cfg)?|debug_vis|marker_pos_offset|viewer|ui_window_class_type|video_recorders",
    "deployment": r"cmd_kind|element_names|export_io_descriptors|log_dir|recorders|xr|teleop_devices|isaac_teleop",
    "rendering and USD": r"rerender_on_reset|num_rerenders_on_reset|wait_for_textures|physics_prim_path|use_fabric"
    r"|render_interval|enable_scene_query_support|create_stage_in_memory|logging_level|save_logs_to_file|visualizer_cfgs"
    r"|default_visualizer_cfg|physics_material|use_newton_actuators|physics|render|replicate_physics|filter_collisions"
    r"|clone_in_fabric|clone_cfg|lazy_sensor_update|class_type|newton.*|.*clon.*|env_template.*|.*stage.*|.*fabric.*",
    "modifiers": r"modifiers",
    "tendons and collections": r"fixed_tendon.*|object_collection.*",
    "deprecated aliases": r"policy|empirical_normalization|stochastic|init_noise_std|noise_std_type|state_dependent_std"
    r"|obs_normalization_.*",
}
"""Genuine fields that the kit does not have, by reason."""

DIFFERENCES = {
    "env.ManagerBasedRLEnvCfg.only_positive_rewards": "the kit's own; the exporter says so",
    "env.ManagerBasedRLEnvCfg.events": "no default event: a reset starts from the default state by itself",
    "sim.SimulationCfg.dt": "the kit's default is 1/200 s, Isaac Lab's 1/60 s",
    "sim.SimulationCfg.device": "the CPU",
    "scene.InteractiveSceneCfg.env_spacing": "has no effect here, so it need not be given",
    "math.euler_xyz_from_quat.wrap_to_2pi": "the kit's angles are within -pi..pi",
    **{
        f"math.{name}.{parameter}": "the kit's draws take a random generator, which has the device"
        for name in (
            "sample_uniform",
            "sample_log_uniform",
            "sample_gaussian",
            "random_orientation",
            "random_yaw_orientation",
        )
        for parameter in ("gen", "device")
    },
}
"""Differences that are meant, with their reasons."""


def look_up(module: ModuleType, dotted: str) -> Any:
    """``module.A.B``, or None."""
    found: Any = module
    for part in dotted.split("."):
        found = getattr(found, part, None)
    return found


def terms() -> list[str]:
    """Every term of the kit that Isaac Lab has under the same name."""
    return [name for name in mdp.__all__ if is_genuine_term(getattr(mdp, name))]


def functions_of_math() -> list[str]:
    """The kit's functions on rotations and frames."""
    module = importlib.import_module(MODULES["math"][0])
    return [
        n for n, f in vars(module).items() if inspect.isfunction(f) and f.__module__ == module.__name__ and n[0] != "_"
    ]


def facts_of(side: int) -> Facts:
    """Facts of the kit (0) or of the genuine modules (1); a name that is not there has no entry."""
    found: Facts = {}
    for part, names in {"mdp": terms(), "math": functions_of_math(), **CONFIGS}.items():
        module = importlib.import_module(MODULES[part][side])
        for name in names:
            thing = look_up(module, name)
            if thing is not None:
                found[f"{part}.{name}"] = fields_of(thing) if dataclasses.is_dataclass(thing) else parameters_of(thing)
            ranges = getattr(thing, "Ranges", None)
            if ranges is not None:
                found[f"{part}.{name}.Ranges"] = fields_of(ranges)
    return found


def parameters_of(thing: Any) -> list[list[str]]:
    """(name, default) of each parameter of a function or of a class term's call, without ``self``."""
    is_term = inspect.isclass(thing) and "__call__" in vars(thing)
    call = vars(thing)["__call__"] if is_term else thing.__init__ if inspect.isclass(thing) else thing
    parameters = list(inspect.signature(call).parameters.values())[int(inspect.isclass(thing)) :]
    return [[p.name, "required" if p.default is p.empty else plain(p.default)] for p in parameters]


def fields_of(cls: type) -> list[list[str]]:
    """(name, default) of each field of a configuration."""
    found = []
    for field in dataclasses.fields(cls):
        default: Any = field.default
        if field.default_factory is not dataclasses.MISSING:
            default = field.default_factory()
        found.append([field.name, "MISSING" if default is dataclasses.MISSING else plain(default)])
    return found


def plain(value: Any) -> str:
    """A default as text that is the same on both sides when the value is."""
    if isinstance(value, str) and ":" in value and re.fullmatch(r"[\w{}.]+:\w+", value):
        return str(value.rpartition(":")[2])  # Isaac Lab names classes by path, to import them late
    if isinstance(value, type(dataclasses.MISSING)):  # Isaac Lab's defaults are copies of it
        return "MISSING"
    if inspect.isclass(value) or inspect.isfunction(value):
        return str(value.__name__)
    if type(value).__name__ == "SceneEntityCfg":
        chosen = {k: getattr(value, k) for k in ("joint_names", "body_names") if getattr(value, k) is not None}
        return f"SceneEntityCfg({value.name!r}{''.join(f', {k}={v!r}' for k, v in chosen.items())})"
    if isinstance(value, list | tuple):
        return f"{type(value).__name__}({', '.join(map(plain, value))})"
    if isinstance(value, bool | int | float | str | dict | type(None) | slice):
        return repr(float(value) if type(value) is int else value)
    return type(value).__name__


def compare(kit: Facts, genuine: Facts) -> list[tuple[str, str]]:
    """What differs: (name, how), without the differences that are meant."""
    wrong = []
    for name, mine in kit.items():
        if name not in genuine:
            wrong.append((name, "Isaac Lab has no such name"))
            continue
        theirs = genuine[name]
        is_config = name.rpartition(".")[2].endswith("Cfg") or name.endswith(".Ranges")
        if is_config:
            theirs = [row for row in theirs if not _only_genuine(row[0]) or row[0] in dict(mine)]
        mine = [row for row in mine if f"{name}.{row[0]}" not in DIFFERENCES]
        theirs = [row for row in theirs if f"{name}.{row[0]}" not in DIFFERENCES]
        if is_config:  # keyword arguments: the order is free
            mine, theirs = sorted(mine), sorted(theirs)
        if mine != theirs:
            wrong.append(
                (name, f"kit {[r for r in mine if r not in theirs]}, genuine {[r for r in theirs if r not in mine]}")
            )
    return wrong


def _only_genuine(field: str) -> bool:
    return any(re.fullmatch(pattern, field) for pattern in ONLY_GENUINE.values())
