"""Genuine terms and managers evaluated on the kit's simulator, against the kit's own."""

from __future__ import annotations

import copy
import inspect
from typing import Any

import isaaclab.managers as genuine_managers
import isaaclab.utils.math as genuine_math
import isaaclab_tasks.core.velocity.mdp as genuine_mdp
import torch

from robotbrain.rl import math_utils, mdp
from robotbrain.rl.managers import (
    ObservationGroupCfg,
    ObservationTermCfg,
    RewardTermCfg,
    SceneEntityCfg,
)
from robotbrain.rl.managers.observation_manager import ObservationManager
from tests.conformance_isaaclab.adapter import AdaptedEnv
from tests.conformance_isaaclab.facts import functions_of_math
from tests.conformance_isaaclab.report import Report
from tests.conformance_isaaclab.worlds import disturb, reaching, walking

STATES = 12
TOLERANCE = 1e-5
VALUES: dict[str, Any] = {
    "std": 0.4, "threshold": 0.02, "limit_angle": 0.5, "minimum_height": 0.3, "bounds": (-0.5, 0.9),
    "max_velocity": 1.5, "soft_ratio": 0.5, "target": 0.3, "target_height": 0.25, "command_threshold": 0.4,
    "max_time": 0.3, "num_resamples": 1, "make_quat_unique": True, "term_keys": ".*",
}  # fmt: skip
MODULES = ("observations", "rewards", "locomotion", "terminations")


def same(mine: Any, theirs: Any, tolerance: float = TOLERANCE) -> bool:
    """Whether two tensors agree in shape and value (bools and numbers alike)."""
    a, b = torch.as_tensor(mine).double(), torch.as_tensor(theirs).double()
    return a.shape == b.shape and bool(torch.allclose(a, b, rtol=tolerance, atol=tolerance, equal_nan=True))


def check_terms(report: Report) -> None:
    """Every observation, reward and termination term, on two robots in random states."""
    generator = torch.Generator().manual_seed(0)
    seen: dict[str, list[torch.Tensor]] = {}
    for robot, env in (("walking", walking()), ("reaching", reaching())):
        adapted = AdaptedEnv(env)
        terms = {name: _parameters(name, env, robot) for name in _term_names()}
        made: dict[str, tuple[Any, Any, dict[str, Any]]] = {}
        for name, params in terms.items():
            if params is not None:
                made[name] = (_make(mdp, name, params, env), _make(genuine_mdp, name, params, adapted), params)
        for _ in range(STATES):
            disturb(env, generator)
            env.episode_length_buf[::5] = env.max_episode_length
            for command in env.command_manager.active_terms:
                env.command_manager.get_term(command).time_left[::3] = 0.0  # about to be drawn anew
            for name, (mine, theirs, params) in made.items():
                a, b = mine(env, **params), theirs(adapted, **params)
                report.check("values", f"terms, {robot}", same(a, b), f"{name}: {a} / {b}")
                seen.setdefault(name, []).append(torch.as_tensor(a).float().flatten())
    for name in _term_names():
        values = torch.cat(seen[name]) if name in seen else torch.zeros(1)
        if name not in seen:
            report.skip(name, "no robot of the kit can show it")
        elif name not in CONSTANT:
            report.check("values", "terms that were seen to vary", bool(values.std() > 0), f"{name} did not")


CONSTANT = {"joint_pos_out_of_limit"}


def _term_names() -> list[str]:
    return [
        name
        for name in mdp.__all__
        if getattr(mdp, name).__module__.rpartition(".")[2] in MODULES and not name.startswith("_")
    ]


def _make(module: Any, name: str, params: dict[str, Any], env: Any) -> Any:
    term = getattr(module, name)
    if not inspect.isclass(term):
        return term
    kind = genuine_managers.RewardTermCfg if module is genuine_mdp else RewardTermCfg
    return term(kind(func=term, params=dict(params), weight=1.0), env)


def _parameters(name: str, env: Any, robot: str) -> dict[str, Any] | None:
    """Arguments of a term for a robot, None where it does not apply."""
    term = getattr(mdp, name)
    names = list(inspect.signature(term.__call__ if inspect.isclass(term) else term).parameters)
    params: dict[str, Any] = {}
    for parameter in names:
        if parameter in ("self", "env", "action_name"):
            continue
        if parameter == "asset_cfg":
            params[parameter] = _asset_cfg(name, env, robot)
        elif parameter == "sensor_cfg":
            if robot == "reaching":
                return None
            if name == "base_height_l2":
                continue
            params[parameter] = SceneEntityCfg("contact_forces", body_names=".*_foot")
            params[parameter].resolve(env.scene)
        elif parameter == "command_name":
            commands = env.command_manager.active_terms
            pose = name.startswith(("position_command", "orientation_command", "pose_command"))
            if pose and robot == "walking":
                return None
            if robot == "reaching" and not pose and name not in ("generated_commands", "command_resample"):
                return None
            params[parameter] = commands[0]
        else:
            params[parameter] = VALUES[parameter]
    return params


def _asset_cfg(name: str, env: Any, robot: str) -> SceneEntityCfg:
    if "command_error" in name:
        cfg = SceneEntityCfg("robot", body_names="hand")
    elif name.startswith("body_"):
        cfg = SceneEntityCfg("robot", body_names=".*foot" if robot == "walking" else "link[3-5]")
    elif name == "feet_slide":
        cfg = SceneEntityCfg("robot", body_names=".*_foot")
    else:
        cfg = SceneEntityCfg("robot", joint_names=".*_(hip|calf)_joint" if robot == "walking" else "joint[1-4]")
    cfg.resolve(env.scene)
    return cfg


def check_managers(report: Report) -> None:
    """Genuine managers with the kit's terms: weights, time step, clip, scale, history, delay."""
    env = walking(seed=3)
    adapted = AdaptedEnv(env)
    generator = torch.Generator().manual_seed(1)
    rewards = genuine_managers.RewardManager(
        _as_genuine(env.reward_manager.cfg, genuine_managers.RewardTermCfg), adapted
    )
    ends = genuine_managers.TerminationManager(
        _as_genuine(env.termination_manager.cfg, genuine_managers.TerminationTermCfg), adapted
    )
    for _ in range(STATES):
        disturb(env, generator)
        total = env.reward_manager.compute(env.step_dt).clone()
        report.check("managers", "RewardManager: weights times step", same(total, rewards.compute(env.step_dt)))
        mine = env.termination_manager.compute().clone()
        report.check("managers", "TerminationManager", same(mine, ends.compute()))
        for what in ("terminated", "time_outs"):
            a, b = getattr(env.termination_manager, what), getattr(ends, what)
            report.check("managers", f"TerminationManager.{what}", same(a, b))
    for order in ("term", "time"):
        _check_observations(report, env, adapted, order, generator)


def _as_genuine(cfg: Any, kind: Any) -> dict[str, Any]:
    """The terms of a resolved kit configuration as genuine ones, with the kit's functions."""
    found = {}
    for name, term in vars(cfg).items():
        fields = {k: v for k, v in vars(term).items() if k in kind.__dataclass_fields__ and k != "noise"}
        found[name] = kind(**fields)
    return found


def _check_observations(report: Report, env: Any, adapted: Any, order: str, generator: torch.Generator) -> None:
    terms = {
        "velocity": {"func": mdp.base_lin_vel, "clip": (-0.5, 0.5), "scale": 2.0},
        "gravity": {"func": mdp.projected_gravity, "scale": (1.0, 2.0, 3.0)},
        "joints": {"func": mdp.joint_pos_rel, "delay_min_lag": 2, "delay_max_lag": 2},
        "time": {"func": mdp.current_time_s, "delay_min_lag": 1, "delay_max_lag": 1},
    }
    group: Any = ObservationGroupCfg(history_length=3, history_order=order)  # type: ignore[arg-type]
    theirs: Any = genuine_managers.ObservationGroupCfg(history_length=3, history_order=order)
    for name, fields in terms.items():
        setattr(group, name, ObservationTermCfg(**fields))  # type: ignore[arg-type]
        setattr(theirs, name, genuine_managers.ObservationTermCfg(**copy.deepcopy(fields)))
    mine = ObservationManager({"policy": group}, env)
    genuine = genuine_managers.ObservationManager({"policy": theirs}, adapted)
    dims = mine.group_obs_dim["policy"], genuine.group_obs_dim["policy"]
    report.check("managers", "ObservationManager: dimensions", dims[0] == dims[1], str(dims))
    what = f"ObservationManager: by {order}, clip, scale, delay"
    for step in range(8):
        disturb(env, generator)
        if step == 5:
            some = torch.tensor([1, 4, 7])
            mine.reset(some)
            genuine.reset(some)
        a = mine.compute(update_history=True)["policy"]
        b = genuine.compute(update_history=True)["policy"]
        report.check("managers", what, same(a, b), f"step {step}")


def check_math(report: Report) -> None:
    """The kit's functions on rotations and frames against the genuine ones."""
    generator = torch.Generator().manual_seed(0)

    def quats() -> torch.Tensor:
        return torch.nn.functional.normalize(torch.randn(200, 4, generator=generator), dim=-1)

    def vectors() -> torch.Tensor:
        return torch.randn(200, 3, generator=generator)

    scalars = ("roll", "pitch", "yaw", "angle")
    made = {
        **dict.fromkeys(("q", "quat", "q1", "q2", "q01", "q02", "q12", "quaternions"), quats),
        **dict.fromkeys(("vec", "t01", "t02", "t12", "x", "axis_angle"), vectors),
        **dict.fromkeys(scalars, lambda: vectors()[:, 0]),
        "angles": lambda: 8.0 * vectors(),
        "lower": lambda: vectors() - 5.0,
        "upper": lambda: vectors() + 5.0,
        "axis": lambda: torch.nn.functional.normalize(vectors(), dim=-1),
        "matrix": lambda: genuine_math.matrix_from_quat(quats()),
    }
    for name in functions_of_math():
        theirs = getattr(genuine_math, name, None)
        parameters = [
            p for p in inspect.signature(getattr(math_utils, name)).parameters.values() if p.default is p.empty
        ]
        if theirs is None or any(p.name not in made for p in parameters):
            report.skip(f"math_utils.{name}", "takes a random generator there is none of in isaaclab.utils.math")
            continue
        arguments = [made[p.name]() for p in parameters]
        a, b = getattr(math_utils, name)(*arguments), theirs(*arguments)
        pairs = zip(a, b, strict=True) if isinstance(a, tuple) else [(a, b)]
        report.check("math", "rotations and frames", all(_same_rotation(name, x, y) for x, y in pairs), name)


def _same_rotation(name: str, mine: torch.Tensor, theirs: torch.Tensor) -> bool:
    if "euler_xyz_from" in name:  # the same angles, from another turn
        return same(math_utils.wrap_to_pi(mine - theirs), torch.zeros_like(mine), 1e-4)
    return same(mine, theirs, 1e-4 if "matrix" in name or "axis_angle" in name else TOLERANCE)
