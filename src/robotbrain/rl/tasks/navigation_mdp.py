"""Terms of the navigation task. None of them is part of Isaac Lab, which has no planar base in a drawn room."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import torch

from robotbrain.errors import InputError
from robotbrain.rl import mdp
from robotbrain.rl.configclass import MISSING, configclass
from robotbrain.rl.managers import ActionTerm, ActionTermCfg, CommandTerm, ManagerTermBase
from robotbrain.rl.mdp._latency import CommandDelay
from robotbrain.rl.robots.base import ACTUATORS, OBSTACLE_HALF_HEIGHT
from robotbrain.rl.tasks.layouts import LayoutSpec, clearance, draw_layouts

if TYPE_CHECKING:
    from robotbrain.rl.envs import ManagerBasedRLEnv
    from robotbrain.rl.managers import EventTermCfg

Tensor = torch.Tensor
_TRIES = 32


# ------------------------------------------------------------ actions


class BodyVelocityAction(ActionTerm):
    """Forward speed and turning rate of the base: ``offset + scale * action``, the action clipped to -1..1.

    ``raw_actions`` is the clipped action, ``processed_actions`` what the drive is told (m/s, rad/s), both
    (num_envs, 2). It arrives late where an event has drawn a latency (``mdp.randomize_action_latency``).
    """

    cfg: BodyVelocityActionCfg

    def __init__(self, cfg: BodyVelocityActionCfg, env: ManagerBasedRLEnv) -> None:
        super().__init__(cfg, env)
        model = env.scene.world.model
        self._columns = [model.actuator(name).id for name in ACTUATORS[:2]]
        self._scale, self._offset = torch.tensor(cfg.scale), torch.tensor(cfg.offset)
        self._raw_actions = torch.zeros(self.num_envs, 2)
        self._processed_actions = torch.zeros(self.num_envs, 2)
        self.delay = CommandDelay(self.num_envs, env.cfg.decimation, env.device)

    @property
    def action_dim(self) -> int:
        """Two."""
        return 2

    @property
    def raw_actions(self) -> Tensor:
        """The policy's action within -1..1, (num_envs, 2)."""
        return self._raw_actions

    @property
    def processed_actions(self) -> Tensor:
        """Forward speed (m/s) and turning rate (rad/s), (num_envs, 2)."""
        return self._processed_actions

    def process_actions(self, actions: Tensor) -> None:
        """Compute the command and send it on its way; once per control step."""
        torch.clamp(actions, -1.0, 1.0, out=self._raw_actions)
        self._processed_actions = self._raw_actions * self._scale + self._offset
        self.delay.push(self._processed_actions)

    def apply_actions(self) -> None:
        """Write the commands that have arrived to the actuators."""
        self._env.scene.world.ctrl[:, self._columns] = self.delay.now().numpy()

    def reset(self, env_ids: Any = None) -> None:
        """Forget the action of these environments (all by default)."""
        rows = slice(None) if env_ids is None else env_ids
        self._raw_actions[rows] = 0.0
        self.delay.reset(rows)


@configclass
class BodyVelocityActionCfg(ActionTermCfg):
    """A base that is told how fast to drive and turn.

    Attributes:
        scale, offset: (m/s, rad/s) per unit of action, and at action 0.
    """

    class_type: type[ActionTerm] = BodyVelocityAction
    scale: tuple[float, float] = MISSING
    offset: tuple[float, float] = (0.0, 0.0)


# ------------------------------------------------------------ rooms


def obstacle_rectangles(env: ManagerBasedRLEnv, env_ids: Any = None) -> Tensor:
    """The layouts that stand in the simulations now, (n, K, 5): see :mod:`robotbrain.rl.tasks.layouts`."""
    world = env.scene.world

    def compute(rows: Any) -> Tensor:
        first, count = _obstacle_geoms(env)
        place = torch.from_numpy(world.batch.mocap_pos[rows, :, :2]).float()
        turn = torch.from_numpy(world.batch.mocap_quat[rows]).float()
        yaw = 2.0 * torch.atan2(turn[..., 3], turn[..., 0])
        half = torch.from_numpy(world.expand("geom_size")[rows, first : first + count, :2]).float()
        return torch.cat((place, yaw[..., None], half), -1)

    every = env.scene.until_written("obstacle_rectangles", compute)
    return every if env_ids is None else every[torch.as_tensor(env_ids)]


def obstacle_clearance(env: ManagerBasedRLEnv, room_half: float = 4.0) -> Tensor:
    """Distance (m) from the robot's middle to the nearest obstacle or wall, (num_envs,); negative inside one."""

    def compute() -> Tensor:
        position = env.scene["robot"].data.root_pos_w.torch[:, None, :2]
        return clearance(position, obstacle_rectangles(env), room_half)[:, 0]

    return env.scene.once_per_state(("obstacle_clearance", room_half), compute)


class reset_layout(ManagerTermBase):  # noqa: N801  (terms are called like functions)
    """Event: put another room of obstacles into each environment, out of a store that ``seed`` alone decides.

    Args (of the call):
        spec: what layouts are drawn from.
        layouts: how many the store holds.
        seed: of the store. Training and evaluation take different ones: rooms of one never appear in the other.
    """

    def __init__(self, cfg: EventTermCfg, env: ManagerBasedRLEnv) -> None:
        super().__init__(cfg, env)
        spec, count = cfg.params["spec"], _obstacle_geoms(env)[1]
        if spec.obstacles != count:
            raise InputError(
                "reset_layout: spec.obstacles",
                given=spec.obstacles,
                expected=f"{count}, as many as the model has obstacle bodies",
                fix="Give base_mjcf(obstacles=...) and LayoutSpec(obstacles=...) the same number.",
            )
        generator = torch.Generator().manual_seed(cfg.params["seed"])
        self._store = draw_layouts(cfg.params["layouts"], spec, generator)

    def __call__(self, env: ManagerBasedRLEnv, env_ids: Tensor, spec: LayoutSpec, layouts: int, seed: int) -> None:
        """Put a layout into each of these environments."""
        world, rows = env.scene.world, torch.as_tensor(env_ids).numpy()
        chosen = torch.randint(len(self._store), (len(rows),), generator=env.generator)
        drawn = self._store[chosen].double().numpy()
        first, count = _obstacle_geoms(env)
        obstacles = slice(first, first + count)
        quaternion = torch.zeros(len(rows), count, 4, dtype=torch.float64).numpy()
        quaternion[..., 0], quaternion[..., 3] = _half_angle(drawn[..., 2])
        world.batch.mocap_pos[rows, :, :2] = drawn[..., :2]
        world.batch.mocap_quat[rows] = quaternion
        world.expand("geom_size")[rows, obstacles, :2] = drawn[..., 3:]
        # Rays skip a geom by its bounding sphere, which does not follow the size by itself.
        radius = (drawn[..., 3:] ** 2).sum(-1) + OBSTACLE_HALF_HEIGHT**2
        world.expand("geom_rbound")[rows, obstacles] = radius**0.5
        world.mark_written(rows)


def reset_root_state_free(env: ManagerBasedRLEnv, env_ids: Tensor, margin: float, room_half: float = 4.0) -> None:
    """Event: stand the robot still at a place at least ``margin`` m from everything, in any direction."""
    ids = torch.as_tensor(env_ids)
    places = (2.0 * torch.rand(len(ids), _TRIES, 2, generator=env.generator) - 1.0) * (room_half - margin)
    place = _first_free(places, obstacle_rectangles(env, ids), margin, room_half)
    yaw = (2.0 * torch.rand(len(ids), generator=env.generator) - 1.0) * math.pi
    pose = torch.zeros(len(ids), 7)
    pose[:, :2] = place
    pose[:, 6], pose[:, 5] = torch.cos(yaw / 2.0), torch.sin(yaw / 2.0)
    robot = env.scene["robot"]
    robot.write_root_pose_to_sim_index(root_pose=pose, env_ids=ids)
    robot.write_root_velocity_to_sim_index(root_velocity=torch.zeros(len(ids), 6), env_ids=ids)


def randomize_motor_lag(env: ManagerBasedRLEnv, env_ids: Tensor, lag_range: tuple[float, float]) -> None:
    """Event: draw each environment's motor lag (s), the same for driving and turning."""
    rows = slice(None) if env_ids is None else torch.as_tensor(env_ids).numpy()
    live = env.scene["robot"].model_param("actuator_dynprm")
    low, high = lag_range
    lag = low + (high - low) * torch.rand(len(live[rows]), 1, generator=env.generator)
    columns = [env.scene.world.model.actuator(name).id for name in ACTUATORS[:2]]
    live[rows, :, 0] = live[rows, :, 0].index_copy(1, torch.tensor(columns), lag.double().expand(-1, 2))


def _first_free(places: Tensor, rectangles: Tensor, margin: float, room_half: float) -> Tensor:
    """The first of the places (n, M, 2) with that much room around it; the roomiest where none has."""
    room = clearance(places, rectangles, room_half)
    free = room >= margin
    index = torch.where(free.any(1), free.to(torch.int8).argmax(1), room.argmax(1))
    return places[torch.arange(len(places)), index]


def _obstacle_geoms(env: ManagerBasedRLEnv) -> tuple[int, int]:
    model = env.scene.world.model
    return int(model.geom("obstacle_0").id), int(model.nmocap)


def _half_angle(yaw: Any) -> tuple[Any, Any]:
    half = torch.from_numpy(yaw / 2.0)
    return half.cos().numpy(), half.sin().numpy()


# ------------------------------------------------------------ commands


class FreePose2dCommand(mdp.UniformPose2dCommand):
    """A goal on the ground within reach of the robot and clear of obstacles; the heading is open (always 0 error)."""

    cfg: FreePose2dCommandCfg

    def _resample_command(self, env_ids: Any) -> None:
        cfg, generator, count = self.cfg, self._env.generator, len(env_ids)
        near, far = cfg.distance
        start = self.robot.data.root_pos_w.torch[env_ids]
        distance = near + (far - near) * torch.rand(count, _TRIES, generator=generator)
        bearing = (2.0 * torch.rand(count, _TRIES, generator=generator) - 1.0) * math.pi
        around = torch.stack((distance * bearing.cos(), distance * bearing.sin()), -1)
        rectangles = obstacle_rectangles(self._env, env_ids)
        goal = _first_free(start[:, None, :2] + around, rectangles, cfg.margin, cfg.room_half)
        self.pos_command_w[env_ids] = torch.cat((goal, start[:, 2:]), 1)
        self.heading_command_w[env_ids] = self.robot.data.heading_w.torch[env_ids]


@configclass
class FreePose2dCommandCfg(mdp.UniformPose2dCommandCfg):
    """A goal clear of obstacles.

    Attributes:
        distance: bounds of its distance from the robot (m).
        margin: least distance of the goal from obstacles and walls (m).
        room_half: half the side of the room (m).
    """

    class_type: type[CommandTerm] = FreePose2dCommand
    asset_name: str = "robot"
    simple_heading: bool = False
    ranges: Any = None
    distance: tuple[float, float] = MISSING
    margin: float = MISSING
    room_half: float = 4.0


def goal_distance(env: ManagerBasedRLEnv, command_name: str) -> Tensor:
    """Distance to the goal (m), (num_envs,)."""
    distance: Tensor = _to_goal(env, command_name).norm(dim=1)
    return distance


def _to_goal(env: ManagerBasedRLEnv, command_name: str) -> Tensor:
    term: Any = env.command_manager.get_term(command_name)  # FreePose2dCommand, or another with a goal in the world
    line: Tensor = (term.pos_command_w - env.scene["robot"].data.root_pos_w.torch)[:, :2]
    return line


# ------------------------------------------------------------ observations


def body_velocity(env: ManagerBasedRLEnv) -> Tensor:
    """Forward speed (m/s) and turning rate (rad/s) of the base, (num_envs, 2)."""
    data = env.scene["robot"].data
    return torch.stack((data.root_lin_vel_b.torch[:, 0], data.root_ang_vel_b.torch[:, 2]), 1)


def goal_polar(env: ManagerBasedRLEnv, command_name: str) -> Tensor:
    """Direction to the goal in the robot's frame and its distance: (cos, sin, m), (num_envs, 3)."""
    line = _to_goal(env, command_name)
    heading = env.scene["robot"].data.heading_w.torch
    bearing = torch.atan2(line[:, 1], line[:, 0]) - heading
    return torch.stack((bearing.cos(), bearing.sin(), line.norm(dim=1)), 1)


def lidar_log_range(
    env: ManagerBasedRLEnv,
    sensor_name: str,
    sectors: int,
    bounds: tuple[float, float],
    noise: tuple[float, float] = (0.0, 0.0),
) -> Tensor:
    """Nearest range in equal sectors of the scan, from straight behind anticlockwise, (num_envs, sectors).

    Args:
        env: the environment.
        sensor_name: the lidar; its rays are a multiple of the sectors.
        sectors: how many.
        bounds: ranges are clipped to them (m); what is returned is the logarithm of the range over the lower one.
        noise: bounds of a uniform error of every range (m). It is added here, to the metres: a term's own noise would
            be added to the logarithm.
    """
    ranges: Tensor = env.scene.sensors[sensor_name].data.ranges.torch
    low, high = noise
    if high > low:
        ranges = ranges + low + (high - low) * torch.rand(ranges.shape, generator=env.generator)
    nearest = ranges.view(len(ranges), sectors, -1).amin(-1)
    return torch.log(nearest.clamp(*bounds) / bounds[0])


def last_command(env: ManagerBasedRLEnv, action_name: str) -> Tensor:
    """The last action as it was used, within -1..1, (num_envs, 2)."""
    used: Tensor = env.action_manager.get_term(action_name).raw_actions
    return used


# ------------------------------------------------------------ rewards and terminations


def progress_to_goal(env: ManagerBasedRLEnv, command_name: str) -> Tensor:
    """Speed towards the goal (m/s), (num_envs,): its sum over an episode is how much nearer the robot came."""
    line = _to_goal(env, command_name)
    velocity = env.scene["robot"].data.root_lin_vel_w.torch[:, :2]
    speed: Tensor = (velocity * line).sum(1) / line.norm(dim=1).clamp(min=1e-3)
    return speed


def obstacle_proximity(env: ManagerBasedRLEnv, radius: float, margin: float) -> Tensor:
    """How far the robot (a disc of ``radius`` m) is inside its ``margin`` (m) to obstacles, 0 to 1 at touch."""
    return (1.0 - (obstacle_clearance(env) - radius) / margin).clamp(0.0, 1.0)


def goal_reached(env: ManagerBasedRLEnv, command_name: str, distance: float) -> Tensor:
    """The robot is within ``distance`` m of the goal."""
    return goal_distance(env, command_name) < distance


def obstacle_collision(env: ManagerBasedRLEnv, radius: float) -> Tensor:
    """The robot (a disc of ``radius`` m) touches an obstacle or a wall."""
    return obstacle_clearance(env) <= radius
