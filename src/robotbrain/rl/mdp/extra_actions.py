"""Actions of the kit's own. None of them is part of Isaac Lab; ``robotbrain rl export-isaaclab`` copies their source.

All can carry a latency: :func:`randomize_action_latency` gives each environment one, in physics steps.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from robotbrain.rl.configclass import MISSING, configclass
from robotbrain.rl.managers import ActionTerm, ActionTermCfg
from robotbrain.rl.mdp._latency import CommandDelay
from robotbrain.rl.mdp.actions import (
    JointAction,
    JointActionCfg,
    JointPositionAction,
    JointPositionActionCfg,
)

if TYPE_CHECKING:
    from robotbrain.rl.envs import ManagerBasedRLEnv


class DelayedJointPositionAction(JointPositionAction):
    """:class:`JointPositionAction` whose target arrives late. Not in Isaac Lab (there the actuator model delays)."""

    def __init__(self, cfg: Any, env: ManagerBasedRLEnv) -> None:
        super().__init__(cfg, env)
        self.delay = CommandDelay(self.num_envs, env.cfg.decimation, self.device)

    def process_actions(self, actions: torch.Tensor) -> None:
        """Compute the target and send it on its way; once per control step."""
        super().process_actions(actions)
        self.delay.push(self._processed_actions)

    def apply_actions(self) -> None:
        """Set the position targets that have arrived."""
        self._asset.set_joint_position_target_index(target=self.delay.now(), joint_ids=self._joint_ids)

    def reset(self, env_ids: Any = None) -> None:
        """Forget the actions of these environments (all by default)."""
        super().reset(env_ids)
        self.delay.reset(slice(None) if env_ids is None else env_ids)


@configclass
class DelayedJointPositionActionCfg(JointPositionActionCfg):
    """Position targets [rad] that arrive late; the latency is 0 until an event draws one."""

    class_type: type[ActionTerm] = DelayedJointPositionAction


class HeldRelativeJointPositionAction(JointAction):
    """The target is the joint's position when the action is given plus the processed action, held until the next one.

    Not in Isaac Lab, whose relative action adds to the present position anew at each physics step, which makes the
    target run ahead of the joint: there the same action moves the arm further the slower the policy is.
    """

    def __init__(self, cfg: Any, env: ManagerBasedRLEnv) -> None:
        super().__init__(cfg, env)
        self.delay = CommandDelay(self.num_envs, env.cfg.decimation, self.device)

    def process_actions(self, actions: torch.Tensor) -> None:
        """Compute the target from where the joints are now; once per control step."""
        super().process_actions(actions)
        self.delay.push(self._asset.data.joint_pos.torch[:, self._joint_ids] + self._processed_actions)

    def apply_actions(self) -> None:
        """Set the position targets that have arrived."""
        self._asset.set_joint_position_target_index(target=self.delay.now(), joint_ids=self._joint_ids)

    def reset(self, env_ids: Any = None) -> None:
        """Forget the actions of these environments (all by default)."""
        super().reset(env_ids)
        self.delay.reset(slice(None) if env_ids is None else env_ids)


@configclass
class HeldRelativeJointPositionActionCfg(JointActionCfg):
    """Position targets relative to the position at the time of the action [rad]."""

    class_type: type[ActionTerm] = HeldRelativeJointPositionAction


class DifferentialDriveAction(ActionTerm):
    """Forward speed and yaw rate of a two-wheeled base as velocity targets of its wheels. Not in Isaac Lab.

    The action is (speed, yaw rate), each in -1..1 of its largest value (clipped).
    """

    def __init__(self, cfg: DifferentialDriveActionCfg, env: ManagerBasedRLEnv) -> None:
        super().__init__(cfg, env)
        ids, _ = self._asset.find_joints([cfg.left_joint, cfg.right_joint], preserve_order=True)
        self._joint_ids = torch.as_tensor(ids, dtype=torch.long, device=self.device)
        self._largest = torch.tensor([cfg.max_speed, cfg.max_yaw_rate], device=self.device)
        half_track, radius = 0.5 * cfg.track_width, cfg.wheel_radius
        self._to_wheels = torch.tensor([[1.0, 1.0], [-half_track, half_track]], device=self.device) / radius
        self._raw_actions = torch.zeros(self.num_envs, 2, device=self.device)
        self._processed_actions = torch.zeros_like(self._raw_actions)
        self.delay = CommandDelay(self.num_envs, env.cfg.decimation, self.device)

    @property
    def action_dim(self) -> int:
        """Two: speed and yaw rate."""
        return 2

    @property
    def raw_actions(self) -> torch.Tensor:
        """The policy's action, (num_envs, 2)."""
        return self._raw_actions

    @property
    def processed_actions(self) -> torch.Tensor:
        """Speed [m/s] and yaw rate [rad/s], (num_envs, 2)."""
        return self._processed_actions

    def process_actions(self, actions: torch.Tensor) -> None:
        """Clip and scale the action, and send the wheels' speeds on their way; once per control step."""
        self._raw_actions[:] = actions
        self._processed_actions = self._raw_actions.clamp(-1.0, 1.0) * self._largest
        self.delay.push(self._processed_actions @ self._to_wheels)

    def apply_actions(self) -> None:
        """Set the wheels' velocity targets [rad/s] that have arrived."""
        self._asset.set_joint_velocity_target_index(target=self.delay.now(), joint_ids=self._joint_ids)

    def reset(self, env_ids: Any = None) -> None:
        """Forget the actions of these environments (all by default)."""
        ids = slice(None) if env_ids is None else env_ids
        self._raw_actions[ids] = 0.0
        self.delay.reset(ids)


@configclass
class DifferentialDriveActionCfg(ActionTermCfg):
    """A two-wheeled base.

    Attributes:
        left_joint, right_joint: the wheels' joints; positive turns drive forward.
        wheel_radius: [m]; track_width: distance between the wheels [m].
        max_speed: forward speed of action 1 [m/s]; max_yaw_rate: yaw rate of action 1 [rad/s].
    """

    class_type: type[ActionTerm] = DifferentialDriveAction
    left_joint: str = MISSING
    right_joint: str = MISSING
    wheel_radius: float = MISSING
    track_width: float = MISSING
    max_speed: float = 1.0
    max_yaw_rate: float = 1.0


def randomize_action_latency(
    env: ManagerBasedRLEnv, env_ids: Any, action_name: str, latency_range: tuple[int, int]
) -> None:
    """Give each environment a latency of its actions, uniform over whole physics steps, bounds included.

    Not in Isaac Lab. The action term has to be one of this module.

    Args:
        latency_range: (fewest, most) physics steps.
    """
    low, high = latency_range
    if not 0 <= low <= high:
        raise ValueError(f"latency_range: got {latency_range}; expected (fewest, most) physics steps, 0 or more")
    term: Any = env.action_manager.get_term(action_name)
    rows = slice(None) if env_ids is None else env_ids
    count = len(term.delay.latency[rows])
    generator = getattr(env, "generator", None)
    term.delay.set(rows, torch.randint(low, high + 1, (count,), generator=generator, device=env.device), high)
    term.apply_every_substep = high > 0
