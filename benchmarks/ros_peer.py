"""The kit beside genuine rclpy: from publish to callback in one process, CDR included; and events per second.

Run with ``python benchmarks/ros_peer.py`` on Linux x86-64. Genuine rclpy is installed from PyPI into an environment of
its own (``build/conformance``, see ``tests/conformance_ros``). The same program runs on both: a publisher and a
subscription of one node, one message under way at a time, or fifty. The two take turns in one run; medians are printed.
The kit's own rates with and without messages come from ``ros_rate.py``.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
CASES = {
    ("Twist", 1): 1000,
    ("Twist", 50): 2000,
    ("LaserScan, 360 rays", 1): 600,
    ("LaserScan, 360 rays", 50): 1000,
    ("Image, 640x480 rgb8", 1): 100,
    ("Image, 640x480 rgb8", 50): 100,
}
"""(message, how many are under way at once) -> messages per turn."""


# ------------------------------------------------------------ the program, on either rclpy


def make(kind: str) -> Any:
    """Return a filled message."""
    from geometry_msgs.msg import Twist
    from sensor_msgs.msg import Image, LaserScan

    if kind.startswith("Twist"):
        twist = Twist()
        twist.linear.x = 0.5
        return twist
    if kind.startswith("LaserScan"):
        scan = LaserScan(range_max=8.0, ranges=[0.01 * step for step in range(360)])
        scan.header.frame_id = "lidar_link"
        return scan
    image = Image(height=480, width=640, step=1920, encoding="rgb8", data=bytes(640 * 480 * 3))
    image.header.frame_id = "camera_optical_frame"
    return image


def measure(kind: str, burst: int, count: int) -> float:
    """Return microseconds per message from publish to callback."""
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.node import Node
    from rclpy.qos import QoSProfile

    node, executor = Node("peer"), SingleThreadedExecutor()
    executor.add_node(node)
    message = make(kind)
    received = [0]

    def callback(_: Any) -> None:
        received[0] += 1

    publisher = node.create_publisher(type(message), "topic", QoSProfile(depth=burst))
    node.create_subscription(type(message), "topic", callback, QoSProfile(depth=burst))
    while publisher.get_subscription_count() == 0:
        executor.spin_once(timeout_sec=0.01)

    def turn(rounds: int) -> float:
        received[0] = 0
        start = time.perf_counter()
        for number in range(rounds):
            for _ in range(burst):
                publisher.publish(message)
            while received[0] < (number + 1) * burst:
                executor.spin_once(timeout_sec=1.0)
        return time.perf_counter() - start

    turn(1 + 20 // burst)
    rounds = max(1, count // burst)
    seconds = turn(rounds)
    executor.shutdown()
    node.destroy_node()
    return seconds / (rounds * burst) * 1e6


def worker() -> None:
    """Answer requests on standard input, one JSON line each, until it ends."""
    import rclpy

    rclpy.init()
    for line in sys.stdin:
        print(json.dumps(measure(*json.loads(line))), flush=True)
    rclpy.shutdown()


# ------------------------------------------------------------ the comparison


class Peer:
    """A process that measures on one rclpy."""

    def __init__(self, backend: Any, domain: int) -> None:
        self.name = backend.name
        self._process = subprocess.Popen(
            backend.command(Path(__file__), "--worker"),
            env=backend.environment(domain),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def measure(self, kind: str, burst: int, count: int) -> float:
        """Return microseconds per message of one turn."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps([kind, burst, count]) + "\n")
        self._process.stdin.flush()
        return float(json.loads(self._process.stdout.readline()))

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(timeout=30)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--distro", default="kilted", choices=["kilted", "jazzy"])
    parser.add_argument("--turns", type=int, default=7, help="turns of each, at least 5")
    arguments = parser.parse_args()
    if arguments.worker:
        worker()
        return
    sys.path.insert(0, str(ROOT))
    from tests.conformance_ros.backends import cache_folder, genuine, kit

    peers = [Peer(kit(), 0), Peer(genuine(arguments.distro, cache_folder()), domain=91)]
    turns = max(5, arguments.turns)
    head = f"us per message, median of {turns} turns"
    print(f"{head:<40}{'at once':>8}{'kit':>10}{arguments.distro:>10}{'times faster':>14}{'range':>14}")
    for (kind, burst), count in CASES.items():
        times: list[list[float]] = [[], []]
        for _ in range(turns):
            for place, peer in enumerate(peers):
                times[place].append(peer.measure(kind, burst, count))
        ratios = sorted(theirs / ours for ours, theirs in zip(*times, strict=True))
        ours, theirs = (statistics.median(values) for values in times)
        print(
            f"{kind:<40}{burst:>8}{ours:>10.1f}{theirs:>10.1f}{statistics.median(ratios):>14.1f}"
            f"{f'{ratios[0]:.1f} to {ratios[-1]:.1f}':>14}",
            flush=True,
        )
    for peer in peers:
        peer.close()


if __name__ == "__main__":
    main()
