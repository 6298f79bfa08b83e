"""``tf2_ros.transform_listener``: fills a buffer from ``/tf`` and ``/tf_static``."""

from __future__ import annotations

from typing import Any

from robotbrain.ros.callback_groups import ReentrantCallbackGroup
from robotbrain.ros.conversions import msg_class
from robotbrain.ros.qos import DurabilityPolicy, QoSProfile

__all__ = ["DEFAULT_STATIC_TF_TOPIC", "DEFAULT_TF_TOPIC", "TransformListener"]

DEFAULT_TF_TOPIC = "/tf"
DEFAULT_STATIC_TF_TOPIC = "/tf_static"


class TransformListener:
    """Puts what is broadcast into a buffer.

    Args:
        buffer: the buffer to fill.
        node: whose subscriptions it uses. Its executor runs them: while a callback of a single-threaded executor is
            busy, no transform arrives.
        spin_thread: accepted; simulated executors have no threads of their own.
        qos: of ``/tf``; depth 100 when omitted.
        static_qos: of ``/tf_static``; depth 100 and transient local when omitted.
        tf_topic: other name of ``/tf``.
        tf_static_topic: other name of ``/tf_static``.
    """

    def __init__(
        self,
        buffer: Any,
        node: Any,
        *,
        spin_thread: bool = False,
        qos: QoSProfile | int | None = None,
        static_qos: QoSProfile | int | None = None,
        tf_topic: str = DEFAULT_TF_TOPIC,
        tf_static_topic: str = DEFAULT_STATIC_TF_TOPIC,
    ) -> None:
        self.buffer, self.node = buffer, node
        self.group = ReentrantCallbackGroup()
        message = msg_class("tf2_msgs/msg/TFMessage")
        if qos is None:
            qos = QoSProfile(depth=100)
        if static_qos is None:
            static_qos = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.tf_sub = node.create_subscription(message, tf_topic, self.callback, qos, callback_group=self.group)
        self.tf_static_sub = node.create_subscription(
            message, tf_static_topic, self.static_callback, static_qos, callback_group=self.group
        )

    def callback(self, data: Any) -> None:
        """Take the transforms of a message on ``/tf``."""
        for transform in data.transforms:
            self.buffer.set_transform(transform, "default_authority")

    def static_callback(self, data: Any) -> None:
        """Take the transforms of a message on ``/tf_static``."""
        for transform in data.transforms:
            self.buffer.set_transform_static(transform, "default_authority")

    def unregister(self) -> None:
        """Stop listening."""
        self.node.destroy_subscription(self.tf_sub)
        self.node.destroy_subscription(self.tf_static_sub)
