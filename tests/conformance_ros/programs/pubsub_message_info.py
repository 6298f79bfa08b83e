"""A subscription callback with two arguments is told about the message, too."""

from conformance import await_match, executor_of, log, ros, spin_until
from rclpy.node import Node
from std_msgs.msg import Int32


def main() -> None:
    node = Node("node")
    executor = executor_of(node)
    infos = []
    publisher = node.create_publisher(Int32, "numbers", 10)
    node.create_subscription(Int32, "numbers", lambda message, info: infos.append((message.data, info)), 10)
    await_match(executor, (publisher, 1))
    for number in range(3):
        publisher.publish(Int32(data=number))
        assert spin_until(executor, lambda number=number: len(infos) == number + 1)
    log("data", values=[data for data, _ in infos])
    log("keys", keys=sorted(infos[0][1]))
    stamps = [info["source_timestamp"] for _, info in infos]
    log("stamps", increasing=stamps == sorted(stamps), kind=type(stamps[0]))
    log(
        "sequence",
        steps=[
            infos[i + 1][1]["publication_sequence_number"] - infos[i][1]["publication_sequence_number"]
            for i in range(2)
        ],
    )


if __name__ == "__main__":
    with ros():
        main()
