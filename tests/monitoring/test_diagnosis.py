"""The diagnosis names what was planted, its proposals keep their promise, and it says so in words."""

from __future__ import annotations

import json

import pytest

from robotbrain.errors import InputError
from robotbrain.monitoring.critical_path import critical_paths
from robotbrain.monitoring.diagnosis import ABSORBED, Diagnosis, diagnose
from robotbrain.monitoring.diagnosis_candidates import best_phase_ms
from robotbrain.monitoring.diagnosis_options import brain_options
from robotbrain.monitoring.generate import generate_pipeline
from robotbrain.monitoring.whatif import Faster, OwnExecutor, QueueDepth, TimerPhase, Without, outcome, predict
from tests.monitoring.small_pipelines import MS, Rig


@pytest.mark.parametrize("seed", range(2000, 2008))
def test_the_planted_bottleneck_is_named_and_the_gain_comes_true(seed: int) -> None:
    # The full acceptance, over more seeds and longer runs, is benchmarks/bottlenecks.py.
    pipeline = generate_pipeline(seed)
    found = diagnose(pipeline.run(10.0), options=pipeline.options, tries=4)
    assert found.bottleneck.kind == pipeline.fault
    assert not pipeline.culprit or found.bottleneck.culprit == pipeline.culprit
    best = found.best
    assert best is not None
    real = outcome(pipeline.changed(best.change).run(10.0), source=found.before.source)
    assert best.gain_ms == pytest.approx(found.before.p50_ms - real.p50_ms, rel=0.1)


def healthy(**extra: float) -> Rig:
    rig = Rig(cores=2)
    rig.sensor("/camera", 100)
    rig.stage("see", "/camera", ("cpu", 10), ("gpu", extra.get("gpu", 30)), out="/seen")
    rig.stage("act", "/seen", ("cpu", 5), out="/cmd_vel")
    rig.stage("log", "/seen", ("cpu", 40))
    rig.sink()
    return rig


def test_causes_add_up_and_the_report_says_what_was_found() -> None:
    trace = healthy().run(5.0)
    found = diagnose(trace, deadlines={"/cmd_vel": 40, "/act subscription /seen": 10}, options=[Faster("/log", 4)])
    assert sum(cause.mean_ms for cause in found.causes) == pytest.approx(found.before.mean_ms)
    assert sum(cause.share for cause in found.causes) == pytest.approx(1)
    assert (found.bottleneck.kind, found.bottleneck.culprit, found.bottleneck.resource) == (
        "slow inference",
        "/see",
        "gpu",
    )
    assert found.bottleneck.mean_ms == pytest.approx(30)
    assert [(d.missed, d.count) for d in found.deadlines] == [(49, 49), (0, 49)]
    text = str(found)
    for words in (
        "median 45.0 ms",
        "slow inference in /see",
        "What would help",
        "What would not",
        "/log 4 times faster",
    ):
        assert words in text
    # Off the path: no gain, and Amdahl's limit says that there is none to be had.
    assert any(p.change == Faster("/log", 4) and p.limit_ms == 0 for p in found.useless)
    assert "0.0 of 45.0 ms would go (Amdahl)" in text.replace("\n    ", " ")
    assert json.loads(json.dumps(found.to_dict()))["bottleneck"]["culprit"] == "/see"


def test_latency_and_throughput_have_different_bottlenecks() -> None:
    rig = Rig()
    rig.sensor("/camera", 100)
    # Short but never idle against long but rarely wanted: the pipeline's latency and its limit differ.
    rig.stage("see", "/camera", ("cpu", 95), out="/seen")
    rig.stage("track", "/seen", ("gpu", 60), out="/tracked")
    rig.stage("smooth", "/tracked", ("gpu", 35), out="/smoothed")
    rig.stage("act", "/smoothed", ("cpu", 1), out="/cmd_vel")
    rig.sink()
    found = diagnose(rig.run(10.0))
    assert found.bottleneck.kind in ("slow node", "slow inference")
    assert not found.throughput.limited and "in use" in str(found.throughput)
    assert found.throughput.use == pytest.approx(0.95, abs=0.03)

    slow = healthy(gpu=180).run(10.0)
    limited = diagnose(slow).throughput
    assert limited.limited and "/see" in limited.limit and limited.use == pytest.approx(1.9, rel=0.05)


def test_a_backlog_is_named_though_others_wait_behind_it() -> None:
    from robotbrain.ros.executors import Executor

    rig = Rig()
    shared = Executor(context=rig.context, num_threads=1)
    rig.sensor("/camera", 50)
    rig.sensor("/lidar", 100)
    rig.stage("see", "/camera", ("cpu", 55), out="/seen", depth=None, executor=shared)
    rig.stage("act", "/lidar", ("cpu", 2), out="/cmd_vel", depth=2, executor=shared)
    rig.sink()
    found = diagnose(rig.run(10.0))
    assert (found.bottleneck.kind, found.bottleneck.culprit) == ("stale queue", "/see")
    assert QueueDepth("/see", "/camera", 1) in [proposal.change for proposal in found.proposals]


def test_a_change_that_leaves_another_sensor_waiting_says_so() -> None:
    rig = Rig()
    rig.sensor("/lidar", 100)
    rig.sensor("/camera", 100)
    rig.stage("match", "/lidar", ("cpu", 60), out="/matched")
    rig.stage("see", "/camera", ("cpu", 40), out="/seen")
    rig.stage("act", "/seen", out="/cmd_vel")
    rig.stage("act", "/matched", out="/cmd_vel")
    rig.sink()
    trace = rig.run(4.0)
    (quick,) = predict(trace, Faster("/match", 10))
    assert quick.before.source == "/lidar" and quick.before.p50_ms == pytest.approx(60)
    assert quick.after.p50_ms == pytest.approx(6) and quick.gain == pytest.approx(0.9)
    assert quick.slowest[0] == "/camera" and quick.slowest[1] == pytest.approx(40)
    assert quick.overall_gain == pytest.approx(1 / 3)
    assert "but then /camera takes longest: median 40.0 ms" in str(diagnose(trace, options=[Faster("/match", 10)]))


def test_a_timer_out_of_step_is_put_in_step() -> None:
    rig = Rig()
    rig.sensor("/camera", 100)
    rig.stage("control", "/camera", ("cpu", 7))
    rig.timer("control", "tick", 50, ("cpu", 1), out="/cmd_vel")
    rig.sink()
    trace = rig.run(10.0)
    paths = critical_paths(trace, view="reaction")
    later = best_phase_ms(paths[0].spans[-1].place, paths, 50 * MS)
    assert later is not None and 7 < later < 10
    found = diagnose(trace)
    assert found.bottleneck.kind == "low timer rate" and found.best is not None
    assert isinstance(found.best.change, TimerPhase)
    assert found.best.after.p50_ms == pytest.approx(8 + later - 7, abs=0.1)


def test_a_saving_that_is_waited_for_further_on_is_no_gain() -> None:
    rig = Rig()
    rig.sensor("/camera", 100)
    rig.stage("see", "/camera", ("gpu", 60), out="/seen")
    rig.stage("control", "/seen")
    rig.timer("control", "tick", 100, ("cpu", 1), out="/cmd_vel")
    rig.sink()
    found = diagnose(rig.run(5.0))
    assert found.causes[0].kind == "slow inference" and found.before.p50_ms == pytest.approx(101)
    assert ABSORBED in found.causes[0].evidence
    assert found.bottleneck.kind == "low timer rate" and "is a larger part" in str(found)
    assert found.best is not None and not isinstance(found.best.change, Faster)


def test_a_hog_is_blamed_by_name_and_stopping_it_is_proposed() -> None:
    from robotbrain.monitoring.faults_device import CpuHog

    rig = healthy()
    CpuHog(6, name="hog").install(rig.context)
    found = diagnose(rig.run(4.0))
    assert (found.bottleneck.kind, found.bottleneck.culprit) == ("cpu contention", "/hog")
    assert Without("/hog") in [proposal.change for proposal in found.proposals]


def test_figures_say_in_words_what_they_show() -> None:
    figure, alt = diagnose(healthy().run(2.0)).plot()
    assert "slow inference in /see 30.0 ms" in alt and figure.get_label() == alt
    assert len(figure.axes) == 2


def test_the_options_of_a_deployment_are_those_it_leaves_open() -> None:
    from robotbrain.pipeline.deployment import Deployment

    full = brain_options("orin-nano-8gb:7W", Deployment((640, 480), one_thread=True, camera_queue=None))
    texts = [str(change) for change in full]
    assert any("INT8" in text for text in texts) and "images of 320 x 240 pixels" in texts
    assert OwnExecutor() in full and QueueDepth("/perception", "/camera/image", 1) in full
    assert any("power mode" in text for text in texts)
    assert not any("INT8" in str(change) for change in brain_options("nano-4gb", Deployment()))
    assert OwnExecutor() not in brain_options("nano-4gb", Deployment())


def test_a_deadline_of_nothing_is_refused() -> None:
    trace = healthy().run(1.0)
    with pytest.raises(InputError, match="/see subscription /camera"):
        diagnose(trace, deadlines={"/see": 10})
    with pytest.raises(InputError, match="ms > 0"):
        diagnose(trace, deadlines={"/cmd_vel": 0})


def test_a_diagnosis_is_the_same_every_time() -> None:
    trace = generate_pipeline(3).run(4.0)
    first, second = diagnose(trace), diagnose(trace)
    assert isinstance(first, Diagnosis) and str(first) == str(second)
