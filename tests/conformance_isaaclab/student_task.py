"""A task as a student would write it: own terms, own constants, a subclassed action, every kind of manager."""

from __future__ import annotations

import math

import torch

from robotbrain.errors import InputError
from robotbrain.rl import math_utils, mdp
from robotbrain.rl.configclass import configclass
from robotbrain.rl.envs import ManagerBasedRLEnv, ManagerBasedRLEnvCfg
from robotbrain.rl.managers import (
    CurriculumTermCfg,
    EventTermCfg,
    ManagerTermBase,
    ObservationGroupCfg,
    ObservationTermCfg,
    RewardTermCfg,
    SceneEntityCfg,
    TerminationTermCfg,
)
from robotbrain.rl.noise_cfg import GaussianNoiseCfg
from robotbrain.rl.ppo_cfg import RslRlMLPModelCfg, RslRlOnPolicyRunnerCfg, RslRlPpoAlgorithmCfg
from robotbrain.rl.robots import arm_mjcf
from robotbrain.rl.scene import ArticulationCfg, InteractiveSceneCfg

BONUS_RADIUS = 0.05
AXIS = torch.tensor([0.0, 0.0, -1.0])


def _hand_axis(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg) -> torch.Tensor:
    quat = env.scene[asset_cfg.name].data.body_quat_w.torch[:, asset_cfg.body_ids][:, 0]
    return math_utils.quat_apply(quat, AXIS.to(quat.device).expand(env.num_envs, 3))


def hand_points_down(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg) -> torch.Tensor:
    """How far the hand's axis is turned from straight down, 0..1."""
    return 0.5 * (1.0 - _hand_axis(env, asset_cfg)[:, 2])


def near_bonus(env: ManagerBasedRLEnv, command_name: str, asset_cfg: SceneEntityCfg) -> torch.Tensor:
    """1 within the radius."""
    return (mdp.position_command_error(env, command_name, asset_cfg) < BONUS_RADIUS).float()


class held_still(ManagerTermBase):  # noqa: N801
    """Number of control steps in a row that the arm has hardly moved."""

    def __init__(self, cfg, env) -> None:  # type: ignore[no-untyped-def]
        super().__init__(cfg, env)
        if cfg.params["speed"] <= 0:
            raise InputError("held_still: speed", given=cfg.params["speed"], expected="above 0", fix="Give 0.1.")
        self.count = torch.zeros(env.num_envs, device=env.device)

    def reset(self, env_ids=None) -> None:  # type: ignore[no-untyped-def]
        self.count[slice(None) if env_ids is None else env_ids] = 0.0

    def __call__(self, env: ManagerBasedRLEnv, speed: float) -> torch.Tensor:
        still = env.scene["robot"].data.joint_vel.torch.abs().amax(dim=1) < speed
        self.count = torch.where(still, self.count + 1.0, torch.zeros_like(self.count))
        return self.count > math.ceil(1.0 / env.step_dt)


@configclass
class SceneCfg(InteractiveSceneCfg):
    robot: ArticulationCfg = ArticulationCfg(model=arm_mjcf, soft_joint_pos_limit_factor=0.9)


@configclass
class PolicyCfg(ObservationGroupCfg):
    position = ObservationTermCfg(func=mdp.joint_pos_rel, noise=GaussianNoiseCfg(std=0.01), history_length=2)
    speed = ObservationTermCfg(func=mdp.joint_vel_rel, clip=(-5.0, 5.0), scale=0.1, delay_max_lag=2)
    hand = ObservationTermCfg(func=mdp.body_pos_b, params={"asset_cfg": SceneEntityCfg("robot", body_names="hand")})
    command = ObservationTermCfg(func=mdp.generated_commands, params={"command_name": "goal"})

    def __post_init__(self) -> None:
        super().__post_init__()
        self.enable_corruption = True


@configclass
class CriticCfg(ObservationGroupCfg):
    position = ObservationTermCfg(func=mdp.joint_pos)
    forces = ObservationTermCfg(func=mdp.joint_effort, scale=(0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1))


@configclass
class ObservationsCfg:
    policy: PolicyCfg = PolicyCfg()
    critic: CriticCfg = CriticCfg()


@configclass
class ActionsCfg:
    arm = mdp.HeldRelativeJointPositionActionCfg(
        asset_name="robot", joint_names=["joint[1-4]"], scale={"joint[12]": 0.2, "joint[34]": 0.3}
    )
    wrist = mdp.JointPositionActionCfg(
        asset_name="robot", joint_names=["joint[5-7]"], scale=0.5, clip={"joint5": (-1.0, 1.0)}
    )


@configclass
class CommandsCfg:
    goal = mdp.UniformPoseCommandCfg(
        asset_name="robot",
        body_name="hand",
        resampling_time_range=(4.0, 5.0),
        position_success_threshold=0.03,
        ranges=mdp.UniformPoseCommandCfg.Ranges(
            pos_x=(0.3, 0.6), pos_y=(-0.3, 0.3), pos_z=(0.2, 0.5), roll=(0.0, 0.0), pitch=(math.pi, math.pi),
            yaw=(-1.0, 1.0),
        ),
    )  # fmt: skip


HAND = SceneEntityCfg("robot", body_names="hand")


@configclass
class RewardsCfg:
    far = RewardTermCfg(
        func=mdp.position_command_error, weight=-0.2, params={"command_name": "goal", "asset_cfg": HAND}
    )
    near = RewardTermCfg(
        func=mdp.position_command_error_gauss,
        weight=-0.3,
        params={"std": 0.03, "command_name": "goal", "asset_cfg": HAND},
    )
    down = RewardTermCfg(func=hand_points_down, weight=-0.1, params={"asset_cfg": HAND})
    bonus = RewardTermCfg(func=near_bonus, weight=1.0, params={"command_name": "goal", "asset_cfg": HAND})
    rate = RewardTermCfg(func=mdp.action_rate_l2, weight=-0.001)


@configclass
class TerminationsCfg:
    time_out = TerminationTermCfg(func=mdp.time_out, time_out=True)
    still = TerminationTermCfg(func=held_still, params={"speed": 0.01})


@configclass
class EventsCfg:
    latency = EventTermCfg(
        func=mdp.randomize_action_latency, mode="reset", params={"action_name": "arm", "latency_range": (0, 6)}
    )
    strength = EventTermCfg(func=mdp.randomize_motor_strength, mode="startup", params={"strength_range": (0.8, 1.1)})
    mass = EventTermCfg(
        func=mdp.randomize_rigid_body_mass,
        mode="startup",
        params={"asset_cfg": HAND, "mass_distribution_params": (0.5, 2.0), "operation": "scale"},
    )
    joints = EventTermCfg(
        func=mdp.reset_joints_by_offset,
        mode="reset",
        params={"position_range": (-0.1, 0.1), "velocity_range": (0.0, 0.0)},
    )


@configclass
class CurriculumCfg:
    smoother = CurriculumTermCfg(
        func=mdp.modify_reward_weight, params={"term_name": "rate", "weight": -0.01, "num_steps": 5000}
    )


@configclass
class StudentEnvCfg(ManagerBasedRLEnvCfg):
    scene: SceneCfg = SceneCfg(num_envs=16)
    observations: ObservationsCfg = ObservationsCfg()
    actions: ActionsCfg = ActionsCfg()
    commands: CommandsCfg = CommandsCfg()
    rewards: RewardsCfg = RewardsCfg()
    terminations: TerminationsCfg = TerminationsCfg()
    events: EventsCfg = EventsCfg()
    curriculum: CurriculumCfg = CurriculumCfg()

    def __post_init__(self) -> None:
        super().__post_init__()
        self.decimation = 8
        self.episode_length_s = 6.0
        self.seed = 7


@configclass
class StudentPPOCfg(RslRlOnPolicyRunnerCfg):
    num_steps_per_env = 24
    max_iterations = 100
    save_interval = 20
    experiment_name = "student"
    obs_groups = {"actor": ["policy"], "critic": ["policy", "critic"]}  # noqa: RUF012
    actor = RslRlMLPModelCfg(
        hidden_dims=[64, 64],
        activation="elu",
        distribution_cfg=RslRlMLPModelCfg.GaussianDistributionCfg(init_std=0.8),
    )
    critic = RslRlMLPModelCfg(hidden_dims=[64, 64], activation="elu")
    algorithm = RslRlPpoAlgorithmCfg(
        value_loss_coef=1.0, use_clipped_value_loss=True, clip_param=0.2, entropy_coef=0.0, num_learning_epochs=5,
        num_mini_batches=4, learning_rate=1e-3, schedule="adaptive", gamma=0.98, lam=0.95, desired_kl=0.01,
        max_grad_norm=1.0,
    )  # fmt: skip
