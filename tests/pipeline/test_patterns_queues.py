"""Queue policies on nodes against closed forms for deterministic arrivals and service."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from robotbrain.errors import InputError
from robotbrain.pipeline.patterns.queues import (
    QUEUE_POLICIES,
    keep_all_age_ns,
    keep_all_latency_ns,
    queue_form,
    run_queue,
    table,
)

MS = 1_000_000


def run(policy, period_ms, service_ms, frames, **more):
    return run_queue(
        policy, arrival_hz=1000 / period_ms, service_ms=service_ms, seconds=(frames + 0.5) * period_ms / 1000, **more
    )


@given(
    st.sampled_from(["keep_last", "drop_newest", "skip", "throttle", "credit"]),
    st.integers(5, 40),
    st.integers(2, 90),
    st.integers(1, 4),
)
@settings(max_examples=60, deadline=None)
def test_every_policy_is_its_closed_form_over_whole_cycles(policy, period, service, capacity):
    form = queue_form(policy, period * MS, service * MS, capacity)
    every = round(1e9 / form.throughput_hz)
    cycle = math.lcm(every, period * MS) if policy != "credit" else every
    assume(cycle / every < 60)
    # A full buffer is reached after about N s / (s - T) frames.
    fill = capacity * service / max(1, service - period) + 2 * capacity + 3
    frames = int((fill + 2) * every / MS / period + 2.2 * cycle / MS / period) + 5
    found = run(policy, period, service, frames, capacity=capacity)
    skip = int(fill)
    count = cycle // every
    outputs = found.latency_ms[skip : skip + count]
    assert len(outputs) == count
    assert outputs.mean() == pytest.approx(form.latency_ms)
    assert outputs.max() == pytest.approx(form.latency_max_ms)
    assert found.peak_age_ms == pytest.approx(form.peak_age_ms, rel=1e-9) or skip < count
    gaps = np.diff([out.released_ns for out in found.outputs[skip:]])
    assert set(gaps) == {every}
    assert found.backlog.max() <= form.backlog
    lost_share = found.lost / found.frames
    assert lost_share == pytest.approx(form.lost_share, abs=(2 + capacity) / found.frames + 1e-9)


@given(st.integers(5, 40), st.integers(1, 60))
@settings(max_examples=20, deadline=None)
def test_a_queue_that_keeps_all_ages_in_a_straight_line(period, extra):
    service = period + extra
    found = run("keep_all", period, service, 60)
    expected = [keep_all_latency_ns(k, period * MS, service * MS) / MS for k in range(len(found.outputs))]
    assert list(found.latency_ms) == expected
    for out, latency in zip(found.outputs, expected, strict=True):
        since = out.released_ns - period * MS
        assert keep_all_age_ns(since, period * MS, service * MS) == pytest.approx(latency * MS)
    form = queue_form("keep_all", period * MS, service * MS)
    slope = np.diff(found.latency_ms) / (np.diff([out.released_ns for out in found.outputs]) / MS)
    assert slope == pytest.approx(form.growth)
    assert found.lost == 0
    assert found.backlog[-1] + len(found.outputs) in (found.frames, found.frames - 1)


@given(st.sampled_from(QUEUE_POLICIES), st.integers(10, 40), st.floats(0.05, 1))
@settings(max_examples=30, deadline=None)
def test_without_overload_all_policies_are_alike(policy, period, load):
    service = max(1, int(load * period))
    found = run(policy, period, service, 20, interval_ms=period / 2)
    assert set(found.latency_ms) == {service}
    assert found.lost == 0
    assert found.backlog.max() == 0


@given(st.integers(5, 40), st.integers(1, 90), st.integers(1, 5))
def test_bounds_and_order_of_the_policies(period, extra, capacity):
    T, s = period * MS, (period + extra) * MS
    forms = {policy: queue_form(policy, T, s, capacity) for policy in QUEUE_POLICIES}
    bound = (capacity + 1) * s / MS
    assert forms["keep_last"].latency_max_ms <= bound
    assert forms["drop_newest"].latency_max_ms <= bound
    assert forms["keep_last"].latency_ms <= forms["drop_newest"].latency_ms + T / MS
    assert forms["credit"].peak_age_ms == min(form.peak_age_ms for form in forms.values())
    assert forms["skip"].throughput_hz <= forms["credit"].throughput_hz


def test_throttling_too_little_is_a_queue_again():
    with pytest.raises(InputError, match="interval_ns"):
        queue_form("throttle", 10 * MS, 45 * MS, interval_ns=40 * MS)
    found = run("throttle", 10, 45, 300, interval_ms=40)
    assert found.latency_ms.max() > 45
    assert found.lost > 0


def test_table_names_all():
    text = table([run_queue(policy, seconds=2) for policy in QUEUE_POLICIES])
    assert len(text.splitlines()) == 1 + len(QUEUE_POLICIES)
    assert all(policy in text for policy in QUEUE_POLICIES)


@pytest.mark.parametrize("change", [{"policy": "hope"}, {"arrival_hz": 0}, {"capacity": 0}, {"seconds": 0.01}])
def test_bad_calls_are_explained(change):
    arguments = {"policy": "keep_last"} | change
    with pytest.raises(InputError, match=r"policy|queue"):
        run_queue(arguments.pop("policy"), **arguments)
