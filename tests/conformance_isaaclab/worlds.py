"""Environments in random states, for comparing what terms make of them."""

from __future__ import annotations

import math

import torch

from robotbrain.rl import mdp
from robotbrain.rl.envs import ManagerBasedRLEnv
from robotbrain.rl.managers import EventTermCfg, TerminationTermCfg
from robotbrain.rl.tasks.reach import ReachEnvCfg
from robotbrain.rl.tasks.velocity import VelocityEnvCfg

NUM_ENVS = 48


def walking(seed: int = 0, num_envs: int = NUM_ENVS) -> ManagerBasedRLEnv:
    """The quadruped in the middle of things."""
    cfg = VelocityEnvCfg()
    cfg.scene.num_envs, cfg.seed = num_envs, seed
    cfg.observations.policy.enable_corruption = False
    cfg.commands.base_velocity.heading_command = True
    cfg.commands.base_velocity.rel_heading_envs = 0.5
    cfg.commands.base_velocity.rel_standing_envs = 0.2
    cfg.commands.base_velocity.ranges.heading = (-math.pi, math.pi)
    cfg.commands.pose = mdp.UniformPose2dCommandCfg(
        asset_name="robot",
        simple_heading=True,
        resampling_time_range=(1.0, 2.0),
        ranges=mdp.UniformPose2dCommandCfg.Ranges(pos_x=(-2.0, 2.0), pos_y=(-2.0, 2.0), heading=(-1.0, 1.0)),
        position_success_threshold=0.5,
    )
    return _ready(ManagerBasedRLEnv(cfg, num_threads=1))


def reaching(seed: int = 0, num_envs: int = NUM_ENVS) -> ManagerBasedRLEnv:
    """The arm in the middle of things."""
    cfg = ReachEnvCfg()
    cfg.scene.num_envs, cfg.seed = num_envs, seed
    command = next(term for term in vars(cfg.commands).values() if isinstance(term, mdp.UniformPoseCommandCfg))
    command.position_success_threshold, command.orientation_success_threshold = 0.5, 1.5
    command.ranges.roll = command.ranges.pitch = command.ranges.yaw = (-1.0, 1.0)
    cfg.terminations.early = TerminationTermCfg(func=mdp.joint_vel_out_of_manual_limit, params={"max_velocity": 50.0})
    cfg.events = {"reset_joints": EventTermCfg(func=mdp.reset_joints_by_offset, mode="reset",
                  params={"position_range": (-0.5, 0.5), "velocity_range": (-1.0, 1.0)})}  # fmt: skip
    return _ready(ManagerBasedRLEnv(cfg, num_threads=1))


def _ready(env: ManagerBasedRLEnv) -> ManagerBasedRLEnv:
    env.reset(seed=1)
    env.scene["robot"].data.soft_joint_vel_limits.torch.fill_(3.0)  # MuJoCo has none: something to compare
    return env


def disturb(env: ManagerBasedRLEnv, generator: torch.Generator) -> None:
    """Bring the environment into another random state: beyond limits, tilted, pushed, after a few steps."""
    robot = env.scene["robot"]
    n, joints = env.num_envs, robot.num_joints

    def draw(*shape: int, scale: float = 1.0) -> torch.Tensor:
        return scale * torch.randn(*shape, generator=generator)

    robot.write_joint_state_to_sim(robot.data.default_joint_pos.torch + draw(n, joints, scale=0.4), draw(n, joints))
    if not robot.is_fixed_base:
        pose = robot.data.default_root_pose.torch.clone()
        pose[:, :3] += draw(n, 3, scale=0.1)
        pose[:, 3:] = torch.nn.functional.normalize(pose[:, 3:] + draw(n, 4, scale=0.25), dim=-1)
        robot.write_root_pose_to_sim_index(root_pose=pose)
        robot.write_root_velocity_to_sim_index(root_velocity=draw(n, 6))
    for _ in range(int(torch.randint(1, 6, (), generator=generator))):
        env.step(draw(n, env.num_actions))
