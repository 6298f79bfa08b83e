"""The robots of the reinforcement-learning tasks as MJCF documents of our own primitive geometry.

Each module is a typed description and one function that returns MJCF text; nothing here loads MuJoCo. Angles are in
rad, z points up, and a robot's ``qpos0`` is its default pose.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from robotbrain.rl.robots.arm import arm_mjcf
    from robotbrain.rl.robots.base import base_mjcf
    from robotbrain.rl.robots.quadruped import quadruped_mjcf

__all__ = ["arm_mjcf", "base_mjcf", "quadruped_mjcf"]

_MODULE_OF = {"arm_mjcf": "arm", "base_mjcf": "base", "quadruped_mjcf": "quadruped"}


def __getattr__(name: str) -> Any:
    if name in _MODULE_OF:
        return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*globals(), *__all__]
