"""The simulated scene of a task: batched MuJoCo worlds, robots and sensors.

Configurations are cheap to import; the rest brings in MuJoCo and torch when it is first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from robotbrain.lazy import lazy
from robotbrain.rl.scene.scene_cfg import (
    ArticulationCfg,
    ContactSensorCfg,
    InitialStateCfg,
    InteractiveSceneCfg,
    LidarCfg,
    SimulationCfg,
)

if TYPE_CHECKING:
    from robotbrain.rl.scene.articulation import Articulation
    from robotbrain.rl.scene.articulation_data import ArticulationData
    from robotbrain.rl.scene.contact_sensor import ContactSensor
    from robotbrain.rl.scene.interactive_scene import InteractiveScene
    from robotbrain.rl.scene.lidar import Lidar
    from robotbrain.rl.scene.world import TensorView, World

__all__ = [
    "Articulation",
    "ArticulationCfg",
    "ArticulationData",
    "ContactSensor",
    "ContactSensorCfg",
    "InitialStateCfg",
    "InteractiveScene",
    "InteractiveSceneCfg",
    "Lidar",
    "LidarCfg",
    "SimulationCfg",
    "TensorView",
    "World",
]

_MODULE_OF = {
    "Articulation": "articulation",
    "ArticulationData": "articulation_data",
    "ContactSensor": "contact_sensor",
    "InteractiveScene": "interactive_scene",
    "Lidar": "lidar",
    "TensorView": "world",
    "World": "world",
}
__getattr__, __dir__ = lazy(__name__, _MODULE_OF, globals())
