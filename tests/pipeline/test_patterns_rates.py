"""Loops that keep a rate: closed forms, the kit's own timers as oracle, and the wall-clock loop on a fake clock."""

from __future__ import annotations

import os
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robotbrain.errors import InputError
from robotbrain.pipeline.patterns import jitter
from robotbrain.pipeline.patterns.jitter import (
    WALL_METHODS,
    JitterResult,
    measure_jitter,
    realtime_priority,
    try_realtime_priority,
)
from robotbrain.pipeline.patterns.rates import METHODS, LoopTimes, drift_ppm, loop_times, next_on_grid
from robotbrain.pipeline.patterns.stamps import timer_period
from robotbrain.ros import SimContext, charge
from robotbrain.ros.node import Node

MS = 1_000_000
works = st.lists(st.integers(0, 70 * MS), min_size=2, max_size=30)


@given(st.integers(MS, 50 * MS), works)
@settings(max_examples=40, deadline=None)
def test_timer_rule_is_that_of_the_kits_timers(period, work):
    context = SimContext()
    node = Node("loop", context=context)
    starts = []

    def call():
        starts.append(context.now_ns)
        charge(work[len(starts) - 1] if len(starts) <= len(work) else 0)

    node.create_timer(timer_period(period), call)
    context.run_until(sum(work) + (len(work) + 2) * period)
    assert starts[: len(work)] == list(loop_times("timer", period, work).starts_ns)


@given(st.integers(MS, 50 * MS), works)
@settings(max_examples=20, deadline=None)
def test_naive_sleep_is_a_program_that_sleeps(period, work):
    context = SimContext()
    starts = []
    for ns in work:
        context.sleep(period)
        starts.append(context.now_ns)
        context.sleep(ns)
    assert starts == list(loop_times("sleep", period, work).starts_ns)


@given(st.integers(10_000, 50 * MS), st.floats(0, 0.6), st.floats(0, 0.3), st.integers(3, 50))
def test_drift_without_overruns(period, load, delay, calls):
    work, wakeup = int(load * period), int(delay * period)
    for method in METHODS:
        found = loop_times(method, period, [work] * calls, wakeup)
        assert found.drift_ppm == pytest.approx(drift_ppm(method, period, work, wakeup), abs=1e-3)
    assert drift_ppm("sleep", period, 1, 1) > drift_ppm("sleep_rest", period, 1, 1) > drift_ppm("until", period, 1, 1)


@given(st.integers(1, 1000), works.map(lambda w: [ns // 10_000 for ns in w]))
def test_a_grid_is_never_left_for_long(period, work):
    """timer: each call is on the grid, or starts the moment the call before it is over."""
    found = loop_times("timer", period, work)
    on_grid = found.phase_ns == 0
    back_to_back = np.concatenate([[False], found.starts_ns[1:] == found.ends_ns[:-1]])
    assert np.all(on_grid | back_to_back)
    assert np.all(np.diff(found.starts_ns // period) >= 0)


@given(st.integers(1, 1000), works.map(lambda w: [ns // 10_000 for ns in w]))
def test_until_makes_up_for_what_it_missed(period, work):
    found = loop_times("until", period, [*work, *[0] * (sum(work) // period + 2)])
    assert np.all(found.lateness_ns >= 0)
    assert found.lateness_ns[-1] == 0


def test_one_overrun_in_four_ways():
    """Period 10, the second call takes 25."""
    work = [2, 25, 2, 2, 2]
    assert list(loop_times("sleep", 10, work).starts_ns) == [10, 22, 57, 69, 81]
    assert list(loop_times("sleep_rest", 10, work).starts_ns) == [10, 20, 45, 55, 65]
    assert list(loop_times("until", 10, work).starts_ns) == [10, 20, 45, 47, 50]
    timer = loop_times("timer", 10, work)
    assert list(timer.starts_ns) == [10, 20, 45, 50, 60]
    assert timer.skipped == 1
    assert list(timer.lateness_ns) == [0, 0, 15, 10, 10]


@given(st.integers(-1000, 1000), st.integers(-1000, 1000), st.integers(1, 50))
def test_next_on_grid(due, now, period):
    found = next_on_grid(due, now, period)
    assert found >= max(due, now)
    assert (found - due) % period == 0
    assert found == due or found - period < now


# ------------------------------------------------------------ the wall-clock loop, on a clock that tests turn


class FakeClock:
    """Time passes by sleeping and working only; every sleep ends ``late`` ns late, looking takes ``look``."""

    def __init__(self, late=0, look=0):
        self.now, self.late, self.look = 5_000, late, look

    def read(self):
        self.now += self.look
        return self.now

    def sleep(self, seconds):
        assert seconds > 0
        self.now += round(seconds * 1e9) + self.late

    def measure(self, method, work, hz=100, calls=20):
        times = iter(work)

        def do():
            self.now += next(times)

        return measure_jitter(hz, calls / hz, method, work=do, clock=self.read, sleep=self.sleep)


@given(st.lists(st.integers(0, 35 * MS), min_size=20, max_size=20), st.integers(0, MS))
@settings(max_examples=25)
def test_wall_clock_loop_does_what_the_exact_one_says(work, late):
    for method in METHODS:
        found = FakeClock(late).measure(method, work)
        exact = loop_times(method, 10 * MS, work, late)
        assert list(found.times.starts_ns) == list(exact.starts_ns)
        assert list(found.times.ends_ns) == list(exact.ends_ns)


def test_wakeup_is_what_sleeping_was_late_by():
    for method in METHODS:
        found = FakeClock(late=70_000).measure(method, [3 * MS] * 20)
        assert found.percentiles_us(0, 100) == (70, 70)
        assert method == "sleep" or found.skipped == 0
    assert FakeClock(70_000).measure("sleep", [3 * MS] * 20).drift_ppm == pytest.approx(307_000)
    assert FakeClock(70_000).measure("timer", [3 * MS] * 20).drift_ppm == 0


def test_spinning_hides_a_late_wakeup():
    spun = FakeClock(late=200_000, look=100).measure("spin", [3 * MS] * 20)
    slept = FakeClock(late=200_000, look=100).measure("timer", [3 * MS] * 20)
    assert max(spun.wakeup_us) < 1 < 200 <= min(slept.wakeup_us)


def test_results_are_in_the_units_they_say():
    times = LoopTimes("timer", 10 * MS, np.array([10, 21, 30]) * MS, np.array([11, 22, 31]) * MS)
    found = JitterResult("timer", 100, times, 0.0)
    assert list(found.wakeup_us) == [0, 1000, 0]
    assert list(found.period_error_us) == [1000, -1000]


def test_a_short_real_run_is_plausible():
    found = measure_jitter(200, 0.1)
    assert len(found.times.starts_ns) == 20
    assert np.all(np.diff(found.times.starts_ns) > 0)
    assert found.wakeup_us.min() >= 0
    assert found.priority == "normal"


# ------------------------------------------------------------ real-time priority


def test_a_refusal_says_what_to_do(monkeypatch):
    if not sys.platform.startswith("linux"):
        assert "Linux" in try_realtime_priority().reason
        return
    import resource

    def refuse(*_):
        raise PermissionError(1, "not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    for limits, word in (((0, 0), "limits.conf"), ((0, 98), "ulimit -r 50"), ((98, 98), "container")):
        monkeypatch.setattr(resource, "getrlimit", lambda _, limits=limits: limits)
        outcome = try_realtime_priority(50)
        assert not outcome.granted
        assert word in outcome.reason
        assert word in str(outcome)


def test_other_systems_are_told_so(monkeypatch):
    monkeypatch.setattr(jitter.sys, "platform", "darwin")
    with realtime_priority(10) as outcome:
        assert not outcome.granted
        assert "darwin" in outcome.reason
        assert outcome.preempt_rt is None


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="sched_getscheduler is Linux's")
def test_priority_is_given_back():
    before = os.sched_getscheduler(0)
    with realtime_priority(1) as outcome:
        assert os.sched_getscheduler(0) == (os.SCHED_FIFO if outcome.granted else before)
    assert os.sched_getscheduler(0) == before
    found = measure_jitter(500, 0.01, priority=1)
    assert found.priority.startswith("SCHED_FIFO 1" if outcome.granted else "normal (")


@pytest.mark.parametrize("call", [(0.0, 1.0, "timer"), (100, 0.001, "timer"), (100, 1, "nap")])
def test_bad_measurements_are_explained(call):
    with pytest.raises(InputError, match=r"method|hz and seconds"):
        measure_jitter(*call)


@pytest.mark.parametrize("arguments", [("nap", 1, [1]), ("sleep", 0, [1]), ("sleep", 1, []), ("sleep", 1, [-1])])
def test_bad_loops_are_explained(arguments):
    with pytest.raises(InputError, match=r"method|loop"):
        loop_times(*arguments)
    assert set(METHODS) < set(WALL_METHODS)


@pytest.mark.parametrize("priority", [0, 100, True, 1.5])
def test_bad_priorities_are_explained(priority):
    with pytest.raises(InputError, match="priority"):
        try_realtime_priority(priority)


def test_a_call_that_comes_periods_late_is_as_late_as_it_is() -> None:
    period = 1_000_000
    starts = np.array([1.0, 4.6, 5.0, 6.0]) * period  # the second call, due at 2, came 2.6 periods late
    times = LoopTimes("timer", period, starts.astype(np.int64), starts.astype(np.int64) + 1000)
    found = jitter.JitterResult("timer", 1000.0, times, 0.0)
    assert found.wakeup_us.tolist() == [0.0, 2600.0, 0.0, 0.0] and found.skipped == 2
