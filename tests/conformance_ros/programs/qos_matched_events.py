"""Matched events: each side is told when the other comes and goes."""

from conformance import executor_of, log, ros, spin_until
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from std_msgs.msg import Int32


def counts(info) -> list[int]:
    return [info.total_count, info.total_count_change, info.current_count, info.current_count_change]


def main() -> None:
    sender, receiver = Node("sender"), Node("receiver")
    executor = executor_of(sender, receiver)
    at_publisher, at_subscription = [], []
    publisher = sender.create_publisher(
        Int32, "numbers", 5, event_callbacks=PublisherEventCallbacks(matched=lambda i: at_publisher.append(counts(i)))
    )
    subscription = receiver.create_subscription(
        Int32,
        "numbers",
        lambda message: None,
        5,
        event_callbacks=SubscriptionEventCallbacks(matched=lambda i: at_subscription.append(counts(i))),
    )
    assert spin_until(executor, lambda: at_publisher and at_subscription)
    log("first", publisher=at_publisher, subscription=at_subscription)
    other = receiver.create_subscription(Int32, "numbers", lambda message: None, 5)
    assert spin_until(executor, lambda: len(at_publisher) == 2)
    log("second", publisher=at_publisher, subscription=at_subscription)
    receiver.destroy_subscription(other)
    assert spin_until(executor, lambda: len(at_publisher) == 3)
    log("one left", publisher=at_publisher, subscription=at_subscription)
    sender.destroy_publisher(publisher)
    assert spin_until(executor, lambda: len(at_subscription) == 2)
    log("none left", subscription=at_subscription, publishers=subscription.get_publisher_count())


if __name__ == "__main__":
    with ros():
        main()
