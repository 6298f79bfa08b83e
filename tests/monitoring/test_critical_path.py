"""The chain of causes behind a command: known timings, sums that are exact, and the kit's own end-to-end latency."""

from __future__ import annotations

import itertools
from collections.abc import Iterable

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from robotbrain.errors import InputError
from robotbrain.monitoring.critical_path import CAUSES, Chains, Path, Place, critical_paths
from robotbrain.monitoring.critical_path_budget import latency_budget
from robotbrain.monitoring.critical_path_device import lay_out
from robotbrain.monitoring.critical_path_load import load
from robotbrain.monitoring.generate import FAULTS, generate_pipeline
from robotbrain.ros.executors import Executor
from tests.monitoring.small_pipelines import MS, Rig


def check_exact(paths: Iterable[Path]) -> None:
    """Spans fill a path without a gap, an overlap or an empty piece."""
    for path in paths:
        assert path.spans[0].begin_ns == path.origin_ns and path.spans[-1].end_ns == path.end_ns
        assert all(a.end_ns == b.begin_ns for a, b in itertools.pairwise(path.spans))
        assert all(span.length_ns > 0 and span.cause in CAUSES for span in path.spans)
        assert sum(span.length_ns for span in path.spans) == path.latency_ns


def parts(path: Path) -> list[tuple[str, str, str, float]]:
    return [(s.cause, s.place.node, s.resource, s.length_ns / MS) for s in path.spans]


def test_a_chain_is_taken_apart_into_what_it_is_made_of() -> None:
    rig = Rig(latency_ns=MS)
    rig.sensor("/camera", 100, delay_ms=7)
    rig.stage("see", "/camera", ("cpu", 10), ("gpu", 20), out="/seen")
    rig.stage("act", "/seen", ("cpu", 5), out="/cmd_vel")
    rig.sink()
    trace = rig.run(2.05)
    wanted = [
        ("sensor", "/see", "/camera", 7),
        ("transport", "/see", "/camera", 1),
        ("execution", "/see", "cpu", 10),
        ("execution", "/see", "gpu", 20),
        ("transport", "/act", "/seen", 1),
        ("execution", "/act", "cpu", 5),
    ]
    ages, reactions = critical_paths(trace), critical_paths(trace, view="reaction")
    assert len(ages) == len(reactions) == 20
    for path in (*ages, *reactions):
        assert parts(path) == wanted
    check_exact(ages)


def test_a_shared_thread_is_blamed_on_who_holds_it() -> None:
    rig = Rig()
    shared = Executor(context=rig.context, num_threads=1)
    rig.sensor("/lidar", 100)
    rig.sensor("/camera", 100)
    rig.stage("map", "/lidar", ("cpu", 40), executor=shared)
    rig.stage("see", "/camera", ("cpu", 10), out="/cmd_vel", executor=shared)
    rig.sink()
    (path, *_) = critical_paths(rig.run(1.0), sources=["/camera"])
    assert [(s.cause, s.by, s.length_ns / MS) for s in path.spans] == [
        ("queueing", Place("/map", "subscription", "/lidar"), 40),
        ("execution", None, 10),
    ]


def test_on_several_threads_the_own_node_is_blamed_before_others() -> None:
    rig = Rig()
    threads = Executor(context=rig.context, num_threads=2)
    for topic in ("/lidar", "/imu", "/camera"):
        rig.sensor(topic, 100)
    rig.stage("map", "/lidar", ("cpu", 60), executor=threads)
    rig.stage("see", "/imu", ("cpu", 20), executor=threads)
    rig.stage("see", "/camera", ("cpu", 10), out="/cmd_vel")
    rig.sink()
    (path, *_) = critical_paths(rig.run(1.0), sources=["/camera"])
    # A thread is free from 20 ms on, but both callbacks are in the node's one mutually exclusive group until then.
    assert [(s.cause, s.by, s.length_ns / MS) for s in path.spans] == [
        ("queueing", Place("/see", "subscription", "/imu"), 20),
        ("execution", None, 10),
    ]


def test_waiting_for_an_accelerator_and_for_cores_is_contention() -> None:
    rig = Rig(cores=1)
    rig.sensor("/lidar", 100)
    rig.sensor("/camera", 100)
    rig.stage("other", "/lidar", ("gpu", 30))
    rig.stage("see", "/camera", ("gpu", 10), ("cpu", 6), out="/cmd_vel")
    rig.stage("burn", "/lidar", ("gpu", 0), ("cpu", 100))
    rig.sink()
    (path, *_) = critical_paths(rig.run(0.25), sources=["/camera"])
    shown = [(s.cause, s.resource, s.by.node if s.by else "", round(s.length_ns / MS, 3)) for s in path.spans]
    # 30 ms behind the other network; then 6 ms of work on half a core.
    assert shown == [
        ("contention", "gpu", "/other", 30),
        ("execution", "gpu", "", 10),
        ("contention", "cpu", "/burn", 6),
        ("execution", "cpu", "", 6),
    ]


def test_a_timer_samples_holds_and_overtakes() -> None:
    rig = Rig()
    rig.sensor("/camera", 100)
    rig.stage("control", "/camera", ("cpu", 4))
    rig.timer("control", "tick", 30, ("cpu", 1), out="/cmd_vel")
    rig.sink()
    chains = Chains(rig.run(3.0))
    ages, reactions = chains.ages(), chains.reactions("/camera")
    check_exact((*ages, *reactions))
    # Where an image and a tick fall together, one waits for the other's callback.
    apart = [path for path in ages if all(span.cause != "queueing" for span in path.spans)]
    assert len(apart) > 60
    for path in apart:
        tick = path.end_ns - MS
        ready = path.origin_ns + 4 * MS
        first = -(-ready // (30 * MS)) * 30 * MS
        by_cause = {s.cause: s.length_ns for s in path.spans if s.cause in ("sampling", "holding")}
        assert by_cause.get("sampling", 0) == min(first, tick) - ready
        assert by_cause.get("holding", 0) == max(0, tick - first)
    for path in reactions:
        assert {s.cause for s in path.spans} <= {"execution", "sampling", "queueing"}

    slow = Rig()
    slow.sensor("/camera", 50)
    slow.stage("control", "/camera", ("cpu", 1))
    slow.timer("control", "tick", 400, ("cpu", 1), out="/cmd_vel")
    slow.sink()
    chains = Chains(slow.run(4.1))
    check_exact(chains.reactions("/camera"))
    for path in chains.reactions("/camera"):
        # What a later image overwrites before the timer fires is shown as such, at the timer.
        lost = [s for s in path.spans if s.cause == "superseded"]
        assert sum(s.length_ns for s in lost) % (50 * MS) == 0
        assert all(s.place.kind == "timer" for s in lost)


@settings(max_examples=24, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.integers(0, 10**6), st.sampled_from(FAULTS))
def test_spans_add_up_to_the_latency_exactly(seed: int, fault: str) -> None:
    trace = generate_pipeline(seed, fault).run(2.5)  # type: ignore[arg-type]
    chains = Chains(trace)
    for source in chains.sources:
        ages, reactions = chains.ages(source), chains.reactions(source)
        check_exact((*ages, *reactions))
        assert [path.latency_ns for path in reactions] == chains.delays(source)
        # The first command that reflects a measurement or a newer one, looked for the slow way.
        behind = [(chains.behind(m).get(source, -1), m.released_ns) for m in chains.sinks]
        for path in reactions:
            answers = [released for origin, released in behind if origin >= path.origin_ns]
            assert path.end_ns == min(answers, default=trace.end_ns) and (path.message > 0) == bool(answers)
    assert [path.latency_ns for path in chains.ages()] == chains.oldest_ns()
    budget = latency_budget(chains.reactions(chains.slowest_source))
    assert sum(row.mean_ms for row in budget.rows) == pytest.approx(budget.mean_ms)
    assert sum(row.share for row in budget.rows) == pytest.approx(1)


@pytest.mark.parametrize("seed", range(8))
def test_pieces_of_callbacks_end_when_the_callbacks_did(seed: int) -> None:
    trace = generate_pipeline(seed).run(2.0)
    pieces = lay_out(trace)
    for record in trace.callbacks:
        mine = pieces[record.id]
        assert [(p.resource, p.demand_ns) for p in mine] == list(record.segments)
        if mine:
            assert mine[0].arrived_ns == record.start_ns and mine[-1].end_ns == record.end_ns
            assert all(a.end_ns == b.arrived_ns for a, b in itertools.pairwise(mine))
            assert all(p.waited_ns >= 0 for p in mine)


@pytest.mark.parametrize("one_thread", [False, True])
def test_the_age_of_images_is_that_of_the_run_s_own_report(one_thread: bool) -> None:
    from robotbrain.pipeline.brain import drive
    from robotbrain.pipeline.deployment import Deployment

    run = drive(6000, profile="nano-4gb", trace=True, time_limit=3, deployment=Deployment(one_thread=one_thread))
    assert run.trace is not None
    ages = [p.latency_ns * 1e-6 for p in Chains(run.trace).ages("/camera/image")][-len(run.camera_age_ms) :]
    np.testing.assert_allclose(ages, run.camera_age_ms, atol=1e-9)
    oldest = np.array(Chains(run.trace).oldest_ns()) * 1e-6
    np.testing.assert_allclose(oldest[-len(run.e2e_ms) :], run.e2e_ms[-len(oldest) :], atol=1e-9)


def test_measurements_that_hang_are_counted_and_those_at_the_end_are_not() -> None:
    rig = Rig()
    rig.sensor("/camera", 100)
    rig.stage("see", "/camera", ("cpu", 300), out="/cmd_vel", depth=None)
    rig.sink()
    trace = rig.run(6.0)
    chains = Chains(trace)
    reactions = chains.reactions("/camera")
    check_exact(reactions)
    # Frame k (1 to 60) is answered at 300 k + 100 ms, so 19 are; their median is 200 * 10 + 100 ms. Of the others those
    # that have waited for longer count: 6000 - 100 k > 2100.
    answered = [path for path in reactions if path.message]
    hanging = [path for path in reactions if not path.message]
    assert [path.latency_ns // MS for path in answered] == [200 * k + 100 for k in range(1, 20)]
    assert [path.latency_ns // MS for path in hanging] == [6000 - 100 * k for k in range(20, 39)]
    assert chains.unanswered("/camera") == 41
    assert load(trace).stages[0].waiting == pytest.approx(20, abs=1)
    assert {span.place for path in hanging for span in path.spans} == {Place("/see", "subscription", "/camera")}


def test_service_answers_are_sinks_too() -> None:
    trace = generate_pipeline(5, "slow service").run(4.0)
    paths = critical_paths(trace, "/make_plan")
    check_exact(paths)
    assert len(paths) > 3
    assert all(path.spans[-1].place == Place("/planner", "service", "/make_plan") for path in paths)


def test_load_is_what_was_asked_for() -> None:
    rig = Rig(cores=2)
    rig.sensor("/camera", 100)
    rig.stage("see", "/camera", ("cpu", 30), ("gpu", 45), out="/seen")
    rig.stage("act", "/seen", ("cpu", 5), out="/cmd_vel")
    rig.sink()
    trace = rig.run(20.0)
    found = load(trace)
    assert found.resources["gpu"] == pytest.approx(0.45, rel=0.02)
    assert found.resources["cpu"] == pytest.approx(0.35 / 2, rel=0.02)
    name, use = found.saturates_first
    assert name == "the thread of /see" and use == pytest.approx(0.75, rel=0.02)
    assert found.headroom == pytest.approx(1 / 0.75, rel=0.02)
    assert found.stages[0].place == Place("/see", "subscription", "/camera")
    assert found.stages[0].cycle_ms == pytest.approx(100)


def test_what_cannot_be_followed_is_refused_in_words() -> None:
    rig = Rig()
    rig.sensor("/camera", 100)
    rig.stage("see", "/camera", ("cpu", 1), out="/cmd_vel")
    rig.sensor("/unused", 100)
    rig.sink()
    trace = rig.run(1.0)
    with pytest.raises(InputError, match="/cmd_vel"):
        critical_paths(trace, "/nothing")
    with pytest.raises(InputError, match="/camera"):
        critical_paths(trace, sources=["/unused"])
    with pytest.raises(InputError, match="'age' or 'reaction'"):
        critical_paths(trace, view="both")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="path"):
        latency_budget(())
