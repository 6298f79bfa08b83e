"""Small programs of known timing for the tests of the critical path and of what-ifs."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile
from sensor_msgs.msg import CompressedImage
from std_msgs.msg import Header

from robotbrain.monitoring.trace import Recorder, Trace
from robotbrain.ros import DeviceResources, SimContext
from robotbrain.ros.conversions import ns_to_time
from robotbrain.ros.executors import Executor

MS = 1_000_000


class Rig:
    """A simulation under construction: sensors, stages and timers with fixed costs.

    Args:
        cores: of the device; 0: no device.
        latency_ns: of transport.
    """

    def __init__(self, cores: int = 8, latency_ns: int = 0, dla: int = 0) -> None:
        device = DeviceResources(cpu_cores=cores, gpu=1, dla=dla) if cores else None
        self.context = SimContext(resources=device, latency_ns=latency_ns)
        self.context.log_sink = lambda _: None
        self.recorder = Recorder(self.context)
        self.robot = Node("robot", context=self.context)
        self.nodes: dict[str, Node] = {}

    def node(self, name: str, executor: Executor | None = None) -> Node:
        """Return a node, made when it is first asked for."""
        if name not in self.nodes:
            self.nodes[name] = Node(name, context=self.context)
            if executor is not None:
                executor.add_node(self.nodes[name])
        return self.nodes[name]

    def sensor(self, topic: str, period_ms: float, size: int = 100, delay_ms: float = 0.0) -> None:
        """Publish stamped messages; stamps are ``delay_ms`` old."""
        publisher = self.robot.create_publisher(CompressedImage, topic, 10)

        def read() -> None:
            stamp = ns_to_time(self.context.now_ns - round(delay_ms * MS))
            publisher.publish(CompressedImage(header=Header(stamp=stamp), data=bytes(size)))

        read.__name__ = "read" + topic.replace("/", "_")
        self.robot.create_timer(period_ms * 1e-3, read)

    def _act(self, node: Node, costs: tuple[tuple[str, float], ...], out: str | None) -> Callable[..., None]:
        publisher = None if out is None else node.create_publisher(CompressedImage, out, 10)

        def act(message: object = None) -> None:
            for resource, milliseconds in costs:
                self.context.charge(round(milliseconds * MS), resource)
            if publisher is not None:
                publisher.publish(CompressedImage())

        return act

    def stage(
        self,
        name: str,
        topic: str,
        *costs: tuple[str, float],
        out: str | None = None,
        depth: int | None = 10,
        executor: Executor | None = None,
    ) -> None:
        """Make a node take a topic, at this cost, and publish on another."""
        node = self.node(name, executor)
        qos = QoSProfile(history=HistoryPolicy.KEEP_ALL) if depth is None else QoSProfile(depth=depth)
        node.create_subscription(CompressedImage, topic, self._act(node, costs, out), qos)

    def timer(self, name: str, function: str, period_ms: float, *costs: tuple[str, float], out: str) -> None:
        """Make a node publish from a timer whose callback is called ``function``."""
        node = self.node(name)
        act = self._act(node, costs, out)

        def tick() -> None:
            act()

        tick.__name__ = function
        node.create_timer(period_ms * 1e-3, tick)

    def sink(self, topic: str = "/cmd_vel") -> None:
        """Let the robot take commands."""
        self.robot.create_subscription(CompressedImage, topic, lambda _: None, 10)

    def run(self, seconds: float) -> Trace:
        """Run and return the trace."""
        self.context.run_for(seconds)
        return self.recorder.trace()
