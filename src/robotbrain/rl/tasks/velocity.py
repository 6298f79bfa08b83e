"""Velocity tracking on flat ground: the quadruped walks as fast, sideways and round as it is told.

Terms, observation order and reward shapes are those of Isaac Lab 3.0's flat velocity task, with weights for a robot of
13 kg. The command is (vx, vy, yaw rate) in the robot's frame, within +-1 m/s, +-0.5 m/s and +-1 rad/s; a share of
the draws tells it to stand still. An episode lasts 20 s and ends early when the trunk touches the floor or tilts over.
"""

from __future__ import annotations

import hashlib
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotbrain.rl import mdp
from robotbrain.rl.configclass import configclass
from robotbrain.rl.envs import ManagerBasedRLEnvCfg
from robotbrain.rl.managers import (
    CurriculumTermCfg,
    EventTermCfg,
    ObservationGroupCfg,
    ObservationTermCfg,
    RewardTermCfg,
    SceneEntityCfg,
    TerminationTermCfg,
)
from robotbrain.rl.noise_cfg import UniformNoiseCfg
from robotbrain.rl.ppo_cfg import RslRlMLPModelCfg, RslRlOnPolicyRunnerCfg, RslRlPpoAlgorithmCfg, RslRlSymmetryCfg
from robotbrain.rl.robots.quadruped import DEFAULT_JOINT_POS, JOINT_NAMES, SPEC, quadruped_mjcf
from robotbrain.rl.scene import ArticulationCfg, ContactSensorCfg, InteractiveSceneCfg
from robotbrain.rl.tasks.velocity_symmetry import OBSERVATIONS, mirror_left_right

if TYPE_CHECKING:
    from robotbrain.rl.policy_meta import PolicyMeta
    from robotbrain.rl.ppo import Network

COMMAND_RANGES = ((-1.0, 1.0), (-0.5, 0.5), (-1.0, 1.0))
"""Bounds of vx (m/s), vy (m/s) and yaw rate (rad/s)."""
WALKS_AFTER = 15_800
"""Control steps (of each environment) after which the quadruped walks, and the curriculum asks for more."""
ACTION_SCALE = 0.25
"""Servo target of a joint = default angle + ACTION_SCALE * action (rad)."""


@configclass
class VelocitySceneCfg(InteractiveSceneCfg):
    """The quadruped and the touch sensors of its trunk, thighs, calves and feet."""

    robot: ArticulationCfg = ArticulationCfg(model=quadruped_mjcf, root_body="base")
    contact_forces: ContactSensorCfg = ContactSensorCfg()


@configclass
class CommandsCfg:
    """What the robot is told; drawn anew every 10 s."""

    base_velocity = mdp.UniformVelocityCommandCfg(
        asset_name="robot",
        resampling_time_range=(10.0, 10.0),
        rel_standing_envs=0.1,
        rel_heading_envs=0.0,
        heading_command=False,
        ranges=mdp.UniformVelocityCommandCfg.Ranges(
            lin_vel_x=COMMAND_RANGES[0], lin_vel_y=COMMAND_RANGES[1], ang_vel_z=COMMAND_RANGES[2]
        ),
    )


@configclass
class ActionsCfg:
    """Targets of the joints' position servos."""

    joint_pos = mdp.JointPositionActionCfg(
        asset_name="robot", joint_names=[".*_joint"], scale=ACTION_SCALE, use_default_offset=True
    )


@configclass
class PolicyObservationsCfg(ObservationGroupCfg):
    """What the policy sees, with the noise of affordable sensors."""

    base_lin_vel = ObservationTermCfg(func=mdp.base_lin_vel, noise=UniformNoiseCfg(n_min=-0.1, n_max=0.1))
    base_ang_vel = ObservationTermCfg(func=mdp.base_ang_vel, noise=UniformNoiseCfg(n_min=-0.2, n_max=0.2))
    projected_gravity = ObservationTermCfg(func=mdp.projected_gravity, noise=UniformNoiseCfg(n_min=-0.05, n_max=0.05))
    velocity_commands = ObservationTermCfg(func=mdp.generated_commands, params={"command_name": "base_velocity"})
    joint_pos = ObservationTermCfg(func=mdp.joint_pos_rel, noise=UniformNoiseCfg(n_min=-0.01, n_max=0.01))
    joint_vel = ObservationTermCfg(func=mdp.joint_vel_rel, noise=UniformNoiseCfg(n_min=-1.5, n_max=1.5))
    actions = ObservationTermCfg(func=mdp.last_action)

    def __post_init__(self) -> None:
        """Switch the noise on."""
        super().__post_init__()
        self.enable_corruption = True
        self.concatenate_terms = True


@configclass
class ObservationsCfg:
    """One group, for actor and critic."""

    policy: PolicyObservationsCfg = PolicyObservationsCfg()


@configclass
class RewardsCfg:
    """What is wanted (first two) and what spoils it; weights are per second."""

    track_lin_vel_xy_exp = RewardTermCfg(
        func=mdp.track_lin_vel_xy_exp, weight=1.5, params={"command_name": "base_velocity", "std": math.sqrt(0.25)}
    )
    track_ang_vel_z_exp = RewardTermCfg(
        func=mdp.track_ang_vel_z_exp, weight=0.75, params={"command_name": "base_velocity", "std": math.sqrt(0.25)}
    )
    lin_vel_z_l2 = RewardTermCfg(func=mdp.lin_vel_z_l2, weight=-2.0)
    ang_vel_xy_l2 = RewardTermCfg(func=mdp.ang_vel_xy_l2, weight=-0.05)
    flat_orientation_l2 = RewardTermCfg(func=mdp.flat_orientation_l2, weight=-2.5)
    base_height_l2 = RewardTermCfg(func=mdp.base_height_l2, weight=-30.0, params={"target_height": 0.3})
    dof_torques_l2 = RewardTermCfg(func=mdp.joint_torques_l2, weight=-2.0e-4)
    dof_acc_l2 = RewardTermCfg(func=mdp.joint_acc_l2, weight=-1.0e-7)
    action_rate_l2 = RewardTermCfg(func=mdp.action_rate_l2, weight=-0.01)
    hip_deviation_l1 = RewardTermCfg(
        func=mdp.joint_deviation_l1,
        weight=-0.1,
        params={"asset_cfg": SceneEntityCfg("robot", joint_names=".*_hip_joint")},
    )
    stand_still = RewardTermCfg(
        func=mdp.stand_still_joint_deviation_l1, weight=-0.5, params={"command_name": "base_velocity"}
    )
    feet_air_time = RewardTermCfg(
        func=mdp.feet_air_time,
        weight=1.0,
        params={
            "sensor_cfg": SceneEntityCfg("contact_forces", body_names=".*_foot"),
            "command_name": "base_velocity",
            "threshold": 0.3,
        },
    )
    undesired_contacts = RewardTermCfg(
        func=mdp.undesired_contacts,
        weight=-1.0,
        params={"sensor_cfg": SceneEntityCfg("contact_forces", body_names=".*_(thigh|calf)"), "threshold": 1.0},
    )


@configclass
class TerminationsCfg:
    """Time is up, or the robot has fallen."""

    time_out = TerminationTermCfg(func=mdp.time_out, time_out=True)
    base_contact = TerminationTermCfg(
        func=mdp.illegal_contact,
        params={"sensor_cfg": SceneEntityCfg("contact_forces", body_names="base"), "threshold": 1.0},
    )
    bad_orientation = TerminationTermCfg(func=mdp.bad_orientation, params={"limit_angle": math.radians(72.0)})


@configclass
class EventsCfg:
    """Domain randomisation, the start of an episode, and pushes."""

    physics_material = EventTermCfg(
        func=mdp.randomize_rigid_body_material,
        mode="startup",
        params={
            "asset_cfg": SceneEntityCfg("robot", body_names=".*"),
            "static_friction_range": (0.5, 1.25),
            "dynamic_friction_range": (0.5, 1.25),
            "restitution_range": (0.0, 0.0),
            "num_buckets": 64,
            "make_consistent": True,
        },
    )
    add_base_mass = EventTermCfg(
        func=mdp.randomize_rigid_body_mass,
        mode="startup",
        params={
            "asset_cfg": SceneEntityCfg("robot", body_names="base"),
            "mass_distribution_params": (-1.0, 3.0),
            "operation": "add",
        },
    )
    base_com = EventTermCfg(
        func=mdp.randomize_rigid_body_com,
        mode="startup",
        params={
            "asset_cfg": SceneEntityCfg("robot", body_names="base"),
            "com_range": {"x": (-0.03, 0.03), "y": (-0.02, 0.02), "z": (-0.02, 0.02)},
        },
    )
    motor_strength = EventTermCfg(
        func=mdp.randomize_actuator_gains,
        mode="startup",
        params={
            "asset_cfg": SceneEntityCfg("robot", joint_names=".*_joint"),
            "stiffness_distribution_params": (0.9, 1.1),
            "damping_distribution_params": (0.9, 1.1),
            "operation": "scale",
        },
    )
    reset_base = EventTermCfg(
        func=mdp.reset_root_state_uniform,
        mode="reset",
        params={
            "pose_range": {"x": (-0.5, 0.5), "y": (-0.5, 0.5), "z": (0.02, 0.02), "yaw": (-math.pi, math.pi)},
            "velocity_range": dict.fromkeys(("x", "y", "z", "roll", "pitch", "yaw"), (-0.5, 0.5)),
        },
    )
    reset_robot_joints = EventTermCfg(
        func=mdp.reset_joints_by_scale,
        mode="reset",
        params={"position_range": (0.8, 1.2), "velocity_range": (0.0, 0.0)},
    )
    push_robot = EventTermCfg(
        func=mdp.push_by_setting_velocity,
        mode="interval",
        interval_range_s=(10.0, 15.0),
        params={"velocity_range": {"x": (-0.5, 0.5), "y": (-0.5, 0.5)}},
    )


def after_steps(env: Any, env_ids: Any, old: float, value: float, num_steps: int) -> Any:
    """Return ``value`` once the environment has made ``num_steps`` control steps; for ``mdp.modify_term_cfg``."""
    return value if env.common_step_counter > num_steps else mdp.modify_term_cfg.NO_CHANGE


def _sharper(term: str, std: float) -> CurriculumTermCfg:
    return CurriculumTermCfg(
        func=mdp.modify_term_cfg,
        params={
            "address": f"rewards.{term}.params.std",
            "modify_fn": after_steps,
            "modify_params": {"value": std, "num_steps": WALKS_AFTER},
        },
    )


def _reweighted(term: str, weight: float, num_steps: int = WALKS_AFTER) -> CurriculumTermCfg:
    return CurriculumTermCfg(
        func=mdp.modify_reward_weight, params={"term_name": term, "weight": weight, "num_steps": num_steps}
    )


@configclass
class CurriculumCfg:
    """First walk, then walk well.

    From the start these settings would teach it to stand: steps that are short and rough cost more than they earn.
    """

    lin_vel_std = _sharper("track_lin_vel_xy_exp", 0.3)
    ang_vel_std = _sharper("track_ang_vel_z_exp", 0.35)
    feet_air_time = _reweighted("feet_air_time", 5.0)
    action_rate = _reweighted("action_rate_l2", -0.02)
    stand_still = _reweighted("stand_still", -2.5, 20400)


@configclass
class VelocityEnvCfg(ManagerBasedRLEnvCfg):
    """The task; physics at 200 Hz, control at 50 Hz."""

    scene: VelocitySceneCfg = VelocitySceneCfg(num_envs=256)
    observations: ObservationsCfg = ObservationsCfg()
    actions: ActionsCfg = ActionsCfg()
    commands: CommandsCfg = CommandsCfg()
    rewards: RewardsCfg = RewardsCfg()
    terminations: TerminationsCfg = TerminationsCfg()
    events: EventsCfg = EventsCfg()
    curriculum: CurriculumCfg = CurriculumCfg()

    def __post_init__(self) -> None:
        """Set the rates."""
        super().__post_init__()
        self.sim.dt = 0.005
        self.decimation = 4
        self.episode_length_s = 20.0
        # Else a beginner earns less by living than by falling, and learns to fall.
        self.only_positive_rewards = True

    def finish_curriculum(self) -> None:
        """Ask for everything from the start: for training that goes on from a robot that walks already."""
        for term in vars(self.curriculum).values():
            to = term.params
            if term.func is mdp.modify_reward_weight:
                getattr(self.rewards, to["term_name"]).weight = to["weight"]
            else:
                getattr(self.rewards, to["address"].split(".")[1]).params["std"] = to["modify_params"]["value"]
        self.curriculum = None  # type: ignore[assignment]

    def play_mode(self) -> None:
        """Make it the task to look at or to evaluate: no noise, no randomisation, no pushes."""
        super().play_mode()
        for name in ("physics_material", "add_base_mass", "base_com", "motor_strength", "push_robot"):
            setattr(self.events, name, None)


@configclass
class VelocityPPORunnerCfg(RslRlOnPolicyRunnerCfg):
    """The recipe of the shipped policy."""

    num_steps_per_env = 24
    max_iterations = 1136
    save_interval = 50
    experiment_name = "velocity"
    obs_groups: dict[str, list[str]] = {"actor": ["policy"], "critic": ["policy"]}  # noqa: RUF012  (copied by configclass)
    actor = RslRlMLPModelCfg(
        hidden_dims=[128, 128, 64],
        activation="elu",
        obs_normalization=True,
        distribution_cfg=RslRlMLPModelCfg.GaussianDistributionCfg(init_std=1.0),
    )
    critic = RslRlMLPModelCfg(hidden_dims=[128, 128, 64], activation="elu", obs_normalization=True)
    algorithm = RslRlPpoAlgorithmCfg(
        value_loss_coef=1.0,
        use_clipped_value_loss=True,
        clip_param=0.2,
        entropy_coef=0.005,
        num_learning_epochs=4,
        num_mini_batches=4,
        learning_rate=1.0e-3,
        schedule="adaptive",
        gamma=0.99,
        lam=0.95,
        desired_kl=0.01,
        max_grad_norm=1.0,
        symmetry_cfg=RslRlSymmetryCfg(use_data_augmentation=True, data_augmentation_func=mirror_left_right),
    )


# ------------------------------------------------------------ the shipped policy

_WEIGHTS = Path(__file__).parents[1] / "weights"
SHIPPED_CHECKPOINT = _WEIGHTS / "velocity.pt"
"""Actor, critic, normalisers and optimiser, to go on training with."""
SHIPPED_ONNX = _WEIGHTS / "velocity.onnx"
"""The policy alone, with its metadata."""
SHIPPED_CURVE = _WEIGHTS / "velocity_curve.json"
"""Return and errors over environment steps of the training."""
SHIPPED_RECIPE = _WEIGHTS / "velocity_recipe.json"
"""The command that trained it, what that cost, and what came of it."""


def load_shipped() -> Network:
    """Return the shipped actor: observations (n, 48) in, actions (n, 12) out, as ``OBSERVATIONS`` and
    ``ACTION_SCALE`` say.

    Raises:
        InputError: the file is missing or damaged.
    """
    from robotbrain.rl.ppo_train import load_actor

    return load_actor(SHIPPED_CHECKPOINT)


def start_from_shipped(run_dir: str | Path) -> int:
    """Put the shipped checkpoint into the folder of a new run, for ``train_ppo(..., resume=True)`` to go on with.

    Use 256 environments, ``VelocityPPORunnerCfg()`` and :meth:`VelocityEnvCfg.finish_curriculum`.

    Returns:
        Its iterations; pass more to ``train_ppo``.

    Raises:
        InputError: the shipped file is missing or damaged.
    """
    from robotbrain.rl.checkpoint import load_checkpoint, save_checkpoint
    from robotbrain.rl.ppo_train import CHECKPOINT_FILE, KIND

    saved = load_checkpoint(SHIPPED_CHECKPOINT, kind=KIND)
    save_checkpoint(Path(run_dir) / CHECKPOINT_FILE, saved, kind=KIND)
    return int(saved["iteration"])


def policy_meta(provenance: dict[str, Any] | None = None) -> PolicyMeta:
    """Return what a policy file of this task says about itself."""
    from robotbrain.rl.policy_meta import PolicyMeta

    count = len(JOINT_NAMES)
    return PolicyMeta(
        task="velocity",
        observation_names=OBSERVATIONS,
        control_dt=0.02,
        action_kind="joint_position",
        action_scale=ACTION_SCALE,
        joint_names=JOINT_NAMES,
        default_joint_pos=DEFAULT_JOINT_POS,
        joint_stiffness=(SPEC.stiffness,) * count,
        joint_damping=(SPEC.damping,) * count,
        command_names=("base_velocity",),
        provenance=provenance or {},
    )


def config_hash() -> str:
    """Return a fingerprint of the task, of PPO's settings and of the robot: equal where a recipe still holds."""
    plain = {
        "task": VelocityEnvCfg().to_dict(),
        "ppo": VelocityPPORunnerCfg().to_dict(),
        "robot": quadruped_mjcf(),
    }
    return hashlib.sha256(json.dumps(plain, sort_keys=True, default=str).encode()).hexdigest()[:16]
