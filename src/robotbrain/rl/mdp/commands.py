"""Command terms: what the robot is told to do, drawn anew from time to time.

Names, fields, defaults, frames and laws are those of ``isaaclab.envs.mdp.commands`` 3.0, without its markers.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch

from robotbrain.errors import InputError
from robotbrain.rl import math_utils
from robotbrain.rl.managers import CommandTerm
from robotbrain.rl.mdp._sampling import uniform, uniform_columns

if TYPE_CHECKING:
    from robotbrain.rl.envs import ManagerBasedRLEnv
    from robotbrain.rl.mdp.commands_cfg import (
        NullCommandCfg,
        UniformPose2dCommandCfg,
        UniformPoseCommandCfg,
        UniformVelocityCommandCfg,
    )

Tensor = torch.Tensor
Array = npt.NDArray[np.float32]


class NullCommand(CommandTerm):
    """No command; for tasks that need none."""

    cfg: NullCommandCfg

    @property
    def command(self) -> Tensor:
        """There is none.

        Raises:
            InputError: always.
        """
        raise InputError("NullCommand", given="command", expected="no reader", fix="Leave this command out.")

    def reset(self, env_ids: Any = None) -> dict[str, Any]:
        """Nothing to do."""
        return {}

    def compute(self, dt: float) -> None:
        """Nothing to do."""

    def _update_metrics(self) -> None: ...

    def _resample_command(self, env_ids: Any) -> None: ...

    def _update_command(self) -> None: ...


class UniformVelocityCommand(CommandTerm):
    """A velocity (vx, vy [m/s], yaw rate [rad/s]) in the root's frame, drawn uniformly.

    With ``heading_command`` a heading is drawn too, and the yaw rate of those environments that follow it is
    ``heading_control_stiffness`` times the heading's error, within the yaw rate's range. Some environments are told
    to stand still. Metrics: mean errors over the episode; success: both below their thresholds.
    """

    cfg: UniformVelocityCommandCfg

    def __init__(self, cfg: UniformVelocityCommandCfg, env: ManagerBasedRLEnv) -> None:
        super().__init__(cfg, env)
        if cfg.heading_command and cfg.ranges.heading is None:
            raise InputError(
                "UniformVelocityCommandCfg.ranges.heading",
                given=None,
                expected="(low, high) in rad",
                fix="Give a range, e.g. (-math.pi, math.pi), or set heading_command=False.",
            )
        self.robot = env.scene[cfg.asset_name]
        self.vel_command_b = torch.zeros(self.num_envs, 3, device=self.device)
        self.heading_target = torch.zeros(self.num_envs, device=self.device)
        self.is_heading_env = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        self.is_standing_env = torch.zeros_like(self.is_heading_env)
        for name in ("error_vel_xy", "error_vel_yaw", "success_rate"):
            self.metrics[name] = torch.zeros(self.num_envs, device=self.device)
        self._error_xy_sum = torch.zeros(self.num_envs, device=self.device)
        self._error_yaw_sum = torch.zeros(self.num_envs, device=self.device)
        self._step_count = torch.zeros(self.num_envs, device=self.device)

    @property
    def command(self) -> Tensor:
        """(vx, vy, yaw rate) in the root's frame, (num_envs, 3)."""
        return self.vel_command_b

    def reset(self, env_ids: Any = None) -> dict[str, Any]:
        """Close the episodes' metrics and draw new commands; returns the metrics' means."""
        ids = slice(None) if env_ids is None else np.asarray(env_ids)
        totals = [total.numpy() for total in (self._error_xy_sum, self._error_yaw_sum, self._step_count)]
        steps = np.maximum(totals[2][ids], 1.0)
        error_xy, error_yaw = totals[0][ids] / steps, totals[1][ids] / steps
        within = (error_xy < self.cfg.vel_xy_success_threshold) & (error_yaw < self.cfg.vel_yaw_success_threshold)
        self.metrics["error_vel_xy"].numpy()[ids] = error_xy
        self.metrics["error_vel_yaw"].numpy()[ids] = error_yaw
        self.metrics["success_rate"].numpy()[ids] = within
        extras = super().reset(env_ids)
        self._env.extras.setdefault("log", {})["Metrics/success_rate"] = extras.pop("success_rate")
        for total in totals:
            total[ids] = 0.0
        return extras

    def _update_metrics(self) -> None:
        # In numpy: at every step, on small arrays, where its calls cost a third of torch's.
        data, command = self.robot.data, self.vel_command_b.numpy()
        error = command[:, :2] - data.root_lin_vel_b.torch.numpy()[:, :2]
        error *= error
        total, total_yaw, steps = self._error_xy_sum.numpy(), self._error_yaw_sum.numpy(), self._step_count.numpy()
        total += np.sqrt(error[:, 0] + error[:, 1])
        total_yaw += np.abs(command[:, 2] - data.root_ang_vel_b.torch.numpy()[:, 2])
        steps += 1.0

    def _resample_command(self, env_ids: Any) -> None:
        count = len(self.vel_command_b[env_ids])
        ranges = self.cfg.ranges
        self.vel_command_b[env_ids] = uniform_columns(
            self._env, (ranges.lin_vel_x, ranges.lin_vel_y, ranges.ang_vel_z), count
        )
        if self.cfg.heading_command:
            assert ranges.heading is not None  # checked at construction
            self.heading_target[env_ids] = uniform(self._env, ranges.heading, (count,))
            self.is_heading_env[env_ids] = uniform(self._env, (0.0, 1.0), (count,)) < self.cfg.rel_heading_envs
        self.is_standing_env[env_ids] = uniform(self._env, (0.0, 1.0), (count,)) < self.cfg.rel_standing_envs

    def _update_command(self) -> None:
        if self.cfg.heading_command:
            error = math_utils.wrap_to_pi(self.heading_target - self.robot.data.heading_w.torch)
            yaw_rate = (self.cfg.heading_control_stiffness * error).clip(*self.cfg.ranges.ang_vel_z)
            self.vel_command_b[:, 2] = torch.where(self.is_heading_env, yaw_rate, self.vel_command_b[:, 2])
        self.vel_command_b.masked_fill_(self.is_standing_env.unsqueeze(1), 0.0)


class UniformPoseCommand(CommandTerm):
    """A pose of a body in the root's frame: uniform position, roll, pitch and yaw (so not uniform on SO(3)).

    Metrics: ``position_error`` [m] and ``orientation_error`` [rad] now; with thresholds, whether an episode ever
    met all of them.
    """

    cfg: UniformPoseCommandCfg
    _metrics: dict[str, Tensor]
    _is_behind: bool

    def __init__(self, cfg: UniformPoseCommandCfg, env: ManagerBasedRLEnv) -> None:
        super().__init__(cfg, env)
        self.robot = env.scene[cfg.asset_name]
        self.body_idx = self.robot.find_bodies(cfg.body_name)[0][0]
        self.pose_command_b = torch.zeros(self.num_envs, 7, device=self.device)
        self.pose_command_b[:, 6] = 1.0
        self.pose_command_w = self.pose_command_b.clone()
        for name in ("position_error", "orientation_error"):
            self.metrics[name] = torch.zeros(self.num_envs, device=self.device)
        self._seen_quat, self._goal_quat = torch.zeros(2, self.num_envs, 4, device=self.device)
        self._track_success = not (cfg.position_success_threshold is cfg.orientation_success_threshold is None)
        self._succeeded = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)

    @property
    def metrics(self) -> dict[str, Tensor]:
        """``position_error`` and ``orientation_error``; the latter takes long and is computed when somebody looks."""
        if self._is_behind:
            self._is_behind = False
            self._metrics["orientation_error"] = math_utils.quat_error_magnitude(self._seen_quat, self._goal_quat)
        return self._metrics

    @metrics.setter
    def metrics(self, values: dict[str, Tensor]) -> None:
        self._is_behind = False
        self._metrics = values

    @property
    def command(self) -> Tensor:
        """(x, y, z [m], qx, qy, qz, qw) in the root's frame, (num_envs, 7)."""
        return self.pose_command_b

    def compute_success(self) -> Tensor:
        """Whether each environment's body is within every threshold that is set now; none set: nowhere."""
        success = self._within(*self._errors())
        self._succeeded |= success
        return success

    def reset(self, env_ids: Any = None) -> dict[str, Any]:
        """Log how many of the ended episodes succeeded, and draw new poses; returns the metrics' means."""
        extras = super().reset(env_ids)
        if self._track_success:
            ids = slice(None) if env_ids is None else env_ids
            self._env.extras.setdefault("log", {})["Metrics/success_rate"] = self._succeeded[ids].float().mean()
            self._succeeded[ids] = False
        return extras

    def _update_metrics(self) -> None:
        self._update_goal_w()
        self._metrics["position_error"] = position = self._position_error()
        self._seen_quat.copy_(self.robot.data.body_quat_w.torch[:, self.body_idx])
        self._goal_quat.copy_(self.pose_command_w[:, 3:])
        self._is_behind = True
        if self.cfg.orientation_success_threshold is not None:
            self._succeeded |= self._within(position, self.metrics["orientation_error"])
        elif self.cfg.position_success_threshold is not None:
            self._succeeded |= position < self.cfg.position_success_threshold

    def _errors(self) -> tuple[Tensor, Tensor]:
        self._update_goal_w()
        quat = self.robot.data.body_quat_w.torch[:, self.body_idx]
        return self._position_error(), math_utils.quat_error_magnitude(quat, self.pose_command_w[:, 3:])

    def _position_error(self) -> Tensor:
        away = self.pose_command_w.numpy()[:, :3] - self.robot.data.body_pos_w.torch.numpy()[:, self.body_idx]
        away *= away
        return torch.from_numpy(np.sqrt(away[:, 0] + away[:, 1] + away[:, 2]))

    def _update_goal_w(self) -> None:
        data = self.robot.data
        goal = self.pose_command_b
        if data.root_is_world:
            self.pose_command_w.copy_(goal)
        else:
            self.pose_command_w[:, :3], self.pose_command_w[:, 3:] = math_utils.combine_frame_transforms(
                data.root_pos_w.torch, data.root_quat_w.torch, goal[:, :3], goal[:, 3:]
            )

    def _within(self, position: Tensor, orientation: Tensor) -> Tensor:
        within = torch.full_like(self._succeeded, self._track_success)
        if self.cfg.position_success_threshold is not None:
            within &= position < self.cfg.position_success_threshold
        if self.cfg.orientation_success_threshold is not None:
            within &= orientation < self.cfg.orientation_success_threshold
        return within

    def _resample_command(self, env_ids: Any) -> None:
        ranges = self.cfg.ranges
        bounds = (ranges.pos_x, ranges.pos_y, ranges.pos_z, ranges.roll, ranges.pitch, ranges.yaw)
        drawn = uniform_columns(self._env, bounds, len(self.pose_command_b[env_ids]))
        quat = math_utils.quat_from_euler_xyz(drawn[:, 3], drawn[:, 4], drawn[:, 5])
        quat = math_utils.quat_unique(quat) if self.cfg.make_quat_unique else quat
        self.pose_command_b[env_ids] = torch.cat([drawn[:, :3], quat], dim=1)

    def _update_command(self) -> None:
        """The command is fixed in the root's frame."""


class UniformPose2dCommand(CommandTerm):
    """A point on the ground and a heading, drawn around the environment's origin; the command is relative to the robot.

    The height is that of the default root pose. With ``simple_heading`` the heading points along the line to the
    goal, forwards or backwards, whichever is nearer to the robot's present heading.
    """

    cfg: UniformPose2dCommandCfg

    def __init__(self, cfg: UniformPose2dCommandCfg, env: ManagerBasedRLEnv) -> None:
        super().__init__(cfg, env)
        self.robot = env.scene[cfg.asset_name]
        self.pos_command_w = torch.zeros(self.num_envs, 3, device=self.device)
        self.heading_command_w = torch.zeros(self.num_envs, device=self.device)
        self.pos_command_b = torch.zeros_like(self.pos_command_w)
        self.heading_command_b = torch.zeros_like(self.heading_command_w)
        for name in ("error_pos", "error_heading"):
            self.metrics[name] = torch.zeros(self.num_envs, device=self.device)
        self._succeeded = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)

    @property
    def command(self) -> Tensor:
        """(x, y, z [m], heading [rad]) in the root's frame without roll and pitch, (num_envs, 4)."""
        return torch.cat([self.pos_command_b, self.heading_command_b.unsqueeze(1)], dim=1)

    def reset(self, env_ids: Any = None) -> dict[str, Any]:
        """Log how many of the ended episodes succeeded, and draw new goals; returns the metrics' means."""
        extras = super().reset(env_ids)
        if self.cfg.position_success_threshold is not None:
            ids = slice(None) if env_ids is None else env_ids
            self._env.extras.setdefault("log", {})["Metrics/success_rate"] = self._succeeded[ids].float().mean()
            self._succeeded[ids] = False
        return extras

    def _update_metrics(self) -> None:
        data = self.robot.data
        away = self.pos_command_w.numpy()[:, :2] - data.root_pos_w.torch.numpy()[:, :2]
        away *= away
        self.metrics["error_pos"] = torch.from_numpy(np.sqrt(away[:, 0] + away[:, 1]))
        turn = _wrapped(self.heading_command_w.numpy() - data.heading_w.torch.numpy())
        self.metrics["error_heading"] = torch.from_numpy(np.abs(turn))
        if self.cfg.position_success_threshold is not None:
            self._succeeded |= self.metrics["error_pos"] < self.cfg.position_success_threshold

    def _resample_command(self, env_ids: Any) -> None:
        data, ranges = self.robot.data, self.cfg.ranges
        goal = self._env.scene.env_origins[env_ids].clone()
        count = len(goal)
        goal[:, 0] += uniform(self._env, ranges.pos_x, (count,))
        goal[:, 1] += uniform(self._env, ranges.pos_y, (count,))
        goal[:, 2] += data.default_root_pose.torch[env_ids, 2]
        self.pos_command_w[env_ids] = goal
        if not self.cfg.simple_heading:
            self.heading_command_w[env_ids] = uniform(self._env, ranges.heading, (count,))
            return
        line = goal - data.root_pos_w.torch[env_ids]
        forwards = torch.atan2(line[:, 1], line[:, 0])
        backwards = math_utils.wrap_to_pi(forwards + math.pi)
        heading = data.heading_w.torch[env_ids]
        turn_forwards = math_utils.wrap_to_pi(forwards - heading).abs()
        turn_backwards = math_utils.wrap_to_pi(backwards - heading).abs()
        self.heading_command_w[env_ids] = torch.where(turn_forwards < turn_backwards, forwards, backwards)

    def _update_command(self) -> None:
        data = self.robot.data
        line = self.pos_command_w.numpy() - data.root_pos_w.torch.numpy()
        heading, seen = data.heading_w.torch.numpy(), self.pos_command_b.numpy()
        cos, sin = np.cos(heading), np.sin(heading)
        seen[:, 0] = cos * line[:, 0] + sin * line[:, 1]
        seen[:, 1] = cos * line[:, 1] - sin * line[:, 0]
        seen[:, 2] = line[:, 2]
        self.heading_command_b.numpy()[:] = _wrapped(self.heading_command_w.numpy() - heading)


def _wrapped(angles: Array) -> Array:
    """:func:`math_utils.wrap_to_pi` of arrays, whose calls cost a third on what is needed at every step."""
    wrapped = np.remainder(angles + math.pi, 2.0 * math.pi) - math.pi
    return np.where((wrapped == -math.pi) & (angles > 0), math.pi, wrapped).astype(np.float32)
