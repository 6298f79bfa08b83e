"""What monitoring costs: CPU time with a monitor less without, for each 20 ms period of the kit's brain.

Run: ``python benchmarks/monitoring_overhead.py [PAIRS]``. The same run is made twice, and each simulated second of it
is watched in one of the two and not in the other, taking turns. The runs being the same to the byte, the difference of
each second is the monitor's; the median over all seconds leaves out what else the machine did meanwhile. Settings:

- simulated: the kit's brain drives, with and without ``drive(..., attach=[monitor.attach])``; the monitor keeps
  figures, raises alarms, takes a snapshot every simulated second and logs it;
- the same run, the time within the monitor's own calls only: far less noise, but without what its presence costs the
  brain besides (a record for each message, cold caches);
- wall clock: nodes with as many callbacks and messages in a period as the brain has, made to do nothing, with and
  without ``monitor.attach_node``; the monitor's own thread is counted where it runs.

CPU time counts, not wall-clock time: of the thread that drives in the first setting (the network's own threads spin
while they wait, which would drown everything), of the process in the second. The target is 0.4 ms a period.
"""

from __future__ import annotations

import gc
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import robotbrain.ros
from robotbrain.monitoring.monitor import Monitor
from robotbrain.pipeline.brain import drive
from robotbrain.ros import SimContext

PERIOD_S = 0.02
SECONDS = 12
TARGET_MS = 0.4
PAIRS = 4

assert robotbrain.ros.BACKEND


def simulated(parity: int) -> tuple[list[float], float]:
    """Drive; return the CPU time of each second, s, and what was seen in a period while somebody watched.

    Args:
        parity: seconds whose number leaves this remainder by two are watched.
    """
    spent: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        monitor = Monitor(log=Path(folder) / "log.jsonl")

        def attach(context: SimContext) -> None:
            monitor.attach(context)
            taps: list[list[Any]] = [context.callback_taps, context.message_taps]
            mine = [found.pop() for found in taps]
            last = [0.0]

            def second(number: int) -> None:
                now = time.thread_time()
                spent.append(now - last[0])
                for found, tap in zip(taps, mine, strict=True):
                    if tap in found:
                        found.remove(tap)
                    if number % 2 == parity:
                        found.append(tap)
                gc.collect()
                context.schedule((number + 1) * 10**9, second, number + 1)
                last[0] = time.thread_time()

            context.schedule(0, second, 0)

        drive(0, time_limit=SECONDS + 0.5, attach=[attach])
        monitor.close()
    summary = monitor.summary()
    assert not summary.notes, summary.notes
    # The first entry ends before the run, the first second also loads the network.
    seen = sum(c.calls for c in summary.callbacks) + sum(t.messages for t in summary.topics)
    return spent[2:], seen / (SECONDS / 2 / PERIOD_S)


class Stopwatch:
    """Adds up the CPU time of the calls of a function, less what reading the clock takes."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function, self.calls, self.spent_ns = function, 0, 0

    def __call__(self, *arguments: Any) -> None:
        began = time.thread_time_ns()
        self._function(*arguments)
        self.spent_ns += time.thread_time_ns() - began
        self.calls += 1


def inside(parity: int) -> tuple[list[float], float]:
    """Drive once; return the CPU time within the monitor's own taps, ms a period, and what was seen in a period."""
    idle = Stopwatch(lambda *_: None)
    for _ in range(100_000):
        idle("x")
    with tempfile.TemporaryDirectory() as folder:
        monitor = Monitor(log=Path(folder) / "log.jsonl")
        taps: list[Stopwatch] = []

        def attach(context: SimContext) -> None:
            monitor.attach(context)
            for found in (context.callback_taps, context.message_taps):
                taps.append(Stopwatch(found.pop()))
                found.append(taps[-1])

        run = drive(0, time_limit=SECONDS + 0.5, attach=[attach])
    periods = run.seconds / PERIOD_S
    spent_ns = sum(tap.spent_ns - tap.calls * idle.spent_ns / idle.calls for tap in taps)
    return [1e-6 * spent_ns / periods], sum(tap.calls for tap in taps) / periods


def nodes_of_a_brain(context: SimContext) -> list[Any]:
    """Return nodes that do nothing, with some 10 callbacks and 5 messages in 20 ms, as the kit's brain."""
    from nav_msgs.msg import Odometry
    from rclpy.node import Node
    from sensor_msgs.msg import Imu, JointState

    def stamped(kind: Any) -> Any:
        message = kind()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(context.now_ns, 10**9)
        return message

    robot, estimator = Node("robot"), Node("estimator")
    for kind, topic in ((Imu, "imu"), (JointState, "joint_states")):
        publisher = robot.create_publisher(kind, topic, 10)
        robot.create_timer(PERIOD_S, lambda publisher=publisher, kind=kind: publisher.publish(stamped(kind)))
    odometry = estimator.create_publisher(Odometry, "odometry", 10)
    estimator.create_subscription(Imu, "imu", lambda _: None, 10)
    estimator.create_subscription(JointState, "joint_states", lambda _: odometry.publish(stamped(Odometry)), 10)
    others = [Node(name) for name in ("mapper", "mission", "controller")]
    for node in others:
        node.create_subscription(Odometry, "odometry", lambda _: None, 10)
        node.create_timer(PERIOD_S, lambda: None)
    return [robot, estimator, *others]


def wall_clock(parity: int) -> tuple[list[float], float]:
    """As :func:`simulated`, of nodes whose callbacks are wrapped while they are watched."""
    context = SimContext()
    spent = []
    with context.as_default(), Monitor(chains=[("/joint_states", "/odometry")]) as monitor:
        nodes = nodes_of_a_brain(context)
        for number in range(SECONDS):
            undo = [monitor.attach_node(node) for node in nodes] if number % 2 == parity else []
            gc.collect()
            began = time.process_time()
            context.run_for(1.0)
            spent.append(time.process_time() - began)
            for function in undo:
                function()
    summary = monitor.summary()
    seen = sum(c.calls for c in summary.callbacks) + sum(t.messages for t in summary.topics)
    return spent[1:], seen / (SECONDS / 2 / PERIOD_S)


def measure(run: Callable[[int], tuple[list[float], float]], pairs: int) -> tuple[list[float], float]:
    """Return what the monitor cost in each second, ms a period, in order of size; and what it saw in a period."""
    run(0)
    costs, seen = [], 0.0
    for _ in range(pairs):
        (even, seen), (odd, _) = run(0), run(1)
        # Entry k is of the second k + 1: the odd ones were watched in the second run.
        for number, (first, second) in enumerate(zip(even, odd, strict=False), 1):
            watched, bare = (second, first) if number % 2 else (first, second)
            costs.append(1e3 * (watched - bare) * PERIOD_S)
    return sorted(costs), seen


def repeat(run: Callable[[int], tuple[list[float], float]], pairs: int) -> tuple[list[float], float]:
    """Return the costs of several runs, in order of size; and what was seen in a period."""
    found = [run(0) for _ in range(max(3, pairs))]
    return sorted(cost for costs, _ in found for cost in costs), found[0][1]


def main() -> None:
    """Print the table."""
    pairs = int(sys.argv[1]) if len(sys.argv) > 1 else PAIRS
    title = "CPU time of the monitor, ms per 20 ms period"
    print(f"{title:<48}{'median':>9}{'middle half':>18}{'target':>9}{'callbacks and messages':>25}")
    settings: tuple[tuple[str, Callable[[], tuple[list[float], float]]], ...] = (
        ("simulated: the kit's brain, with less without", lambda: measure(simulated, pairs)),
        ("simulated: within the monitor's own calls", lambda: repeat(inside, pairs)),
        ("wall clock: idle nodes, with less without", lambda: measure(wall_clock, pairs)),
    )
    for label, find in settings:
        costs, seen = find()
        low, _, high = statistics.quantiles(costs, n=4)
        middle = f"{low:.3f} to {high:.3f}"
        print(f"{label:<48}{statistics.median(costs):>9.3f}{middle:>18}{TARGET_MS:>9.1f}{seen:>25.1f}", flush=True)
    print(f"{pairs} pairs of runs, {SECONDS - 1} simulated seconds compared in each")


if __name__ == "__main__":
    main()
