"""Lifespan: what waited too long for a busy subscriber, or for a late one, is not delivered any more."""

from conformance import await_match, executor_of, log, ros, spin_for, spin_until, steady
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Int32


def busy(lifespan: float) -> list[int]:
    """The subscriber is busy for 0.6 s while messages wait; return what it then sees."""
    node = Node("node")
    executor = executor_of(node)
    seen: list[int] = []
    publisher = node.create_publisher(
        Int32, "fresh", QoSProfile(depth=20, lifespan=Duration(seconds=lifespan) if lifespan else Duration())
    )

    def on_number(message: Int32) -> None:
        seen.append(message.data)
        if message.data == 0:
            for number in (1, 2, 3):
                publisher.publish(Int32(data=number))
            steady().sleep_for(Duration(seconds=0.6))

    node.create_subscription(Int32, "fresh", on_number, 20)
    await_match(executor, (publisher, 1))
    publisher.publish(Int32(data=0))
    assert spin_until(executor, lambda: seen)
    spin_for(executor, 0.2)
    publisher.publish(Int32(data=4))
    assert spin_until(executor, lambda: seen[-1] == 4)
    node.destroy_node()
    return seen


def main() -> None:
    log("no lifespan", seen=busy(0.0))
    log("long lifespan", seen=busy(5.0))
    log("short lifespan", seen=busy(0.2))

    node = Node("latched")
    executor = executor_of(node)
    publisher = node.create_publisher(
        Int32,
        "latched",
        QoSProfile(depth=5, durability=DurabilityPolicy.TRANSIENT_LOCAL, lifespan=Duration(seconds=0.3)),
    )
    publisher.publish(Int32(data=1))
    spin_for(executor, 0.6)
    publisher.publish(Int32(data=2))
    seen: list[int] = []
    node.create_subscription(
        Int32,
        "latched",
        lambda message: seen.append(message.data),
        QoSProfile(depth=5, durability=DurabilityPolicy.TRANSIENT_LOCAL),
    )
    assert spin_until(executor, lambda: seen)
    spin_for(executor, 0.1)
    log("late joiner", seen=seen)


if __name__ == "__main__":
    with ros():
        main()
