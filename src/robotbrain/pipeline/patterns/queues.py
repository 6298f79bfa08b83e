"""More frames than can be worked off: what to do with the rest, and what each answer costs in age, loss and memory.

A camera gives a frame every T, a consumer takes s > T for each. No queue helps against that; it only decides which
frames are lost, and how old the others get:

- ``keep_all`` (QoS KEEP_ALL): nothing is lost, the backlog and the age grow without end: (1 - T / s) t + T after t.
- ``keep_last`` (QoS KEEP_LAST, depth N): the oldest is lost; latency up to s + N T, below (N + 1) s.
- ``drop_newest`` (a bounded buffer that refuses): what is kept is the oldest; latency up to (N + 1) s.
- ``skip`` (when busy): a frame is taken only by a consumer that is free; latency s, but it then idles until the next
  frame: one frame every ⌈s / T⌉ T.
- ``throttle``: frames are let through at intervals of at least I, chosen beforehand; as skip if I >= s, a queue if not.
- ``credit`` (back-pressure): the consumer says when it is ready, and only then a frame is taken: latency s and one
  frame every s. The best of all, where the source can be triggered.

The first two are settings of a topic. The others are a :class:`Gate`, a small node between the two.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from robotbrain.errors import InputError
from robotbrain.monitoring.trace import stamp_of
from robotbrain.pipeline.patterns.forms import common_rhythm_ns
from robotbrain.pipeline.patterns.results import Command, age_curve, mean_age_ns
from robotbrain.pipeline.patterns.stages import NS_PER_MS, NS_PER_S
from robotbrain.pipeline.patterns.stamps import stamp_ns, stamped_publisher, timer_period
from robotbrain.ros.api import charge
from robotbrain.ros.context import SimContext
from robotbrain.ros.conversions import msg_class
from robotbrain.ros.node import Node
from robotbrain.ros.qos import HistoryPolicy, QoSProfile

QueuePolicy = Literal["keep_last", "keep_all", "drop_newest", "skip", "throttle", "credit"]
QUEUE_POLICIES: tuple[QueuePolicy, ...] = ("keep_last", "keep_all", "drop_newest", "skip", "throttle", "credit")
"""What to do with more than can be worked off."""

FRAME_BYTES = 640 * 480 * 3
"""Bytes of a camera image, for memory."""

IMAGE = "sensor_msgs/msg/Image"
READY = "geometry_msgs/msg/PointStamped"


class Gate(Node):
    """A node between a source and a consumer that lets frames through by a rule.

    Subscribes ``frames`` and ``ready`` (a stamped message from the consumer whenever it is done with a frame),
    publishes ``gated``.

    Args:
        capacity: frames that wait in the gate while the consumer is busy; a full gate refuses new ones.
        interval_ns: least time between frames let through; then ``ready`` and ``capacity`` are not looked at.
        context: the simulation; the default context if None.

    Attributes:
        refused: frames that were not let in.
    """

    def __init__(self, capacity: int = 0, interval_ns: int | None = None, context: SimContext | None = None) -> None:
        super().__init__("gate", context=context)
        self.refused = 0
        self._capacity, self._interval_ns = capacity, interval_ns
        self._waiting: deque[int] = deque()
        self._credits, self._next_ns = 1, 0
        self._pass_on = stamped_publisher(self, IMAGE, "gated", 10)
        self.create_subscription(msg_class(IMAGE), "frames", self._on_frame, 10)
        self.create_subscription(msg_class(READY), "ready", self._on_ready, 10)

    def __len__(self) -> int:
        return len(self._waiting)

    def _on_frame(self, message: Any) -> None:
        stamp = stamp_ns(message)
        if self._interval_ns is not None:
            now = self.get_clock().now().nanoseconds
            if now < self._next_ns:
                self.refused += 1
                return
            self._next_ns = now + self._interval_ns
            self._pass_on(stamp)
        elif self._credits:
            self._credits -= 1
            self._pass_on(stamp)
        elif len(self._waiting) < self._capacity:
            self._waiting.append(stamp)
        else:
            self.refused += 1

    def _on_ready(self, _message: Any) -> None:
        if self._waiting:
            self._pass_on(self._waiting.popleft())
        else:
            self._credits += 1


@dataclass(frozen=True)
class QueueResult:
    """How a policy did.

    Attributes:
        policy: one of QUEUE_POLICIES.
        capacity: frames that may wait.
        frames: taken by the source.
        lost: of these, dropped or refused.
        outputs: of the consumer, in order; ``state_ns`` is the frame's stamp.
        backlog: frames that wait, just after each period of the source.
    """

    policy: str
    capacity: int
    frames: int
    lost: int
    outputs: tuple[Command, ...] = field(repr=False)
    backlog: NDArray[np.int64] = field(repr=False)

    @property
    def latency_ms(self) -> NDArray[np.float64]:
        """Of each frame that was worked off: from its stamp to the end, ms."""
        return np.array([(out.released_ns - out.state_ns) / NS_PER_MS for out in self.outputs])

    @property
    def throughput_hz(self) -> float:
        """Frames worked off per second."""
        span = self.outputs[-1].released_ns - self.outputs[0].released_ns
        return (len(self.outputs) - 1) * 1e9 / span if span else 0.0

    @property
    def mean_age_ms(self) -> float:
        """Age of the newest output, averaged over time, ms."""
        return mean_age_ns(*age_curve(self.outputs)) / NS_PER_MS

    @property
    def peak_age_ms(self) -> float:
        """Largest age of the newest output, ms."""
        return float(age_curve(self.outputs)[1].max()) / NS_PER_MS

    @property
    def memory_mb(self) -> float:
        """Of the frames that waited, at most, MB."""
        return float(self.backlog.max()) * FRAME_BYTES / 1e6


def run_queue(
    policy: QueuePolicy,
    *,
    arrival_hz: float = 30.0,
    service_ms: float = 45.0,
    seconds: float = 10.0,
    capacity: int = 1,
    interval_ms: float | None = None,
) -> QueueResult:
    """Run a source and a consumer with a policy in between, on nodes in simulated time.

    Args:
        policy: one of QUEUE_POLICIES.
        arrival_hz: of the source.
        service_ms: that the consumer takes for a frame.
        seconds: simulated time.
        capacity: frames that wait: the depth of ``keep_last``, the buffer of ``drop_newest``.
        interval_ms: of ``throttle``; the service time if None.

    Raises:
        InputError: for an unknown policy or numbers out of range.
    """
    if policy not in QUEUE_POLICIES:
        raise InputError("policy", given=policy, expected="one of " + ", ".join(QUEUE_POLICIES), fix="Choose one.")
    if not (0 < arrival_hz <= 10_000 and service_ms > 0 and seconds * arrival_hz >= 2 and capacity >= 1):
        raise InputError(
            "queue",
            given={"arrival_hz": arrival_hz, "service_ms": service_ms, "seconds": seconds, "capacity": capacity},
            expected="positive numbers, at least two frames, and a capacity >= 1",
            fix="run_queue('keep_last', arrival_hz=30, service_ms=45, seconds=10).",
        )
    period, service = round(NS_PER_S / arrival_hz), round(service_ms * NS_PER_MS)
    context = SimContext()
    gate = None
    if policy in ("drop_newest", "skip", "throttle"):
        interval = service if interval_ms is None else round(interval_ms * NS_PER_MS)
        gate = Gate(
            capacity if policy == "drop_newest" else 0, interval if policy == "throttle" else None, context=context
        )
    qos = QoSProfile(history=HistoryPolicy.KEEP_ALL) if policy == "keep_all" else QoSProfile(depth=capacity)
    subscription = _consumer(context, "frames" if gate is None else "gated", qos, service)
    taken = _source(context, period, on_credit=policy == "credit")
    outputs: list[Command] = []
    context.add_message_tap(
        lambda record, data: (
            outputs.append(Command(record.released_ns, *[stamp_of(data)] * 2)) if record.name == "/ready" else None
        )
    )
    backlog = []
    for k in range(1, int(seconds * NS_PER_S) // period + 1):
        context.run_until(k * period)
        backlog.append(subscription.queue_depth() + (len(gate) if gate is not None else 0))
    lost = subscription.dropped + (gate.refused if gate is not None else 0)
    return QueueResult(policy, capacity, len(taken), lost, tuple(outputs), np.array(backlog, dtype=np.int64))


def _source(context: SimContext, period: int, *, on_credit: bool) -> list[int]:
    """Make the camera; return the list that it writes the stamps of its frames to."""
    node = Node("source", context=context)
    taken: list[int] = []
    publish = stamped_publisher(node, IMAGE, "frames", 10)

    def take(_: Any = None) -> None:
        taken.append(context.now_ns)
        publish(context.now_ns)

    if on_credit:
        node.create_subscription(msg_class(READY), "ready", take, 10)
        context.schedule(period, take)  # the first frame needs no asking
    else:
        # After all else that happens in this nanosecond, see brains._camera.
        node.create_timer(timer_period(period), lambda: context.schedule(context.now_ns, take))
    return taken


def _consumer(context: SimContext, topic: str, qos: QoSProfile, service: int) -> Any:
    node = Node("consumer", context=context)
    ready = stamped_publisher(node, READY, "ready", 10)

    def work(message: Any) -> None:
        charge(service)
        ready(stamp_ns(message))

    return node.create_subscription(msg_class(IMAGE), topic, work, qos)


# ------------------------------------------------------------ closed forms


@dataclass(frozen=True)
class QueueForm:
    """What theory says about a policy in the long run.

    Attributes:
        policy: one of QUEUE_POLICIES.
        throughput_hz: frames worked off per second.
        latency_ms: mean; infinite if it grows without end.
        latency_max_ms: largest.
        peak_age_ms: largest age of the newest output.
        lost_share: of the source's frames, 0 to 1.
        backlog: frames that wait at most; infinite if they grow without end.
        growth: by how much the age rises per second, s/s.
    """

    policy: str
    throughput_hz: float
    latency_ms: float
    latency_max_ms: float
    peak_age_ms: float
    lost_share: float
    backlog: float
    growth: float = 0.0


def queue_form(
    policy: QueuePolicy, period_ns: int, service_ns: int, capacity: int = 1, interval_ns: int | None = None
) -> QueueForm:
    """Return what a policy does in the long run, with a source of fixed period and a fixed service time (D/D/1).

    Args:
        policy: one of QUEUE_POLICIES.
        period_ns: T of the source.
        service_ns: s of the consumer.
        capacity: N.
        interval_ns: I of ``throttle``, at least s; s if None.

    Raises:
        InputError: a throttle that lets more through than can be worked off.
    """
    T, s = period_ns, service_ns
    interval = s if interval_ns is None else interval_ns
    if policy == "throttle" and -(-interval // T) * T < s:
        raise InputError("interval_ns", given=interval, expected=f"at least {s}", fix="A shorter one makes a queue.")

    def form(every: float, mean: float, most: float, backlog: float, growth: float = 0.0) -> QueueForm:
        lost = 0.0 if growth or policy == "credit" else 1 - T / every
        ms = NS_PER_MS
        return QueueForm(
            policy, 1e9 / every, mean / ms, most / ms, (most + every) / ms, max(0.0, lost), backlog, growth
        )

    if policy == "credit":
        return form(s, s, s, 0)
    if policy == "throttle":
        return form(-(-interval // T) * T, s, s, 0)
    if s <= T:
        return form(T, s, s, 0)
    if policy == "skip":
        return form(-(-s // T) * T, s, s, 0)
    if policy == "keep_all":
        return form(s, math.inf, math.inf, math.inf, 1 - T / s)
    rhythm, side = common_rhythm_ns(s, T)
    least = 0.0 if side > 0 else rhythm  # of what the newest frame has waited, see forms
    if policy == "keep_last":
        oldest = s + (capacity - 1) * T + least
        return form(s, oldest + (T - rhythm) / 2, oldest + T - rhythm, capacity)
    # A place in the buffer is taken by the next frame, up to a period after it became free.
    soonest = rhythm if side > 0 else 0.0
    full = (capacity + 1) * s - soonest
    return form(s, full - (T - rhythm) / 2, full, capacity)


def keep_all_latency_ns(frame: int, period_ns: int, service_ns: int) -> int:
    """Return the latency of the k-th frame (from 0) of a queue that keeps all, ns: k (s - T) + s."""
    return frame * max(0, service_ns - period_ns) + service_ns


def keep_all_age_ns(time_ns: float, period_ns: int, service_ns: int) -> float:
    """Return the latency of the output that leaves at a time since the first frame, ns: (1 - T / s) t + T."""
    return (1 - period_ns / service_ns) * time_ns + period_ns


def table(results: list[QueueResult]) -> str:
    """Return a comparison as text."""
    rows = [
        f"{'policy':<16}{'frames/s':>9}{'lost %':>8}{'latency ms':>12}{'largest':>9}{'peak age':>10}{'waiting':>9}"
        f"{'MB':>7}"
    ]
    for found in results:
        name = f"{found.policy} {found.capacity}" if found.policy in ("keep_last", "drop_newest") else found.policy
        latency = found.latency_ms
        rows.append(
            f"{name:<16}{found.throughput_hz:>9.1f}{100 * found.lost / found.frames:>8.1f}{latency.mean():>12.1f}"
            f"{latency.max():>9.1f}{found.peak_age_ms:>10.1f}{found.backlog.max():>9}{found.memory_mb:>7.1f}"
        )
    return "\n".join(rows)
