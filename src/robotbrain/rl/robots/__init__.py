"""The robots of the reinforcement-learning tasks as MJCF documents of our own primitive geometry.

Each module is a typed description and one function that returns MJCF text; nothing here loads MuJoCo. Angles are in
rad, z points up, and a robot's ``qpos0`` is its default pose.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from robotbrain.lazy import lazy

if TYPE_CHECKING:
    from robotbrain.rl.robots.arm import arm_mjcf
    from robotbrain.rl.robots.base import base_mjcf
    from robotbrain.rl.robots.quadruped import quadruped_mjcf

__all__ = ["arm_mjcf", "base_mjcf", "quadruped_mjcf"]

_MODULE_OF = {"arm_mjcf": "arm", "base_mjcf": "base", "quadruped_mjcf": "quadruped"}
__getattr__, __dir__ = lazy(__name__, _MODULE_OF, globals())
