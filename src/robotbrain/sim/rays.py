"""Casting rays at a scene's live state."""

from __future__ import annotations

from collections.abc import Iterable

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from robotbrain.sim.geometry import Array

_GROUPS = 6  # mjNGROUP


class RayCaster:
    """Rays against the geoms of some groups of a model, in any configuration.

    A batch of one simulation on the calling thread holds the configuration, so that the model under way is
    neither touched nor woken. Sleep is switched off in the copy: a batch of sleeping models would have to keep
    its own data.

    Args:
        model: the model.
        groups: the geom groups that stop a ray.
    """

    def __init__(self, model: mujoco.MjModel, groups: Iterable[int]) -> None:
        static = mujoco.MjModel.__copy__(model)
        static.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
        self._batch = Batch(static, 1, nthread=1)
        self._qpos = self._batch.bind("qpos")
        self._groups = np.zeros(_GROUPS, np.uint8)
        self._groups[list(groups)] = 1

    def cast(self, qpos: Array, origin: Array, directions: Array) -> tuple[Array, NDArray[np.int32], Array]:
        """Return distance (n,), geom id (n,) and outward normal (n, 3) of the first hit of each ray.

        Args:
            qpos: configuration, (nq,).
            origin: of all rays, (3,), in the world frame (m).
            directions: unit vectors, (n, 3), in the world frame.

        A ray that hits nothing has distance -1, geom -1 and a zero normal.
        """
        self._qpos[0] = qpos
        distance, geom, normal = self._batch.ray(origin, directions, geomgroup=self._groups, normal=True)
        return distance[0], geom[0], normal[0]


def rotation_from_quaternion(wxyz: Array) -> Array:
    """Rotation matrix (3, 3) of a MuJoCo quaternion (w, x, y, z)."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, wxyz)
    return matrix.reshape(3, 3)
