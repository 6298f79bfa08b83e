"""Figures of a recorded run: against the special-purpose watch, brute force, closed forms and direct sampling."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Twist
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.node import Node
from sensor_msgs.msg import LaserScan

from robotbrain.errors import InputError
from robotbrain.monitoring.chains import (
    CAMERA_CHAIN,
    KIT_CHAINS,
    SCAN_CHAIN,
    chain_ages,
    end_to_end_ms,
    find_chains,
    label_of,
    main_chains,
)
from robotbrain.monitoring.deadlines import SHORT_NAMES, Deadlines, jitter_of
from robotbrain.monitoring.distribution import Distribution
from robotbrain.monitoring.metrics import measure, rate_hz
from robotbrain.monitoring.queues import queue_timelines
from robotbrain.monitoring.trace import Recorder, Trace
from robotbrain.ros import SimContext, charge
from tests.monitoring.sample_runs import trace_of, watched_run

MS = 1_000_000


# ---- against the judge's own bookkeeping ----


@pytest.mark.parametrize("overloaded", [False, True])
def test_ages_along_chains_are_those_of_the_watch(overloaded: bool) -> None:
    run, _ = watched_run(overloaded)
    camera, scan = chain_ages(trace_of(overloaded), (CAMERA_CHAIN, SCAN_CHAIN))
    both = ~np.isnan(camera.age_ms) & ~np.isnan(scan.age_ms)
    assert len(run.e2e_ms) == both.sum() > 10
    np.testing.assert_allclose(camera.age_ms[both], run.camera_age_ms, rtol=1e-12)
    np.testing.assert_allclose(scan.age_ms[both], run.scan_age_ms, rtol=1e-12)
    np.testing.assert_allclose(end_to_end_ms(trace_of(overloaded)), run.e2e_ms, rtol=1e-12)


@pytest.mark.parametrize("overloaded", [False, True])
def test_misses_rates_and_plans_are_those_of_the_watch(overloaded: bool) -> None:
    run, _ = watched_run(overloaded)
    summary = measure(trace_of(overloaded))
    for (role, kind, name), short in SHORT_NAMES.items():
        assert summary.callback(role, kind, name).misses == run.deadline_misses[short], short
    rate = next(topic.rate_hz for topic in summary.topics if topic.topic == "/cmd_vel")
    assert rate == pytest.approx(run.control_hz)
    plan = summary.callback("planner", "service", "/plan").response
    assert plan.p50 == pytest.approx(np.median(run.planning_ms))
    for name, share in run.busy.items():
        assert summary.utilisation[name] == pytest.approx(share, abs=0.05)
    if overloaded:
        assert summary.misses > 100


# ---- small brains whose answers are known ----


def brain(build: Callable[[SimContext], object], seconds: float, *, latency_ns: int = 0) -> tuple[Trace, SimContext]:
    context = SimContext(latency_ns=latency_ns)
    recorder = Recorder(context)
    with context.as_default():
        build(context)
        context.run_for(seconds)
    return recorder.trace(), context


def sensor(period: float, topic: str = "/scan", offset_ms: float = 0.0) -> Node:
    """A node that publishes a scan every period, stamped ``offset_ms`` before it leaves."""
    node = Node(f"sensor_{topic.strip('/')}")
    publisher = node.create_publisher(LaserScan, topic, 10)

    def tick() -> None:
        message = LaserScan()
        stamp = node.get_clock().now().nanoseconds - round(offset_ms * MS)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
        publisher.publish(message)

    node.create_timer(period, tick)
    return node


def relay(name: str, source: str, target: str, ms: float, depth: int = 10) -> Node:
    """A node that passes scans on, without their stamps, after so many ms of work."""
    node = Node(name)
    publisher = node.create_publisher(LaserScan, target, 10)

    def take(_: Any) -> None:
        charge(round(ms * MS))
        publisher.publish(LaserScan())

    node.create_subscription(LaserScan, source, take, depth)
    return node


def actuator() -> Node:
    node = Node("wheels")
    node.create_subscription(Twist, "/cmd_vel", lambda _: None, 10)
    return node


def controller(period: float, source: str, ms: float = 0.0) -> Node:
    node = Node("controller")
    publisher = node.create_publisher(Twist, "/cmd_vel", 10)
    node.create_subscription(LaserScan, source, lambda _: None, 10)

    def control() -> None:
        charge(round(ms * MS))
        publisher.publish(Twist())

    node.create_timer(period, control)
    return node


def test_latency_through_relays_and_a_timer_is_the_closed_form() -> None:
    def build(_: SimContext) -> None:
        sensor(0.1, offset_ms=4)
        relay("first", "/scan", "/a", 7)
        relay("second", "/a", "/b", 11)
        controller(0.05, "/b", 3)

    trace, _ = brain(build, 2.0, latency_ns=1 * MS)
    (found,) = chain_ages(trace, [("/scan", "/a", "/b", "/cmd_vel")])
    # Stamped 4 ms before leaving; 3 hops of 1 ms, 18 ms of work: there 21 ms later. The controller starts at multiples
    # of 50 ms and takes 3 ms: alternately 50 and 100 ms after the scan left, plus 4 + 3.
    assert {round(age, 6) for age in found.known_ms} == {57.0, 107.0}
    assert np.isnan(found.age_ms[:2]).all() and not np.isnan(found.age_ms[2:]).any()
    assert main_chains(trace) == (("/scan", "/a", "/b", "/cmd_vel"),)


def test_a_callback_that_is_not_over_when_the_sink_starts_does_not_count() -> None:
    def build(context: SimContext) -> None:
        from robotbrain.ros.callback_groups import ReentrantCallbackGroup
        from robotbrain.ros.executors import MultiThreadedExecutor

        sensor(0.1)
        node = Node("controller")
        publisher = node.create_publisher(Twist, "/cmd_vel", 10)
        group = ReentrantCallbackGroup()
        node.create_subscription(LaserScan, "/scan", lambda _: charge(60 * MS), 10, callback_group=group)
        node.create_timer(0.05, lambda: publisher.publish(Twist()), callback_group=group)
        MultiThreadedExecutor(2, context=context).add_node(node)

    trace, _ = brain(build, 1.0)
    (found,) = chain_ages(trace, [("/scan", "/cmd_vel")])
    # The scan of 100 ms is ready at 160 ms, so the command at 150 ms knows none and that at 200 ms that of 100 ms.
    ages = dict(zip((found.time_ns // MS).tolist(), found.age_ms.tolist(), strict=True))
    assert math.isnan(ages[150]) and ages[200] == pytest.approx(100) and ages[250] == pytest.approx(150)


def walk_back(trace: Trace, chain: tuple[str, ...], message: int) -> float | None:
    """Follow a chain backwards from one message, the plain way: look at every earlier callback of the node."""
    if len(chain) == 1:
        return trace.stamps.get(message)
    sender = trace.sender.get(message)
    if sender is None:
        return None
    wanted = chain[-2]
    earlier = [
        c
        for c in trace.callbacks
        if c.node == sender.node and c.message and label_of(trace.message_by_id[c.message]) == wanted
    ]
    own = [c for c in earlier if c.id == sender.id]
    kept = [c for c in earlier if c.end_ns <= sender.start_ns and c.id < sender.id]
    for callback in [*own, *sorted(kept, key=lambda c: -c.id)]:
        origin = walk_back(trace, chain[:-1], callback.message)
        if origin is not None:
            return origin
    return None


@given(
    work=st.lists(st.integers(0, 130), min_size=2, max_size=2),
    period=st.sampled_from([20, 30, 70]),
    control=st.sampled_from([25, 60]),
    depth=st.integers(1, 3),
)
@settings(max_examples=15, deadline=None)
def test_the_tracker_agrees_with_walking_back(work: list[int], period: int, control: int, depth: int) -> None:
    def build(_: SimContext) -> None:
        sensor(period / 1000)
        relay("first", "/scan", "/a", work[0], depth)
        relay("second", "/a", "/b", work[1], depth)
        controller(control / 1000, "/b", 5)

    trace, _ = brain(build, 1.0)
    chain = ("/scan", "/a", "/b", "/cmd_vel")
    (found,) = chain_ages(trace, [chain])
    commands = [m for m in trace.messages if m.name == "/cmd_vel"]
    expected = [walk_back(trace, chain, m.id) for m in commands]
    ages = [math.nan if o is None else (m.released_ns - o) / MS for m, o in zip(commands, expected, strict=True)]
    np.testing.assert_allclose(found.age_ms, ages)


def test_chains_are_found_and_the_robot_is_not_part_of_them() -> None:
    trace = trace_of(False)
    chains = find_chains(trace)
    assert set(KIT_CHAINS) <= set(chains)
    assert ("/scan", "/cmd_vel") in chains
    assert all(chain.count("/cmd_vel") == 1 for chain in chains)
    services = [chain for chain in chains if "/plan (response)" in chain]
    assert services and all(len(chain) <= 6 for chain in chains)
    assert main_chains(trace) == KIT_CHAINS


def test_chains_that_make_no_sense_are_refused() -> None:
    with pytest.raises(InputError, match="two or more topics"):
        chain_ages(trace_of(False), [("/cmd_vel",)])
    with pytest.raises(InputError, match="end in the same topic"):
        end_to_end_ms(trace_of(False), [("/scan", "/cmd_vel"), ("/scan", "/map")])


# ---- queues ----


@pytest.mark.parametrize(("depth", "work_ms", "keeps_up"), [(1, 25, False), (4, 73, False), (10, 9, True)])
def test_queue_depth_is_what_sampling_the_queue_gives(depth: int, work_ms: int, keeps_up: bool) -> None:
    node: list[Node] = []

    def build(_: SimContext) -> None:
        sensor(0.01)
        node.append(relay("slow", "/scan", "/out", work_ms, depth))

    context = SimContext()
    recorder = Recorder(context)
    depths = []
    with context.as_default():
        build(context)
        for step in range(4000):  # in the middle of each quarter millisecond, so never at an event
            context.run_until(step * MS // 4 + MS // 8)
            depths.append(node[0].subscriptions[0].queue_depth())
    trace = recorder.trace()
    queue = next(q for q in queue_timelines(trace) if q.node == "/slow")
    assert queue.mean_depth == pytest.approx(np.mean(depths), rel=0.02, abs=1e-3)
    assert queue.max_depth == max(depths)
    assert queue.limit == depth and (queue.dropped == 0) == keeps_up
    assert len(queue.drop_ns) == pytest.approx(queue.dropped, abs=1)
    np.testing.assert_array_equal(queue.drop_ns % (10 * MS), 0)


def test_a_message_that_a_fault_ate_did_not_wait() -> None:
    def build(context: SimContext) -> None:
        sensor(0.01)
        relay("node", "/scan", "/out", 1)
        context.add_filter("/scan", lambda record, data: [] if record.id % 3 == 0 else [(data, 0)])

    trace, _ = brain(build, 0.5)
    queue = next(q for q in queue_timelines(trace) if q.node == "/node")
    assert queue.max_depth == 0 and queue.dropped == 0


# ---- rhythm ----


def test_jitter_of_a_known_signal() -> None:
    rng = np.random.default_rng(3)
    period, drift_ppm = 20 * MS, 150.0
    late = rng.uniform(0, 2, 2000)
    times = np.round(np.arange(2000) * period * (1 + drift_ppm * 1e-6) + late * MS).astype(np.int64)
    found = jitter_of(times, period)
    assert found.drift_ppm == pytest.approx(drift_ppm, abs=2)
    assert found.offset.max == pytest.approx(2.0, abs=0.05) and found.offset.p50 == pytest.approx(1.0, abs=0.06)
    deviation = np.abs(np.diff(times) - period) / MS
    assert found.deviation.p95 == pytest.approx(np.percentile(deviation, 95))
    assert found.missed == 0
    gappy = np.delete(times, [100, 101, 500])
    assert jitter_of(gappy, period).missed == 3
    assert jitter_of(gappy, period).drift_ppm == pytest.approx(drift_ppm, abs=2)


def test_jitter_without_a_declared_period_takes_the_median() -> None:
    found = jitter_of(np.arange(50) * 33 * MS)
    assert found.period_ms == pytest.approx(33) and not found.declared
    assert math.isnan(found.drift_ppm) and found.deviation.max == 0
    assert jitter_of([5, 7]).deviation.count == 0
    assert jitter_of([7, 7, 7, 7]).deviation.count == 0


def test_rates() -> None:
    assert rate_hz([0, 10**9, 2 * 10**9]) == 1.0
    assert math.isnan(rate_hz([5])) and math.isnan(rate_hz([5, 5])) and math.isnan(rate_hz([]))


# ---- deadlines and tables ----


def test_the_most_specific_deadline_counts() -> None:
    table = Deadlines(
        {
            ("*", "timer", "*"): 1.0,
            ("controller", "timer", "*"): 2.0,
            ("controller", "timer", "_control"): 3.0,
            ("/special", "timer", "*"): 4.0,
        }
    )
    assert table.of("/n", "", "timer", "x") == 1.0
    assert table.of("/n", "controller", "timer", "x") == 2.0
    assert table.of("/n", "controller", "timer", "_control") == 3.0
    assert table.of("/special", "controller", "timer", "_control") == 4.0
    assert table.of("/n", "controller", "service", "x") is None


@pytest.mark.parametrize(
    ("key", "limit"),
    [(("a", "timer"), 1), (("a", "tmer", "b"), 1), (("a", "timer", "b"), 0), (("a", "timer", "b"), math.nan)],
)
def test_deadlines_are_checked(key: Any, limit: float) -> None:
    with pytest.raises(InputError, match="deadline"):
        Deadlines({key: limit})


def test_a_distribution_is_numpys() -> None:
    values = np.random.default_rng(0).exponential(size=500)
    found = Distribution.of([*values, math.nan])
    assert found.count == 500
    assert (found.p50, found.p90, found.p95, found.p99) == tuple(np.percentile(values, (50, 90, 95, 99)))
    assert Distribution.of([]).to_dict() == {**dict.fromkeys(Distribution().to_dict()), "count": 0}


@pytest.mark.parametrize("overloaded", [False, True])
def test_a_summary_is_json_and_text(overloaded: bool) -> None:
    summary = measure(trace_of(overloaded))
    plain = json.loads(summary.to_json())
    assert len(plain["callbacks"]) == len(summary.callbacks)
    assert plain["end_to_end"]["p99"] == summary.end_to_end.p99
    text = str(summary)
    assert "/camera/image > /perception/points > /cmd_vel" in text and " nan " not in text
    with pytest.raises(KeyError):
        summary.callback("controller", "timer", "nothing")


def test_parts_of_a_response_add_up() -> None:
    trace = trace_of(True)
    for found in measure(trace).callbacks:
        assert found.response.mean == pytest.approx(found.queueing.mean + found.latency.mean)
        demand = sum(d.mean * d.count for d in found.demand.values()) / max(1, found.calls)
        assert found.latency.mean == pytest.approx(demand + found.contention.mean, abs=1e-9)


def test_inference_is_the_gpu_time_of_a_callback() -> None:
    image = measure(trace_of(True)).callback("perception", "subscription", "/camera/image")
    assert image.demand["gpu"].p50 == image.demand["gpu"].max > 100
    assert image.latency.p50 > image.demand["gpu"].p50


def test_an_empty_trace_has_an_empty_summary() -> None:
    empty = replace(trace_of(False), callbacks=(), messages=(), stamps={}, end_ns=0, start_ns=0, queue_limits={})
    summary = measure(empty)
    assert summary.callbacks == () and summary.end_to_end.count == 0
    json.loads(summary.to_json())
