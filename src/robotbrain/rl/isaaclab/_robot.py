"""A robot of the kit as genuine Isaac Lab takes it: its MJCF without the world, and its servos as actuators."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from robotbrain.errors import InputError
from robotbrain.rl.scene.articulation import Articulation
from robotbrain.rl.scene.scene_cfg import ArticulationCfg

_TOP_LEVEL = ("actuator", "sensor", "keyframe", "contact", "equality", "tendon")


@dataclass
class RobotFiles:
    """What an articulation is turned into.

    Attributes:
        mjcf: its MJCF, robot only.
        keywords: arguments of ``isaaclab.assets.ArticulationCfg`` that need no code of their own.
        servos: arguments of its ``ImplicitActuatorCfg``.
        fixed: whether its base is fixed.
        left_out: parts of the world that are not in it.
        friction: of the ground.
        joint_names, body_names: in the order that actions and observations have here.
    """

    mjcf: str
    init_state: dict[str, Any]
    servos: dict[str, Any]
    fixed: bool
    joint_names: list[str]
    body_names: list[str]
    soft_limit_factor: float
    friction: float = 1.0
    left_out: list[str] = field(default_factory=list)


def robot_files(cfg: ArticulationCfg, robot: Articulation) -> RobotFiles:
    """Take a robot out of its scene.

    Raises:
        InputError: the articulation has no model of its own.
    """
    if cfg.model is None:
        raise InputError(
            "scene",
            given="a robot without a model of its own",
            expected="one robot",
            fix="Export tasks with one articulation; add the others to the generated file.",
        )
    text = cfg.model() if callable(cfg.model) else cfg.model
    layout = robot.layout
    mjcf, left_out = strip_world(text, layout.body_names[0])
    names = layout.joint_names
    data = robot.data
    pose = layout.default_root_pose
    state = {
        "pos": _numbers(pose[:3]),
        "rot": _numbers(pose[3:]),
        "lin_vel": _numbers(layout.default_root_vel[:3]),
        "ang_vel": _numbers(layout.default_root_vel[3:]),
        "joint_pos": _by_name(names, layout.default_joint_pos),
        "joint_vel": _by_name(names, layout.default_joint_vel),
    }
    limits = data.joint_effort_limits.torch[0].tolist()
    servos = {
        "joint_names_expr": list(names),
        "stiffness": _by_name(names, data.joint_stiffness.torch[0]),
        "damping": _by_name(names, data.joint_damping.torch[0]),
        "joint_effort_limit": _by_name(*_finite(names, limits)) or None,
        "armature": _by_name(names, data.joint_armature.torch[0]),
        "friction": _by_name(names, data.joint_friction_coeff.torch[0]),
        "viscous_friction": _by_name(names, data.joint_viscous_friction_coeff.torch[0]),
    }
    return RobotFiles(
        mjcf=mjcf,
        init_state=state,
        servos=servos,
        fixed=robot.is_fixed_base,
        joint_names=list(names),
        body_names=list(layout.body_names),
        soft_limit_factor=cfg.soft_joint_pos_limit_factor,
        friction=_robot_friction(robot),
        left_out=left_out,
    )


def strip_world(mjcf: str, root_body: str) -> tuple[str, list[str]]:
    """The MJCF of the body ``root_body`` alone, and what was left out.

    Servos, sensors and keyframes are left out because Isaac Lab configures its own; lights, floors and other bodies
    because the robot's file is copied into each environment.
    """
    root = ET.fromstring(mjcf)
    left_out = []
    for world in root.findall("worldbody"):
        for child in list(world):
            if child.tag == "body" and child.get("name") == root_body:
                continue
            world.remove(child)
            left_out.append(f"{child.tag} {child.get('name', '')}".strip())
    for tag in _TOP_LEVEL:
        for element in root.findall(tag):
            root.remove(element)
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n", left_out


def _robot_friction(robot: Articulation) -> float:
    bodies = set(robot.body_ids_in_model)
    owner = robot.default_model_param("geom_bodyid").tolist()
    collides = (robot.default_model_param("geom_contype") | robot.default_model_param("geom_conaffinity")) != 0
    friction = robot.default_model_param("geom_friction")[:, 0]
    mine = [float(friction[g]) for g, body in enumerate(owner) if body in bodies and bool(collides[g])]
    return _round(max(mine)) if mine else 1.0


def _by_name(names: list[str], values: Any) -> dict[str, float]:
    found = {name: _round(float(value)) for name, value in zip(names, values, strict=True)}
    return {".*": found[names[0]]} if len(found) > 1 and len(set(found.values())) == 1 else found


def _finite(names: list[str], values: list[float]) -> tuple[list[str], list[float]]:
    kept = [(name, value) for name, value in zip(names, values, strict=True) if math.isfinite(value)]
    return [name for name, _ in kept], [value for _, value in kept]


def _numbers(values: Any) -> tuple[float, ...]:
    return tuple(_round(float(v)) for v in np.asarray(values))


def _round(value: float) -> float:
    """Seven digits: what float32 holds."""
    return float(f"{value:.7g}") + 0.0  # no -0.0
