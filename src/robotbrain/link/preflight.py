"""Before the wheels turn: is everything there that the brain needs, of the right type, often enough, and now?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from robotbrain.link.description import Sensor
from robotbrain.ros.conversions import msg_class, time_to_ns

MOST_AGE_S = 1.0
"""A reading may be this old when it arrives, s; older ones, or ones from the future, mean that clocks differ."""

FUTURE_S = 0.1
JOINTS = ("left_wheel_joint", "right_wheel_joint")


@dataclass
class Sight:
    """What was seen of one topic: messages, their arrivals (ns), frames, stamps against arrival (s), joint names."""

    messages: int = 0
    first_ns: int = 0
    last_ns: int = 0
    frame: str = ""
    youngest_s: float = float("inf")
    joints: tuple[str, ...] = ()

    @property
    def hz(self) -> float:
        """Messages per second between the first and the last; 0 with less than two."""
        span = self.last_ns - self.first_ns
        return (self.messages - 1) * 1e9 / span if span > 0 else 0.0


class Preflight:
    """Listens to all sensors at once, through a node of its own.

    Args:
        sensors: what the brain needs.
    """

    def __init__(self, sensors: Sequence[Sensor]) -> None:
        from rclpy.node import Node
        from rclpy.qos import qos_profile_sensor_data

        self.sensors = tuple(sensors)
        self.sights = {sensor.topic: Sight() for sensor in sensors}
        self.node: Any = Node("preflight")
        for sensor in sensors:
            # Best effort gets along with every publisher.
            self.node.create_subscription(
                msg_class(sensor.type_name), sensor.topic, self._listener(sensor.topic), qos_profile_sensor_data
            )

    def _listener(self, topic: str) -> Any:
        def listen(msg: Any) -> None:
            now = int(self.node.get_clock().now().nanoseconds)
            sight = self.sights[topic]
            sight.first_ns = sight.first_ns if sight.messages else now
            sight.last_ns = now
            sight.messages += 1
            sight.frame = msg.header.frame_id
            sight.youngest_s = min(sight.youngest_s, (now - time_to_ns(msg.header.stamp)) * 1e-9, key=abs)
            if hasattr(msg, "position"):
                sight.joints = tuple(msg.name)

        return listen

    def restart(self) -> None:
        """Forget what was seen, so that rates do not count the time before a topic began."""
        for sight in self.sights.values():
            sight.messages = 0

    def name(self, sensor: Sensor) -> str:
        """Return the absolute, remapped name of a sensor's topic."""
        return str(self.node.resolve_topic_name(sensor.topic))

    def missing(self) -> list[Sensor]:
        """Return the sensors of which nothing has come."""
        return [sensor for sensor in self.sensors if not self.sights[sensor.topic].messages]

    def waiting_for(self, offered: Mapping[str, Sequence[str]]) -> str:
        """Return what is missing, in words; ``offered`` are the types of the topics on the robot's side."""
        words = []
        for sensor in self.missing():
            name, types = self.name(sensor), offered.get(self.name(sensor), ())
            if types and sensor.type_name not in types:
                words.append(f"{name} as {sensor.type_name} (the robot has it as {', '.join(types)})")
            elif types:
                words.append(f"{name} (announced, but silent)")
            else:
                words.append(f"{name} ({sensor.type_name})")
        return ", ".join(words)

    def problems(self) -> list[str]:
        """Return what speaks against driving, one sentence each."""
        heard = self.node.count_subscribers(str(self.node.resolve_topic_name("cmd_vel"))) > 0
        found = problems(self.sensors, self.sights, heard)
        for sensor in self.sensors:
            count = self.node.count_publishers(self.name(sensor))
            if count > 1:
                found.append(f"{count} publishers of {self.name(sensor)}: is there a second robot?")
        return found


def problems(sensors: Sequence[Sensor], sights: Mapping[str, Sight], commands_heard: bool) -> list[str]:
    """Return what speaks against driving, one sentence each; ``commands_heard``: somebody subscribes to cmd_vel."""
    found = []
    for sensor in sensors:
        sight = sights[sensor.topic]
        if sight.hz < sensor.least_hz:
            found.append(f"{sensor.topic} comes {sight.hz:.1f} times a second; the brain needs {sensor.least_hz:g}")
        if sensor.frame and sight.messages and sight.frame != sensor.frame:
            found.append(
                f"{sensor.topic} is in frame {sight.frame!r}; the description of the robot says {sensor.frame!r}"
            )
        if sight.messages and not -FUTURE_S <= sight.youngest_s <= MOST_AGE_S:
            found.append(
                f"{sensor.topic} is stamped {sight.youngest_s:.1f} s before it arrives: the clocks of brain and robot "
                "differ (set them by NTP, or follow the robot's with --use-sim-time where it publishes /clock)"
            )
        if sensor.topic == "joint_states" and sight.messages and not set(JOINTS) <= set(sight.joints):
            found.append(f"joint_states names {list(sight.joints)}; the brain needs {', '.join(JOINTS)}")
    if not commands_heard:
        found.append("nobody subscribes to cmd_vel: the robot would not obey")
    return found
