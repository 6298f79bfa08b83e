"""Configurations of the command terms; fields, defaults and units as in Isaac Lab 3.0."""

from __future__ import annotations

import math

from robotbrain.rl.configclass import MISSING, Config, configclass
from robotbrain.rl.managers import CommandTerm, CommandTermCfg
from robotbrain.rl.mdp.commands import NullCommand, UniformPose2dCommand, UniformPoseCommand, UniformVelocityCommand

Range = tuple[float, float]


@configclass
class NullCommandCfg(CommandTermCfg):
    """No command."""

    class_type: type[CommandTerm] = NullCommand

    def __post_init__(self) -> None:
        """Never draw anew."""
        self.resampling_time_range = (math.inf, math.inf)


@configclass
class UniformVelocityCommandCfg(CommandTermCfg):
    """A planar velocity in the root's frame.

    Attributes:
        asset_name: the robot.
        heading_command: derive the yaw rate from a drawn heading.
        heading_control_stiffness: yaw rate per heading error [1/s].
        rel_standing_envs: probability that a draw tells the robot to stand still.
        rel_heading_envs: probability that a draw follows the heading; the others follow the drawn yaw rate.
        ranges: bounds of the draws.
        vel_xy_success_threshold: success needs an episode's mean error below this [m/s].
        vel_yaw_success_threshold: and a mean yaw error below this [rad/s].
        marker_pos_offset: kept for Isaac Lab's sake; nothing is drawn.
    """

    class_type: type[CommandTerm] = UniformVelocityCommand
    asset_name: str = MISSING
    heading_command: bool = False
    heading_control_stiffness: float = 1.0
    rel_standing_envs: float = 0.0
    rel_heading_envs: float = 1.0

    @configclass
    class Ranges(Config):
        """Bounds: velocities [m/s], yaw rate [rad/s], heading [rad]."""

        lin_vel_x: Range = MISSING
        lin_vel_y: Range = MISSING
        ang_vel_z: Range = MISSING
        heading: Range | None = None

    ranges: Ranges = MISSING
    vel_xy_success_threshold: float = 0.5
    vel_yaw_success_threshold: float = 0.4
    marker_pos_offset: tuple[float, float, float] = (0.0, 0.0, 0.5)


@configclass
class UniformPoseCommandCfg(CommandTermCfg):
    """A pose of a body in the root's frame.

    Attributes:
        asset_name: the robot.
        body_name: the body that shall reach the pose.
        make_quat_unique: of the two quaternions of a rotation take the one with w >= 0.
        ranges: bounds of the draws.
        position_success_threshold: success needs a distance below this [m]; None: not asked for.
        orientation_success_threshold: and an angle below this [rad]; None: not asked for.
    """

    class_type: type[CommandTerm] = UniformPoseCommand
    asset_name: str = MISSING
    body_name: str = MISSING
    make_quat_unique: bool = False

    @configclass
    class Ranges(Config):
        """Bounds: position [m], roll, pitch and yaw [rad]."""

        pos_x: Range = MISSING
        pos_y: Range = MISSING
        pos_z: Range = MISSING
        roll: Range = MISSING
        pitch: Range = MISSING
        yaw: Range = MISSING

    ranges: Ranges = MISSING
    position_success_threshold: float | None = None
    orientation_success_threshold: float | None = None


@configclass
class UniformPose2dCommandCfg(CommandTermCfg):
    """A point on the ground and a heading.

    Attributes:
        asset_name: the robot.
        simple_heading: the heading follows from the goal's direction instead of being drawn.
        ranges: bounds of the draws, around the environment's origin.
        position_success_threshold: success is to come nearer than this once [m]; None: not asked for.
    """

    class_type: type[CommandTerm] = UniformPose2dCommand
    asset_name: str = MISSING
    simple_heading: bool = MISSING

    @configclass
    class Ranges(Config):
        """Bounds: position [m], heading [rad]."""

        pos_x: Range = MISSING
        pos_y: Range = MISSING
        heading: Range = MISSING

    ranges: Ranges = MISSING
    position_success_threshold: float | None = None
