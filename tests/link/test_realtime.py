"""The kit's nodes under a clock that others set: late events, overload, data from other threads, no wall clock."""

from __future__ import annotations

import threading
from typing import Any

import pytest
from std_msgs.msg import Int32
from std_srvs.srv import Trigger

from robotbrain.link.realtime import LATE_NS, FollowedClock, Lag, RealtimeContext, WallClock
from robotbrain.ros import CallbackRecord
from robotbrain.ros.exceptions import CallbackError
from robotbrain.ros.node import Node


def at(context: RealtimeContext, clock: FollowedClock, seconds: float) -> None:
    """Set the clock and process what is due."""
    clock.set(round(seconds * 1e9))
    context.run_until(clock.now_ns())


@pytest.fixture
def clock() -> FollowedClock:
    return FollowedClock()


@pytest.fixture
def context(clock: FollowedClock) -> RealtimeContext:
    return RealtimeContext(clock)


def test_timers_keep_their_grid_and_overload_does_not_spiral(context: RealtimeContext, clock: FollowedClock) -> None:
    node = Node("n", context=context)
    calls: list[float] = []
    node.create_timer(0.1, lambda: calls.append(context.now_ns * 1e-9))
    at(context, clock, 0.1)
    at(context, clock, 0.2)
    at(context, clock, 1.05)  # the machine was away for eight periods
    at(context, clock, 1.1)
    at(context, clock, 1.2)
    assert calls == pytest.approx([0.1, 0.2, 1.05, 1.1, 1.2])
    assert context.lag.worst_ns == pytest.approx(0.75e9)
    assert context.lag.late == 1


def test_the_clock_runs_on_inside_a_callback(context: RealtimeContext, clock: FollowedClock) -> None:
    node = Node("n", context=context)
    records: list[CallbackRecord] = []
    context.add_callback_tap(records.append)
    seen: list[int] = []

    def work() -> None:
        seen.append(node.get_clock().now().nanoseconds)
        clock.set(130_000_000)
        seen.append(node.get_clock().now().nanoseconds)

    node.create_timer(0.1, work)
    at(context, clock, 0.1)
    assert seen == [100_000_000, 130_000_000]
    (record,) = records
    assert (record.start_ns, record.end_ns, record.demand_ns) == (100_000_000, 130_000_000, 30_000_000)


def test_charges_cost_nothing(context: RealtimeContext, clock: FollowedClock) -> None:
    node = Node("n", context=context)
    ends: list[int] = []
    context.add_callback_tap(lambda record: ends.append(record.end_ns))
    charged: list[bool] = []

    def work() -> None:
        charged.extend((context.charge(10**9), context.charge_work("anything", 1e9)))

    node.create_timer(0.1, work)
    at(context, clock, 0.1)
    assert charged == [False, False]
    assert ends == [100_000_000]


def test_data_from_another_thread_arrive(context: RealtimeContext, clock: FollowedClock) -> None:
    node = Node("n", context=context)
    got: list[int] = []
    node.create_subscription(Int32, "x", lambda msg: got.append(msg.data), 10)
    publisher = node.create_publisher(Int32, "x", 10)
    thread = threading.Thread(target=lambda: context.post(lambda value: publisher.publish(Int32(data=value)), 7))
    thread.start()
    thread.join()
    at(context, clock, 0.1)
    assert got == [7]


def test_posted_data_end_a_wait_at_once() -> None:
    """With a clock that never comes to the timer, only the posted event can end the wait."""
    context = RealtimeContext(FollowedClock())
    got: list[Any] = []
    threading.Timer(0.05, lambda: context.post(got.append, 1)).start()
    for _ in range(1000):
        context.step()
        if got:
            break
    assert got == [1]


def test_services_and_spinning_work_in_real_time() -> None:
    context = RealtimeContext(WallClock(0))
    server, asker = Node("server", context=context), Node("asker", context=context)

    def answer(_: Any, response: Any) -> Any:
        response.message = "here"
        return response

    server.create_service(Trigger, "ask", answer)
    client = asker.create_client(Trigger, "ask")
    assert client.wait_for_service(1.0)
    assert client.call(Trigger.Request(), 5.0).message == "here"
    assert not asker.create_client(Trigger, "nobody").wait_for_service(0.02)


def test_spinning_ends_at_shutdown_from_a_callback() -> None:
    context = RealtimeContext(WallClock(0))
    node = Node("n", context=context)
    node.create_timer(0.01, context.shutdown)
    assert node.executor is not None
    node.executor.spin()
    assert not context.ok()


def test_errors_in_callbacks_come_out_and_the_context_goes_on(context: RealtimeContext, clock: FollowedClock) -> None:
    node = Node("n", context=context)
    calls: list[int] = []

    def fail() -> None:
        calls.append(1)
        if len(calls) == 1:
            raise ValueError("no")

    node.create_timer(0.1, fail)
    clock.set(100_000_000)
    with pytest.raises(CallbackError):
        context.run_until(100_000_000)
    at(context, clock, 0.2)
    assert len(calls) == 2


def test_a_clock_told_to_go_back_stays(clock: FollowedClock) -> None:
    clock.set(5)
    clock.set(3)
    assert clock.now_ns() == 5 and clock.jumps_back == 1


def test_wall_clocks_are_monotonic_and_count_from_their_start() -> None:
    clock = WallClock(1_000)
    times = [clock.now_ns() for _ in range(100)]
    assert times == sorted(times) and times[0] >= 1_000
    assert clock.seconds_until(0) == 0.0


def test_lag_percentiles_bound_the_true_ones() -> None:
    lag = Lag()
    values = [1_000 * k for k in range(1, 20_001)]
    for value in values:
        lag.add(value)
    assert lag.late == sum(value >= LATE_NS for value in values)
    for percent in (50, 90, 99):
        true_ms = values[len(values) * percent // 100 - 1] * 1e-6
        assert true_ms <= lag.percentile_ms(percent) <= 2 * true_ms
