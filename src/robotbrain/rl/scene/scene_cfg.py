"""Configurations of the simulation, the scene and what is in it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import field
from typing import Any

from robotbrain.rl.configclass import MISSING, Config, configclass


@configclass
class SimulationCfg(Config):
    """The physics.

    Attributes:
        dt: physics time step [s].
        gravity: acceleration in the world frame [m/s^2].
        device: where the tensors live; only ``"cpu"``.
    """

    dt: float = 0.005
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    device: str = "cpu"


@configclass
class InitialStateCfg(Config):
    """The default state of an articulation; what is ``None`` comes from the model's first keyframe, or its ``qpos0``.

    Attributes:
        pos: of the root in the world [m].
        rot: of the root, xyzw.
        lin_vel, ang_vel: of the root in the world [m/s], [rad/s].
        joint_pos, joint_vel: by joint name (regular expressions) [rad or m], [rad/s or m/s].
    """

    pos: tuple[float, float, float] | None = None
    rot: tuple[float, float, float, float] | None = None
    lin_vel: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ang_vel: tuple[float, float, float] = (0.0, 0.0, 0.0)
    joint_pos: dict[str, float] | None = None
    joint_vel: dict[str, float] | None = None


@configclass
class ArticulationCfg(Config):
    """A robot: a tree of bodies in an MJCF model.

    Attributes:
        model: MJCF text, or a function without arguments that returns it (resolved once, when the scene is made).
            ``None``: the robot is part of the model that another articulation of the scene brings.
        root_body: name of the tree's root; ``None``: the first body of the world that has joints in its tree.
        init_state: default state, which resets start from.
        soft_joint_pos_limit_factor: the part of each joint's range that counts as its soft limits.
    """

    model: str | Callable[[], str] | None = MISSING
    root_body: str | None = None
    init_state: InitialStateCfg = field(default_factory=InitialStateCfg)
    soft_joint_pos_limit_factor: float = 1.0


@configclass
class ContactSensorCfg(Config):
    """Contact forces from the model's touch sensors named ``contact_<body>``.

    Attributes:
        track_air_time: whether the times in the air and in contact are kept.
        force_threshold: a body is in contact above this force [N].
    """

    track_air_time: bool = True
    force_threshold: float = 1.0


@configclass
class LidarCfg(Config):
    """A planar lidar on a body.

    Attributes:
        body: that carries it; its own geoms are not seen.
        offset: of the lidar in the body's frame [m].
        angles: of the rays about the body's z axis, 0 is forward, counter-clockwise [rad].
        max_range: reported where nothing is nearer [m].
        geomgroup: six flags, which groups of geoms are seen; ``None``: all.
    """

    body: str = MISSING
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    angles: tuple[float, ...] = tuple(2.0 * math.pi * i / 36 - math.pi for i in range(36))
    max_range: float = 10.0
    geomgroup: tuple[int, ...] | None = None


@configclass
class InteractiveSceneCfg(Config):
    """The scene; a subclass adds its entities as fields, in any order.

    Attributes:
        num_envs: number of environments.
        env_spacing: kept for Isaac Lab's sake; here every environment is a world of its own around the origin.
    """

    num_envs: int = MISSING
    env_spacing: float = 2.5


def entities(cfg: InteractiveSceneCfg) -> dict[str, Any]:
    """The entities of a scene by name: every field that is no setting of the scene itself and not ``None``."""
    settings = InteractiveSceneCfg.__dataclass_fields__
    return {k: getattr(cfg, k) for k in cfg.__dataclass_fields__ if k not in settings and getattr(cfg, k) is not None}
