"""Liveliness: a publisher that must show that it is alive stops doing so, is lost, and comes back."""

from conformance import await_match, executor_of, log, ros, spin_for, spin_until
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import LivelinessPolicy, QoSProfile
from std_msgs.msg import Int32


def counts(info) -> list[int]:
    return [info.alive_count, info.not_alive_count, info.alive_count_change, info.not_alive_count_change]


def main() -> None:
    sender, receiver = Node("sender"), Node("receiver")
    executor = executor_of(sender, receiver)
    profile = QoSProfile(
        depth=5, liveliness=LivelinessPolicy.MANUAL_BY_TOPIC, liveliness_lease_duration=Duration(seconds=0.5)
    )
    lost, changes = [], []
    publisher = sender.create_publisher(
        Int32, "alive", profile, event_callbacks=PublisherEventCallbacks(liveliness=lost.append)
    )
    receiver.create_subscription(
        Int32,
        "alive",
        lambda message: None,
        profile,
        event_callbacks=SubscriptionEventCallbacks(liveliness=lambda info: changes.append(counts(info))),
    )
    await_match(executor, (publisher, 1))
    publisher.assert_liveliness()
    assert spin_until(executor, lambda: changes)
    log("asserted", changes=changes, lost=len(lost))
    for _ in range(8):
        publisher.assert_liveliness()
        spin_for(executor, 0.1)
    log("kept alive", changes=changes, lost=len(lost))
    assert spin_until(executor, lambda: len(changes) >= 2 and lost, 5.0)
    log("lost", changes=changes, lost=[[info.total_count, info.total_count_change] for info in lost])
    publisher.publish(Int32(data=1))
    assert spin_until(executor, lambda: len(changes) >= 3, 5.0)
    log("alive by publishing", changes=changes)
    sender.destroy_publisher(publisher)
    assert spin_until(executor, lambda: len(changes) >= 4, 5.0)
    log("destroyed", changes=changes)


if __name__ == "__main__":
    with ros():
        main()
