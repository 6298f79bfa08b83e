"""Stamps and periods in whole ns: publish a message for a time, read the time of one, make a timer of a period."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from robotbrain.pipeline.patterns.stages import NS_PER_S
from robotbrain.ros.conversions import msg_class
from robotbrain.ros.node import Node


def timer_period(period_ns: int) -> float:
    """Return a period as the seconds that ``create_timer`` makes the same ns of, whether it rounds or cuts off."""
    return (period_ns + 0.25) / NS_PER_S


def stamp_ns(message: Any) -> int:
    """Return the header stamp of a message, ns."""
    return int(message.header.stamp.sec) * NS_PER_S + int(message.header.stamp.nanosec)


def stamped_publisher(node: Node, type_name: str, topic: str, qos: Any) -> Callable[[int], None]:
    """Return a function that publishes an empty message with a stamp, given in ns.

    Args:
        node: that publishes.
        type_name: of a message with a header, e.g. ``sensor_msgs/msg/Image``.
        topic, qos: as for ``create_publisher``.
    """
    cls = msg_class(type_name)
    publisher = node.create_publisher(cls, topic, qos)

    def publish(stamp: int) -> None:
        message = cls()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, NS_PER_S)
        publisher.publish(message)

    return publish
