"""What terms read from the scene, with its type."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

if TYPE_CHECKING:
    from robotbrain.rl.envs import ManagerBasedRLEnv
    from robotbrain.rl.managers import SceneEntityCfg
    from robotbrain.rl.scene import Articulation, ArticulationData, ContactSensor


def robot(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg) -> Articulation:
    """The articulation that the term is about."""
    found: Articulation = env.scene[asset_cfg.name]
    return found


def state(env: ManagerBasedRLEnv, asset_cfg: SceneEntityCfg) -> ArticulationData:
    """Its data."""
    found: ArticulationData = env.scene[asset_cfg.name].data
    return found


def contacts(env: ManagerBasedRLEnv, sensor_cfg: SceneEntityCfg) -> ContactSensor:
    """The contact sensor that the term is about."""
    found: ContactSensor = env.scene.sensors[sensor_cfg.name]
    return found


def squares(vectors: torch.Tensor) -> torch.Tensor:
    """Sum of squares over two columns, (num_envs,)."""
    # In numpy (the same memory): on arrays this small its calls cost a third of torch's.
    found = np.square(vectors.numpy())
    return torch.from_numpy(found[:, 0] + found[:, 1])


def length(vectors: torch.Tensor) -> torch.Tensor:
    """Euclidean norm over the last dimension."""
    found: torch.Tensor = torch.linalg.vector_norm(vectors, dim=-1)
    return found


def largest_contact(env: ManagerBasedRLEnv, sensor_cfg: SceneEntityCfg) -> torch.Tensor:
    """Largest contact force over the sensor's history for each chosen body [N], (num_envs, B)."""
    return contacts(env, sensor_cfg).data.force_magnitude.columns(sensor_cfg.body_ids)
