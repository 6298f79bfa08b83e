"""``/parameter_events`` and ``/rosout``: topics on which every node publishes, once somebody listens.

Nodes get their publishers when the first subscription is made. Without one nothing is sent, so a run that nobody
watches pays nothing for them and looks the same.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

from robotbrain.ros.messages import message_class
from robotbrain.ros.qos import qos_profile_parameter_events, qos_profile_rosout_default
from robotbrain.ros.time import NS_PER_S
from robotbrain.ros.topics import Publisher

if TYPE_CHECKING:
    from robotbrain.ros.logging import LogRecord
    from robotbrain.ros.node import Node

PARAMETER_EVENTS = "/parameter_events"
ROSOUT = "/rosout"
SYSTEM_TOPICS = {
    PARAMETER_EVENTS: ("rcl_interfaces/msg/ParameterEvent", qos_profile_parameter_events),
    ROSOUT: ("rcl_interfaces/msg/Log", qos_profile_rosout_default),
}
"""Topic -> type and QoS."""


def join_system_topics(node: Node) -> None:
    """Give a new node the publishers of the system topics that somebody listens to."""
    for topic in SYSTEM_TOPICS:
        if topic in node.context.topics:
            add_system_publisher(node, topic)


def add_system_publisher(node: Node, topic: str) -> None:
    """Give a node its publisher of a system topic, unless it has it or does without."""
    if topic in node._system_publishers or (topic == ROSOUT and not node._rosout):
        return
    type_name, qos = SYSTEM_TOPICS[topic]
    publisher = node._system_publishers[topic] = Publisher(node, message_class(type_name), topic, qos)
    if topic == ROSOUT:
        node.context.rosout[node.get_logger().name] = partial(_tell, publisher)


def leave_system_topics(node: Node) -> None:
    """Take a node's publishers of system topics away."""
    for publisher in node._system_publishers.values():
        publisher.destroy()
    node._system_publishers.clear()
    node.context.rosout.pop(node.get_logger().name, None)


def _tell(publisher: Publisher, record: LogRecord, frame: Any) -> None:
    if not publisher.matched:
        return
    seconds, nanoseconds = divmod(record.time_ns, NS_PER_S)
    publisher.publish(
        message_class("rcl_interfaces/msg/Log")(
            stamp=message_class("builtin_interfaces/msg/Time")(sec=seconds, nanosec=nanoseconds),
            level=int(record.severity),
            name=record.name,
            msg=record.message,
            file=frame.f_code.co_filename,
            function=frame.f_code.co_name,
            line=frame.f_lineno,
        )
    )
