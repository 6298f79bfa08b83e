"""Two tiny tasks for the tests of the environment: a two-joint arm, and a box on two legs that can fall over."""

from __future__ import annotations

from typing import Any

import torch

from robotbrain.rl.configclass import configclass
from robotbrain.rl.envs import ManagerBasedRLEnvCfg, SimulationCfg
from robotbrain.rl.managers import (
    ActionTerm,
    ActionTermCfg,
    CommandTerm,
    CommandTermCfg,
    EventTermCfg,
    ObservationGroupCfg,
    ObservationTermCfg,
    RewardTermCfg,
    TerminationTermCfg,
)
from robotbrain.rl.noise_cfg import UniformNoiseCfg
from robotbrain.rl.scene import ArticulationCfg, ContactSensorCfg, InteractiveSceneCfg, LidarCfg

ARM = """
<mujoco><compiler angle="radian"/><option timestep="0.005" integrator="implicitfast"/>
<worldbody>
  <body name="base"><geom type="sphere" size="0.05" contype="0" conaffinity="0"/>
    <body name="upper" pos="0 0 0.1"><joint name="shoulder" axis="0 1 0" range="-2 2" limited="true" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0 0.3" size="0.03" mass="1" contype="0" conaffinity="0"/>
      <body name="lower" pos="0 0 0.3"><joint name="elbow" axis="0 1 0" range="-1 3" limited="true" damping="0.1"/>
        <geom type="capsule" fromto="0 0 0 0 0 0.3" size="0.03" mass="0.5" contype="0" conaffinity="0"/>
        <body name="tip" pos="0 0 0.3"/>
      </body></body></body>
</worldbody>
<actuator><position name="elbow" joint="elbow" kp="40" kv="2"/>
  <position name="shoulder" joint="shoulder" kp="60" kv="3"/></actuator>
</mujoco>"""

WALKER = """
<mujoco><compiler angle="radian"/><option timestep="0.005" integrator="implicitfast"/>
<worldbody>
  <geom name="floor" type="plane" size="5 5 0.1"/>
  <geom name="wall" type="box" size="0.1 5 1" pos="2 0 1" group="3"/>
  <body name="trunk" pos="0 0 0.42"><freejoint/>
    <geom type="box" size="0.2 0.1 0.05" mass="4" contype="0" conaffinity="0"/>
    <body name="left" pos="0 0.15 0">
      <joint name="left_hip" axis="0 1 0" range="-1 1" limited="true" armature="0.02"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.35" size="0.02" mass="0.4" contype="0" conaffinity="0"/>
      <body name="left_foot" pos="0 0 -0.35"><geom type="box" size="0.15 0.05 0.03" mass="0.2"/>
        <site name="left_touch" type="box" size="0.2 0.1 0.08"/></body></body>
    <body name="right" pos="0 -0.15 0">
      <joint name="right_hip" axis="0 1 0" range="-1 1" limited="true" armature="0.02"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.35" size="0.02" mass="0.4" contype="0" conaffinity="0"/>
      <body name="right_foot" pos="0 0 -0.35"><geom type="box" size="0.15 0.05 0.03" mass="0.2"/>
        <site name="right_touch" type="box" size="0.2 0.1 0.08"/></body></body>
  </body>
</worldbody>
<actuator>
  <position name="left" joint="left_hip" kp="80" kv="4"/><position name="right" joint="right_hip" kp="80" kv="4"/>
</actuator>
<sensor><touch name="contact_left_foot" site="left_touch"/>
  <touch name="contact_right_foot" site="right_touch"/></sensor>
</mujoco>"""


# -- terms


def joint_pos(env: Any) -> torch.Tensor:
    return env.scene["robot"].data.joint_pos.torch


def joint_vel(env: Any) -> torch.Tensor:
    return env.scene["robot"].data.joint_vel.torch


def root_motion(env: Any) -> torch.Tensor:
    data = env.scene["robot"].data
    return torch.cat((data.root_lin_vel_b.torch, data.root_ang_vel_b.torch, data.projected_gravity_b.torch), 1)


def forces(env: Any) -> torch.Tensor:
    return env.scene["contact_forces"].data.net_normal_forces_w.torch[:, :, 2]


def last_action(env: Any) -> torch.Tensor:
    return env.action_manager.action


def command(env: Any, name: str) -> torch.Tensor:
    return env.command_manager.get_command(name)


def step_number(env: Any) -> torch.Tensor:
    return env.episode_length_buf.float().unsqueeze(1)


def alive(env: Any) -> torch.Tensor:
    return torch.ones(env.num_envs)


def effort(env: Any) -> torch.Tensor:
    return env.scene["robot"].actuators.applied_effort.torch.square().sum(1)


def action_rate(env: Any) -> torch.Tensor:
    return (env.action_manager.action - env.action_manager.prev_action).square().sum(1)


def time_out(env: Any) -> torch.Tensor:
    return env.episode_length_buf >= env.max_episode_length


def tilted(env: Any, limit: float) -> torch.Tensor:
    return env.scene["robot"].data.projected_gravity_b.torch[:, 2] > limit


def joints_at_random(env: Any, env_ids: torch.Tensor, width: float) -> None:
    robot = env.scene["robot"]
    shape = (len(env_ids), robot.num_joints)
    pos = robot.data.default_joint_pos.torch[env_ids] + width * (2 * torch.rand(shape, generator=env.generator) - 1)
    robot.write_joint_state_to_sim(pos, torch.zeros(shape), env_ids=env_ids)


def push(env: Any, env_ids: torch.Tensor, speed: float) -> None:
    robot = env.scene["robot"]
    velocity = robot.data.root_vel_w.torch[env_ids].clone()
    velocity[:, :2] += speed * (2 * torch.rand(len(env_ids), 2, generator=env.generator) - 1)
    robot.write_root_velocity_to_sim_index(root_velocity=velocity, env_ids=env_ids)


class Position(ActionTerm):
    """Joint targets: default + 0.5 * action."""

    def __init__(self, cfg: Any, env: Any) -> None:
        super().__init__(cfg, env)
        self._raw = torch.zeros(env.num_envs, self.action_dim)
        self._processed = torch.zeros(env.num_envs, self.action_dim)

    @property
    def action_dim(self) -> int:
        return self._asset.num_joints

    @property
    def raw_actions(self) -> torch.Tensor:
        return self._raw

    @property
    def processed_actions(self) -> torch.Tensor:
        return self._processed

    def process_actions(self, actions: torch.Tensor) -> None:
        self._raw.copy_(actions)
        torch.add(self._asset.data.default_joint_pos.torch, actions, alpha=0.5, out=self._processed)

    def apply_actions(self) -> None:
        self._asset.set_joint_position_target(self._processed)


class PositionEverySubstep(Position):
    """The same, one physics step at a time."""

    apply_every_substep = True


class Direction(CommandTerm):
    """A number in [-1, 1)."""

    def __init__(self, cfg: Any, env: Any) -> None:
        super().__init__(cfg, env)
        self._value = torch.zeros(env.num_envs, 1)
        self.metrics["size"] = torch.zeros(env.num_envs)

    @property
    def command(self) -> torch.Tensor:
        return self._value

    def _update_metrics(self) -> None:
        self.metrics["size"] += self._value[:, 0].abs()

    def _resample_command(self, env_ids: torch.Tensor) -> None:
        self._value[env_ids] = 2 * torch.rand(len(env_ids), 1, generator=self._env.generator) - 1

    def _update_command(self) -> None:
        pass


# -- tasks


@configclass
class ArmSceneCfg(InteractiveSceneCfg):
    robot = ArticulationCfg(model=ARM)


@configclass
class ArmObservationsCfg:
    @configclass
    class PolicyCfg(ObservationGroupCfg):
        joint_pos = ObservationTermCfg(func=joint_pos)
        joint_vel = ObservationTermCfg(func=joint_vel, scale=0.1)
        actions = ObservationTermCfg(func=last_action)

    policy: PolicyCfg = PolicyCfg()


@configclass
class ActionsCfg:
    joints = ActionTermCfg(class_type=Position, asset_name="robot")


@configclass
class ArmRewardsCfg:
    alive = RewardTermCfg(func=alive, weight=1.0)
    effort = RewardTermCfg(func=effort, weight=-0.01)


@configclass
class TimeOutCfg:
    time_out = TerminationTermCfg(func=time_out, time_out=True)


@configclass
class ArmEventsCfg:
    scatter = EventTermCfg(func=joints_at_random, mode="reset", params={"width": 0.3})


@configclass
class ArmCfg(ManagerBasedRLEnvCfg):
    sim = SimulationCfg(dt=0.005)
    scene = ArmSceneCfg(num_envs=4)
    decimation = 4
    episode_length_s = 0.4
    observations = ArmObservationsCfg()
    actions = ActionsCfg()
    rewards = ArmRewardsCfg()
    terminations = TimeOutCfg()
    events = ArmEventsCfg()
    seed = 0


@configclass
class WalkerSceneCfg(InteractiveSceneCfg):
    robot = ArticulationCfg(model=WALKER)
    contact_forces = ContactSensorCfg()
    lidar = LidarCfg(
        body="trunk", offset=(0.1, 0.0, 0.0), angles=(-0.3, 0.0, 0.3), max_range=5.0, geomgroup=(0, 0, 0, 1, 0, 0)
    )


@configclass
class WalkerObservationsCfg:
    @configclass
    class PolicyCfg(ObservationGroupCfg):
        root = ObservationTermCfg(func=root_motion, noise=UniformNoiseCfg(n_min=-0.1, n_max=0.1))
        joint_pos = ObservationTermCfg(func=joint_pos)
        forces = ObservationTermCfg(func=forces, scale=0.01, clip=(0.0, 100.0))
        direction = ObservationTermCfg(func=command, params={"name": "direction"})

        def __post_init__(self) -> None:
            super().__post_init__()
            self.enable_corruption = True

    policy: PolicyCfg = PolicyCfg()


@configclass
class WalkerRewardsCfg:
    alive = RewardTermCfg(func=alive, weight=1.0)
    action_rate = RewardTermCfg(func=action_rate, weight=-0.1)


@configclass
class WalkerTerminationsCfg:
    time_out = TerminationTermCfg(func=time_out, time_out=True)
    tilted = TerminationTermCfg(func=tilted, params={"limit": -0.7})


@configclass
class WalkerEventsCfg:
    scatter = EventTermCfg(func=joints_at_random, mode="reset", params={"width": 0.2})
    push = EventTermCfg(func=push, mode="interval", interval_range_s=(0.2, 0.4), params={"speed": 0.5})


@configclass
class CommandsCfg:
    direction = CommandTermCfg(class_type=Direction, resampling_time_range=(0.1, 0.3))


@configclass
class WalkerCfg(ManagerBasedRLEnvCfg):
    sim = SimulationCfg(dt=0.005)
    scene = WalkerSceneCfg(num_envs=6)
    decimation = 4
    episode_length_s = 1.0
    observations = WalkerObservationsCfg()
    actions = ActionsCfg()
    commands = CommandsCfg()
    rewards = WalkerRewardsCfg()
    terminations = WalkerTerminationsCfg()
    events = WalkerEventsCfg()
    seed = 0
    compute_final_obs = True
