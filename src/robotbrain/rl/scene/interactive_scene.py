"""The scene: the simulations, the robots in them and their sensors, by name."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any

import mujoco
import torch

from robotbrain.errors import InputError
from robotbrain.rl.configclass import did_you_mean
from robotbrain.rl.scene.articulation import Articulation
from robotbrain.rl.scene.contact_sensor import ContactSensor
from robotbrain.rl.scene.lidar import Lidar
from robotbrain.rl.scene.scene_cfg import (
    ArticulationCfg,
    ContactSensorCfg,
    InteractiveSceneCfg,
    LidarCfg,
    SimulationCfg,
    entities,
)
from robotbrain.rl.scene.world import EnvIds, World


class InteractiveScene:
    """What is in the simulations.

    Args:
        cfg: the scene; the one articulation with a ``model`` brings the MJCF of the whole world.
        sim: physics settings, which replace those of the model.
        num_threads: of the batch; 0: all processors.

    Attributes:
        world: the batch of simulations (``world.batch``, ``world.model`` are MuJoCo's).
        articulations, sensors: the entities by name.
        env_origins: zeros, (num_envs, 3): every environment is a world of its own.

    Raises:
        InputError: no or several models, MJCF that MuJoCo cannot compile, or unknown entities.
    """

    def __init__(self, cfg: InteractiveSceneCfg, sim: SimulationCfg, num_threads: int = 0) -> None:
        cfg.validate()
        self.cfg = cfg
        members = entities(cfg)
        model = compile_model(members)
        model.opt.timestep = sim.dt
        model.opt.gravity[:] = sim.gravity
        self.world = World(model, cfg.num_envs, num_threads)
        self.env_origins = torch.zeros(cfg.num_envs, 3)
        self._memory: dict[Hashable, tuple[int, torch.Tensor]] = {}
        self.articulations: dict[str, Articulation] = {}
        self.sensors: dict[str, Any] = {}
        for name, member in members.items():
            if isinstance(member, ArticulationCfg):
                self.articulations[name] = Articulation(member, self.world)
            elif isinstance(member, ContactSensorCfg):
                self.sensors[name] = ContactSensor(member, self.world)
            elif isinstance(member, LidarCfg):
                self.sensors[name] = Lidar(member, self.world)
            else:
                raise InputError(
                    f"scene.{name}",
                    given=type(member).__name__,
                    expected="ArticulationCfg, ContactSensorCfg or LidarCfg",
                    fix="Put bodies that are no robot into the robot's MJCF.",
                )

        self._entities: dict[str, Any] = {**self.articulations, **self.sensors}

    @property
    def num_envs(self) -> int:
        """Number of environments."""
        return self.world.num_envs

    @property
    def device(self) -> torch.device:
        """The CPU."""
        return torch.device("cpu")

    def keys(self) -> list[str]:
        """Names of the entities."""
        return list(self._entities)

    def __getitem__(self, name: str) -> Any:
        found = self._entities.get(name)
        if found is None:
            raise InputError(
                "scene entity", given=name, expected="an entity of the scene", fix=did_you_mean(name, self.keys())
            )
        return found

    def once_per_state(self, key: Hashable, compute: Callable[[], torch.Tensor]) -> torch.Tensor:
        """What ``compute()`` returns, computed anew only when the simulations' state has changed.

        For quantities that several terms need. Do not change the result in place.
        """
        found = self._memory.get(key)
        if found is None or found[0] != self.world.tick:
            found = self._memory[key] = (self.world.tick, compute())
        return found[1]

    def until_written(self, key: Hashable, compute: Callable[[Any], torch.Tensor]) -> torch.Tensor:
        """What ``compute(slice(None))`` returns; anew only for the environments that somebody has written to since.

        For quantities that the physics does not change, e.g. where things stand. ``compute(index)`` returns the rows
        of ``index``. Do not change the result in place.
        """
        found = self._memory.get(key)
        if found is None:
            rows = compute(slice(None))
        else:
            tick, rows = found
            written = self.world.written_since(tick) if tick != self.world.tick else ()
            if len(written):
                rows = rows.clone()
                rows[torch.from_numpy(written)] = compute(written)
        self._memory[key] = (self.world.tick, rows)
        return rows

    def update(self, dt: float) -> None:
        """Let the sensors take over the new state after ``dt`` seconds."""
        for sensor in self.sensors.values():
            sensor.update(dt)

    def reset(self, env_ids: EnvIds = None) -> None:
        """Put environments into the default state."""
        self.world.reset(env_ids)
        for articulation in self.articulations.values():
            articulation.reset(env_ids)
        for sensor in self.sensors.values():
            sensor.reset(env_ids)


def compile_model(members: dict[str, Any]) -> mujoco.MjModel:
    """Compile the one model that the entities bring.

    Raises:
        InputError: none or several of them, or MJCF that MuJoCo cannot compile.
    """
    sources = {k: m.model for k, m in members.items() if isinstance(m, ArticulationCfg) and m.model is not None}
    if len(sources) != 1:
        raise InputError(
            "scene",
            given=list(sources),
            expected="exactly one articulation with a model",
            fix="Give ArticulationCfg(model=...) once; further robots in the same model have model=None.",
        )
    ((name, source),) = sources.items()
    text = source() if callable(source) else source
    try:
        return mujoco.MjModel.from_xml_string(text)
    except (ValueError, TypeError) as error:
        raise InputError(
            f"scene.{name}.model", given=str(text)[:80], expected="MJCF", fix=f"MuJoCo says: {error}"
        ) from error
