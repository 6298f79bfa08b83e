"""A robot in a world: physics, firmware and sensors under one clock, and the judge's view apart from them."""

from __future__ import annotations

import math
import numbers
from collections import deque
from dataclasses import dataclass
from typing import NoReturn

import mujoco
import numpy as np

from robotbrain.errors import InputError, RobotBrainError
from robotbrain.sim.camera import CameraExtrinsics, CameraImage, CameraIntrinsics, RayCamera
from robotbrain.sim.checks import check_seed
from robotbrain.sim.geometry import Array, Pose2D
from robotbrain.sim.lidar import LidarSpec, RayLidar
from robotbrain.sim.rays import rotation_from_quaternion
from robotbrain.sim.readings import CameraReading, ImuReading, LidarReading, WheelReading
from robotbrain.sim.robot import BaseFirmware, RobotParams, SensorParams
from robotbrain.sim.scene import TIMESTEP_S, build_scene
from robotbrain.sim.world import World

GRAVITY = 9.81


class UnstableError(RobotBrainError):
    """The physics left the range in which it means anything (NaN, or speeds no robot has)."""


@dataclass(frozen=True, slots=True)
class Collision:
    """The robot began to touch something.

    Args:
        stamp_ns: when.
        name: of the obstacle.
        speed: of the robot just before (m/s).
    """

    stamp_ns: int
    name: str
    speed: float


@dataclass(frozen=True, slots=True)
class Twist2D:
    """Motion in the robot's own frame.

    Args:
        v: forward speed (m/s).
        w: turning rate (rad/s).
    """

    v: float
    w: float


class RobotSim:
    """One robot in one world.

    Time is whole physics steps of 5 ms; ``advance_to`` goes to the last step not after the time asked for. All
    sensors draw from generators of their own, so reading one never changes another's noise. The whole run is a
    function of world, parameters, seed and commands.

    Args:
        world: where the robot is; it starts at ``world.start``.
        robot: body and drive; the nominal robot by default.
        sensors: errors and timing; mild realistic noise by default.
        seed: of the sensor noise.
        intrinsics: of the camera.
        extrinsics: mounting of the camera.
        lidar: geometry of the scan.
    """

    def __init__(
        self,
        world: World,
        robot: RobotParams | None = None,
        sensors: SensorParams | None = None,
        seed: int = 0,
        *,
        intrinsics: CameraIntrinsics | None = None,
        extrinsics: CameraExtrinsics | None = None,
        lidar: LidarSpec | None = None,
    ) -> None:
        self.world = world
        self.robot = robot or RobotParams()
        self.sensors = sensors or SensorParams()
        self.scene = build_scene(world, self.robot)
        self.camera = RayCamera(self.scene, intrinsics, extrinsics)
        self.lidar = RayLidar(self.scene, lidar)
        streams = np.random.SeedSequence([0x51E, check_seed("simulation seed", seed)]).spawn(4)
        self._encoder_rng, self._imu_rng, self._lidar_rng, self._camera_rng = map(np.random.default_rng, streams)
        self._model, self._data = self.scene.model, mujoco.MjData(self.scene.model)
        mujoco.mj_forward(self._model, self._data)
        self._step_ns = round(TIMESTEP_S * 1e9)
        self._steps = 0
        self._firmware = BaseFirmware(self.robot, TIMESTEP_S)
        self._commands: deque[tuple[int, float, float]] = deque()
        self._deadline_ns = 0
        self._slip = np.zeros(2)
        self._rolled = np.zeros(2)
        self._imu_mark = (0, np.zeros(3))
        self.truth = Truth(self)
        """The judge's view. Nothing in it may reach the robot's software."""

    @property
    def now_ns(self) -> int:
        """Simulated time of the state (ns)."""
        return self._steps * self._step_ns

    def set_twist(self, v: float, w: float) -> None:
        """Command a forward speed (m/s) and turning rate (rad/s); clamped to the robot's limits.

        It takes effect after the robot's command delay, and lapses after its command timeout.

        Raises:
            InputError: a value is not a finite number.
        """
        for name, value in (("v", v), ("w", w)):
            if not math.isfinite(value):
                raise InputError(
                    f"set_twist {name}",
                    given=value,
                    expected="a finite number",
                    fix="Check the controller's output before sending it.",
                )
        due = self.now_ns + round(self.robot.command_delay_s * 1e9)
        self._commands.append((due, float(v), float(w)))

    def advance_to(self, t_ns: int) -> None:
        """Run the physics up to ``t_ns`` (ns since the start).

        Raises:
            InputError: ``t_ns`` lies in the past.
            UnstableError: the physics became unstable.
        """
        integer = isinstance(t_ns, numbers.Integral)
        target = int(t_ns) // self._step_ns if integer else -1
        if target < self._steps:
            raise InputError(
                "advance_to",
                given=t_ns,
                expected=f"an integer time, in ns, not before the present {self.now_ns}",
                fix="Time runs forward only; make a new RobotSim to start again.",
            )
        for _ in range(target - self._steps):
            self._step()
        if self._data.warning.number.any():
            self.truth.raise_unstable()

    def read_encoders(self) -> WheelReading:
        """Read both wheel encoders (they sit on the motor side of the gearbox)."""
        p, rng = self.sensors, self._encoder_rng
        speed = self._data.qvel[6:8]
        angle = self._data.qpos[7:9] + self._firmware.play
        self._slip += p.encoder_slip * np.sqrt(np.abs(angle - self._rolled)) * rng.standard_normal(2)
        self._rolled = angle.copy()
        tick = 2.0 * math.pi / p.encoder_ticks
        position = np.round((angle + self._slip) / tick) * tick
        velocity = speed + p.encoder_velocity_noise * rng.standard_normal(2)
        return WheelReading(self.now_ns, position, velocity)

    def read_imu(self) -> ImuReading:
        """Read the inertial unit."""
        p, rng = self.sensors, self._imu_rng
        stamp, before = self._imu_mark
        velocity = self._data.qvel[:3].copy()
        elapsed = (self.now_ns - stamp) * 1e-9
        change = (velocity - before) / elapsed if elapsed > 0.0 else np.zeros(3)
        self._imu_mark = (self.now_ns, velocity)
        change[2] += GRAVITY
        force = rotation_from_quaternion(self._data.qpos[3:7]).T @ change
        rate = self._data.qvel[3:6] + p.gyro_bias + p.gyro_noise * rng.standard_normal(3)
        return ImuReading(self.now_ns, rate, force + p.accelerometer_noise * rng.standard_normal(3))

    def read_lidar(self) -> LidarReading | None:
        """Take a scan; None when it is lost."""
        p, rng, spec = self.sensors, self._lidar_rng, self.lidar.spec
        lost = rng.random() < p.lidar_drop
        ranges = self.lidar.scan(self._data.qpos, p, rng)
        if lost:
            return None
        return LidarReading(
            self.now_ns,
            self.now_ns + round(p.lidar_latency_s * 1e9),
            ranges,
            spec.angle_min,
            spec.angle_increment,
            spec.range_min,
            spec.range_max,
        )

    def read_camera(self) -> CameraReading | None:
        """Take a frame; None when it is lost."""
        p, rng = self.sensors, self._camera_rng
        if rng.random() < p.camera_drop:
            return None
        image = self.camera.render(self._data.qpos, p, rng)
        available = self.now_ns + round(p.camera_latency_s * 1e9)
        return CameraReading(self.now_ns, available, image.rgb, image.depth)

    def _step(self) -> None:
        data, now = self._data, self.now_ns
        while self._commands and self._commands[0][0] <= now:
            _, v, w = self._commands.popleft()
            self._firmware.command(v, w)
            self._deadline_ns = now + round(self.robot.command_timeout_s * 1e9)
        if now >= self._deadline_ns:
            self._firmware.command(0.0, 0.0)
        speed = data.qvel[6:8].tolist()
        data.ctrl[:] = self._firmware.step(speed[0], speed[1])
        mujoco.mj_step(self._model, data)
        self._steps += 1
        self.truth._update()


class Truth:
    """What only a judge may know: the true state, collisions and progress of a ``RobotSim``."""

    def __init__(self, sim: RobotSim) -> None:
        self._sim, self._data = sim, sim._data
        self._robot_geoms, self._names = sim.scene.robot_geoms, sim.scene.geom_names
        self._touching: frozenset[int] = frozenset()
        self._collisions: list[Collision] = []
        self._last = (sim.world.start.x, sim.world.start.y)
        self._length = self._speed = 0.0

    @property
    def pose(self) -> Pose2D:
        """Pose of ``base_link`` in the world frame."""
        q = self._data.qpos
        w, x, y, z = (float(value) for value in q[3:7])
        return Pose2D(float(q[0]), float(q[1]), math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))

    @property
    def twist(self) -> Twist2D:
        """Velocity of ``base_link`` in its own frame."""
        yaw, v = self.pose.yaw, self._data.qvel
        return Twist2D(float(v[0] * math.cos(yaw) + v[1] * math.sin(yaw)), float(v[5]))

    @property
    def collisions(self) -> tuple[Collision, ...]:
        """Every beginning of a touch, in order of time."""
        return tuple(self._collisions)

    @property
    def collided(self) -> frozenset[str]:
        """Names of all obstacles touched so far; empty is a clean run."""
        return frozenset(c.name for c in self._collisions)

    @property
    def touching(self) -> frozenset[str]:
        """Names of the obstacles touched now."""
        return frozenset(self._names[i] for i in self._touching)

    @property
    def distance_to_goal(self) -> float:
        """From the robot's middle to the goal's (m)."""
        goal = self._sim.world.goal
        return math.hypot(self._last[0] - goal.x, self._last[1] - goal.y)

    @property
    def path_length(self) -> float:
        """Way of the robot's middle so far (m)."""
        return self._length

    def obstacle_poses(self) -> tuple[Pose2D, ...]:
        """Poses of the movable obstacles, in the order of ``world.movable``."""
        q, poses = self._data.qpos, []
        for i in self._sim.scene.box_qpos:
            w, x, y, z = (float(value) for value in q[i + 3 : i + 7])
            yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
            poses.append(Pose2D(float(q[i]), float(q[i + 1]), yaw))
        return tuple(poses)

    def qpos(self) -> Array:
        """Copy of the whole configuration (nq,)."""
        return np.array(self._data.qpos)

    def camera_image(self) -> CameraImage:
        """What a perfect camera sees now, with true classes."""
        return self._sim.camera.render(self._data.qpos)

    def raise_unstable(self) -> NoReturn:
        """Raise ``UnstableError`` with what is known."""
        x, y = self._data.qpos[:2].tolist()
        raise UnstableError(
            f"the physics of {self._sim.world.spec} became unstable at t = {self._sim.now_ns / 1e9:.3f} s "
            f"(robot at x = {x:.3g}, y = {y:.3g} m). Use parameters nearer to the nominal robot, and please "
            "report the seed."
        )

    def _update(self) -> None:
        data = self._data
        x, y = data.qpos[:2].tolist()
        vx, vy = data.qvel[:2].tolist()
        if not abs(x) + abs(y) < 100.0 or not abs(vx) + abs(vy) < 50.0:  # also where they are NaN
            self.raise_unstable()
        self._length += math.hypot(x - self._last[0], y - self._last[1])
        self._last = (x, y)
        touching = frozenset(
            other
            for a, b in data.contact.geom.tolist()
            if (other := b if a in self._robot_geoms else a if b in self._robot_geoms else -1) >= 0
        )
        if touching != self._touching:
            for geom in sorted(touching - self._touching):
                self._collisions.append(Collision(self._sim.now_ns, self._names[geom], self._speed))
            self._touching = touching
        self._speed = math.hypot(vx, vy)
