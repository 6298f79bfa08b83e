"""The reach task with and without domain randomisation, one group of events at a time.

The laws are what somebody would write who knows the arm's data sheet and not the arm: plain uniform ranges around the
nominal values. The surrogates (:mod:`robotbrain.rl.surrogate`) are drawn from others, and have faults that are in no
law here: play, motor lag, encoder bias, lost frames.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from robotbrain.errors import InputError
from robotbrain.rl import mdp
from robotbrain.rl.configclass import configclass
from robotbrain.rl.gap import TERMS
from robotbrain.rl.managers import EventTermCfg, ObservationTermCfg, SceneEntityCfg
from robotbrain.rl.noise_cfg import UniformNoiseCfg
from robotbrain.rl.policy_meta import PolicyMeta
from robotbrain.rl.tasks.reach import ACTION_SCALE, ObservationsCfg, PolicyObservationsCfg, ReachEnvCfg

LATENCY_STEPS = (0, 10)
"""Physics steps of 5 ms from a command to the servo: 0 to 50 ms."""
LOAD_N = 8.0
"""Constant force on the hand, each component up to this (N): what a payload of 0.8 kg weighs, from any side."""
FRICTION_NM = {"joint[1-2]": 4.0, "joint[3-4]": 2.5, "joint[5-6]": 1.0, "joint7": 0.4}
"""Largest dry friction (N m), and viscous friction (N m s/rad) on top of the model's."""
STRENGTH = (0.7, 1.1)
MASS = (0.85, 1.25)
ANGLE_NOISE, SPEED_NOISE, PLACE_NOISE = 0.004, 0.05, 0.002
"""Half widths of uniform noise: rad, rad/s, m."""


@configclass
class DeployableObservationsCfg(PolicyObservationsCfg):
    """What reach observes, and the last action: with delays, a robot must know what it has just asked for."""

    actions = ObservationTermCfg(func=mdp.last_action)


@configclass
class DeployableObservationGroupsCfg(ObservationsCfg):
    """One group, for actor and critic."""

    policy: PolicyObservationsCfg = DeployableObservationsCfg()


def reach_cfg(randomise: Collection[str] = ()) -> ReachEnvCfg:
    """Return the reach task with these groups of randomisation; without any it is the plain one.

    Both have the same observations, reward and actions.

    Args:
        randomise: names of :data:`robotbrain.rl.gap.TERMS`.

    Raises:
        InputError: an unknown name.
    """
    for name in randomise:
        if name not in TERMS:
            raise InputError("randomisation", given=name, expected=", ".join(TERMS), fix="Check the spelling.")
    cfg = ReachEnvCfg(observations=DeployableObservationGroupsCfg())
    if "noise" in randomise:
        _add_noise(cfg.observations.policy)
    for name, term in _events(randomise).items():
        setattr(cfg.events, name, term)
    return cfg


def _events(randomise: Collection[str]) -> dict[str, EventTermCfg]:
    """Events by name; what needs MuJoCo's constants anew is drawn once per environment, the rest every episode."""
    events: dict[str, EventTermCfg] = {}

    def add(name: str, func: Any, mode: str, **params: Any) -> None:
        events[name] = EventTermCfg(func=func, mode=mode, params=params)

    if "latency" in randomise:
        add("latency", mdp.randomize_action_latency, "reset", action_name="arm_action", latency_range=LATENCY_STEPS)
    if "load" in randomise:
        hand = SceneEntityCfg("robot", body_names="hand")
        force = (-LOAD_N, LOAD_N)
        add(
            "load", mdp.apply_external_force_torque, "reset", asset_cfg=hand, force_range=force, torque_range=(0.0, 0.0)
        )
    if "friction" in randomise:
        for number, (pattern, most) in enumerate(FRICTION_NM.items()):
            add(
                f"friction{number}",
                mdp.randomize_joint_parameters,
                "reset",
                asset_cfg=SceneEntityCfg("robot", joint_names=pattern),
                friction_distribution_params=(0.0, most),
                operation="add",
            )
    if "motor" in randomise:
        everywhere = SceneEntityCfg("robot", joint_names="joint.*")
        add("motor", mdp.randomize_motor_strength, "reset", asset_cfg=everywhere, strength_range=STRENGTH)
    if "mass" in randomise:
        add(
            "mass",
            mdp.randomize_rigid_body_mass,
            "startup",
            asset_cfg=SceneEntityCfg("robot", body_names="link.*"),
            mass_distribution_params=MASS,
            operation="scale",
        )
    return events


def _add_noise(group: Any) -> None:
    for name, half in (
        ("joint_pos", ANGLE_NOISE),
        ("joint_vel", SPEED_NOISE),
        ("ee_pos", PLACE_NOISE),
        ("ee_to_target", PLACE_NOISE),
    ):
        getattr(group, name).noise = UniformNoiseCfg(n_min=-half, n_max=half)


def reach_meta(env: Any, **provenance: Any) -> PolicyMeta:
    """Return what a policy file says about a policy that was trained in a reach environment.

    Args:
        env: the ``ManagerBasedRLEnv``.
        provenance: how it was trained (JSON types only).
    """
    group = env.cfg.observations.policy
    manager, robot = env.observation_manager, env.scene["robot"]
    names, sizes = manager.active_terms["policy"], manager.group_obs_term_dim["policy"]
    scales = [getattr(group, name).scale for name in names]
    count = len(robot.joint_names)
    return PolicyMeta(
        task="reach",
        observation_names=tuple((name, int(size[-1])) for name, size in zip(names, sizes, strict=True)),
        observation_scales=tuple((1.0 if scale is None else float(scale),) for scale in scales),
        control_dt=round(float(env.step_dt), 9),
        action_kind="held_relative_joint_position",
        action_scale=ACTION_SCALE,
        action_low=(-1.0,) * count,
        action_high=(1.0,) * count,
        joint_names=tuple(robot.joint_names),
        default_joint_pos=tuple(robot.data.default_joint_pos.torch[0].tolist()),
        joint_stiffness=tuple(robot.data.joint_stiffness.torch[0].tolist()),
        joint_damping=tuple(robot.data.joint_damping.torch[0].tolist()),
        command_names=("pose_command",),
        provenance=provenance,
    )
