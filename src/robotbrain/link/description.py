"""What the brain must know about the robot that it drives: geometry, frames, rates, topic names, limits."""

from __future__ import annotations

import dataclasses
import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

from robotbrain.errors import InputError


@dataclass(frozen=True, slots=True)
class Sensor:
    """A topic that the brain needs.

    Args:
        topic: its name, relative.
        type_name: e.g. ``sensor_msgs/msg/LaserScan``.
        frame: of its headers; empty where nobody looks at it.
        least_hz: the brain drives badly on less.
    """

    topic: str
    type_name: str
    frame: str
    least_hz: float


SENSORS = (
    Sensor("scan", "sensor_msgs/msg/LaserScan", "lidar_link", 5.0),
    Sensor("imu", "sensor_msgs/msg/Imu", "imu_link", 20.0),
    Sensor("joint_states", "sensor_msgs/msg/JointState", "", 20.0),
    Sensor("camera/image", "sensor_msgs/msg/Image", "camera_optical_frame", 3.0),
    Sensor("camera/depth", "sensor_msgs/msg/Image", "camera_optical_frame", 3.0),
    Sensor("camera/camera_info", "sensor_msgs/msg/CameraInfo", "camera_optical_frame", 3.0),
)
"""What the kit's brain listens to, as the kit's robot has it."""


@dataclass(frozen=True)
class RobotDescription:
    """A differential-drive robot as its data sheet describes it. The defaults are the kit's robot.

    Args:
        name: for people.
        wheel_radius, track: m.
        camera: x, y, z of the optical centre in base_link (m) and downward pitch (rad).
        sensors: topics that the brain needs.
        remap: other names of topics on the robot: ``{"scan": "/lidar/scan"}``.
        safety: fields of :class:`~robotbrain.pipeline.nodes.safety.SafetyLimits` that differ from its defaults.
    """

    name: str = "the kit's robot"
    wheel_radius: float = 0.06
    track: float = 0.30
    camera: tuple[float, float, float, float] = (0.10, 0.0, 0.26, 0.14)
    sensors: tuple[Sensor, ...] = SENSORS
    remap: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    safety: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))

    def ros_arguments(self) -> list[str]:
        """Return the remappings as arguments of ``rclpy.init``."""
        rules = [word for name, other in self.remap.items() for word in ("-r", f"{name}:={other}")]
        return ["--ros-args", *rules] if rules else []


_EXAMPLE = """\
name = "my robot"

[base]
wheel_radius = 0.033  # m
track = 0.287  # m

[camera]  # optical centre in base_link: m, and downward pitch in rad
x = 0.10
y = 0.0
z = 0.26
pitch = 0.14

[frames]
"scan" = "base_scan"

[least_hz]
"scan" = 4.0

[remap]
"camera/image" = "/oak/rgb/image_raw"

[safety]
max_speed = 0.22
"""
"""A description that names every table; ``robotbrain drive --help`` points at it."""


def example() -> str:
    """Return a description with every table, to start one's own from."""
    return _EXAMPLE


def load_description(path: str | Path) -> RobotDescription:
    """Return the robot described in a TOML file; see :func:`example`.

    Raises:
        InputError: the file is missing or no TOML, or has unknown or impossible entries.
    """
    path = Path(path)
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(
            "robot description",
            given=str(path),
            expected="a readable TOML file",
            fix=f"{error}. A full example:\n{_EXAMPLE}",
        ) from None
    return description_from(content)


def description_from(content: Mapping[str, Any]) -> RobotDescription:
    """Return the robot described by tables as those of :func:`example`.

    Raises:
        InputError: unknown or impossible entries.
    """
    default = RobotDescription()
    topics = {sensor.topic for sensor in default.sensors}
    tables = {
        "base": {"wheel_radius", "track"},
        "camera": {"x", "y", "z", "pitch"},
        "frames": topics,
        "least_hz": topics,
        "remap": topics | {"cmd_vel"},
        "safety": None,
    }
    for key, value in content.items():
        if key == "name":
            _check(key, value, str)
            continue
        _known(f"entry {key!r}", key, {"name", *tables})
        _check(key, value, dict)
        for name, entry in value.items():
            allowed = tables[key]
            if allowed is not None:
                _known(f"{key}.{name}", name, allowed)
            _check(f"{key}.{name}", entry, str if key in ("frames", "remap") else float)
    base, camera = content.get("base", {}), content.get("camera", {})
    frames, rates = content.get("frames", {}), content.get("least_hz", {})
    for name in ("wheel_radius", "track"):
        if not base.get(name, 1.0) > 0:
            raise InputError(f"base.{name}", given=base[name], expected="m, > 0", fix="Measure it.")
    return RobotDescription(
        name=content.get("name", default.name),
        wheel_radius=float(base.get("wheel_radius", default.wheel_radius)),
        track=float(base.get("track", default.track)),
        camera=(
            float(camera.get("x", default.camera[0])),
            float(camera.get("y", default.camera[1])),
            float(camera.get("z", default.camera[2])),
            float(camera.get("pitch", default.camera[3])),
        ),
        sensors=tuple(
            dataclasses.replace(s, frame=frames.get(s.topic, s.frame), least_hz=float(rates.get(s.topic, s.least_hz)))
            for s in default.sensors
        ),
        remap=MappingProxyType(dict(content.get("remap", {}))),
        safety=MappingProxyType({name: float(value) for name, value in content.get("safety", {}).items()}),
    )


def _known(what: str, name: str, allowed: set[str]) -> None:
    if name not in allowed:
        raise InputError(
            f"robot description: {what}",
            given=name,
            expected="one of " + ", ".join(sorted(allowed)),
            fix=f"A full example:\n{_EXAMPLE}",
        )


def _check(what: str, value: Any, kind: type) -> None:
    number = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    if not (number if kind is float else isinstance(value, kind)):
        word = {str: "a text", float: "a number", dict: "a table"}[kind]
        raise InputError(f"robot description: {what}", given=value, expected=word, fix=f"An example:\n{_EXAMPLE}")
