"""Replaying bags: in simulated time, or in real time into any function."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

from robotbrain.errors import InputError
from robotbrain.ros.bag.metadata import INFINITE_NS
from robotbrain.ros.bag.reader import BagReader
from robotbrain.ros.bag.source import BagMessage
from robotbrain.ros.context import SimContext
from robotbrain.ros.conversions import msg_class, ns_to_time
from robotbrain.ros.node import Node
from robotbrain.ros.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from robotbrain.ros.typedefs import typenames

CLOCK = "/clock"


class Replay:
    """A replay under way in a simulation.

    Attributes:
        node: its publishing node.
        published: messages published so far.
        skipped: topics of types the kit does not know.
        done: everything was published, or it was cancelled.
        ended_ns: simulated time of that; 0 while it is not done.
    """

    def __init__(self, node: Node, messages: Iterator[BagMessage], publishers: Mapping[str, Any]) -> None:
        self.node = node
        self.published = 0
        self.skipped: tuple[str, ...] = ()
        self.done = False
        self.ended_ns = 0
        self._messages, self._publishers = messages, publishers

    def cancel(self) -> None:
        """Publish nothing more."""
        if not self.done:
            self.done, self.ended_ns = True, self.node.context.now_ns

    def _begin(self, time_of: Callable[[int], int]) -> None:
        self._time_of = time_of
        self._schedule_next()

    def _schedule_next(self) -> None:
        message = next(self._messages, None)
        if message is None:
            self.cancel()
            return
        self.node.context.schedule(self._time_of(message.stamp_ns), self._publish, message)

    def _publish(self, message: BagMessage) -> None:
        if self.done:
            return
        # As CDR, and one at a time: what the bag holds is published bit for bit, and a long bag stays on the disk.
        self._publishers[message.topic].publish(message.data)
        self.published += 1
        self._schedule_next()


def replay(
    reader: BagReader,
    target: SimContext | Node,
    *,
    rate: float = 1.0,
    topics: Iterable[str] | None = None,
    start_s: float = 0.0,
    remap: Mapping[str, str] | None = None,
    clock_hz: float | None = None,
) -> Replay:
    """Publish a bag in simulated time, beginning now; run the simulation to let it happen.

    Messages keep their distances (divided by ``rate``) and their order. For a clock that agrees with the stamps inside
    the messages make the simulation with ``SimContext(start_ns=reader.start_ns)``.

    Args:
        reader: an open bag; leave it open until the replay is done.
        target: the simulation, or the node to publish from; a node ``rosbag2_player`` is made otherwise.
        rate: 2 replays twice as fast; > 0.
        topics: these only. All when omitted, but for those of types the kit does not know, which are named in the log.
        start_s: seconds of the bag to leave out at its beginning; >= 0.
        remap: recorded topic -> topic to publish on.
        clock_hz: publish the recorded time on ``/clock`` so many times per simulated second; a recorded ``/clock`` is
            then left out.

    Raises:
        InputError: an argument out of range, an unknown topic, or a topic asked for whose type is unknown.
    """
    _check(rate, start_s)
    node = target if isinstance(target, Node) else Node("rosbag2_player", context=target)
    context, log = node.context, node.get_logger()
    chosen, skipped = _choose(reader, topics, without_clock=clock_hz is not None)
    if skipped:
        log.warning(f"{reader.path.name}: not replayed, their types are unknown here: {', '.join(skipped)}")
    for note in reader.notes:
        log.warning(note)
    names = dict(remap or {})
    publishers = {
        name: node.create_publisher(
            msg_class(reader.topics[name].typename), names.get(name, name), offer(reader.topics[name].qos)
        )
        for name in chosen
    }
    origin, now = reader.start_ns + round(start_s * 1e9), context.now_ns
    running = Replay(node, reader.messages(chosen, start_ns=origin), publishers)
    running.skipped = tuple(skipped)

    def time_of(stamp_ns: int) -> int:
        return now + (stamp_ns - origin if rate == 1.0 else round((stamp_ns - origin) / rate))

    if clock_hz is not None:
        _publish_clock(running, clock_hz, rate, origin)
    running._begin(time_of)
    return running


def _publish_clock(running: Replay, clock_hz: float, rate: float, origin_ns: int) -> None:
    if not clock_hz > 0:
        raise InputError("clock_hz", given=clock_hz, expected="> 0", fix="40 is usual.")
    kind = msg_class("rosgraph_msgs/msg/Clock")
    publisher = running.node.create_publisher(kind, CLOCK, QoSProfile(depth=1))
    context = running.node.context
    began, period = context.now_ns, round(1e9 / clock_hz)

    def tick(number: int) -> None:
        if running.done and context.now_ns > running.ended_ns:
            return
        publisher.publish(kind(clock=ns_to_time(origin_ns + round(number * period * rate))))
        context.schedule(began + (number + 1) * period, tick, number + 1)

    context.schedule(began, tick, 0)


def replay_wall(
    reader: BagReader,
    publish: Callable[[BagMessage], object],
    *,
    rate: float = 1.0,
    topics: Iterable[str] | None = None,
    start_s: float = 0.0,
    remap: Mapping[str, str] | None = None,
    now: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], object] = time.sleep,
) -> int:
    """Call ``publish(message)`` for each message at its time, in real time; return how many.

    Times are counted from the start, so delays do not add up: a message that is late is published at once.

    Args:
        reader: an open bag.
        publish: sends a message (its CDR bytes are ``message.data``), for instance to a raw publisher of genuine rclpy.
        rate: 2 replays twice as fast; > 0.
        topics: these only; all when omitted.
        start_s: seconds of the bag to leave out at its beginning; >= 0.
        remap: recorded topic -> topic of the message handed to ``publish``.
        now: a clock in seconds.
        sleep: waits so many seconds.
    """
    _check(rate, start_s)
    names = dict(remap or {})
    origin, began, count = reader.start_ns + round(start_s * 1e9), now(), 0
    for message in reader.messages(topics, start_ns=origin):
        wait = began + (message.stamp_ns - origin) / 1e9 / rate - now()
        if wait > 0:
            sleep(wait)
        publish(message._replace(topic=names.get(message.topic, message.topic)))
        count += 1
    return count


def offer(recorded: tuple[QoSProfile, ...]) -> QoSProfile:
    """Return the QoS to publish a topic with: as recorded where its publishers agreed, else reliable with depth 10.

    As in ``ros2 bag play``, except that history and depth are kept where the bag knows them.
    """
    if not recorded:
        return QoSProfile(depth=10)
    first = recorded[0]
    reliability, durability = (
        (first.reliability, first.durability)
        if all(_promise(one) == _promise(first) for one in recorded)
        else (ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE)
    )
    keep_all = first.history == HistoryPolicy.KEEP_ALL
    return QoSProfile(
        history=HistoryPolicy.KEEP_ALL if keep_all else HistoryPolicy.KEEP_LAST,
        depth=first.depth if keep_all else first.depth or 10,
        reliability=reliability if reliability == ReliabilityPolicy.BEST_EFFORT else ReliabilityPolicy.RELIABLE,
        durability=durability if durability == DurabilityPolicy.TRANSIENT_LOCAL else DurabilityPolicy.VOLATILE,
        deadline=max((one.deadline for one in recorded), key=lambda one: one.nanoseconds or INFINITE_NS),
        lifespan=max((one.lifespan for one in recorded), key=lambda one: one.nanoseconds or INFINITE_NS),
    )


def _promise(profile: QoSProfile) -> tuple[ReliabilityPolicy, DurabilityPolicy]:
    return profile.reliability, profile.durability


def _choose(reader: BagReader, topics: Iterable[str] | None, *, without_clock: bool) -> tuple[list[str], list[str]]:
    if topics is not None:
        asked = list(topics)
        for name in asked:
            reader.qos(name)  # refuses an unknown topic
            if reader.topics[name].typename not in typenames():
                raise InputError(
                    f"type of topic {name}",
                    given=reader.topics[name].typename,
                    expected="a type the kit knows",
                    fix="Leave the topic out.",
                )
        return asked, []
    known = [name for name in reader.topics if reader.topics[name].typename in typenames()]
    skipped = [name for name in reader.topics if name not in known]
    return [name for name in known if not (without_clock and name == CLOCK)], skipped


def _check(rate: float, start_s: float) -> None:
    if not 0 < rate < float("inf"):
        raise InputError("rate", given=rate, expected="a number > 0", fix="1.0 is real time, 2.0 twice as fast.")
    if not 0 <= start_s < float("inf"):
        raise InputError("start_s", given=start_s, expected="seconds >= 0", fix="0 begins at the first message.")
