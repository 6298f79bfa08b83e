"""Reaching: the arm brings its fingertips to a point and stays there.

Targets are uniform over 0.3 m^3 in front of the arm; an episode is 50 control steps at 25 Hz, and a target counts as
reached when the fingertips are within 2 cm of it over the last 5 steps. The structure is that of Isaac Lab 3.0's reach
task; its orientation part is left out, and three terms are the kit's own (`robotbrain.rl.mdp.extra`).

The plain distance as reward (`ReachDistanceEnvCfg`) hovers about 2 cm: its slope is the same everywhere, so that far
targets drown out the last centimetres. `ReachEnvCfg` adds a term that only matters there.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from robotbrain.rl import mdp
from robotbrain.rl.configclass import configclass
from robotbrain.rl.ddpg import DDPGConfig
from robotbrain.rl.envs import ManagerBasedRLEnvCfg
from robotbrain.rl.envs.gym import TaskVectorEnv
from robotbrain.rl.managers import (
    EventTermCfg,
    ObservationGroupCfg,
    ObservationTermCfg,
    RewardTermCfg,
    SceneEntityCfg,
    TerminationTermCfg,
)
from robotbrain.rl.robots.arm import WORKSPACE, arm_mjcf
from robotbrain.rl.scene import ArticulationCfg, InteractiveSceneCfg

TOLERANCE_M = 0.02
"""A target is reached within this distance (m) ..."""
LAST_STEPS = 5
"""... over so many control steps at the end of the episode."""
EPISODE_STEPS = 50
ACTION_SCALE = 0.3
"""Servo target of a joint = its angle now + ACTION_SCALE * action (rad)."""
START_SPREAD = 0.25
"""Joint angles at the start: the default pose plus or minus so much (rad)."""

_EE = SceneEntityCfg("robot", body_names="ee")


@configclass
class ReachSceneCfg(InteractiveSceneCfg):
    """The arm."""

    robot: ArticulationCfg = ArticulationCfg(model=arm_mjcf)


@configclass
class CommandsCfg:
    """Where to reach, in the base frame: one target per episode."""

    ee_pose = mdp.UniformPoseCommandCfg(
        asset_name="robot",
        body_name="ee",
        resampling_time_range=(1e9, 1e9),
        ranges=mdp.UniformPoseCommandCfg.Ranges(
            pos_x=WORKSPACE[0],
            pos_y=WORKSPACE[1],
            pos_z=WORKSPACE[2],
            roll=(0.0, 0.0),
            pitch=(0.0, 0.0),
            yaw=(0.0, 0.0),
        ),
        position_success_threshold=TOLERANCE_M,
    )


@configclass
class ActionsCfg:
    """Steps of the joints' servo targets."""

    arm_action = mdp.HeldRelativeJointPositionActionCfg(asset_name="robot", joint_names=["joint.*"], scale=ACTION_SCALE)


@configclass
class PolicyObservationsCfg(ObservationGroupCfg):
    """What the policy sees: 27 numbers. The scales bring all of them to about 1."""

    joint_pos = ObservationTermCfg(func=mdp.joint_pos_rel)
    joint_vel = ObservationTermCfg(func=mdp.joint_vel_rel, scale=0.3)
    pose_command = ObservationTermCfg(func=mdp.generated_commands, params={"command_name": "ee_pose"})
    ee_pos = ObservationTermCfg(func=mdp.body_pos_b, params={"asset_cfg": _EE})
    ee_to_target = ObservationTermCfg(
        func=mdp.body_to_command_b, params={"command_name": "ee_pose", "asset_cfg": _EE}, scale=5.0
    )

    def __post_init__(self) -> None:
        """Join the terms to one vector."""
        super().__post_init__()
        self.enable_corruption = True  # of the noise that a variant of the task may add; here there is none
        self.concatenate_terms = True


@configclass
class ObservationsCfg:
    """One group, for actor and critic."""

    policy: PolicyObservationsCfg = PolicyObservationsCfg()


@configclass
class DistanceRewardsCfg:
    """Minus the distance, in metres, at each step (weights are per second, and there are 25 steps in one)."""

    position_tracking = RewardTermCfg(
        func=mdp.position_command_error, weight=-25.0, params={"command_name": "ee_pose", "asset_cfg": _EE}
    )


@configclass
class RewardsCfg(DistanceRewardsCfg):
    """And a penalty that is all about the last centimetres."""

    position_precision = RewardTermCfg(
        func=mdp.position_command_error_gauss,
        weight=-5.0,
        params={"std": 0.03, "command_name": "ee_pose", "asset_cfg": _EE},
    )


@configclass
class TerminationsCfg:
    """Only the clock."""

    time_out = TerminationTermCfg(func=mdp.time_out, time_out=True)


@configclass
class EventsCfg:
    """Another start pose for each episode."""

    reset_robot_joints = EventTermCfg(
        func=mdp.reset_joints_by_offset,
        mode="reset",
        params={"position_range": (-START_SPREAD, START_SPREAD), "velocity_range": (0.0, 0.0)},
    )


@configclass
class ReachEnvCfg(ManagerBasedRLEnvCfg):
    """The task; physics at 200 Hz, control at 25 Hz."""

    scene: ReachSceneCfg = ReachSceneCfg(num_envs=64)
    observations: ObservationsCfg = ObservationsCfg()
    actions: ActionsCfg = ActionsCfg()
    commands: CommandsCfg = CommandsCfg()
    rewards: DistanceRewardsCfg = RewardsCfg()
    terminations: TerminationsCfg = TerminationsCfg()
    events: EventsCfg = EventsCfg()

    def __post_init__(self) -> None:
        """Set the rates."""
        super().__post_init__()
        self.sim.dt = 0.005
        self.decimation = 8
        self.episode_length_s = EPISODE_STEPS * self.sim.dt * self.decimation


@configclass
class ReachDistanceEnvCfg(ReachEnvCfg):
    """The same with the plain distance as reward."""

    rewards: DistanceRewardsCfg = DistanceRewardsCfg()


def reach_ddpg_config(**changes: object) -> DDPGConfig:
    """Return the recipe: with 64 environments, 4 updates for each step of all of them; ``changes`` replace fields."""
    recipe: dict[str, object] = {
        "total_steps": 60_000,
        "warmup_steps": 3_200,
        "updates_per_step": 1 / 16,
        "batch_size": 128,
        "gamma": 0.85,  # half a second of foresight is enough to reach, and quicker to learn than 0.99
        "tau": 0.02,
        "actor_lr": 2e-3,
        "critic_lr": 2e-3,
        "actor_every": 2,  # as in TD3: a quarter less work per update, and no more updates
        "noise_std": 0.2,
        "averaged": True,  # such rates are quick, but the actor itself misses the last centimetre every other moment
        "overlap": True,
        "eval_every": 6_400,
    }
    return DDPGConfig(**(recipe | changes))  # type: ignore[arg-type]


class ReachEvaluation:
    """Judges policies on the same targets and start poses each time; an ``evaluate`` for `train_ddpg`.

    Args:
        cfg: the task.
        episodes: how many; all run side by side.
        seed: of targets and start poses. Take one that no training has.
        num_threads: of the simulation; None: all processors.
    """

    def __init__(
        self,
        cfg: ReachEnvCfg | None = None,
        *,
        episodes: int = 500,
        seed: int = 1_000_003,
        num_threads: int | None = None,
    ) -> None:
        cfg = cfg.copy() if cfg is not None else ReachEnvCfg()
        cfg.scene.num_envs = episodes
        # One step more than is run, so that the last distances are read before the reset.
        cfg.episode_length_s += cfg.sim.dt * cfg.decimation
        self._vector, self._seed = TaskVectorEnv(cfg, num_threads=num_threads), seed
        self._body = self._vector.env.scene["robot"].find_bodies("ee")[0][0]

    def distances(self, policy: Callable[[NDArray[np.float32]], NDArray[np.float32]]) -> NDArray[np.float32]:
        """Return how far the fingertips are from the target after each step (m), (episodes, EPISODE_STEPS)."""
        obs, _ = self._vector.reset(seed=self._seed)
        env, found = self._vector.env, []
        for _ in range(EPISODE_STEPS):
            obs = self._vector.step(policy(obs))[0]
            ee = env.scene["robot"].data.body_pos_w.torch[:, self._body]
            found.append((ee - env.command_manager.get_command("ee_pose")[:, :3]).norm(dim=1).numpy())
        return np.stack(found, axis=1)

    def __call__(self, policy: Callable[[NDArray[np.float32]], NDArray[np.float32]]) -> dict[str, float]:
        """Return the share of targets reached and the mean distance over the last steps (m)."""
        distances = self.distances(policy)
        return {"success": float(reached(distances).mean()), "error_m": float(distances[:, -LAST_STEPS:].mean())}


def reached(distances: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Whether each episode (E, T) of distances (m) ends with `LAST_STEPS` steps within `TOLERANCE_M`, (E,)."""
    within: NDArray[np.bool_] = np.all(distances[:, -LAST_STEPS:] < TOLERANCE_M, axis=1)
    return within
