"""A planar lidar on a body: distances along rays, cast in every environment's own world."""

from __future__ import annotations

import mujoco
import numpy as np
import torch

from robotbrain.errors import InputError
from robotbrain.rl.configclass import did_you_mean
from robotbrain.rl.scene.scene_cfg import LidarCfg
from robotbrain.rl.scene.world import EnvIds, Source, TensorView, World


class LidarData:
    """Readings with a ``.torch``.

    Attributes:
        ranges: (num_envs, rays) [m], ``max_range`` where nothing is nearer.
    """

    def __init__(self, ranges: TensorView) -> None:
        self.ranges = ranges


class Lidar:
    """The lidar of a scene; it casts only when it is read, and only for environments that have changed since.

    Args:
        cfg: its configuration.
        world: the simulations.

    Raises:
        InputError: an unknown body, no rays, a range that is not positive, or flags that are not six.
    """

    def __init__(self, cfg: LidarCfg, world: World) -> None:
        self.cfg, self._world = cfg, world
        names = [world.model.body(b).name for b in range(world.model.nbody)]
        if cfg.body not in names:
            raise InputError(
                "LidarCfg.body", given=cfg.body, expected="a body of the model", fix=did_you_mean(str(cfg.body), names)
            )
        if not len(cfg.angles) or not cfg.max_range > 0:
            raise InputError(
                "LidarCfg",
                given={"angles": len(cfg.angles), "max_range": cfg.max_range},
                expected="at least one angle and a positive range",
                fix="Give e.g. angles=(-0.1, 0.0, 0.1), max_range=10.0.",
            )
        groups = None if cfg.geomgroup is None else np.asarray(cfg.geomgroup, dtype=np.uint8)
        if groups is not None and groups.shape != (mujoco.mjNGROUP,):
            raise InputError(
                "LidarCfg.geomgroup", given=cfg.geomgroup, expected=f"{mujoco.mjNGROUP} flags", fix="0 or 1 per group."
            )
        self._groups, self._body = groups, names.index(cfg.body)
        angles = np.asarray(cfg.angles, dtype=np.float64)
        self._rays = np.stack((np.cos(angles), np.sin(angles), np.zeros_like(angles)), 1)
        self._offset = np.asarray(cfg.offset, dtype=np.float64)
        self._ranges = torch.full((world.num_envs, len(angles)), float(cfg.max_range))
        self.data = LidarData(TensorView(self._ranges, Source(world, self._cast)))
        self._tick = -1

    @property
    def num_rays(self) -> int:
        """Number of rays."""
        return len(self._rays)

    @property
    def body_names(self) -> list[str]:
        """The body that carries it."""
        return [self.cfg.body]

    def _cast(self) -> None:
        world = self._world
        changed = world.changed_since(self._tick)
        self._tick = world.tick
        if changed is not None and not len(changed):
            return
        index: slice | np.ndarray = slice(None) if changed is None else changed
        rotation = world.derived("xmat")[index, self._body].reshape(-1, 3, 3)
        origin = world.derived("xpos")[index, self._body] + rotation @ self._offset
        direction = self._rays @ rotation.transpose(0, 2, 1)
        distance, _ = world.batch.ray(
            origin[:, None, :], direction, geomgroup=self._groups, bodyexclude=self._body, ids=changed
        )
        far = float(self.cfg.max_range)
        np.copyto(distance, far, where=distance < 0.0)
        self._ranges.numpy()[index] = np.minimum(distance, far, out=distance)

    def update(self, dt: float) -> None:
        """Nothing to do: it is cast when it is read."""

    def reset(self, env_ids: EnvIds = None) -> None:
        """Nothing to forget."""
