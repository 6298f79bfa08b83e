"""A raw subscription gets the bytes, which decode to the message and can be published as they are."""

from conformance import attempt, await_match, executor_of, log, ros, spin_until
from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import Path
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import Image, LaserScan
from std_msgs.msg import Empty, String


def examples():
    twist = Twist()
    twist.linear.x, twist.angular.z = 0.25, -1.5
    scan = LaserScan(range_min=0.1, range_max=8.0, ranges=[1.0, 2.5, float("inf")], intensities=[])
    scan.header.frame_id = "lidar_link"
    scan.header.stamp.sec, scan.header.stamp.nanosec = 12, 345
    path = Path()
    for step in range(3):
        pose = PoseStamped()
        pose.header.frame_id = "map"
        pose.pose.position.x = 0.5 * step
        path.poses.append(pose)
    image = Image(height=2, width=3, encoding="rgb8", step=9, data=bytes(range(18)))
    return {
        "twist": twist,
        "scan": scan,
        "path": path,
        "image": image,
        "text": String(data="häß"),
        "nothing": Empty(),
    }


def main() -> None:
    node = Node("node")
    executor = executor_of(node)
    for name, message in examples().items():
        seen = []
        publisher = node.create_publisher(type(message), name, 5)
        subscription = node.create_subscription(type(message), name, seen.append, 5, raw=True)
        await_match(executor, (publisher, 1))
        publisher.publish(message)
        assert spin_until(executor, lambda seen=seen: seen)
        data = seen[0]
        log(
            name,
            kind=type(data),
            header=data[:4],
            decodes_to_equal=deserialize_message(data, type(message)) == message,
            raw=subscription.raw,
        )
        # Sent on as they are, the bytes arrive unchanged.
        publisher.publish(data)
        assert spin_until(executor, lambda seen=seen: len(seen) == 2)
        log(f"{name} sent on", unchanged=seen[1] == data)
    attempt("too short", lambda: deserialize_message(b"\x00\x01\x00\x00", Twist))


if __name__ == "__main__":
    with ros():
        main()
