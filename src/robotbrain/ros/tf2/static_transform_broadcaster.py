"""``tf2_ros.static_transform_broadcaster``: publishes frames that do not move on ``/tf_static``."""

from __future__ import annotations

from typing import Any

from robotbrain.ros.conversions import msg_class
from robotbrain.ros.qos import DurabilityPolicy, QoSProfile
from robotbrain.ros.tf2.transform_broadcaster import as_list

__all__ = ["StaticTransformBroadcaster"]


class StaticTransformBroadcaster:
    """Sends transforms on ``/tf_static``; a subscriber that comes later gets them too.

    Every message holds all transforms sent so far. As in genuine tf2_ros for Python, the first transform of a child
    frame stays: sending another one for the same frame changes nothing (a warning says so).

    Args:
        node: the publishing node. One broadcaster per node: a second one of the same node does not know the first.
        qos: profile or depth; depth 1 and transient local when omitted.
    """

    def __init__(self, node: Any, qos: QoSProfile | int | None = None) -> None:
        message = msg_class("tf2_msgs/msg/TFMessage")
        if qos is None:
            qos = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.pub_tf = node.create_publisher(message, "/tf_static", qos)
        self.net_message = message()
        self._node = node

    def sendTransform(self, transform: Any) -> None:  # noqa: N802 - tf2's name
        """Add a ``TransformStamped``, or several, and send all."""
        known = {sent.child_frame_id: sent for sent in self.net_message.transforms}
        for one in as_list(transform):
            earlier = known.setdefault(one.child_frame_id, one)
            if earlier is one:
                self.net_message.transforms.append(one)
            elif earlier.transform != one.transform or earlier.header.frame_id != one.header.frame_id:
                self._node.get_logger().warning(
                    f"static frame {one.child_frame_id} was sent before and keeps its first transform; "
                    "a frame that moves belongs to a TransformBroadcaster"
                )
        self.pub_tf.publish(self.net_message)
