"""How well a policy follows commanded velocities: one environment for each command, means over an episode."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from robotbrain.errors import InputError
from robotbrain.rl.envs.manager_based_rl_env import ManagerBasedRLEnv
from robotbrain.rl.tasks.velocity import COMMAND_RANGES, VelocityEnvCfg

if TYPE_CHECKING:
    from robotbrain.rl.view import Motion

Tensor = torch.Tensor

UNSEEN_SEED = 20_260_000
"""Seed of the commands in reports; no training uses it."""
_NEVER = (1e9, 1e9)


@dataclass(frozen=True)
class Tracking:
    """What came of n commands.

    Attributes:
        commands: (n, 3), vx, vy (m/s) and yaw rate (rad/s) in the trunk's frame.
        achieved: (n, 3), means of the same from ``settle_s`` until the end or the fall; after an earlier fall nan.
        fell: (n,) bool.
    """

    commands: Tensor
    achieved: Tensor
    fell: Tensor

    @property
    def error(self) -> Tensor:
        """(n,) planar norm of command minus mean velocity (m/s)."""
        error: Tensor = (self.commands - self.achieved)[:, :2].norm(dim=1)
        return error

    @property
    def yaw_error(self) -> Tensor:
        """(n,) size of command minus mean yaw rate (rad/s)."""
        return (self.commands - self.achieved)[:, 2].abs()


def draw_commands(count: int, seed: int = UNSEEN_SEED) -> Tensor:
    """Return ``count`` commands (count, 3), uniform over the task's ranges."""
    low, high = torch.tensor(COMMAND_RANGES).T
    commands: Tensor = low + (high - low) * torch.rand(count, 3, generator=torch.Generator().manual_seed(seed))
    return commands


def track(
    act: Callable[[Tensor], Tensor],
    commands: Tensor,
    *,
    pushes: bool = False,
    randomised: bool = False,
    seconds: float = 20.0,
    settle_s: float = 2.0,
    seed: int = UNSEEN_SEED,
    num_threads: int | None = None,
) -> Tracking:
    """Have each command followed for one episode.

    Args:
        act: from observations (n, 48) to actions (n, 12).
        commands: (n, 3), see :func:`draw_commands`.
        pushes: change the trunk's velocity by up to 0.5 m/s along x and y every 10 to 15 s.
        randomised: robots and sensor noise as in training; else the nominal robot and perfect sensors.
        seconds: length of the episode (s).
        settle_s: left out of the means at the start (s).
        seed: of starts, pushes, randomisation and noise.
        num_threads: of the simulation.

    Raises:
        InputError: commands of another shape, or nothing left after ``settle_s``.
    """
    if commands.ndim != 2 or commands.shape[1] != 3 or not len(commands):
        raise InputError("commands", given=tuple(commands.shape), expected="(n, 3)", fix="See draw_commands.")
    if not 0.0 <= settle_s < seconds:
        raise InputError("settle_s", given=settle_s, expected=f"0 <= s < {seconds:g}", fix="Give fewer seconds.")
    env = ManagerBasedRLEnv(_cfg(len(commands), seconds, seed, pushes, randomised), num_threads=num_threads)
    env.reset(seed=seed)
    told = env.command_manager.get_term("base_velocity").command
    told[:] = commands
    seen: dict[str, Any] = env.observation_manager.compute()
    data = env.scene["robot"].data
    sums, count = torch.zeros(len(commands), 3), torch.zeros(len(commands), 1)
    fell = torch.zeros(len(commands), dtype=torch.bool)
    with torch.no_grad():
        # The last step would reset every environment, so it is not taken.
        for step in range(env.max_episode_length - 1):
            seen, _, terminated, _, _ = env.step(act(seen["policy"]))
            fell |= terminated
            if (step + 1) * env.step_dt > settle_s:
                velocity = torch.cat([data.root_lin_vel_b.torch[:, :2], data.root_ang_vel_b.torch[:, 2:]], dim=1)
                going = (~fell)[:, None]
                sums += torch.where(going, velocity, 0.0)
                count += going
    return Tracking(commands.clone(), sums / count, fell)  # 0 / 0 is nan: fell before it could be measured


def record_walk(
    act: Callable[[Tensor], Tensor], command: tuple[float, float, float], *, seconds: float = 6.0, seed: int = 0
) -> Motion:
    """Return the motion of the nominal robot that follows one command, to watch.

    Args:
        act: from observations (1, 48) to actions (1, 12).
        command: vx, vy (m/s) and yaw rate (rad/s).
        seconds: how long (s); shorter if it falls.
        seed: of the start.
    """
    from robotbrain.rl.view import Motion

    env = ManagerBasedRLEnv(_cfg(1, seconds, seed, pushes=False, randomised=False), num_threads=1)
    env.reset(seed=seed)
    env.command_manager.get_term("base_velocity").command[:] = torch.tensor(command)
    seen: dict[str, Any] = env.observation_manager.compute()
    qpos = [env.scene.world.qpos[0].copy()]
    with torch.no_grad():
        for _ in range(env.max_episode_length - 1):
            seen, _, terminated, _, _ = env.step(act(seen["policy"]))
            if terminated.item():
                break  # what follows is another episode
            qpos.append(env.scene.world.qpos[0].copy())
    label = f"{command[0]:g} m/s forwards, {command[1]:g} m/s left, {command[2]:g} rad/s"
    return Motion(label, env.scene.world.batch.get_model(0), np.stack(qpos), env.step_dt, trace="base")


def _cfg(count: int, seconds: float, seed: int, pushes: bool, randomised: bool) -> VelocityEnvCfg:
    cfg = VelocityEnvCfg()
    events: Any = cfg.events
    push = events.push_robot
    if not randomised:
        cfg.play_mode()
    events.push_robot = push if pushes else None
    cfg.scene.num_envs, cfg.episode_length_s, cfg.seed = count, seconds, seed
    cfg.commands.base_velocity.resampling_time_range = _NEVER
    cfg.commands.base_velocity.rel_standing_envs = 0.0
    return cfg
