"""Sequential, pipelined and parallel brains on nodes against closed forms, recurrences and invariants."""

from __future__ import annotations

import itertools
import math
from collections import defaultdict

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from robotbrain.errors import InputError
from robotbrain.jetson.profiles import load_profile
from robotbrain.pipeline.deployment import Deployment
from robotbrain.pipeline.devices import detector_deployment
from robotbrain.pipeline.patterns.brains import KINDS, run_brain
from robotbrain.pipeline.patterns.forms import closed_form, overlap, waits_ns
from robotbrain.pipeline.patterns.results import Command, age_curve, mean_age_ns
from robotbrain.pipeline.patterns.stages import Device, Stage, as_device, brain_stages, split_stage

MS = 1_000_000
NAMES = ("perception", "estimation", "planning", "control")
BIG = Device(cpu_cores=16)


def cpu_stages(*times_ns):
    return [Stage(name, (("cpu", int(ns)),)) for name, ns in zip(NAMES, times_ns, strict=True)]


def run(kind, stages, period_ns, frames, device=BIG, **more):
    return run_brain(
        kind, stages, device, camera_hz=1e9 / period_ns, seconds=(frames + 1) * period_ns / 1e9, warmup=0, **more
    )


def latencies(result):
    return [command.released_ns - command.state_ns for command in result.commands]


ns_times = st.integers(1, 60 * MS)
ms_times = st.integers(1, 40).map(lambda ms: ms * MS)
periods = st.integers(5, 50).map(lambda ms: ms * MS)


# ------------------------------------------------------------ frame by frame, to the nanosecond


@given(st.lists(ns_times, min_size=4, max_size=4), st.integers(10 * MS, 80 * MS))
@settings(max_examples=25, deadline=None)
def test_sequential_brain_starts_back_to_back_with_the_newest_frame(times, period):
    stages, total = cpu_stages(*times), sum(times)
    found = latencies(run("sequential", stages, period, 60))
    assert found == list(total + waits_ns(total, period, len(found)))


@given(st.lists(ns_times, min_size=4, max_size=4), st.integers(60 * MS, 90 * MS), st.sampled_from(["cpu", "gpu"]))
@settings(max_examples=20, deadline=None)
def test_pipeline_that_keeps_up_has_the_sum_of_the_stages_as_latency(times, period, first_on):
    stages = [Stage("perception", ((first_on, times[0]),)), *cpu_stages(*times)[1:]]
    result = run("pipelined", stages, period, 40)
    assert set(latencies(result)) == {sum(times)}
    assert set(np.diff([command.released_ns for command in result.commands])) == {period}
    assert sum(result.drops.values()) == 0


@given(st.lists(st.floats(0.01, 1), min_size=4, max_size=4), st.integers(0, 3), st.floats(1.01, 4), periods)
@settings(max_examples=25, deadline=None)
def test_pipeline_with_one_saturated_stage_waits_only_there(shares, place, factor, period):
    times = [round(share * period) for share in shares]
    times[place] = slowest = round(factor * period)
    # Behind the slowest stage frames come more slowly, so that others may take longer than the camera's period.
    times[place + 1 :] = [round(factor * ns) for ns in times[place + 1 :]]
    result = run("pipelined", cpu_stages(*times), period, 60)
    found = latencies(result)
    assert found == list(sum(times) + waits_ns(slowest, period, len(found)))
    assert set(np.diff([command.released_ns for command in result.commands])) == {slowest}


@pytest.mark.parametrize("order", [(30, 50, 70, 5), (5, 70, 50, 30), (30, 50, 30, 5)])
def test_pipeline_with_several_saturated_stages_follows_the_recurrence(order):
    """Oracle: each stage in turn takes the newest of what arrived strictly before it became free."""
    period, times = 20 * MS, [t * MS + 137 * k for k, t in enumerate(order)]
    arrivals = [((k + 1) * period, (k + 1) * period) for k in range(150)]  # (when, stamp)
    for service in times:
        free, out, k = -1, [], 0
        while k < len(arrivals):
            while k + 1 < len(arrivals) and arrivals[k + 1][0] < free:
                k += 1
            start = max(free, arrivals[k][0])
            free = start + service
            out.append((free, arrivals[k][1]))
            k += 1
        arrivals = out
    result = run("pipelined", cpu_stages(*times), period, 150)
    found = [(command.released_ns, command.state_ns) for command in result.commands]
    assert len(found) > 20
    assert found == arrivals[: len(found)]


# ------------------------------------------------------------ closed forms over whole cycles


def whole_cycles(result, period_ns, out_ns, skip, tick_ns=None):
    """Commands of a whole number of cycles, and one more to close the last saw-tooth."""
    cycle = math.lcm(period_ns, round(out_ns), tick_ns or 1)
    last = result.commands[-1].released_ns
    begin = result.commands[skip].released_ns
    count = (last - begin) // cycle
    assert count >= 1
    return [c for c in result.commands[skip:] if c.released_ns <= begin + count * cycle]


def compare(form, commands, rel=1e-9):
    assert form.accuracy == "exact"
    ages = [c.released_ns - c.state_ns for c in commands[:-1]]
    times, curve = age_curve(commands)
    assert np.mean(ages) == pytest.approx(form.latency_ns, rel=rel)
    assert max(ages) == pytest.approx(form.latency_max_ns, rel=rel)
    assert mean_age_ns(times, curve) == pytest.approx(form.mean_age_ns, rel=rel)
    assert curve.max() == pytest.approx(form.peak_age_ns, rel=rel)
    rate = (len(commands) - 1) * 1e9 / (commands[-1].released_ns - commands[0].released_ns)
    assert rate == pytest.approx(form.throughput_hz, rel=rel)


@given(st.sampled_from(["sequential", "pipelined"]), st.lists(ms_times, min_size=4, max_size=4), periods)
@settings(max_examples=40, deadline=None)
def test_closed_form_is_exact_over_whole_cycles(kind, times, period):
    stages = cpu_stages(*times)
    form = closed_form(kind, stages, BIG, period)
    assume(form.accuracy == "exact")
    service = 1e9 / form.throughput_hz
    cycle = math.lcm(period, round(service))
    assume(cycle / period < 200)
    # Ratios with small terms follow the exact rule, too; those with large ones are exact by the gcd.
    result = run(kind, stages, period, int(2.2 * cycle / period) + 40)
    compare(form, whole_cycles(result, period, service, 2))


@given(st.integers(2, 4), st.tuples(ms_times, ms_times, ms_times), periods)
@settings(max_examples=20, deadline=None)
def test_several_frames_at_once(workers, times, period):
    """Perception of CPU, GPU and CPU with W frames at once: limited by camera, GPU or threads."""
    pre, gpu, post = times
    stages = [Stage("perception", (("cpu", pre), ("gpu", gpu), ("cpu", post))), *cpu_stages(1, MS, MS, MS)[1:]]
    form = closed_form("pipelined", stages, BIG, period, frames_at_once=workers)
    expected = max(period, gpu, (pre + gpu + post) / workers)
    assert form.throughput_hz == pytest.approx(1e9 / expected)
    assume(form.accuracy == "exact")
    service = pre + gpu + post
    cycle = math.lcm(period, service if form.limited_by == "perception" else round(expected))
    assume(cycle / period < 80)
    # Start of a cycle after the GPU's queue has filled, on the first frame of a group of threads. It fills slowly if
    # the GPU is only a little slower than the camera.
    slowly = math.ceil(gpu / (gpu - period)) if gpu > period else 0
    skip = (10 + 2 * slowly) * workers
    result = run(
        "pipelined", stages, period, int((2.2 * cycle + 1.2 * skip * expected) / period) + 40, frames_at_once=workers
    )
    assume(form.limited_by != "gpu" or workers * gpu != service)
    commands = whole_cycles(result, period, cycle, skip)
    compare(form, commands)
    assert result.overtaken == 0


def test_more_threads_than_the_gpu_can_feed_only_make_older_frames():
    stages = [Stage.of("perception", 2, 20, 2), *cpu_stages(1, MS, MS, MS)[1:]]
    forms = [closed_form("pipelined", stages, BIG, 10 * MS, frames_at_once=w) for w in (2, 3, 4)]
    assert [form.throughput_hz for form in forms] == [50.0] * 3
    assert [form.limited_by for form in forms] == ["gpu"] * 3
    assert np.diff([form.latency_ns for form in forms]) == pytest.approx([20 * MS] * 2)


@given(
    st.lists(st.integers(1, 20).map(lambda ms: ms * MS), min_size=3, max_size=3),
    st.integers(20, 60).map(lambda ms: ms * MS),
    st.sampled_from([5, 10, 20, 25, 40]).map(lambda ms: ms * MS),
)
@settings(max_examples=30, deadline=None)
def test_control_at_its_own_rate_reads_the_newest_state(times, period, tick):
    stages = cpu_stages(*times, MS)
    form = closed_form("parallel", stages, BIG, period, control_period_ns=tick)
    assert form.limited_by == ("camera" if period >= tick else "control")
    cycle = math.lcm(period, tick)
    result = run("parallel", stages, period, int((3 * cycle + 12 * tick) / period) + 12, control_hz=1e9 / tick)
    begin = result.commands[8].released_ns
    commands = [c for c in result.commands[8:] if c.released_ns <= begin + 2 * cycle]
    firsts = [b for a, b in itertools.pairwise(commands) if b.state_ns > a.state_ns]
    assert np.mean([c.released_ns - c.state_ns for c in firsts]) == pytest.approx(form.latency_ns)
    assert max(c.released_ns - c.state_ns for c in firsts) == pytest.approx(form.latency_max_ns)
    assert mean_age_ns(*age_curve(commands)) == pytest.approx(form.mean_age_ns)
    assert age_curve(commands)[1].max() == pytest.approx(form.peak_age_ns)
    assert np.mean([c.released_ns - c.plan_ns for c in commands[1:]]) == pytest.approx(form.plan_age_ns)
    assert set(np.diff([c.released_ns for c in commands])) == {tick}


# ------------------------------------------------------------ a device that is shared


@given(
    st.lists(st.tuples(st.sampled_from(["cpu", "gpu"]), ns_times), min_size=4, max_size=4),
    st.integers(1, 3),
    st.integers(5 * MS, 60 * MS),
    st.sampled_from(["pipelined", "parallel"]),
    st.integers(1, 3),
)
@settings(max_examples=30, deadline=None)
def test_no_brain_beats_its_bound(costs, cores, period, kind, at_once):
    stages = [Stage(name, (cost,)) for name, cost in zip(NAMES, costs, strict=True)]
    device = Device(cpu_cores=cores)
    form = closed_form(kind, stages, device, period, frames_at_once=at_once)
    result = run(kind, stages, period, 80, device, frames_at_once=at_once)
    assume(len(result.commands) > 3)
    firsts = result.first_uses
    span = firsts[-1].released_ns - firsts[0].released_ns
    # The first frame may have had the device to itself.
    slack = sum(stage.ns for stage in stages) + period + 20 * MS
    assert (len(firsts) - 1) <= (span + slack) * form.throughput_hz / 1e9 + 1e-6
    if form.accuracy == "bound":
        assert result.latency_ns.min() >= form.latency_ns
        assert result.mean_age_ms * MS >= form.latency_ns
        assert round(result.plan_age_ms.min() * MS) >= form.plan_age_ns  # a float in ms; the other counts ns
        path = stages if kind == "pipelined" else [*stages[:-2], stages[-1]]
        assert form.latency_ns == sum(stage.ns for stage in path)


@given(st.lists(st.integers(MS, 60 * MS), min_size=4, max_size=4))
@settings(max_examples=15, deadline=None)
def test_one_core_gains_nothing_from_pipelining_cpu_work(times):
    stages, one = cpu_stages(*times), Device(cpu_cores=1)
    period = sum(times) // 3
    sequential = run("sequential", stages, period, 90, one)
    pipelined = run("pipelined", stages, period, 90, one)
    assert len(pipelined.commands) <= len(sequential.commands) + 1
    assert closed_form("pipelined", stages, one, period).limited_by == "cpu"


@given(st.lists(st.tuples(st.integers(0, 60), st.integers(0, 60)), max_size=5), st.integers(1, 25))
def test_overlap_counts_what_runs_at_the_same_time(pairs, period):
    intervals = [(start, start + length) for start, length in pairs]
    counts = [
        sum(start <= t + k * period < end for start, end in intervals for k in range(-1, 130 // period + 2))
        for t in range(period)
    ]
    assert overlap(intervals, period) == max(counts)


# ------------------------------------------------------------ the kit's brain on a Jetson


@pytest.mark.parametrize("deployment", [None, detector_deployment()], ids=["kit", "detector"])
@pytest.mark.parametrize("camera_hz", [15, 30, 60])
def test_pipelined_against_sequential_on_orin_nano_is_the_closed_form_within_1_percent(deployment, camera_hz):
    stages = brain_stages("orin-nano-8gb", "15W", deployment)
    for kind in ("sequential", "pipelined"):
        result = run_brain(kind, stages, "orin-nano-8gb:15W", camera_hz=camera_hz, seconds=20)
        form = closed_form(kind, stages, "orin-nano-8gb:15W", result.period_ns)
        assert form.accuracy == "exact"
        assert result.throughput_hz == pytest.approx(form.throughput_hz, rel=0.01)
        assert result.latency_ns.mean() == pytest.approx(form.latency_ns, rel=0.01)
        assert result.mean_age_ms * MS == pytest.approx(form.mean_age_ns, rel=0.01)


def test_stages_add_up_to_the_profile():
    profile = load_profile("orin-nano-8gb", "15W")
    stages = {stage.name: stage for stage in brain_stages(profile)}
    ms = profile.callback_ms
    assert stages["perception"].on("cpu") / MS == pytest.approx(ms["perception"], abs=1e-3)
    assert stages["perception"].on("gpu") / MS == pytest.approx(profile.segmentation_ms, abs=1e-3)
    assert stages["planning"].ms == pytest.approx(ms["planner"], abs=1e-3)
    parts = ms["estimator_scan"] + ms["controller_scan"] + ms["controller_points"]
    assert stages["estimation"].ms == pytest.approx(parts, abs=1e-3)


def test_larger_images_cost_more_but_plans_do_not():
    small, large = (
        {s.name: s.ms for s in brain_stages("nano-4gb", None, Deployment(image_size=size))}
        for size in ((64, 64), (128, 128))
    )
    assert large["perception"] > 1.5 * small["perception"]
    assert large["planning"] == small["planning"]


# ------------------------------------------------------------ what a run tells


def test_same_frames_cost_the_same_in_every_brain_and_jitter_stays_in_its_range():
    stages = cpu_stages(8 * MS, 2 * MS, 6 * MS, MS)
    seen = {}
    for kind in KINDS:
        result = run(kind, stages, 40 * MS, 50, jitter=0.3, seed=7)
        lengths = defaultdict(int)
        for span in result.spans:
            if span.stage != "control":
                lengths[span.frame, span.stage] += span.end_ns - span.start_ns
        seen[kind] = {key: ns for key, ns in lengths.items() if key[0] < 45}
    assert seen["sequential"] == seen["pipelined"] == seen["parallel"]
    ratios = [ns / {s.name: s.ns for s in stages}[stage] for (_, stage), ns in seen["sequential"].items()]
    assert 0.7 <= min(ratios) < 0.75
    assert 1.25 < max(ratios) <= 1.3


def test_work_may_change_from_frame_to_frame():
    def work(frame):
        return [("cpu", 30 * MS if frame % 10 == 0 else 3 * MS)]

    stages = cpu_stages(MS, MS, 3 * MS, MS)
    stages[2] = Stage("planning", (("cpu", 3 * MS),), work)
    result = run("sequential", stages, 50 * MS, 40)
    slow = [c.state_ns // (50 * MS) for c in result.commands if c.released_ns - c.state_ns > 20 * MS]
    assert slow == [10, 20, 30, 40]
    with pytest.raises(InputError, match="fixed times"):
        closed_form("sequential", stages, BIG, 50 * MS)


@pytest.mark.parametrize("kind", KINDS)
def test_spans_add_up_and_never_overlap_on_a_thread(kind):
    stages = brain_stages(deployment=detector_deployment())
    result = run_brain(kind, stages, 6, camera_hz=25, seconds=2, warmup=0.5)
    lanes = defaultdict(list)
    for span in result.spans:
        lanes[(span.stage if kind != "sequential" else "", span.worker if kind == "sequential" else 0)].append(span)
    for spans in lanes.values():
        spans.sort(key=lambda span: span.start_ns)
        assert all(a.end_ns <= b.start_ns for a, b in itertools.pairwise(spans))
    gpu = sum(span.end_ns - span.start_ns for span in result.spans if span.resource == "gpu")
    unfinished = stages[0].on("gpu") * 1.01
    assert abs(gpu - result.busy["gpu"] * 2e9) <= unfinished


def test_a_saw_tooth_by_hand():
    commands = [Command(30, 10, 10), Command(50, 40, 10), Command(60, 40, 40)]
    times, ages = age_curve(commands)
    assert list(zip(times, ages, strict=True)) == [(30, 20), (50, 40), (50, 10), (60, 20), (60, 20)]
    assert mean_age_ns(times, ages) == pytest.approx((20 * 30 + 10 * 15) / 30)
    assert list(age_curve(commands, of="plan")[1]) == [20, 40, 40, 50, 20]


def test_frames_that_were_overtaken_are_not_used():
    stages = [Stage("perception", (("cpu", 30 * MS),)), *cpu_stages(1, MS, MS, MS)[1:]]
    result = run("pipelined", stages, 10 * MS, 300, frames_at_once=4, jitter=0.9, seed=1)
    stamps = [command.state_ns for command in result.commands]
    assert result.overtaken > 0
    assert stamps == sorted(stamps)


def test_a_run_is_a_function_of_its_arguments():
    stages = cpu_stages(8 * MS, 2 * MS, 6 * MS, MS)
    runs = [run("parallel", stages, 7 * MS, 100, Device(cpu_cores=2), jitter=0.5, seed=s) for s in (1, 1, 2)]
    assert runs[0].commands == runs[1].commands != runs[2].commands


def test_splitting_a_stage_lets_its_parts_overlap():
    stages = [Stage.of("perception", 10, 20, 10), *cpu_stages(1, MS, MS, MS)[1:]]
    parts = split_stage(stages, "perception")
    assert [part.name for part in parts[:3]] == ["perception_pre", "perception_gpu", "perception_post"]
    assert closed_form("pipelined", stages, BIG, MS).throughput_hz == pytest.approx(25)
    assert closed_form("pipelined", parts, BIG, MS).throughput_hz == pytest.approx(50)


def test_devices_can_be_named_in_four_ways():
    profile = load_profile("orin-nano-8gb", "15W")
    assert as_device("orin-nano-8gb:15W") == as_device(profile)
    assert as_device(profile).cpu_cores == profile.cpu_cores
    assert as_device(3).cpu_cores == 3


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"kind": "serial"}, "sequential"),
        ({"camera_hz": 0}, "camera_hz"),
        ({"queue_depth": 1.5}, "whole number"),
        ({"jitter": 1.0}, "jitter"),
        ({"frames_at_once": 2}, "pipelined"),
        ({"seconds": 0.1, "warmup": 1.0}, "warmup"),
        ({"device": Device(gpu=0), "stages": [Stage.of("perception", 1, 1)]}, "this device has"),
        ({"kind": "parallel", "stages": [Stage.of("control", 1)]}, "at least three"),
        ({"stages": [Stage.of("a", 1), Stage.of("a", 1)]}, "name of its own"),
    ],
)
def test_bad_calls_are_explained(change, match):
    arguments = {"kind": "sequential", "stages": cpu_stages(1, 1, 1, 1), "device": 2} | change
    with pytest.raises(InputError, match=match):
        run_brain(arguments.pop("kind"), arguments.pop("stages"), arguments.pop("device"), **arguments)


@pytest.mark.parametrize("segments", [(), (("tpu", 1),), (("cpu", 0),), (("cpu", 1.5),)])
def test_bad_stages_are_explained(segments):
    with pytest.raises(InputError, match="stage 'x'"):
        Stage("x", segments)
