"""Genuine commands, actions and events driven on the kit's simulator, against the kit's own."""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable
from typing import Any
from unittest.mock import MagicMock

import isaaclab.managers as genuine_managers
import isaaclab_tasks.core.velocity.mdp as genuine_mdp
import torch
from scipy import stats

from robotbrain.rl import mdp
from robotbrain.rl.managers import EventTermCfg, SceneEntityCfg
from robotbrain.rl.managers.event_manager import EventManager
from tests.conformance_isaaclab.adapter import AdaptedEnv
from tests.conformance_isaaclab.report import Report
from tests.conformance_isaaclab.values import same
from tests.conformance_isaaclab.worlds import disturb, reaching, walking

DRAWS = 2000
REPEATS = 8
ALPHA = 1e-4


def same_law(mine: torch.Tensor, theirs: torch.Tensor) -> tuple[bool, str]:
    """Whether two samples (n, columns) come from the same law, column by column (Kolmogorov-Smirnov)."""
    a, b = mine.double().reshape(len(mine), -1), theirs.double().reshape(len(theirs), -1)
    for column in range(a.shape[1]):
        x, y = a[:, column], b[:, column]
        if torch.allclose(x, x[0].expand_as(x)) and torch.allclose(y, x[0].expand_as(y), atol=1e-5):
            continue
        if stats.ks_2samp(x.numpy(), y.numpy()).pvalue < ALPHA:
            return False, f"column {column}: {x.min():.3g}..{x.max():.3g} / {y.min():.3g}..{y.max():.3g}"
    return True, ""


def check_commands(report: Report) -> None:
    """Laws of the draws, and what is made of them."""
    for env in (walking(num_envs=DRAWS), reaching(num_envs=DRAWS)):
        adapted = AdaptedEnv(env)
        disturb(env, torch.Generator().manual_seed(5))
        for name in env.command_manager.active_terms:
            mine = env.command_manager.get_term(name)
            theirs = _genuine_command(mine.cfg, adapted)
            torch.manual_seed(2)
            every = torch.arange(env.num_envs)
            kind = type(mine).__name__
            public = [b for b, v in vars(mine).items() if isinstance(v, torch.Tensor) and b[0] != "_"]
            buffers = [buffer for buffer in public if hasattr(theirs, buffer)]
            draws: dict[str, list[list[torch.Tensor]]] = {buffer: [[], []] for buffer in buffers}
            for _ in range(REPEATS):
                for side, term in enumerate((mine, theirs)):
                    term.reset(every)
                    term.compute(0.0)
                    for buffer in buffers:
                        draws[buffer][side].append(getattr(term, buffer).float().clone())
            for a, b in draws.values():
                report.check("laws", kind, *same_law(torch.cat(a), torch.cat(b)))
            for buffer, value in vars(mine).items():  # from here on the same state
                if isinstance(value, torch.Tensor):
                    getattr(theirs, buffer).copy_(value) if hasattr(theirs, buffer) else None
            for _ in range(3):
                mine.compute(0.0)
                theirs.compute(0.0)
                report.check("commands", kind, same(mine.command, theirs.command), name)
                for metric, value in mine.metrics.items():
                    report.check("commands", f"{kind}: metrics", same(value, theirs.metrics[metric]), metric)
            if hasattr(mine, "compute_success"):
                report.check("commands", f"{kind}: success", same(mine.compute_success(), theirs.compute_success()))


def _genuine_command(cfg: Any, env: Any) -> Any:
    kind = getattr(genuine_mdp, type(cfg).__name__)
    fields = {
        k: v for k, v in vars(cfg).items() if k in kind.__dataclass_fields__ and k not in ("class_type", "ranges")
    }
    genuine = kind(**fields, ranges=kind.Ranges(**vars(cfg.ranges)))
    return getattr(genuine_mdp, type(cfg).__name__.removesuffix("Cfg"))(genuine, env)


def check_actions(report: Report) -> None:
    """Scale, offset, clip, and the targets that the joints get."""
    env = walking(seed=4)
    adapted = AdaptedEnv(env)
    generator = torch.Generator().manual_seed(3)
    disturb(env, generator)
    joints = {"joint_names": [".*_(thigh|calf)_joint"]}
    variants = (
        {},
        {"scale": 0.3, "clip": {".*calf_joint": (-1.5, -1.4)}},
        {"scale": {".*_thigh_joint": 0.5, ".*_calf_joint": 2.0}, "offset": {"FL_calf_joint": 0.1}},
        {"preserve_order": True, "joint_names": ["RR_calf_joint", "FL_calf_joint"]},
    )
    for name, what in (("JointPosition", "position"), ("RelativeJointPosition", "position"),
                       ("JointVelocity", "velocity"), ("JointEffort", "effort")):  # fmt: skip
        for fields in variants:
            arguments = {"asset_name": "robot", **joints, **fields}
            cfg = getattr(mdp, f"{name}ActionCfg")(**copy.deepcopy(arguments))
            genuine_cfg = getattr(genuine_mdp, f"{name}ActionCfg")(**copy.deepcopy(arguments))
            mine = cfg.class_type(cfg, adapted)  # on the adapted asset too: it remembers the targets
            theirs = getattr(genuine_mdp, f"{name}Action")(genuine_cfg, adapted)
            action = torch.randn(env.num_envs, mine.action_dim, generator=generator)
            targets = []
            for term in (mine, theirs):
                term.process_actions(action)
                term.apply_actions()
                targets.append(adapted.scene["robot"].targets[what])
            report.check("actions", name, same(mine.processed_actions, theirs.processed_actions), str(fields))
            report.check("actions", f"{name}: targets", same(*targets), str(fields))
            mine.reset(torch.tensor([0, 2]))
            theirs.reset(torch.tensor([0, 2]))
            report.check("actions", f"{name}: reset", same(mine.raw_actions, theirs.raw_actions), str(fields))


def _state(env: Any) -> torch.Tensor:
    data = env.scene["robot"].data
    env.scene.world.mark_written(None)
    return torch.cat((data.root_pose_w.torch, data.root_vel_w.torch, data.joint_pos.torch, data.joint_vel.torch), 1)


def _model(*names: str) -> Callable[[Any], torch.Tensor]:
    return lambda env: torch.cat([getattr(env.scene["robot"].data, n).torch.flatten(1) for n in names], 1)


def _events() -> list[tuple[str, dict[str, Any], Callable[[Any], torch.Tensor]]]:
    robot, base = {"name": "robot"}, {"name": "robot", "body_names": "base"}
    hips = {"name": "robot", "joint_names": ".*_hip_joint"}
    speeds = {"x": (-0.5, 0.5), "y": (-0.2, 0.3), "yaw": (0.0, 1.0)}
    bodies, joints = _model("body_mass", "body_inertia"), _model("joint_friction_coeff", "joint_viscous_friction_coeff")
    return [
        ("reset_root_state_uniform", {"pose_range": {"x": (-1.0, 1.0), "z": (0.0, 0.2), "roll": (-0.2, 0.2),
         "yaw": (-3.0, 3.0)}, "velocity_range": speeds}, _state),
        ("push_by_setting_velocity", {"velocity_range": speeds}, _state),
        ("reset_joints_by_scale", {"position_range": (0.5, 1.5), "velocity_range": (0.0, 0.0)}, _state),
        ("reset_joints_by_offset", {"position_range": (-0.4, 1.5), "velocity_range": (-1.0, 1.0),
         "asset_cfg": hips}, _state),
        ("reset_scene_to_default", {}, _state),
        ("apply_external_force_torque", {"force_range": (-2.0, 3.0), "torque_range": (0.0, 1.0), "asset_cfg": base},
         lambda env: env.scene["robot"].permanent_wrench_composer.state_dict()["wrench"].flatten(1)),
        ("randomize_rigid_body_mass", {"asset_cfg": base, "mass_distribution_params": (-1.0, 3.0),
         "operation": "add"}, bodies),
        ("randomize_rigid_body_mass", {"asset_cfg": robot, "mass_distribution_params": (0.5, 2.0),
         "operation": "scale", "distribution": "log_uniform"}, bodies),
        ("randomize_rigid_body_mass", {"asset_cfg": base, "mass_distribution_params": (4.0, 0.5), "operation": "abs",
         "distribution": "gaussian", "recompute_inertia": False}, bodies),
        ("randomize_rigid_body_com", {"asset_cfg": base, "com_range": {"x": (-0.05, 0.05), "z": (0.0, 0.1)}},
         _model("body_com_pose_b")),
        ("randomize_actuator_gains", {"asset_cfg": robot, "stiffness_distribution_params": (0.8, 1.2),
         "damping_distribution_params": (0.5, 2.0), "operation": "scale"}, _model("joint_stiffness", "joint_damping")),
        ("randomize_joint_parameters", {"asset_cfg": hips, "friction_distribution_params": (0.0, 0.4)}, joints),
        ("randomize_joint_parameters", {"asset_cfg": robot, "armature_distribution_params": (0.5, 2.0),
         "operation": "scale"}, _model("joint_armature")),
        ("randomize_joint_parameters", {"asset_cfg": hips, "lower_limit_distribution_params": (-0.1, 0.1),
         "upper_limit_distribution_params": (-0.1, 0.1), "operation": "add"}, _model("joint_pos_limits")),
    ]  # fmt: skip


def check_events(report: Report) -> None:
    """The law of the state or of the physical parameters after an event, and which environments it left alone."""
    for name, params, read in _events():
        results = []
        for side in ("kit", "genuine"):
            env = walking(seed=6, num_envs=DRAWS)
            torch.manual_seed(7)
            if side == "kit":
                _fire_kit(env, name, params)
            else:
                _fire_genuine(AdaptedEnv(env), name, params)
            results.append(read(env).clone())
        kit, genuine = results
        report.check("laws", f"event {name}", *same_law(kit[: DRAWS // 2], genuine[: DRAWS // 2]))
        report.check("events", f"{name}: others untouched", same(kit[DRAWS // 2 :], genuine[DRAWS // 2 :]))
    for name, why in (
        ("randomize_rigid_body_material", "genuine code writes through PhysX or Newton views; signature compared"),
        ("randomize_physics_scene_gravity", "genuine code writes to the backend's scene; signature compared"),
    ):
        report.skip(f"event {name}", why)


def _half() -> torch.Tensor:
    return torch.arange(DRAWS // 2)


def _fire_kit(env: Any, name: str, params: dict[str, Any]) -> None:
    given = {k: SceneEntityCfg(**v) if k == "asset_cfg" else v for k, v in copy.deepcopy(params).items()}
    manager = EventManager({"event": EventTermCfg(func=getattr(mdp, name), mode="probe", params=given)}, env)
    manager.apply("probe", _half())


def _fire_genuine(env: Any, name: str, params: dict[str, Any]) -> None:
    given = {
        k: genuine_managers.SceneEntityCfg(**v) if k == "asset_cfg" else v for k, v in copy.deepcopy(params).items()
    }
    # The Newton engine is not installed; for implicit actuators nothing of this module is called.
    sys.modules.setdefault("isaaclab.actuators.newton", MagicMock())
    cfg = genuine_managers.EventTermCfg(func=getattr(genuine_mdp, name), mode="probe", params=given)
    manager = genuine_managers.EventManager({"event": cfg}, env)
    manager.apply("probe", env_ids=_half())
