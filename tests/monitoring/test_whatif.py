"""The replay twin: it repeats what was recorded, and its predictions come true when the change is really made."""

from __future__ import annotations

import dataclasses
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robotbrain.errors import InputError
from robotbrain.monitoring.generate import FAULTS, Pipeline, generate_pipeline
from robotbrain.monitoring.trace import Trace
from robotbrain.monitoring.whatif import (
    Change,
    Device,
    Faster,
    MoveTo,
    OwnExecutor,
    QueueDepth,
    SmallerMessages,
    Threads,
    TimerPhase,
    TimerRate,
    Together,
    WhatIf,
    Without,
    estimate_ms,
    infer_model,
    outcome,
    predict,
    replay_trace,
)
from robotbrain.monitoring.whatif_model import timer_grid
from tests.monitoring.small_pipelines import MS, Rig

SECONDS = 8.0


def schedule(trace: Trace) -> list[tuple[object, ...]]:
    """When every callback got ready, started and ended, and what it took."""
    return sorted((r.node, r.kind, r.name, r.ready_ns, r.start_ns, r.end_ns, r.segments) for r in trace.callbacks)


@pytest.mark.parametrize("fault", FAULTS)
def test_without_a_change_the_replay_is_the_run(fault: str) -> None:
    trace = generate_pipeline(40, fault).run(5.0)  # type: ignore[arg-type]
    again = replay_trace(trace)
    pairs = zip(trace.callbacks, again.callbacks, strict=False)
    # Transport is fitted, so times may be off by a rounding; and what had begun when the trace ended is not in it.
    close = [
        abs(a.start_ns - b.start_ns) <= 20 and abs(a.end_ns - b.end_ns) <= 20
        for a, b in pairs
        if (a.node, a.kind, a.name) == (b.node, b.kind, b.name)
    ]
    assert sum(close) >= 0.98 * len(trace.callbacks) and len(again.callbacks) <= 1.02 * len(trace.callbacks)
    assert outcome(again).p50_ms == pytest.approx(outcome(trace).p50_ms, rel=1e-3)


def test_the_replay_of_the_kit_s_brain_is_the_run() -> None:
    from robotbrain.pipeline.brain import drive
    from robotbrain.pipeline.deployment import Deployment

    deployment = Deployment(one_thread=True, scan_rays=1000)
    trace = drive(6000, profile="nano-4gb:5W", deployment=deployment, trace=True, time_limit=4).trace
    assert trace is not None
    same = set(schedule(trace)) & set(schedule(replay_trace(trace)))
    assert len(same) > 0.99 * len(trace.callbacks)


def made(pipeline: Pipeline, change: Change, seconds: float = SECONDS) -> tuple[float, float, float]:
    """Return gain predicted, gain made (median, ms), and the median before."""
    study = WhatIf(pipeline.run(seconds), source="/camera")
    predicted, real, _ = study.check(change, pipeline.changed(change).run(seconds))
    return predicted.gain_ms, study.before.p50_ms - real.p50_ms, study.before.p50_ms


CHANGES: tuple[tuple[str, int, Change], ...] = (
    ("slow node", 8, Faster("/segmenter", 1.7)),
    ("slow node", 8, Faster("/controller", 0.2)),
    ("serial executor", 11, OwnExecutor(("/mapper",))),
    ("serial executor", 11, Threads("/controller", 3)),
    ("stale queue", 2, QueueDepth("/predictor", "/camera", 3)),
    ("stale queue", 2, Faster("/predictor", 2.0, "cpu")),
    ("cpu contention", 6, Device(cores=4)),
    ("cpu contention", 6, Device(cpu=1.8)),
    ("slow inference", 9, Device(gpu=2.5, cpu=0.7)),
    ("slow inference", 9, MoveTo("/fuser", "cpu", slower=1.4)),
    ("low timer rate", 15, TimerRate("/controller", "control", 7.0)),
    ("low timer rate", 15, TimerPhase("/controller", "control", 60.0)),
    ("oversized input", 12, SmallerMessages("/camera", 0.4)),
    ("slow service", 13, Faster("/planner", 3.0, kind="service", name="/make_plan")),
    ("cpu contention", 14, Without("/indexer")),
    ("slow node", 16, Together((Faster("/predictor", 2.0), Device(cpu=1.5)))),
)


@pytest.mark.parametrize(("fault", "seed", "change"), CHANGES, ids=lambda value: str(value)[:40])
def test_what_is_predicted_happens(fault: str, seed: int, change: Change) -> None:
    predicted, real, before = made(generate_pipeline(seed, fault), change)  # type: ignore[arg-type]
    assert abs(predicted - real) <= max(0.1 * abs(real), 0.02 * before)


def test_the_gain_of_quicker_work_on_one_chain_is_the_closed_form() -> None:
    rig = Rig(latency_ns=MS)
    rig.sensor("/camera", 100)
    rig.stage("see", "/camera", ("cpu", 12), ("gpu", 30), out="/seen")
    rig.stage("act", "/seen", ("cpu", 6), out="/cmd_vel")
    rig.sink()
    trace = rig.run(3.0)
    for change, gain in (
        (Faster("/see", 3), 28.0),
        (Faster("/see", 2, "gpu"), 15.0),
        (Faster("/act", 1e9), 6.0),
        (Device(cpu=2.0), 9.0),
        (Together((Faster("/see", 2, "gpu"), Faster("/see", 4, "cpu"))), 24.0),
    ):
        (prediction,) = predict(trace, change)
        assert prediction.gain_ms == pytest.approx(gain, abs=1e-4)
        assert prediction.estimate_ms == pytest.approx(gain, abs=1e-4)
    (slower,) = predict(trace, Faster("/act", 0.5))
    assert slower.gain_ms == pytest.approx(-6) and "+12%" in str(slower)
    assert predict(trace, Faster("/see", 2, "gpu"))[0].limit_ms == pytest.approx(30)


@pytest.mark.parametrize("change", [TimerRate("/control", "tick", 8.0), TimerPhase("/control", "tick", 13.0)], ids=str)
def test_a_changed_timer_fires_when_the_real_one_would(change: Change) -> None:
    def run(period_ms: float, later_ms: float) -> list[int]:
        rig = Rig()
        rig.sensor("/camera", 100)
        rig.stage("control", "/camera", ("cpu", 1))
        rig.context.run_for(later_ms * 1e-3)
        rig.timer("control", "tick", period_ms, ("cpu", 1), out="/cmd_vel")
        rig.sink()
        trace = rig.run(2.0 - later_ms * 1e-3)
        timers.append(trace)
        return [r.ready_ns for r in trace.callbacks if r.name == "tick"]

    timers: list[Trace] = []
    run(50, 0)
    wanted = run(125, 0) if isinstance(change, TimerRate) else run(50, 13)
    assert [r.ready_ns for r in replay_trace(timers[0], change).callbacks if r.name == "tick"] == wanted


def test_an_overloaded_queue_drains_to_what_theory_says() -> None:
    """D/D/1 with service 130 ms and a frame each 100 ms: the queue grows; at depth 1 a frame waits for one at most."""
    rig = Rig()
    rig.sensor("/camera", 100)
    rig.stage("see", "/camera", ("cpu", 130), out="/cmd_vel", depth=None)
    rig.sink()
    study = WhatIf(rig.run(20.0))
    assert study.before.p99_ms > 4000
    prediction = study.predict(QueueDepth("/see", "/camera", 1))
    # The age of an answered frame: its wait, at most one frame's time, and 130 ms.
    assert 130 <= prediction.after.age_p50_ms <= 230
    assert prediction.after.fresh_hz == pytest.approx(1 / 0.13, rel=0.02)


def test_a_full_queue_gives_its_depth_away() -> None:
    for depth in (1, 2, 5, 9):
        rig = Rig()
        rig.sensor("/camera", 20)
        rig.stage("see", "/camera", ("cpu", 33), out="/cmd_vel", depth=depth)
        rig.sink()
        trace = dataclasses.replace(rig.run(3.0), queue_limits={})
        assert infer_model(trace).stage("/see", "subscription", "/camera").depth == depth


@settings(max_examples=60, deadline=None)
@given(
    st.integers(1_000_000, 10**9),
    st.integers(0, 10**10),
    st.lists(st.integers(1, 4), min_size=4, max_size=40).filter(lambda steps: math.gcd(*steps) == 1),
)
def test_a_timer_s_grid_is_found_though_calls_are_missed(period: int, start: int, steps: list[int]) -> None:
    due = [start]
    for step in steps:
        due.append(due[-1] + step * period)
    assert timer_grid(due) == (period, start)


def test_times_on_no_grid_are_none() -> None:
    assert timer_grid([0, 10_000_001, 23_000_017, 31_000_005]) == (0, 0)
    assert timer_grid([5]) == (0, 0)


def test_what_was_lost_or_late_on_its_way_is_so_in_the_replay() -> None:
    from robotbrain.monitoring.faults import DropFrames, LateFrames

    rig = Rig(latency_ns=MS)
    DropFrames("/camera", 0.3, 2.0).install(rig.context)
    LateFrames("/seen", 20.0, 0.5, jitter_ms=8.0).install(rig.context)
    rig.sensor("/camera", 50)
    rig.stage("see", "/camera", ("cpu", 10), out="/seen")
    rig.stage("act", "/seen", ("cpu", 5), out="/cmd_vel")
    rig.sink()
    trace = rig.run(5.0)
    again = replay_trace(trace)
    assert schedule(again) == schedule(trace)
    assert 40 < len({r.message for r in trace.callbacks if r.name == "/camera"}) < 85
    # Twice as fast, the same frames are lost.
    (prediction,) = predict(trace, Faster("/see", 2))
    assert prediction.after.fresh_hz == pytest.approx(prediction.before.fresh_hz, rel=0.02)


def test_timers_of_one_name_are_kept_apart() -> None:
    rig = Rig(cores=1)
    rig.sensor("/camera", 100)
    rig.stage("see", "/camera", ("cpu", 10), out="/cmd_vel")
    rig.sink()
    for _ in range(3):
        rig.timer("load", "tick", 80, ("cpu", 9), out="/unused")
    trace = rig.run(4.0)
    assert schedule(replay_trace(trace)) == schedule(trace)
    assert predict(trace, Without("/load"))[0].after.p99_ms == pytest.approx(10)


def test_overlapping_callbacks_are_not_serialised_by_the_replay() -> None:
    from rclpy.callback_groups import ReentrantCallbackGroup
    from sensor_msgs.msg import CompressedImage

    from robotbrain.ros.executors import Executor

    rig = Rig()
    threads = Executor(context=rig.context, num_threads=3)
    node = rig.node("see", threads)
    publisher = node.create_publisher(CompressedImage, "/cmd_vel", 10)

    def see(_: object) -> None:
        rig.context.charge(50 * MS)
        publisher.publish(CompressedImage())

    rig.sensor("/camera", 20)
    node.create_subscription(CompressedImage, "/camera", see, 10, callback_group=ReentrantCallbackGroup())
    rig.sink()
    trace = rig.run(2.0)
    assert outcome(trace).p50_ms == pytest.approx(50)
    assert schedule(replay_trace(trace)) == schedule(trace)


def test_a_size_that_varies_tells_how_much_work_goes_by_it() -> None:
    pipeline = generate_pipeline(4, "oversized input")
    trace = pipeline.run(15.0)
    first = pipeline.nodes[0]
    task = first.tasks[0]
    mean = pipeline.sensors[0].size * task.work[0].byte_ns * 1e-6
    share = mean / (mean + task.work[0].mean_ms)
    stage = infer_model(trace).stage(first.name, "subscription", "/camera")
    assert stage.by_size("cpu") == pytest.approx(share, abs=0.06)
    assert infer_model(trace).transport.ns_per_byte == pytest.approx(pipeline.byte_ns, rel=0.01)


def test_changes_that_do_not_fit_are_refused_in_words() -> None:
    trace = generate_pipeline(1).run(2.0)
    for change, words in (
        (Faster("/nobody", 2), "/nobody"),
        (Faster("/controller", 2, kind="service", name="/x"), "has no service"),
        (QueueDepth("/controller", "/nothing"), "/nothing"),
        (TimerRate("/segmenter", "tick", 10), "has no timer"),
        (MoveTo("/segmenter", "dla0"), "dla0"),
        (SmallerMessages("/nothing", 0.5), "/camera"),
        (Without("/nobody"), "/nobody"),
        (OwnExecutor(("/nobody",)), "/nobody"),
    ):
        with pytest.raises(InputError, match=words):
            predict(trace, change)
    for wrong in (0, -1, float("nan"), True):
        with pytest.raises(InputError):
            Faster("/x", wrong)
        with pytest.raises(InputError):
            TimerRate("/x", "t", wrong)
    with pytest.raises(InputError, match="resource"):
        Faster("/x", 2, "tpu")
    with pytest.raises(InputError, match="work"):
        SmallerMessages("/x", 0.5, work=2)


def test_a_prediction_is_the_same_every_time() -> None:
    trace = generate_pipeline(2).run(5.0)
    first, second = (predict(trace, QueueDepth("/predictor", "/camera"))[0] for _ in range(2))
    assert first == second
    assert estimate_ms((), Faster("/x", 2)) == 0
