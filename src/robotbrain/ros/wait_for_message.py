"""Waiting for one message (``rclpy.wait_for_message``)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from robotbrain.ros import cdr
from robotbrain.ros.qos import QoSProfile, as_profile
from robotbrain.ros.spinning import spin_while
from robotbrain.ros.topics import Packet, Subscription

if TYPE_CHECKING:
    from robotbrain.ros.node import Node


class _First(Subscription):
    """Keeps the first message that arrives; needs no executor."""

    packet: Packet | None = None

    def receive(self, packet: Packet) -> None:
        """Keep it."""
        self.packet = self.packet or packet


def wait_for_message(
    msg_type: Any,
    node: Node,
    topic: str,
    *,
    qos_profile: QoSProfile | int = 1,
    time_to_wait: float = -1,
) -> tuple[bool, Any]:
    """Let simulated time pass until a message arrives on a topic; outside callbacks only.

    Args:
        msg_type: message class.
        node: that subscribes meanwhile.
        topic: its name.
        qos_profile: of the subscription.
        time_to_wait: seconds; negative for no limit.

    Returns:
        ``(True, message)``, or ``(False, None)`` when the time was over or the context shut down.

    Raises:
        SimulationDeadlockError: no limit, and nothing can happen any more.
    """
    name = node.resolve_topic_name(topic)
    subscription = _First(node, msg_type, name, lambda _: None, as_profile(qos_profile))
    try:
        spin_while(node.context, lambda: subscription.packet is None, time_to_wait, "wait_for_message")
    finally:
        subscription.destroy()
    if subscription.packet is None:
        return False, None
    return True, cdr.from_cdr(subscription.packet.data, msg_type)
