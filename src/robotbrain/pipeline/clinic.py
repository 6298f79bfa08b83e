"""Tools for looking for a fault: record a drive once, replay it with one thing changed, and compare with the truth."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robotbrain.errors import InputError
from robotbrain.pipeline.geometry import inverse, transform, wrap_angle
from robotbrain.ros.context import SimContext
from robotbrain.ros.qos import QoSProfile, ReliabilityPolicy

if TYPE_CHECKING:
    from robotbrain.monitoring.faults import Fault
    from robotbrain.pipeline.brain import RunResult

Array = NDArray[np.float64]

ANY_SENDER = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
"""A subscription that takes from reliable and from best-effort publishers alike."""


def recording(path: str | Path, topics: Iterable[str]) -> Callable[[SimContext], None]:
    """Return what records a drive: ``drive(8, attach=[recording("bag", ["/scan"])])``; the bag is whole at its end.

    Args:
        path: the bag folder to make; one that is there already is replaced.
        topics: absolute names.
    """
    chosen = list(topics)

    def attach(context: SimContext) -> None:
        from robotbrain.ros.bag import BagRecorder

        context.on_shutdown(BagRecorder(path, context, chosen, overwrite=True).close)

    return attach


def replay_into(
    path: str | Path,
    listen: Iterable[str],
    *,
    node: Callable[[], object] | None = None,
    topics: Iterable[str] | None = None,
    faults: Iterable[Fault] = (),
) -> dict[str, list[Any]]:
    """Replay a bag in simulated time and return what is heard, in order, by topic.

    Args:
        path: of the bag.
        listen: absolute names of topics, of the bag or of the node.
        node: makes a node that shall hear the bag.
        topics: of the bag, these only; all if None.
        faults: to inject into the replay; the bag holds what was sent, before any fault.

    Raises:
        InputError: for a bag that cannot be read, or a topic to listen to that nobody publishes.
    """
    from robotbrain.ros.bag import open_bag, replay
    from robotbrain.ros.conversions import msg_class
    from robotbrain.ros.node import Node

    heard: dict[str, list[Any]] = {name: [] for name in listen}
    with open_bag(path) as reader, SimContext(start_ns=reader.start_ns).as_default() as context:
        if node is not None:
            node()
        replay(reader, context, topics=topics)
        ears = Node("clinic", context=context)
        for name, messages in heard.items():
            topic = context.topics.get(name)
            if topic is None or not topic.publishers:
                known = sorted(n for n, t in context.topics.items() if t.publishers)
                raise InputError("listen", given=name, expected="one of " + ", ".join(known), fix="Check the name.")
            keep = functools.partial(_keep, messages, msg_class(topic.typename))
            ears.create_subscription(msg_class(topic.typename), name, keep, ANY_SENDER, raw=True)
        for fault in faults:
            fault.install(context)
        context.run_for(reader.duration_ns * 1e-9 + 0.2)
        context.try_shutdown()
    return heard


def _keep(messages: list[Any], kind: Any, data: bytes) -> None:
    from robotbrain.ros.cdr import from_cdr

    messages.append(from_cdr(data, kind))


def poses_of(odometry: Iterable[Any]) -> Array:
    """Return (N, 4) time s, x m, y m, yaw rad of ``nav_msgs/Odometry`` messages."""
    from robotbrain.ros.conversions import quaternion_to_yaw, time_to_ns

    rows = []
    for message in odometry:
        pose = message.pose.pose
        yaw = quaternion_to_yaw(pose.orientation)
        rows.append((time_to_ns(message.header.stamp) * 1e-9, pose.position.x, pose.position.y, yaw))
    return np.array(rows, dtype=np.float64).reshape(-1, 4)


def truth_in_map(run: RunResult) -> Array:
    """Return (T, 4) where the robot truly was, time s, x m, y m, yaw rad, in the map frame (its pose at the start)."""
    start = run.world.start
    times, points, yaws = run.trajectory[:, 0], run.trajectory[:, 1:3], run.trajectory[:, 3]
    seen = transform(inverse((start.x, start.y, start.yaw)), points)
    return np.column_stack([times, seen, wrap_angle(yaws - start.yaw)])


def distance_from_truth(estimate: Array, truth: Array) -> Array:
    """Return (N,) how far each estimated position is from the true one of its time, m.

    Args:
        estimate, truth: (N, 4) and (T, 4) time, x, y, yaw; estimates before or after the truth are held against its
            first or last row.
    """
    true = [np.interp(estimate[:, 0], truth[:, 0], truth[:, column]) for column in (1, 2)]
    return np.asarray(np.hypot(estimate[:, 1] - true[0], estimate[:, 2] - true[1]), dtype=np.float64)


def wheel_turn_rate(joint_states: Iterable[Any], wheel_radius: float = 0.06, track: float = 0.30) -> Array:
    """Return (N, 2) time s and turn rate rad/s that the wheels of a differential drive say, counter-clockwise positive.

    Args:
        joint_states: ``sensor_msgs/JointState`` messages of the robot's two wheels.
        wheel_radius, track: of the robot, m.
    """
    from robotbrain.ros.conversions import time_to_ns

    rows = []
    for message in joint_states:
        left, right = (message.velocity[list(message.name).index(f"{s}_wheel_joint")] for s in ("left", "right"))
        rows.append((time_to_ns(message.header.stamp) * 1e-9, wheel_radius * (right - left) / track))
    return np.array(rows, dtype=np.float64).reshape(-1, 2)


def gyro_turn_rate(imu: Iterable[Any]) -> Array:
    """Return (N, 2) time s and turn rate rad/s about z of ``sensor_msgs/Imu`` messages."""
    from robotbrain.ros.conversions import time_to_ns

    rows = [(time_to_ns(message.header.stamp) * 1e-9, message.angular_velocity.z) for message in imu]
    return np.array(rows, dtype=np.float64).reshape(-1, 2)


class Link:
    """A network link that carries one message after the other, as a radio does: what is large delays what comes next.

    ``Link(20e6).attach(context)`` makes it the transport of a simulation.

    Args:
        bits_per_s: that get through, > 0.
        overhead_ms: for each message besides its bytes, ms, >= 0.

    Attributes:
        sent_bytes: so far.
    """

    def __init__(self, bits_per_s: float, overhead_ms: float = 1.0) -> None:
        if not (0 < bits_per_s < math.inf and 0 <= overhead_ms < math.inf):
            raise InputError(
                "link", given=(bits_per_s, overhead_ms), expected="a rate > 0 and an overhead >= 0", fix="Link(20e6)."
            )
        self.bits_per_s, self.overhead_ms = bits_per_s, overhead_ms
        self.sent_bytes = 0
        self._free_ns = 0

    def attach(self, context: SimContext) -> None:
        """Become the transport of a simulation."""

        def latency(_name: str, size: int) -> int:
            self.sent_bytes += size
            start = max(context.now_ns, self._free_ns)
            self._free_ns = start + round(size * 8e9 / self.bits_per_s + self.overhead_ms * 1e6)
            return self._free_ns - context.now_ns

        context.latency_ns = latency
