"""A busy subscriber: what a queue of depth 3, of depth 1 and one that keeps all still hold afterwards."""

from conformance import await_match, executor_of, log, ros, settle, spin_for, spin_until, steady
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Int32


class Busy(Node):
    """Publishes ten numbers to itself within one callback, which then keeps the executor busy."""

    def __init__(self, name: str, profile: QoSProfile) -> None:
        super().__init__(name)
        self.seen: list[int] = []
        self.publisher = self.create_publisher(Int32, f"{name}_numbers", QoSProfile(depth=100))
        self.subscription = self.create_subscription(Int32, f"{name}_numbers", self.on_number, profile)

    def on_number(self, message: Int32) -> None:
        self.seen.append(message.data)
        if message.data == 0:
            for number in range(1, 11):
                self.publisher.publish(Int32(data=number))
            steady().sleep_for(Duration(seconds=0.3))


def run(name: str, profile: QoSProfile) -> None:
    node = Busy(name, profile)
    executor = executor_of(node)
    await_match(executor, (node.publisher, 1))
    node.publisher.publish(Int32(data=0))
    assert spin_until(executor, lambda: node.seen and node.seen[-1] == 10)
    spin_for(executor, 0.1)
    log(name, seen=node.seen)
    executor.remove_node(node)
    node.destroy_node()


def outside_of_callbacks() -> None:
    """Ten messages are published while nobody spins."""
    node = Node("outside")
    executor = executor_of(node)
    seen: list[int] = []
    publisher = node.create_publisher(Int32, "outside_numbers", 100)
    node.create_subscription(Int32, "outside_numbers", lambda message: seen.append(message.data), 3)
    await_match(executor, (publisher, 1))
    for number in range(10):
        publisher.publish(Int32(data=number))
    settle()
    assert spin_until(executor, lambda: seen and seen[-1] == 9)
    spin_for(executor, 0.1)
    log("outside", seen=seen)


def main() -> None:
    run("depth_3", QoSProfile(depth=3))
    run("depth_1", QoSProfile(depth=1))
    run("depth_20", QoSProfile(depth=20))
    run("keep_all", QoSProfile(history=HistoryPolicy.KEEP_ALL))
    run("best_effort_2", QoSProfile(depth=2, reliability=ReliabilityPolicy.BEST_EFFORT))
    outside_of_callbacks()


if __name__ == "__main__":
    with ros():
        main()
