"""A latched map: who comes late gets the last messages, if both sides are transient local."""

from conformance import await_match, executor_of, log, ros, spin_for, spin_until
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Int32


def latched(depth: int) -> QoSProfile:
    return QoSProfile(depth=depth, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.RELIABLE)


def main() -> None:
    server, client = Node("map_server"), Node("navigator")
    executor = executor_of(server, client)
    publisher = server.create_publisher(Int32, "map", latched(2))
    for number in range(5):
        publisher.publish(Int32(data=number))

    late: list[int] = []
    client.create_subscription(Int32, "map", lambda message: late.append(message.data), latched(10))
    assert spin_until(executor, lambda: len(late) >= 2)
    spin_for(executor, 0.1)
    log("late joiner", seen=late)

    one: list[int] = []
    client.create_subscription(Int32, "map", lambda message: one.append(message.data), latched(1))
    assert spin_until(executor, lambda: one)
    spin_for(executor, 0.1)
    log("late joiner of depth 1", last=one[-1])

    volatile: list[int] = []
    client.create_subscription(Int32, "map", lambda message: volatile.append(message.data), 10)
    await_match(executor, (publisher, 3))
    spin_for(executor, 0.2)
    log("volatile late joiner", seen=volatile)

    publisher.publish(Int32(data=99))
    assert spin_until(executor, lambda: late[-1] == one[-1] == 99 and volatile)
    log("afterwards", late=late, one=one[-1], volatile=volatile)

    server.destroy_publisher(publisher)
    after: list[int] = []
    subscription = client.create_subscription(Int32, "map", lambda message: after.append(message.data), latched(10))
    spin_for(executor, 0.2)
    log("after the publisher is gone", seen=after, publishers=subscription.get_publisher_count())


if __name__ == "__main__":
    with ros():
        main()
