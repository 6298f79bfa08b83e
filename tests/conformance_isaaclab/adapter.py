"""The kit's environment as genuine terms and managers want to find it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import torch

from robotbrain.rl.envs import ManagerBasedRLEnv


class _Ids(list):
    """Joint indices, with the tensor that ``as_proxy=True`` asks for."""

    @property
    def torch(self) -> torch.Tensor:
        return torch.tensor(list(self), dtype=torch.long)


class AdaptedActuators:
    """The kit's servos as one group of implicit actuators, as Isaac Lab's collection has them."""

    def __init__(self, asset: Any) -> None:
        self._actuators = asset.actuators
        data = asset.data
        self._group = SimpleNamespace(
            is_implicit_model=True,
            joint_indices=slice(None),
            stiffness=data.joint_stiffness.torch.clone(),
            damping=data.joint_damping.torch.clone(),
        )

    def __getattr__(self, name: str) -> Any:
        return getattr(self._actuators, name)

    def items(self) -> list[tuple[str, Any]]:
        return [("servos", self._group)]


class AdaptedAsset:
    """The kit's articulation; ``find_joints`` takes ``as_proxy``, and the targets that were set are kept."""

    def __init__(self, asset: Any) -> None:
        self._asset = asset
        self.actuators = AdaptedActuators(asset)
        self.targets: dict[str, torch.Tensor] = {}

    def __getattr__(self, name: str) -> Any:
        return getattr(self._asset, name)

    def find_joints(self, names: Any, preserve_order: bool = False, as_proxy: bool = False) -> tuple[Any, list[str]]:
        ids, found = self._asset.find_joints(names, preserve_order=preserve_order)
        return (_Ids(ids) if as_proxy else ids), found

    def set_joint_position_target_index(
        self, *, target: torch.Tensor, joint_ids: Any = None, env_ids: Any = None
    ) -> None:
        self.targets["position"] = target.clone()

    def set_joint_velocity_target_index(
        self, *, target: torch.Tensor, joint_ids: Any = None, env_ids: Any = None
    ) -> None:
        self.targets["velocity"] = target.clone()

    def set_joint_effort_target_index(
        self, *, target: torch.Tensor, joint_ids: Any = None, env_ids: Any = None
    ) -> None:
        self.targets["effort"] = target.clone()


class AdaptedScene:
    """The kit's scene with adapted articulations; what the kit has not is empty."""

    def __init__(self, scene: Any) -> None:
        self._scene = scene
        self.rigid_objects: dict[str, Any] = {}
        self.cable_objects: dict[str, Any] = {}
        self.deformable_objects: dict[str, Any] = {}
        self.articulations = {name: AdaptedAsset(asset) for name, asset in scene.articulations.items()}

    def __getattr__(self, name: str) -> Any:
        return getattr(self._scene, name)

    def __getitem__(self, name: str) -> Any:
        return self.articulations.get(name) or self._scene[name]


class AdaptedEnv:
    """The kit's environment; the simulation's interface (markers, timeline) is a stub."""

    def __init__(self, env: ManagerBasedRLEnv) -> None:
        self._env = env
        self.sim = MagicMock()
        self.scene = AdaptedScene(env.scene)
        self.extras: dict[str, Any] = {}

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)
