"""Deadlines: both sides are told when messages stay away, and not while they come in time."""

from conformance import await_match, executor_of, log, ros, spin_for, spin_until
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_msgs.msg import Int32


def main() -> None:
    node = Node("node")
    executor = executor_of(node)
    profile = QoSProfile(depth=5, deadline=Duration(seconds=0.5))
    offered, requested, seen = [], [], []
    publisher = node.create_publisher(
        Int32, "beat", profile, event_callbacks=PublisherEventCallbacks(deadline=offered.append)
    )
    node.create_subscription(
        Int32,
        "beat",
        lambda message: seen.append(message.data),
        profile,
        event_callbacks=SubscriptionEventCallbacks(deadline=requested.append),
    )
    await_match(executor, (publisher, 1))
    log("before the first message", requested_total=sum(event.total_count_change for event in requested))

    for number in range(8):
        publisher.publish(Int32(data=number))
        spin_for(executor, 0.1)
    log("in time", seen=len(seen), offered=len(offered), requested=len(requested))

    assert spin_until(executor, lambda: offered and requested, 5.0)
    log(
        "missed",
        offered=[offered[0].total_count, offered[0].total_count_change],
        requested=[requested[0].total_count, requested[0].total_count_change],
    )
    assert spin_until(executor, lambda: offered[-1].total_count >= 3 and requested[-1].total_count >= 3, 5.0)
    changes = [sum(event.total_count_change for event in events) for events in (offered, requested)]
    log("go on", changes_add_up=changes == [offered[-1].total_count, requested[-1].total_count])

    publisher.publish(Int32(data=100))
    assert spin_until(executor, lambda: seen[-1] == 100)
    counts = len(offered), len(requested)
    for number in range(5):
        publisher.publish(Int32(data=number))
        spin_for(executor, 0.1)
    log("in time again", offered=len(offered) - counts[0], requested=len(requested) - counts[1])


if __name__ == "__main__":
    with ros():
        main()
