"""Goal reaching with the differential-drive base among obstacles, from lidar.

The room, the obstacles and the base are the lab's: a policy trained here replaces the lab's controller node, see
:mod:`robotbrain.pipeline.nodes.policy_controller`. Ten times a second the policy sees the base's velocity, the goal in
its own frame, the nearest obstacle in each of 36 sectors, and its last action; it commands forward speed and turning
rate within the limits that the lab's own controller keeps. An episode ends at the goal, at the first touch, or after
20 s.

Goals are 0.5 to 3 m away. A policy without memory cannot search a room for the way round a long wall; that is what the
planner is for, whose waypoints are nearer.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import torch

from robotbrain.rl import mdp
from robotbrain.rl.configclass import configclass
from robotbrain.rl.envs import ManagerBasedRLEnvCfg
from robotbrain.rl.managers import (
    EventTermCfg,
    ObservationGroupCfg,
    ObservationTermCfg,
    RewardTermCfg,
    TerminationTermCfg,
)
from robotbrain.rl.noise_cfg import GaussianNoiseCfg
from robotbrain.rl.ppo_cfg import RslRlMLPModelCfg, RslRlOnPolicyRunnerCfg, RslRlPpoAlgorithmCfg, RslRlSymmetryCfg
from robotbrain.rl.robots.base import LIDAR_GROUPS, TIMESTEP_S, base_mjcf
from robotbrain.rl.scene import ArticulationCfg, InteractiveSceneCfg, LidarCfg
from robotbrain.rl.tasks import navigation_mdp as nav
from robotbrain.rl.tasks.layouts import LayoutSpec
from robotbrain.rl.tasks.navigation_spec import (
    ACTION_OFFSET,
    ACTION_SCALE,
    CONTROL_DT,
    GOAL_RANGE,
    LIDAR_NEAREST,
    LIDAR_RANGE,
    OBSERVATION_SCALES,
    SECTORS,
)
from robotbrain.sim.robot import CHASSIS_RADIUS, LIDAR_HEIGHT

Tensor = torch.Tensor

RAYS_PER_SECTOR = 2
REACHED = 0.1
"""Distance to the goal that counts as there (m)."""
TRAIN_SEED, TEST_SEED = 0, 1_000_000
"""Seeds of the stores of rooms for training and for evaluation."""
_RAYS = SECTORS * RAYS_PER_SECTOR


@configclass
class NavigationSceneCfg(InteractiveSceneCfg):
    """The base with its lidar in a room of obstacles."""

    robot: ArticulationCfg = ArticulationCfg(model=base_mjcf, root_body="base")
    lidar: LidarCfg = LidarCfg(
        body="base",
        offset=(0.0, 0.0, LIDAR_HEIGHT),
        angles=tuple(2.0 * math.pi * (i + 0.5) / _RAYS - math.pi for i in range(_RAYS)),
        max_range=8.0,
        geomgroup=LIDAR_GROUPS,
    )


@configclass
class CommandsCfg:
    """One goal for the whole episode."""

    goal = nav.FreePose2dCommandCfg(
        resampling_time_range=(1.0e6, 1.0e6),
        distance=(0.5, 3.0),
        margin=0.27,
    )


@configclass
class ActionsCfg:
    """Forward speed and turning rate."""

    body_velocity = nav.BodyVelocityActionCfg(asset_name="robot", scale=ACTION_SCALE, offset=ACTION_OFFSET)


@configclass
class PolicyObservationsCfg(ObservationGroupCfg):
    """What the policy sees, with noise like that of the lab's sensors."""

    body_velocity = ObservationTermCfg(func=nav.body_velocity, noise=GaussianNoiseCfg(mean=0.0, std=0.02))
    goal = ObservationTermCfg(
        func=nav.goal_polar,
        params={"command_name": "goal"},
        clip=(-1.0, GOAL_RANGE),
        scale=OBSERVATION_SCALES[1],
    )
    lidar_log_range = ObservationTermCfg(
        func=nav.lidar_log_range,
        params={
            "sensor_name": "lidar",
            "sectors": SECTORS,
            "bounds": (LIDAR_NEAREST, LIDAR_RANGE),
            "noise": (-0.02, 0.02),
        },
        scale=OBSERVATION_SCALES[2][0],
    )
    last_action = ObservationTermCfg(func=nav.last_command, params={"action_name": "body_velocity"})

    def __post_init__(self) -> None:
        """Switch the noise on."""
        super().__post_init__()
        self.enable_corruption = True


@configclass
class ObservationsCfg:
    """One group, for actor and critic."""

    policy: PolicyObservationsCfg = PolicyObservationsCfg()


@configclass
class RewardsCfg:
    """Weights are per second; a bonus at the end of an episode counts for one control step of 0.1 s."""

    progress_to_goal = RewardTermCfg(func=nav.progress_to_goal, weight=2.0, params={"command_name": "goal"})
    reached_goal = RewardTermCfg(func=mdp.is_terminated_term, weight=50.0, params={"term_keys": "goal_reached"})
    collision = RewardTermCfg(func=mdp.is_terminated_term, weight=-150.0, params={"term_keys": "collision"})
    obstacle_proximity = RewardTermCfg(
        func=nav.obstacle_proximity, weight=-2.0, params={"radius": CHASSIS_RADIUS, "margin": 0.2}
    )
    action_rate_l2 = RewardTermCfg(func=mdp.action_rate_l2, weight=-0.2)
    time = RewardTermCfg(func=mdp.is_alive, weight=-0.3)


@configclass
class TerminationsCfg:
    """There, touched something, or too late."""

    time_out = TerminationTermCfg(func=mdp.time_out, time_out=True)
    goal_reached = TerminationTermCfg(func=nav.goal_reached, params={"command_name": "goal", "distance": REACHED})
    collision = TerminationTermCfg(func=nav.obstacle_collision, params={"radius": CHASSIS_RADIUS})


@configclass
class EventsCfg:
    """Another room and another start for every episode; drives that differ as the lab's surrogates do."""

    motor_lag = EventTermCfg(func=nav.randomize_motor_lag, mode="startup", params={"lag_range": (0.04, 0.10)})
    layout = EventTermCfg(
        func=nav.reset_layout, mode="reset", params={"spec": LayoutSpec(), "layouts": 1024, "seed": TRAIN_SEED}
    )
    reset_base = EventTermCfg(func=nav.reset_root_state_free, mode="reset", params={"margin": 0.25})
    latency = EventTermCfg(
        func=mdp.randomize_action_latency,
        mode="reset",
        params={"action_name": "body_velocity", "latency_range": (0, 2)},  # physics steps of 50 ms
    )


@configclass
class NavigationEnvCfg(ManagerBasedRLEnvCfg):
    """The task; physics at 20 Hz, control at 10 Hz."""

    scene: NavigationSceneCfg = NavigationSceneCfg(num_envs=256)
    observations: ObservationsCfg = ObservationsCfg()
    actions: ActionsCfg = ActionsCfg()
    commands: CommandsCfg = CommandsCfg()
    rewards: RewardsCfg = RewardsCfg()
    terminations: TerminationsCfg = TerminationsCfg()
    events: EventsCfg = EventsCfg()

    def __post_init__(self) -> None:
        """Set the rates."""
        super().__post_init__()
        self.sim.dt = TIMESTEP_S
        self.sim.gravity = (0.0, 0.0, 0.0)
        self.decimation = round(CONTROL_DT / self.sim.dt)
        self.episode_length_s = 20.0

    def play_mode(self) -> None:
        """Make it the task to evaluate: rooms that were never trained in; noise, lag and latency stay."""
        self.events.layout.params = {**self.events.layout.params, "seed": TEST_SEED}


def mirror_left_right(
    env: Any = None, obs: Mapping[str, Tensor] | None = None, actions: Tensor | None = None
) -> tuple[Any, Tensor | None]:
    """Append the mirror images (left and right swapped) to observations and actions, as rsl-rl's symmetry wants it.

    Args:
        env: not used.
        obs: groups by name, each (B, 43); a ``TensorDict`` comes back as one.
        actions: (B, 2).

    Returns:
        Observations (2 B, 43) and actions (2 B, 2), originals first; None for what was not given.
    """
    if obs is not None:
        images = {name: torch.cat([x, x[:, OBS_MIRROR] * OBS_SIGN]) for name, x in obs.items()}
        rows = len(next(iter(images.values())))
        # rsl-rl hands over a TensorDict and wants one back.
        obs = cast(Any, type(obs))(images, batch_size=[rows]) if hasattr(obs, "batch_size") else images
    if actions is not None:
        actions = torch.cat([actions, actions * torch.tensor([1.0, -1.0])])
    return obs, actions


def _mirror() -> tuple[Tensor, Tensor]:
    sign = [1.0, -1.0, 1.0, -1.0, 1.0, *[1.0] * SECTORS, 1.0, -1.0]
    lidar = torch.arange(5, 5 + SECTORS).flip(0)
    return torch.cat((torch.arange(5), lidar, torch.arange(5 + SECTORS, 7 + SECTORS))), torch.tensor(sign)


OBS_MIRROR, OBS_SIGN = _mirror()
"""Mirror image of observations x (..., 43): ``x[..., OBS_MIRROR] * OBS_SIGN``."""


@configclass
class NavigationPPORunnerCfg(RslRlOnPolicyRunnerCfg):
    """The recipe of the shipped policy."""

    num_steps_per_env = 24
    max_iterations = 150
    save_interval = 25
    experiment_name = "navigation"
    clip_actions = 1.0
    obs_groups: dict[str, list[str]] = {"actor": ["policy"], "critic": ["policy"]}  # noqa: RUF012  (configclass copies it)
    actor = RslRlMLPModelCfg(
        hidden_dims=[128, 128],
        activation="elu",
        distribution_cfg=RslRlMLPModelCfg.GaussianDistributionCfg(init_std=0.7),
    )
    critic = RslRlMLPModelCfg(hidden_dims=[128, 128], activation="elu")
    algorithm = RslRlPpoAlgorithmCfg(
        value_loss_coef=1.0,
        use_clipped_value_loss=True,
        clip_param=0.2,
        entropy_coef=0.003,
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
SHIPPED_CURVE = _WEIGHTS / "navigation_curve.json"
"""Return and how episodes ended over environment steps of the training."""
SHIPPED_RECIPE = _WEIGHTS / "navigation_recipe.json"
"""The command that trained it, what that cost, and what came of it."""


def config_hash() -> str:
    """Return a fingerprint of the task, of PPO's settings and of the base: equal where a recipe still holds."""
    plain = {"task": NavigationEnvCfg().to_dict(), "ppo": NavigationPPORunnerCfg().to_dict(), "robot": base_mjcf()}
    return hashlib.sha256(json.dumps(plain, sort_keys=True, default=str).encode()).hexdigest()[:16]
