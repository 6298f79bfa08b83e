"""How old data gets on its way through a chain of nodes: each on its own timer, or each set off by the one before.

In a periodic chain every link wakes up by its own clock and reads the newest output of the one before it. Simple and
robust, but each link can have just missed its input: the worst reaction is bounded by Σ (T_i + R_i), periods and
response times, which Davare et al. ("Period optimization for hard real-time distributed automotive systems", DAC 2007)
showed. An event-triggered chain only samples once: T_1 + Σ R_i. Three nodes at 10 Hz differ by 200 ms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from robotbrain.errors import InputError
from robotbrain.monitoring.trace import stamp_of
from robotbrain.pipeline.patterns.budgets import Task
from robotbrain.pipeline.patterns.results import Command, age_curve, mean_age_ns
from robotbrain.pipeline.patterns.stages import NS_PER_MS, NS_PER_S
from robotbrain.pipeline.patterns.stamps import stamp_ns, stamped_publisher, timer_period
from robotbrain.ros.api import charge
from robotbrain.ros.context import SimContext
from robotbrain.ros.conversions import msg_class
from robotbrain.ros.node import Node
from robotbrain.ros.resources import DeviceResources

POINTS = "sensor_msgs/msg/PointCloud2"
Trigger = Literal["timers", "events"]


def reaction_bound_ns(links: Sequence[Task], trigger: Trigger = "timers", cores: int | None = None) -> float:
    """Return a bound on the time from something happening to the first output that knows, ns.

    Args:
        links: of the chain, in the order of the data.
        trigger: ``timers``: each link has a period of its own. ``events``: the first has, the others follow.
        cores: that the links share, a thread each; None: one for each link.
    """
    responses = [shared_response_ns(link.wcet_ns, len(links), cores or len(links)) for link in links]
    if trigger == "events":
        return links[0].period_ns + sum(responses)
    return sum(link.period_ns for link in links) + sum(responses)


def shared_response_ns(wcet_ns: int, threads: int, cores: int) -> float:
    """Return the longest that work takes when ``threads`` share ``cores`` fairly: C max(1, n / m), ns."""
    # Round-robin in slices of 1 ns: to within one round.
    return wcet_ns if threads <= cores else wcet_ns * threads / cores + threads


@dataclass(frozen=True)
class ChainResult:
    """How a chain ran.

    Attributes:
        links: of the chain.
        trigger: what sets them off.
        outputs: of the last link; ``state_ns`` is when the first link read the world.
    """

    links: tuple[Task, ...]
    trigger: str
    outputs: tuple[Command, ...] = field(repr=False)

    @property
    def reaction_ms(self) -> float:
        """Longest time from something happening to the first output that knew, ms."""
        return float(age_curve(self.outputs)[1].max()) / NS_PER_MS

    @property
    def mean_age_ms(self) -> float:
        """Age of the newest output, averaged over time, ms."""
        return mean_age_ns(*age_curve(self.outputs)) / NS_PER_MS


def run_chain(
    links: Sequence[Task],
    trigger: Trigger = "timers",
    *,
    seconds: float = 10.0,
    cores: int | None = None,
    offsets_ns: Sequence[int] | None = None,
) -> ChainResult:
    """Run a chain of nodes in simulated time, a thread each.

    Args:
        links: in the order of the data; each reads the newest output of the one before and takes its ``wcet_ns``.
        trigger: ``timers`` or ``events``.
        seconds: simulated time.
        cores: shared by all; None: one for each link.
        offsets_ns: when each timer is created, 0 for all if None: nobody switches on a robot in phase.

    Raises:
        InputError: no links, an unknown trigger, or offsets of another number.
    """
    offsets = list(offsets_ns or [0] * len(links))
    if not links or trigger not in ("timers", "events") or len(offsets) != len(links) or min(offsets) < 0:
        raise InputError(
            "chain",
            given={"links": len(links), "trigger": trigger, "offsets_ns": offsets_ns},
            expected="at least one link, 'timers' or 'events', and an offset >= 0 for each link",
            fix="run_chain([Task.of('camera', 100, 5), Task.of('planner', 100, 20)]).",
        )
    context = SimContext(resources=DeviceResources(cpu_cores=cores or len(links)))
    outputs: list[Command] = []
    last = f"/link{len(links)}"
    context.add_message_tap(
        lambda record, data: (
            outputs.append(Command(record.released_ns, *[stamp_of(data)] * 2)) if record.name == last else None
        )
    )
    for offset, place in sorted((offset, place) for place, offset in enumerate(offsets)):
        context.run_until(offset)
        _link(context, links[place], place, trigger)
    context.run_until(round(seconds * NS_PER_S))
    return ChainResult(tuple(links), trigger, tuple(outputs))


def _link(context: SimContext, link: Task, place: int, trigger: Trigger) -> None:
    """Make the node of a link, with a thread of its own."""
    node = Node(link.name, context=context)
    publish = stamped_publisher(node, POINTS, f"link{place + 1}", 1)
    newest: list[int] = []

    def step() -> None:
        # The first link reads the world as it is now.
        stamp = newest[-1] if place else context.now_ns
        charge(link.wcet_ns)
        publish(stamp)

    def on_input(message: Any) -> None:
        newest[:] = [stamp_ns(message)]
        if trigger == "events":
            step()

    if place:
        node.create_subscription(msg_class(POINTS), f"link{place}", on_input, 1)
    if not place or trigger == "timers":
        node.create_timer(timer_period(link.period_ns), lambda: step() if newest or not place else None)
