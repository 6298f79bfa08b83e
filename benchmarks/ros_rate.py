"""How fast the simulated-time core runs on this machine: timer events and messages per wall-clock second.

Run: ``python benchmarks/ros_rate.py``. One thread; a message is published by a timer callback, serialized to
CDR, carried by the event heap, deserialized and given to a subscription callback.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import numpy as np

from robotbrain.ros import SimContext
from robotbrain.ros.conversions import msg_class, numpy_to_image
from robotbrain.ros.node import Node

REPEATS = 5


def timer_rate(count: int) -> float:
    """Events per second of one timer whose callback does nothing."""
    context = SimContext()
    node = Node("ticker", context=context)
    node.create_timer(0.001, lambda: None)
    start = time.perf_counter()
    context.run_for(count * 0.001)
    return count / (time.perf_counter() - start)


def message_rate(typename: str, make: Callable[[], object], count: int) -> float:
    """Messages per second from publish to callback, CDR both ways; one message object is filled and reused."""
    context = SimContext()
    sender, receiver = Node("sender", context=context), Node("receiver", context=context)
    cls = msg_class(typename)
    publisher = sender.create_publisher(cls, "topic", 10)
    received = [0]

    def callback(message: object) -> None:
        received[0] += 1

    receiver.create_subscription(cls, "topic", callback, 10)
    message = make()
    sender.create_timer(0.001, lambda: publisher.publish(message))
    start = time.perf_counter()
    context.run_for(count * 0.001)
    elapsed = time.perf_counter() - start
    assert received[0] == count
    return count / elapsed


def make_scan() -> object:
    """A 120-ray scan."""
    scan = msg_class("sensor_msgs/msg/LaserScan")()
    scan.header.frame_id = "lidar_link"
    scan.ranges = np.linspace(0.1, 8.0, 120, dtype=np.float32)
    return scan


def make_twist() -> object:
    """A velocity command."""
    twist = msg_class("geometry_msgs/msg/Twist")()
    twist.linear.x = 0.5
    return twist


def main() -> None:
    """Print the table."""
    image = numpy_to_image(np.zeros((64, 64, 3), np.uint8), "rgb8", frame_id="camera_optical_frame")
    cases: list[tuple[str, str, Callable[[], float]]] = [
        ("timer events, no messages", "50,000", lambda: timer_rate(50_000)),
        ("Twist messages", "10,000", lambda: message_rate("geometry_msgs/msg/Twist", make_twist, 10_000)),
        ("LaserScan (120 rays) messages", "-", lambda: message_rate("sensor_msgs/msg/LaserScan", make_scan, 10_000)),
        ("Image 64x64 rgb8 messages", "-", lambda: message_rate("sensor_msgs/msg/Image", lambda: image, 10_000)),
    ]
    print(f"{'per second (median of ' + str(REPEATS) + ' runs)':<34}{'measured':>12}{'lowest':>12}{'target':>12}")
    for label, target, run in cases:
        run()
        rates = [run() for _ in range(REPEATS)]
        print(f"{label:<34}{statistics.median(rates):>12,.0f}{min(rates):>12,.0f}{target:>12}")


if __name__ == "__main__":
    main()
