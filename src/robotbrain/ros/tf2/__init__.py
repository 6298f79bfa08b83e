"""Coordinate frames over time: ``tf2_ros``, ``tf2_py``, ``tf2_geometry_msgs`` and ``tf2_sensor_msgs`` of the kit.

A program imports them by those names (see :mod:`robotbrain.ros.shim`), so that it runs on genuine ROS 2 unchanged.
This package itself imports nothing: the modules load when they are asked for.
"""

from __future__ import annotations

TF2_MODULES: dict[str, str] = {
    "tf2_geometry_msgs": "tf2.geometry",
    "tf2_geometry_msgs.tf2_geometry_msgs": "tf2.geometry",
    "tf2_py": "tf2.core",
    "tf2_ros": "tf2.ros",
    "tf2_ros.buffer": "tf2.buffer",
    "tf2_ros.buffer_interface": "tf2.buffer_interface",
    "tf2_ros.static_transform_broadcaster": "tf2.static_transform_broadcaster",
    "tf2_ros.transform_broadcaster": "tf2.transform_broadcaster",
    "tf2_ros.transform_listener": "tf2.transform_listener",
    "tf2_sensor_msgs": "tf2.sensor",
    "tf2_sensor_msgs.tf2_sensor_msgs": "tf2.sensor",
}
"""Module of genuine tf2 -> module of ``robotbrain.ros`` whose public names it shows."""

__all__ = ["TF2_MODULES"]
