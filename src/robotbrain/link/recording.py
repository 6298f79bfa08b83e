"""Recording a drive as a rosbag2 bag, from the kit's graph or from genuine ROS 2."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from robotbrain.link.runtime import KitRuntime, Runtime
from robotbrain.ros.conversions import msg_class

LOOK_S = 0.25
"""New topics of genuine ROS 2 are looked for this often."""

DEPTH = 100
"""Messages of a topic that wait at most while the disk is busy."""

IGNORED = frozenset({"/rosout", "/parameter_events"})


def record(runtime: Runtime, path: Path) -> Callable[[], None]:
    """Record all topics of the graph into a new bag; return what makes the bag whole.

    Raises:
        InputError: the path exists.
    """
    from robotbrain.ros.bag import BagRecorder

    if isinstance(runtime, KitRuntime):
        return BagRecorder(path, runtime.context, exclude=IGNORED).close
    return _GenuineRecorder(runtime, path).close


def accepting(offers: Sequence[Any]) -> Any:
    """Return a QoS profile that gets along with each of the publishers' profiles and asks for as much as all offer."""
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

    reliable = all(offer.reliability == ReliabilityPolicy.RELIABLE for offer in offers)
    latched = all(offer.durability == DurabilityPolicy.TRANSIENT_LOCAL for offer in offers)
    return QoSProfile(
        depth=DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


class _GenuineRecorder:
    """Raw subscriptions to whatever topics there are; stamps are times of arrival."""

    def __init__(self, runtime: Runtime, path: Path) -> None:
        from robotbrain.ros.bag import BagWriter

        self._writer = BagWriter(path)
        self._known: set[str] = set(IGNORED)
        self._node: Any = None
        runtime.make(self._make)

    def _make(self) -> Any:
        from rclpy.node import Node

        self._node = Node("recorder")
        self._look()
        self._node.create_timer(LOOK_S, self._look)
        return self._node

    def _look(self) -> None:
        for topic, types in self._node.get_topic_names_and_types():
            offers = [info.qos_profile for info in self._node.get_publishers_info_by_topic(topic)]
            if topic in self._known or not offers:
                continue
            self._known.add(topic)
            try:
                kind = msg_class(types[0])
            except (ImportError, AttributeError):
                self._node.get_logger().warning(f"{topic} is not recorded: {types[0]} is not installed here")
                continue
            self._node.create_subscription(kind, topic, self._listener(topic, types[0]), accepting(offers), raw=True)

    def _listener(self, topic: str, type_name: str) -> Callable[[bytes], None]:
        def listen(data: bytes) -> None:
            self._writer.write(topic, type_name, data, int(self._node.get_clock().now().nanoseconds))

        return listen

    def close(self) -> None:
        """Make the bag whole. The node goes with its runtime."""
        self._node.executor.shutdown()
        self._writer.close()
