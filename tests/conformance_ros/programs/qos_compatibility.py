"""Every pair of reliabilities, durabilities, deadlines and liveliness: who hears whom, and which events tell."""

from itertools import product

from conformance import executor_of, log, ros, spin_for, spin_until
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    LivelinessPolicy,
    QoSPolicyKind,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
    qos_policy_name_from_kind,
)
from std_msgs.msg import Int32


def run(name: str, offered: QoSProfile, requested: QoSProfile) -> None:
    """One publisher and one subscription with events for everything about their match."""
    sender, receiver = Node(f"sender_{name}"), Node(f"receiver_{name}")
    executor = executor_of(sender, receiver)
    seen, events = [], []

    def note(side: str):
        def callback(info) -> None:
            kind = QoSPolicyKind(info.last_policy_kind)
            events.append([side, kind.name, qos_policy_name_from_kind(kind), info.total_count, info.total_count_change])

        return callback

    publisher = sender.create_publisher(
        Int32, name, offered, event_callbacks=PublisherEventCallbacks(incompatible_qos=note("offered"))
    )
    receiver.create_subscription(
        Int32,
        name,
        lambda message: seen.append(message.data),
        requested,
        event_callbacks=SubscriptionEventCallbacks(incompatible_qos=note("requested")),
    )
    compatibility, reason = qos_check_compatible(offered, requested)
    spin_until(executor, lambda: publisher.get_subscription_count() == 1 or len(events) == 2)
    publisher.publish(Int32(data=7))
    if publisher.get_subscription_count():
        spin_until(executor, lambda: seen)
    else:
        spin_for(executor, 0.1)
    log(
        name,
        check=compatibility,
        has_reason=bool(reason),
        matched=publisher.get_subscription_count(),
        seen=seen,
        events=sorted(events),
    )
    for node in (sender, receiver):
        executor.remove_node(node)
        node.destroy_node()


def main() -> None:
    for offered, requested in product((ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT), repeat=2):
        run(
            f"{offered.name}_to_{requested.name}".lower(),
            QoSProfile(depth=5, reliability=offered),
            QoSProfile(depth=5, reliability=requested),
        )
    for offered, requested in product((DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE), repeat=2):
        run(
            f"{offered.name}_to_{requested.name}".lower(),
            QoSProfile(depth=5, durability=offered),
            QoSProfile(depth=5, durability=requested),
        )
    for offered, requested in ((1.0, 2.0), (2.0, 1.0), (None, 1.0), (1.0, None)):
        run(
            f"deadline_{offered}_to_{requested}".replace(".", "_").lower(),
            QoSProfile(depth=5, deadline=Duration(seconds=offered) if offered else Duration()),
            QoSProfile(depth=5, deadline=Duration(seconds=requested) if requested else Duration()),
        )
    automatic, manual = LivelinessPolicy.AUTOMATIC, LivelinessPolicy.MANUAL_BY_TOPIC
    for offered, requested in product((automatic, manual), repeat=2):
        run(
            f"liveliness_{offered.name}_to_{requested.name}".lower(),
            QoSProfile(depth=5, liveliness=offered, liveliness_lease_duration=Duration(seconds=5)),
            QoSProfile(depth=5, liveliness=requested, liveliness_lease_duration=Duration(seconds=5)),
        )


if __name__ == "__main__":
    with ros():
        main()
