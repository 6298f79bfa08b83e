"""Seeded worlds, a simulated differential-drive robot and its sensors, without OpenGL.

``generate_world`` makes a world, ``RobotSim`` puts the robot into it, ``RayCamera`` is the camera alone. The
names are loaded when first used, so that importing the package stays cheap.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from robotbrain.lazy import lazy

if TYPE_CHECKING:
    from robotbrain.sim.camera import CameraExtrinsics, CameraImage, CameraIntrinsics, RayCamera
    from robotbrain.sim.dataset import LabelledImages, render_dataset
    from robotbrain.sim.generate import direct_line_blocked, generate_world, route_exists
    from robotbrain.sim.geometry import Point2D, Pose2D, to_child, to_parent
    from robotbrain.sim.lidar import LidarSpec, RayLidar
    from robotbrain.sim.readings import CameraReading, ImuReading, LidarReading, WheelReading
    from robotbrain.sim.robot import IDEAL_SENSORS, RobotParams, SensorParams
    from robotbrain.sim.scene import Scene, SegmentationClass, build_scene
    from robotbrain.sim.simulation import Collision, RobotSim, Truth, Twist2D, UnstableError
    from robotbrain.sim.surrogate import SURROGATE_RANGES, surrogate_robot
    from robotbrain.sim.view import Replay, SceneView, describe, plot_topdown
    from robotbrain.sim.world import Look, Obstacle, World, WorldSpec

__all__ = [
    "IDEAL_SENSORS",
    "SURROGATE_RANGES",
    "CameraExtrinsics",
    "CameraImage",
    "CameraIntrinsics",
    "CameraReading",
    "Collision",
    "ImuReading",
    "LabelledImages",
    "LidarReading",
    "LidarSpec",
    "Look",
    "Obstacle",
    "Point2D",
    "Pose2D",
    "RayCamera",
    "RayLidar",
    "Replay",
    "RobotParams",
    "RobotSim",
    "Scene",
    "SceneView",
    "SegmentationClass",
    "SensorParams",
    "Truth",
    "Twist2D",
    "UnstableError",
    "WheelReading",
    "World",
    "WorldSpec",
    "build_scene",
    "describe",
    "direct_line_blocked",
    "generate_world",
    "plot_topdown",
    "render_dataset",
    "route_exists",
    "surrogate_robot",
    "to_child",
    "to_parent",
]

_HOME = {
    "camera": ("CameraExtrinsics", "CameraImage", "CameraIntrinsics", "RayCamera"),
    "dataset": ("LabelledImages", "render_dataset"),
    "generate": ("direct_line_blocked", "generate_world", "route_exists"),
    "geometry": ("Point2D", "Pose2D", "to_child", "to_parent"),
    "lidar": ("LidarSpec", "RayLidar"),
    "readings": ("CameraReading", "ImuReading", "LidarReading", "WheelReading"),
    "robot": ("IDEAL_SENSORS", "RobotParams", "SensorParams"),
    "scene": ("Scene", "SegmentationClass", "build_scene"),
    "simulation": ("Collision", "RobotSim", "Truth", "Twist2D", "UnstableError"),
    "surrogate": ("SURROGATE_RANGES", "surrogate_robot"),
    "view": ("Replay", "SceneView", "describe", "plot_topdown"),
    "world": ("Look", "Obstacle", "World", "WorldSpec"),
}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}
__getattr__, __dir__ = lazy(__name__, _MODULE_OF, globals())
