"""The same stages as three brains on ROS nodes in simulated time: sequential, pipelined and parallel.

- ``sequential``: one callback takes a frame through all stages, as ``PerceptionControlIntegrator::update()`` of the
  course's outline does. Simple, no locks, and everything waits for everything.
- ``pipelined``: a node with a thread of its own for each stage; frame k + 1 is perceived while frame k is planned.
- ``parallel``: one node on a multi-threaded executor. Each stage is in a mutually exclusive callback group of its own;
  control runs at its own fixed rate and reads the newest state and the newest plan, whatever the others do.

In the last two, perception may work on several frames at once (a reentrant callback group on threads of its own; in
``parallel``, where all share a pool, a group that admits so many). Nodes, topics, executors
and the device are those of :mod:`robotbrain.ros`: nothing here is computed from a formula. The formulas are in
:mod:`~robotbrain.pipeline.patterns.forms`, and tests compare the two.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from robotbrain.errors import InputError
from robotbrain.monitoring.trace import Recorder, Trace
from robotbrain.pipeline.patterns.results import Command, PatternResult, Span
from robotbrain.pipeline.patterns.stages import NS_PER_S, Device, Stage, as_device, check_stages
from robotbrain.pipeline.patterns.stamps import stamp_ns, stamped_publisher, timer_period
from robotbrain.ros.api import charge
from robotbrain.ros.callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from robotbrain.ros.context import SimContext
from robotbrain.ros.conversions import msg_class
from robotbrain.ros.executors import MultiThreadedExecutor
from robotbrain.ros.node import Node
from robotbrain.ros.resources import Segment

if TYPE_CHECKING:
    from robotbrain.jetson.profiles import JetsonProfile

Kind = Literal["sequential", "pipelined", "parallel"]
KINDS: tuple[Kind, ...] = ("sequential", "pipelined", "parallel")
"""The ways to arrange a brain."""

CAMERA_TOPIC = "/camera/image"
CAMERA_TYPE = "sensor_msgs/msg/Image"
COMMAND_TOPIC = "/cmd_vel"

OUTPUTS = {
    "perception": ("/perception/points", "sensor_msgs/msg/PointCloud2"),
    "estimation": ("/odometry/filtered", "nav_msgs/msg/Odometry"),
    "planning": ("/plan", "nav_msgs/msg/Path"),
}
"""Topic and type of what a stage of that name publishes; others publish ``/<name>`` as PointCloud2. The last stage
publishes COMMAND_TOPIC. Every message carries the stamp of the image that it came from."""

Costs = Callable[[int, int], Sequence[Segment]]
"""(place of the stage, frame) -> its segments."""


def frame_costs(stages: Sequence[Stage], frames: int, jitter: float = 0.0, seed: int = 0) -> Costs:
    """Return what each stage takes for each frame, so that every kind of brain meets the same frames.

    Args:
        stages: of the brain.
        frames: how many there will be at most.
        jitter: each stage's time of each frame is multiplied by a number drawn evenly from [1 - jitter, 1 + jitter].
        seed: of these numbers.

    Raises:
        InputError: for a jitter outside [0, 1).
    """
    if not 0 <= jitter < 1:
        raise InputError("jitter", given=jitter, expected="0 <= jitter < 1", fix="0.2 is plus or minus 20 %.")
    factors = 1 + jitter * np.random.default_rng(seed).uniform(-1, 1, size=(frames + 2, len(stages)))

    def costs(place: int, frame: int) -> Sequence[Segment]:
        stage = stages[place]
        segments = stage.segments if stage.work is None else stage.work(frame)
        if not jitter:
            return segments
        factor = factors[min(frame, frames + 1), place]
        return [(resource, max(1, round(length * factor))) for resource, length in segments]

    return costs


class AtMost(CallbackGroup):
    """A callback group of which up to ``count`` callbacks run at a time: between mutually exclusive and reentrant."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self.count = count

    def can_execute(self) -> bool:
        """Tell whether one more may start now."""
        return self.active < self.count


class _Wiring:
    """What the nodes of one run share: topics, messages and costs."""

    def __init__(self, context: SimContext, stages: tuple[Stage, ...], period_ns: int, depth: int, costs: Costs):
        self.context, self.stages, self.period_ns, self.depth, self.costs = context, stages, period_ns, depth, costs
        self.overtaken = 0
        self.plan_stamps: list[int] = []
        self.outputs = [OUTPUTS.get(stage.name, (f"/{stage.name}", "sensor_msgs/msg/PointCloud2")) for stage in stages]
        self.outputs[-1] = (COMMAND_TOPIC, "geometry_msgs/msg/TwistStamped")

    def source(self, place: int) -> tuple[str, Any]:
        """Return topic and class of what a stage takes in."""
        name, type_name = self.outputs[place - 1] if place else (CAMERA_TOPIC, CAMERA_TYPE)
        return name, msg_class(type_name)

    def publisher(self, node: Node, place: int) -> Callable[[int], None]:
        """Return a function that publishes a stage's output for a stamp."""
        topic, type_name = self.outputs[place]
        return stamped_publisher(node, type_name, topic, self.depth)

    def work(self, place: int, stamp_ns: int) -> None:
        """Do a stage's work: charge what it takes for that frame."""
        for resource, length in self.costs(place, stamp_ns // self.period_ns):
            charge(length, resource)

    def stage(self, node: Node, place: int, group: CallbackGroup | None = None) -> None:
        """Let ``node`` do a stage for everything that its input brings."""
        publish = self.publisher(node, place)
        newest = -1

        def on_input(message: Any) -> None:
            nonlocal newest
            stamp = stamp_ns(message)
            if stamp < newest:
                # A frame that came out of turn: what the stages behind know already is newer.
                self.overtaken += 1
                return
            newest = stamp
            self.work(place, stamp)
            publish(stamp)

        topic, cls = self.source(place)
        node.create_subscription(cls, topic, on_input, self.depth, callback_group=group)


def _camera(wiring: _Wiring) -> Node:
    """A camera that takes a frame every period; it costs the brain nothing."""
    context = wiring.context
    node = Node("camera", context=context)
    publish = stamped_publisher(node, CAMERA_TYPE, CAMERA_TOPIC, wiring.depth)
    # The frame leaves after all else that happens in this very nanosecond: a stage that becomes free in that moment
    # never has it yet. Otherwise the order of events would decide, and round numbers have ties in every second cycle.
    node.create_timer(timer_period(wiring.period_ns), lambda: context.schedule(context.now_ns, publish, context.now_ns))
    return node


def _sequential(wiring: _Wiring) -> None:
    """One callback does it all, in turn."""
    node = Node("brain", context=wiring.context)
    publish = wiring.publisher(node, len(wiring.stages) - 1)

    def update(image: Any) -> None:
        stamp = stamp_ns(image)
        for place in range(len(wiring.stages)):
            wiring.work(place, stamp)
        publish(stamp)

    topic, cls = wiring.source(0)
    node.create_subscription(cls, topic, update, wiring.depth)


def _pipelined(wiring: _Wiring, frames_at_once: int) -> None:
    """A node for each stage, a thread for each node."""
    for place, stage in enumerate(wiring.stages):
        node = Node(stage.name, context=wiring.context)
        if place == 0 and frames_at_once > 1:
            MultiThreadedExecutor(frames_at_once, context=wiring.context).add_node(node)
            wiring.stage(node, place, ReentrantCallbackGroup())
        else:
            wiring.stage(node, place)


def _parallel(wiring: _Wiring, frames_at_once: int, control_ns: int) -> None:
    """One node on a pool of threads; a callback group for each stage, and a timer for control."""
    node = Node("brain", context=wiring.context)
    last = len(wiring.stages) - 1
    # A thread for each stage, one for each further frame, and one for the inbox of control.
    MultiThreadedExecutor(last + 1 + frames_at_once, context=wiring.context).add_node(node)
    for place in range(last):
        # A reentrant group would take as many frames as the pool has threads, and leave none for the others.
        wiring.stage(node, place, AtMost(frames_at_once if place == 0 else 1))
    newest: dict[str, int] = {}
    inbox = MutuallyExclusiveCallbackGroup()
    for what, place in (("plan", last), ("state", last - 1)):
        topic, cls = wiring.source(place)

        # State and plan are taken from messages: what a callback of another thread has only begun is not there yet.
        def remember(message: Any, what: str = what) -> None:
            newest[what] = max(newest.get(what, 0), stamp_ns(message))

        node.create_subscription(cls, topic, remember, 1, callback_group=inbox)
    publish = wiring.publisher(node, last)

    def control() -> None:
        if len(newest) == 2:
            wiring.work(last, newest["state"])
            wiring.plan_stamps.append(newest["plan"])
            publish(newest["state"])

    node.create_timer(timer_period(control_ns), control, MutuallyExclusiveCallbackGroup())


def run_brain(
    kind: Kind,
    stages: Sequence[Stage],
    device: Device | JetsonProfile | str | int = "orin-nano-8gb:15W",
    *,
    camera_hz: float = 30.0,
    seconds: float = 10.0,
    queue_depth: int = 1,
    frames_at_once: int = 1,
    control_hz: float = 50.0,
    transport_us: float = 0.0,
    jitter: float = 0.0,
    seed: int = 0,
    warmup: float = 1.0,
) -> PatternResult:
    """Run a brain in simulated time and say how old its commands were.

    Args:
        kind: ``sequential``, ``pipelined`` or ``parallel``.
        stages: in the order of the data; ``parallel`` takes the last three as state, plan and control.
        device: a profile or its slug, a :class:`Device`, or a number of CPU cores.
        camera_hz: frames per second.
        seconds: simulated time, of which ``warmup`` is not counted.
        queue_depth: frames that wait before each stage; the oldest is dropped for a new one (KEEP_LAST).
        frames_at_once: that perception (the first stage) may work on; ``sequential`` has no use for it.
        control_hz: rate of control; only ``parallel`` has one.
        transport_us: from publisher to subscription, μs.
        jitter: spread of the stages' times, see :func:`frame_costs`; the same frames take the same in every brain.
        seed: of the jitter.
        warmup: s.

    Raises:
        InputError: for an unknown kind, numbers out of range, too few stages, or a resource the device does not have.
    """
    found = as_device(device)
    chosen = check_stages(stages, found)
    period_ns, control_ns = _check(kind, chosen, camera_hz, control_hz, queue_depth, frames_at_once, seconds, warmup)
    context = SimContext(resources=found.resources(), latency_ns=round(transport_us * 1000))
    recorder = Recorder(context, title=f"{kind} brain on {found.name}" if found.name else f"{kind} brain")
    frames = round(seconds * NS_PER_S) // period_ns
    costs = frame_costs(chosen, frames, jitter, seed)
    wiring = _Wiring(context, chosen, period_ns, queue_depth, costs)
    if kind == "sequential":
        _sequential(wiring)
    elif kind == "pipelined":
        _pipelined(wiring, frames_at_once)
    else:
        _parallel(wiring, frames_at_once, control_ns)
    _camera(wiring)
    context.run_until(round(seconds * NS_PER_S))
    roles = {f"/{stage.name}": stage.name for stage in chosen} if kind == "pipelined" else {}
    trace = recorder.trace(roles=roles)
    resources = context.resources
    assert resources is not None
    return PatternResult(
        kind=kind,
        stages=chosen,
        device=found,
        period_ns=period_ns,
        seconds=seconds,
        warmup_ns=round(warmup * NS_PER_S),
        commands=_commands(trace, wiring.plan_stamps),
        frames=frames,
        drops=_drops(trace, wiring),
        overtaken=wiring.overtaken,
        busy=resources.utilisation(),
        spans=tuple(_spans(kind, trace, wiring)),
        trace=trace,
    )


def _check(
    kind: str,
    stages: Sequence[Stage],
    camera_hz: float,
    control_hz: float,
    queue_depth: int,
    frames_at_once: int,
    seconds: float,
    warmup: float,
) -> tuple[int, int]:
    """Return the periods of camera and control in ns, if all is well."""
    if kind not in KINDS:
        raise InputError("kind of brain", given=kind, expected="one of " + ", ".join(KINDS), fix="Choose one of these.")
    if kind == "parallel" and len(stages) < 3:
        raise InputError(
            "stages of a parallel brain",
            given=[stage.name for stage in stages],
            expected="at least three: ..., state, plan, control",
            fix="Use brain_stages(), or another kind of brain.",
        )
    if kind == "sequential" and frames_at_once != 1:
        raise InputError(
            "frames_at_once", given=frames_at_once, expected="1 in a sequential brain", fix="Use kind='pipelined'."
        )
    for label, value, low, high in (
        ("camera_hz", camera_hz, 0.01, 10_000),
        ("control_hz", control_hz, 0.01, 10_000),
        ("queue_depth", queue_depth, 1, 1000),
        ("frames_at_once", frames_at_once, 1, 64),
        ("seconds", seconds, 1e-3, 10_000),
        ("warmup", warmup, 0, seconds),
    ):
        whole = label in ("queue_depth", "frames_at_once")
        if not low <= value <= high or (whole and not isinstance(value, int)):
            raise InputError(
                label,
                given=value,
                expected=f"{'a whole number' if whole else 'a number'} from {low:g} to {high:g}",
                fix="Check the call of run_brain.",
            )
    return round(NS_PER_S / camera_hz), round(NS_PER_S / control_hz)


# ------------------------------------------------------------ what the trace tells


def _commands(trace: Trace, plan_stamps: Sequence[int]) -> tuple[Command, ...]:
    found: list[Command] = []
    for message in trace.messages:
        if message.name == COMMAND_TOPIC:
            state = trace.stamps[message.id]
            # Control runs one callback at a time, so its commands leave in the order in which it began them.
            plan = plan_stamps[len(found)] if plan_stamps else state
            found.append(Command(message.released_ns, state, plan))
    return tuple(found)


def _drops(trace: Trace, wiring: _Wiring) -> dict[str, int]:
    readers = {wiring.source(place)[0]: stage.name for place, stage in enumerate(wiring.stages)}
    return {
        stage.name: sum(count for (_, topic), count in trace.dropped.items() if readers.get(topic) == stage.name)
        for stage in wiring.stages
    }


def _spans(kind: str, trace: Trace, wiring: _Wiring) -> list[Span]:
    """Cut callbacks into stages and segments; where they had to share, in proportion."""
    stages = wiring.stages
    readers = {wiring.source(place)[0]: place for place in range(len(stages))}
    spans: list[Span] = []
    for record in trace.callbacks:
        if not record.segments:
            continue
        stamp = trace.stamps[record.message or record.published[0]]
        frame = stamp // wiring.period_ns
        if kind == "sequential":
            places = list(range(len(stages)))
        else:
            places = [len(stages) - 1 if record.kind == "timer" else readers[record.name]]
        taken, length = 0, record.end_ns - record.start_ns
        for place in places:
            for resource, ns in wiring.costs(place, frame):
                start = record.start_ns + taken * length // record.demand_ns
                taken += ns
                end = record.start_ns + taken * length // record.demand_ns
                spans.append(Span(stages[place].name, frame, resource, start, end, record.worker))
    return spans
