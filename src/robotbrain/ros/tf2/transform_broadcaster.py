"""``tf2_ros.transform_broadcaster``: publishes moving frames on ``/tf``."""

from __future__ import annotations

from typing import Any

from robotbrain.ros.conversions import msg_class
from robotbrain.ros.qos import QoSProfile

__all__ = ["TransformBroadcaster"]


class TransformBroadcaster:
    """Sends transforms on ``/tf``.

    Args:
        node: the publishing node.
        qos: profile or depth; depth 100 when omitted.
    """

    def __init__(self, node: Any, qos: QoSProfile | int | None = None) -> None:
        self._message = msg_class("tf2_msgs/msg/TFMessage")
        self.pub_tf = node.create_publisher(self._message, "/tf", QoSProfile(depth=100) if qos is None else qos)

    def sendTransform(self, transform: Any) -> None:  # noqa: N802 - tf2's name
        """Send a ``TransformStamped``, or several in one message."""
        self.pub_tf.publish(self._message(transforms=as_list(transform)))


def as_list(transform: Any) -> list[Any]:
    """Return one transform or an iterable of them as a list."""
    return list(transform) if hasattr(transform, "__iter__") else [transform]
