"""The kit's three tasks as single Gymnasium environments on plain MuJoCo, for comparison in ``rl_stepping.py``.

Same models, decimation, observations, rewards and ends of episodes, in numpy, written to be quick. Left out, in the
peers' favour: domain randomisation, pushes and latency, logs of terms.
"""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import mujoco
import numpy as np

from robotbrain.rl.robots import arm_mjcf, base_mjcf, quadruped_mjcf
from robotbrain.rl.robots.arm import WORKSPACE
from robotbrain.sim.robot import CHASSIS_RADIUS, LIDAR_HEIGHT

Float = np.ndarray


class Peer(gymnasium.Env):  # type: ignore[misc]
    """What the three have in common; subclasses give ``start``, ``command``, ``observe``, ``reward`` and ``ended``."""

    decimation: int
    horizon: int

    def __init__(self, model: mujoco.MjModel, observations: int, actions: int) -> None:
        self.model, self.data = model, mujoco.MjData(model)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (observations,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (actions,), np.float32)
        self.action, self.before = np.zeros(actions), np.zeros(actions)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Float, dict[str, Any]]:
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        if self.model.nkey:
            mujoco.mj_resetDataKeyframe(self.model, self.data, 0)
        self.clock = 0
        self.action[:] = 0
        self.start()
        return self.observe().astype(np.float32), {}

    def step(self, action: Float) -> tuple[Float, float, bool, bool, dict[str, Any]]:
        self.before[:], self.action[:] = self.action, action
        self.command()
        mujoco.mj_step(self.model, self.data, nstep=self.decimation)
        self.clock += 1
        self.look()
        reward, ended = self.reward(), self.ended()
        return self.observe().astype(np.float32), reward, ended, self.clock >= self.horizon, {}

    def look(self) -> None:
        """Compute what observation and reward share."""


class Reach(Peer):
    decimation, horizon = 8, 50

    def __init__(self) -> None:
        super().__init__(mujoco.MjModel.from_xml_string(arm_mjcf()), 27, 7)
        self.home = self.model.key_qpos[0].copy()
        self.hand = self.model.body("ee").id
        self.low, self.high = np.array(WORKSPACE).T
        self.goal = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])

    def start(self) -> None:
        self.data.qpos[:] = self.home + self.np_random.uniform(-0.25, 0.25, 7)
        self.goal[:3] = self.np_random.uniform(self.low, self.high)
        self.look()

    def command(self) -> None:
        np.multiply(self.action, 0.3, out=self.data.ctrl)
        self.data.ctrl += self.data.qpos

    def look(self) -> None:
        mujoco.mj_kinematics(self.model, self.data)
        self.ee = self.data.xpos[self.hand].copy()
        self.line = self.goal[:3] - self.ee
        self.distance = math.sqrt(self.line @ self.line)

    def observe(self) -> Float:
        d = self.data
        return np.concatenate((d.qpos - self.home, 0.3 * d.qvel, self.goal, self.ee, 5 * self.line))

    def reward(self) -> float:
        return -self.distance - 0.2 * (1.0 - math.exp(-((self.distance / 0.03) ** 2)))

    def ended(self) -> bool:
        return False


class Velocity(Peer):
    decimation, horizon = 4, 1000

    def __init__(self) -> None:
        super().__init__(mujoco.MjModel.from_xml_string(quadruped_mjcf()), 48, 12)
        m = self.model
        self.home = (m.key_qpos[0] if m.nkey else m.qpos0).copy()
        self.trunk = m.body("base").id
        touch = {m.sensor(i).name.removeprefix("contact_"): int(m.sensor_adr[i]) for i in range(m.nsensor)}
        self.feet = np.array([a for n, a in touch.items() if n.endswith("_foot")])
        self.legs = np.array([a for n, a in touch.items() if n.endswith(("_thigh", "_calf"))])
        self.belly = touch["base"]
        noise = [0.1] * 3 + [0.2] * 3 + [0.05] * 3 + [0.0] * 3 + [0.01] * 12 + [1.5] * 12 + [0.0] * 12
        self.noise = np.array(noise)
        self.air, self.target = np.zeros(4), np.zeros(3)

    def start(self) -> None:
        d, rng = self.data, self.np_random
        d.qpos[:2] += rng.uniform(-0.5, 0.5, 2)
        yaw = rng.uniform(-math.pi, math.pi) / 2
        d.qpos[3:7] = math.cos(yaw), 0.0, 0.0, math.sin(yaw)
        d.qpos[7:] *= rng.uniform(0.8, 1.2, 12)
        d.qvel[:6] = rng.uniform(-0.5, 0.5, 6)
        self.air[:] = 0.0
        self.redraw()
        mujoco.mj_kinematics(self.model, d)
        self.look()

    def redraw(self) -> None:
        rng = self.np_random
        self.target[:] = rng.uniform((-1, -0.5, -1), (1, 0.5, 1)) * (rng.random() > 0.1)

    def command(self) -> None:
        np.multiply(self.action, 0.25, out=self.data.ctrl)
        self.data.ctrl += self.home[7:]
        if self.clock % 500 == 499:
            self.redraw()

    def look(self) -> None:
        d = self.data
        w, x, y, z = d.qpos[3:7]
        self.down = np.array((2 * (w * y - x * z), -2 * (y * z + w * x), 2 * (x * x + y * y) - 1))
        u, v = -d.qpos[4:7], d.qvel[:3]
        t = 2 * np.array((u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]))
        self.speed = v + w * t + (u[1] * t[2] - u[2] * t[1], u[2] * t[0] - u[0] * t[2], u[0] * t[1] - u[1] * t[0])
        self.away = d.qpos[7:] - self.home[7:]

    def observe(self) -> Float:
        d = self.data
        obs = np.concatenate((self.speed, d.qvel[3:6], self.down, self.target, self.away, d.qvel[6:], self.action))
        return obs + self.noise * self.np_random.uniform(-1, 1, 48)

    def reward(self) -> float:
        d, v, w, g = self.data, self.speed, self.data.qvel[3:6], self.down
        ex, ey, ez = self.target - (v[0], v[1], w[2])
        touching = d.sensordata[self.feet] > 1.0
        first = touching & (self.air > 0)
        self.air += 0.02
        swing = float((self.air - 0.3) @ first)
        self.air[touching] = 0.0
        walk = math.hypot(self.target[0], self.target[1])
        away = np.abs(self.away)
        change, torque, acc = self.action - self.before, d.qfrc_actuator[6:], d.qacc[6:]
        total = (
            1.5 * math.exp(-4 * (ex * ex + ey * ey))
            + 0.75 * math.exp(-4 * ez * ez)
            - 2.0 * v[2] ** 2
            - 0.05 * (w[0] ** 2 + w[1] ** 2)
            - 2.5 * (g[0] ** 2 + g[1] ** 2)
            - 10.0 * (d.qpos[2] - 0.3) ** 2
            - 2e-4 * (torque @ torque)
            - 2.5e-7 * (acc @ acc)
            - 0.01 * (change @ change)
            - 0.1 * away[::3].sum()
            - 0.5 * away.sum() * (walk < 0.06)
            + 0.5 * swing * (walk > 0.1)
            - 1.0 * np.count_nonzero(d.sensordata[self.legs] > 1.0)
        )
        return max(float(total), 0.0) * 0.02

    def ended(self) -> bool:
        return bool(self.data.sensordata[self.belly] > 1.0 or -self.down[2] < math.cos(math.radians(72)))


class Navigation(Peer):
    decimation, horizon = 2, 200
    rays, sectors, low, high = 72, 36, CHASSIS_RADIUS, 3.0

    def __init__(self) -> None:
        model = mujoco.MjModel.from_xml_string(base_mjcf())
        model.opt.timestep = 0.05
        super().__init__(model, 43, 2)
        self.base, self.count = model.body("base").id, model.nmocap
        first = model.geom("obstacle_0").id
        self.geoms = slice(first, first + self.count)
        angles = 2 * np.pi * (np.arange(self.rays) + 0.5) / self.rays - np.pi
        self.cos, self.sin = np.cos(angles), np.sin(angles)
        self.ray = np.zeros((self.rays, 3))
        self.hit, self.range = np.zeros(self.rays, np.int32), np.zeros(self.rays)
        self.group = np.array((1, 0, 0, 0, 0, 0), np.uint8)
        self.scale = 1 / math.log(self.high / self.low)

    def start(self) -> None:
        d, rng = self.data, self.np_random
        self.place = rng.uniform(-3.5, 3.5, (self.count, 2))
        turn, self.half = rng.uniform(-np.pi, np.pi, self.count), rng.uniform(0.13, 0.4, (self.count, 2))
        self.axis = np.stack((np.cos(turn), np.sin(turn)), 1)
        d.mocap_pos[:, :2] = self.place
        d.mocap_quat[:] = np.stack((np.cos(turn / 2), 0 * turn, 0 * turn, np.sin(turn / 2)), 1)
        self.model.geom_size[self.geoms, :2] = self.half
        self.model.geom_rbound[self.geoms] = np.sqrt((self.half**2).sum(1) + 0.16)
        for _ in range(32):
            d.qpos[:2] = rng.uniform(-3.7, 3.7, 2)
            if self.clearance() > 0.25:
                break
        yaw = rng.uniform(-np.pi, np.pi)
        d.qpos[3], d.qpos[6] = math.cos(yaw / 2), math.sin(yaw / 2)
        far, bearing = rng.uniform(0.5, 4.0), rng.uniform(-np.pi, np.pi)
        self.goal = d.qpos[:2] + far * np.array((math.cos(bearing), math.sin(bearing)))
        self.look()

    def clearance(self) -> float:
        x, y = (self.data.qpos[:2] - self.place).T
        ax, ay = self.axis.T
        ahead, aside = np.abs(ax * x + ay * y) - self.half[:, 0], np.abs(ax * y - ay * x) - self.half[:, 1]
        gap = np.hypot(np.maximum(ahead, 0), np.maximum(aside, 0)) + np.minimum(np.maximum(ahead, aside), 0)
        return float(min(gap.min(), 4.0 - np.abs(self.data.qpos[:2]).max()))

    def command(self) -> None:
        self.data.ctrl[0], self.data.ctrl[1] = 0.15 + 0.35 * self.action[0], 1.2 * self.action[1]

    def look(self) -> None:
        d = self.data
        self.heading = 2 * math.atan2(d.qpos[6], d.qpos[3])
        self.line = self.goal - d.qpos[:2]
        self.distance = math.hypot(*self.line)
        self.gap = self.clearance() - CHASSIS_RADIUS

    def observe(self) -> Float:
        d, c, s = self.data, math.cos(self.heading), math.sin(self.heading)
        mujoco.mj_kinematics(self.model, d)
        self.ray[:, 0], self.ray[:, 1] = c * self.cos - s * self.sin, s * self.cos + c * self.sin
        origin = np.array((d.qpos[0], d.qpos[1], d.qpos[2] + LIDAR_HEIGHT))
        mujoco.mj_multiRay(
            self.model, d, origin, self.ray.ravel(), self.group, 1, self.base, self.hit, self.range, None, self.rays, 8
        )
        scan = np.where(self.hit < 0, 8.0, self.range) + self.np_random.uniform(-0.02, 0.02, self.rays)
        near = scan.reshape(self.sectors, -1).min(1).clip(self.low, self.high)
        bearing = math.atan2(self.line[1], self.line[0]) - self.heading
        polar = (math.cos(bearing), math.sin(bearing), min(self.distance, 3.0) / 3.0)
        motion = np.array((c * d.qvel[0] + s * d.qvel[1], d.qvel[5])) + self.np_random.normal(0, 0.02, 2)
        return np.concatenate((motion, polar, np.log(near / self.low) * self.scale, self.action))

    def reward(self) -> float:
        progress = float(self.data.qvel[:2] @ self.line) / max(self.distance, 1e-3)
        change = self.action - self.before
        close = min(max(1 - self.gap / 0.15, 0.0), 1.0)
        bonus = 50.0 * (self.distance < 0.1) - 120.0 * (self.gap <= 0)
        return 0.1 * (2.0 * progress + bonus - close - 0.2 * float(change @ change) - 0.1)

    def ended(self) -> bool:
        return self.distance < 0.1 or self.gap <= 0


PEERS: dict[str, type[Peer]] = {"reach": Reach, "velocity": Velocity, "navigation": Navigation}
