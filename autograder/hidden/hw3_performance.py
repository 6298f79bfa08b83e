"""Hidden tests of `hw3_performance`. They never ship to students, who see a test's name and its hint only."""

from __future__ import annotations

import functools
import json
import math
from pathlib import Path

import numpy as np

from robotbrain.grading import Suite, expect
from robotbrain.grading.suites import hw3_performance_drives as drives
from robotbrain.grading.suites import hw3_performance_tools as tools
from robotbrain.grading.suites import hw3_performance_traces as traces
from robotbrain.grading.suites import hw3_performance_verdict as verdict
from robotbrain.grading.suites import judging
from robotbrain.grading.suites.hw3_performance_drives import NANO, NX
from robotbrain.grading.suites.planner_bench import PlannerBench, open_room, walled_room, with_box

suite = Suite.extending("hw3_performance")

RECORDED = (
    ("inherited", NX, 8.0, ("perception", "gpu")),
    ("inherited", NANO, 4.0, ("perception", "cpu")),
    ("int8", NX, 2.5, ("perception", "cpu")),
    ("size", NANO, 2.5, ("perception", "sharing")),
)
"""Recorded runs of the brain between repairs: stage, module, seconds, and the bottleneck (role, cause)."""

REFERENCE = Path(__file__).parents[1] / "reference"

FRESHER = 20.0
"""How many times fresher a repaired brain's images must be than those of the inherited one."""


@functools.cache
def reference():
    """Return what the course measured; tests/test_hw3_performance.py measures it again."""
    return json.loads((REFERENCE / "hw3_performance.json").read_text(encoding="utf-8"))


def known_drives():
    """Return the runs of likely repairs as (key, run); benchmarks/repaired_drives.py makes them."""
    for key, run in json.loads((REFERENCE / "hw3_performance_drives.json").read_text(encoding="utf-8")):
        yield tuple(key), drives.Drive(**run)


PLANTED = (("cpu", False), ("cpu", True), ("gpu", False), ("gpu", True), ("sharing", False), ("none", False))
"""Cause of a planted bottleneck, and whether all stages share a thread."""
PIPELINES = 5
"""Planted pipelines of each kind: made before the first submission comes; a student's seed says which are asked."""


@functools.cache
def _pipeline(cause, one_thread, which):
    rng = np.random.default_rng([0x71BE, traces.PLANTS.index(cause), one_thread, which])
    return traces.random_pipeline(rng, cause, one_thread=one_thread)


def _planted(rng, cause, one_thread=False):
    """Return one of the planted traces and its bottleneck (role, cause)."""
    return _pipeline(cause, one_thread, int(rng.integers(PIPELINES)))


def _random_trace(rng, images=12, limit=math.inf):
    """Images at about 10 Hz, some of which wait long or for ever; commands at 20 Hz from before the first image."""
    taken = np.cumsum(rng.uniform(80, 120, images)).round(1)
    starts, free = [], 0.0
    for time in taken:
        start = max(time + float(rng.uniform(0.2, 3)), free)
        if start - time > limit or rng.random() < 0.15:
            starts.append(math.inf)
            continue
        starts.append(start)
        free = start + 48.0 + float(rng.exponential(35.0))
    commands = np.arange(5.0, taken[-1] + 120.0, 50.0) + rng.uniform(0, 6, len(np.arange(5.0, taken[-1] + 120.0, 50.0)))
    return traces.camera_to_command(
        [(float(t), float(s)) for t, s in zip(taken, starts, strict=True)],
        [float(c) for c in commands],
        inference=float(rng.uniform(20, 40)),
    )


@suite.test("ages", points=3, name="more images, late ones, lost ones", reread="Exercise 1.1")
def ages_random(student):
    rng = student.rng("ages")
    for _ in range(3):
        tools.compare_ages(student, _random_trace(rng), "twelve images, some of which wait or get lost")


@suite.test("ages", points=1, name="in the real brain", reread="Exercise 1.1", time_limit_s=30)
def ages_brain(student):
    # Followed independently by the kit while the brain ran; it counts from the first image AND the first scan on.
    run = traces.brain_run("size")
    answer = judging.as_numbers(student.command_ages_ms(traces.hand_over(student, run.trace)))
    count = len(run.camera_age_ms)
    expect(answer is not None and answer.ndim == 1 and len(answer) >= count, "commands are missing", expected=count)
    judging.compare(answer[len(answer) - count :], run.camera_age_ms)


@suite.test("ages", points=1, name="other percentiles", reread="Exercise 1.1, last paragraph")
def ages_percentiles(student):
    rng = student.rng("percentiles")
    for n in (1, 7, 200):
        tools.compare_summary(student, rng.lognormal(4.0, 1.0, n).tolist())


@suite.test("deadlines", points=3, name="queues that grow and queues that drop", reread="Exercise 1.2")
def deadlines_random(student):
    rng = student.rng("deadlines")
    for deadline in (60.0, 100.0, 250.0):
        trace = _random_trace(rng, 25)
        tools.compare_misses(student, trace, deadline, f"25 images, deadline {deadline:g} ms")
    exact = traces.camera_to_command([(0, 62), (100, 162.5)], [], end=400)
    tools.compare_misses(student, exact, 100.0, "one image exactly at its deadline, one just after")
    held = traces.camera_to_command([(0, 1), (100, 380), (200, math.inf), (300, math.inf)], [], end=450)
    tools.compare_misses(student, held, 100.0, "a queue without limit")


@suite.test("rhythm", points=3, name="timers that drift and timers that do not", reread="Exercise 1.3")
def rhythm_random(student):
    rng = student.rng("rhythm")
    for period, drift in ((50.0, 0.0), (20.0, 0.8), (100.0, -1.5)):
        starts = np.arange(40) * (period + drift) + rng.uniform(0, 4, 40)
        trace = traces.camera_to_command([(3.0, 5.0)], [float(s) for s in starts])
        tools.compare_rhythm(student, trace, period, f"a {period:g} ms timer with jitter")


@suite.test("utilisation", points=3, name="planted pipelines", reread="Exercise 2.1")
def utilisation_random(student):
    rng = student.rng("utilisation")
    for cause in ("gpu", "sharing"):
        trace, _ = _planted(rng, cause)
        tools.compare_utilisation(student, trace, "four stages, 4 cores and a GPU")
    script = traces.Script()
    for k in range(4):
        begin = 20.0 + 100 * k
        script.callback("/perception", "subscription", "/camera/image", (begin, begin, begin + 90),
                        segments=[("cpu", 10), ("gpu", 30), ("dla0", 20), ("cpu", 5)], thread=(1, k % 2))  # fmt: skip
    trace = script.trace(600, {"cpu": 6, "gpu": 1, "dla0": 1, "dla1": 1}, start=10)
    tools.compare_utilisation(student, trace, "two workers of one executor, contention, an idle DLA")


@suite.test("utilisation", points=1, name="in the real brain", reread="Exercise 2.1", time_limit_s=30)
def utilisation_brain(student):
    run = traces.brain_run("size")
    resources, _ = student.utilisation(traces.hand_over(student, run.trace))
    for name, busy in run.busy.items():
        judging.compare(resources[name], busy, atol=0.03, what=f"the share of {name}", hint="all-the-cores")


@suite.test("chain", points=2, name="late images, lost images, commands without any", reread="Exercise 2.2")
def chain_random(student):
    rng = student.rng("chain")
    trace = _random_trace(rng)
    commands = [m.id for m in trace.messages if m.name == tools.COMMAND]
    tools.compare_chains(student, trace, commands, "twelve images, some of which wait or get lost")


@suite.test("chain", points=1, name="budgets with contention", reread="Exercise 2.2, the budget")
def budget_random(student):
    rng = student.rng("budget")
    for _ in range(3):
        edges = np.cumsum(rng.uniform(1, 40, 8))
        script = traces.Script()
        script.callback("/robot", "timer", "_camera", (0, 0, 0))
        for node, start, end in zip("abcd", edges[::2], edges[1::2], strict=True):
            script.callback(f"/{node}", "subscription", "/x", (start - 0.4, start, end), segments=[("cpu", 0.5)])
        links = list(script.trace(1000).callbacks)
        tools.compare_budget(student, links, "four links after the sensor's")


@suite.test(
    "chain", points=2, name="in the real brain, the budget is the latency", reread="Exercise 2.2", time_limit_s=30
)
def chain_brain(student):
    run = traces.brain_run("size")
    trace, count = run.trace, len(run.camera_age_ms)
    commands = [m for m in trace.messages if m.name == tools.COMMAND and m.id in trace.sender][-count:]
    theirs = traces.hand_over(student, trace)
    for command, age in list(zip(commands, run.camera_age_ms, strict=True))[::6]:
        links = student.causal_chain(theirs, command.id, dict(tools.FOLLOW))
        total = sum(waiting + working for _, waiting, working in student.latency_budget(links))
        judging.compare(total, age, hint="newest-input", what="the sum of the budget")


@suite.test("bottleneck", points=4, name="planted bottlenecks", reread="Exercise 2.3", time_limit_s=30)
def bottleneck_planted(student):
    rng = student.rng("bottleneck")
    right = 0
    failure = None
    for cause, alone in PLANTED:
        trace, answer = _planted(rng, cause, alone)
        try:
            tools.compare_bottleneck(student, trace, answer, "a planted pipeline")
            right += 1
        except AssertionError as error:
            failure = failure or error
    if failure is not None:
        failure.credit = 0.5 if right >= len(PLANTED) - 1 else 0.0
        raise failure


@suite.test("bottleneck", points=2, name="in the brain, between repairs", reread="Exercise 2.3", time_limit_s=30)
def bottleneck_brain(student):
    for k in student.rng("recorded").permutation(len(RECORDED)):
        stage, module, seconds, answer = RECORDED[k]
        trace = traces.brain_trace(stage, module, seconds)
        tools.compare_bottleneck(student, trace, answer, f"{stage} on {module}")


@suite.test("gain", points=3, name="other stages and several changes", reread="Exercise 3.1")
def gain_random(student):
    rng = student.rng("gain")
    for n in (2, 4, 6):
        stages = {f"stage {k}": float(rng.uniform(2, 80)) for k in range(n)}
        change = {name: float(rng.uniform(1.2, 5)) for name in list(stages)[:: max(1, n // 2)]}
        tools.compare_gain(student, stages, change)
    # The second slowest is in the way of the slowest; and a change for the worse.
    tools.compare_gain(student, {"a": 50.0, "b": 45.0, "c": 5.0}, {"a": 10.0})
    tools.compare_gain(student, {"a": 50.0, "b": 45.0}, {"b": 0.5})


@suite.test(
    "prediction", points=2, name="INT8, as it was measured", hint="amdahl", reread="Exercise 3.2", time_limit_s=30
)
def prediction_brain(student):
    stored, trace, place = reference()["int8_after_size"], traces.brain_trace("size"), (tools.PERCEPTION, tools.IMAGE)
    factor = float(student.rng("factor").uniform(1.5, 8.0))
    tools.compare_prediction(student, trace, place, "gpu", factor)
    tools.compare_prediction(student, trace, place, "gpu", stored["gpu_speedup"], stored["perception_ms"])


@suite.test("planner", points=1, name="the goal moves", hint="goal-moved", reread="Exercise 4.1", time_limit_s=20)
def planner_goal(student):
    room = walled_room()
    bench = PlannerBench.of(student, "ReusingPlanner")
    bench.show(room)
    bench.ask((-1.5, 0.4), (1.5, 0.4))
    drives.check_path(bench.ask((-1.4, 0.3), (-0.6, 0.9)), room, (-1.4, 0.3), (-0.6, 0.9), hint="goal-moved")
    drives.check_path(bench.ask((-1.4, 0.3), (-0.5, 1.1)), room, (-1.4, 0.3), (-0.5, 1.1), hint="goal-moved")


@suite.test(
    "planner", points=1, name="an obstacle behind the robot", hint="behind-does-not-matter", reread="Exercise 4.1",
    time_limit_s=20,
)  # fmt: skip
def planner_behind(student):
    room, goal = walled_room(), (1.5, 0.4)
    bench = PlannerBench.of(student, "ReusingPlanner")
    bench.show(room)
    path = bench.ask((-1.5, 0.4), goal)
    boxed = with_box(room, -1.5, 0.45)
    bench.show(boxed)
    here = path[len(path) // 2] + np.array([0.05, 0.06])
    rest = bench.ask((float(here[0]), float(here[1])), goal)
    drives.check_path(rest, boxed, (float(here[0]), float(here[1])), goal)
    kept = drives.share_kept(rest, path)
    expect(kept > 0.9, "this is a new path", got=f"{kept:.0%} kept", hint="behind-does-not-matter")


@suite.test("planner", points=1, name="far from the path", hint="lost-the-path", reread="Exercise 4.1", time_limit_s=20)
def planner_lost(student):
    room = open_room()
    bench = PlannerBench.of(student, "ReusingPlanner")
    bench.show(room)
    bench.ask((-1.5, -0.8), (1.5, -0.8))
    points = bench.ask((-0.2, 0.9), (1.5, -0.8))
    drives.check_path(points, room, (-0.2, 0.9), (1.5, -0.8), astray="lost-the-path")


@suite.test(
    "planner", points=1, name="no map, no route", hint="empty-when-stuck", reread="Exercise 4.1", time_limit_s=20
)
def planner_stuck(student):
    bench = PlannerBench.of(student, "ReusingPlanner")
    expect(len(bench.ask((0.0, 0.0), (1.0, 0.0))) == 0, "a path without a map")
    room = open_room()
    bench.show(room)
    drives.check_path(bench.ask((-1.5, 0.0), (1.5, 0.0)), room, (-1.5, 0.0), (1.5, 0.0))
    closed = room[0].copy()
    closed[:, 20] = 100
    bench.show((closed, room[1], room[2]))
    expect(len(bench.ask((-1.2, 0.0), (1.5, 0.0))) == 0, "a path through a closed wall", hint="check-the-rest")
    bench.show(room)
    drives.check_path(bench.ask((-1.2, 0.0), (1.5, 0.0)), room, (-1.2, 0.0), (1.5, 0.0))


@suite.test(
    "planner", points=2, name="pays for its work", hint="charge-the-search", reread="Exercise 4.1", time_limit_s=20
)
def planner_charges(student):
    room = walled_room()
    bench = PlannerBench.of(student, "ReusingPlanner")
    bench.show(room)
    path = bench.ask((-1.5, 0.4), (1.5, 0.4))
    expect(len(path) > 1, "the path is empty, but there is a route")
    first = dict(bench.work)
    fewest = {"map_read": room[0].size / 4, "costmap": room[0].size / 4, "astar": len(path), "smooth": len(path) / 2}
    for kind, units in fewest.items():
        expect(first.get(kind, 0.0) >= units, f"planning was not charged as {kind}", hint="charge-the-search")
    bench.ask((float(path[3][0]), float(path[3][1])), (1.5, 0.4))
    checked = bench.work
    expect("astar" not in checked, "a reused path is charged as a search", hint="same-path", credit=0.5)
    expect(sum(checked.values()) >= len(path), "the check is not charged", hint="charge-the-check", credit=0.5)


@suite.test("repair", points=1, name="whatever the module", hint="build-on-the-argument", reread="Exercise 4.2")
def repair_module(student):
    setup = drives.repaired(student, NX).setup
    expect(setup.module == NX, "the module was changed", got=setup.module, expected=NX)


@suite.test("repair", points=1, name="another world", reread="Exercise 4.2", time_limit_s=60)
def repair_other_world(student):
    drives.check_planner(student, NX, student.rng("another"))
    run = drives.drive_repaired(student, 4)
    expect(run.success, "the robot does not arrive", hint="measure-again")
    drives.check_latency(run, NANO)


@suite.test("repair", points=1, name="much fresher than inherited", hint="measure-again", time_limit_s=60)
def repair_fresher(student):
    run = drives.driven(drives.repaired(student).setup, 4)
    before = reference()["inherited"]["image_to_points_p95_ms"]
    gain = before / run.image_p95_ms
    expect(gain >= FRESHER, "images wait too long for perception", credit=0.5 if gain > 5 else 0.0)


@suite.test("repair", points=2, name="on the sister robot's Xavier NX", hint="measure-again", time_limit_s=60)
def repair_sister(student):
    drives.check_latency(drives.drive_repaired(student, 3, NX, time_limit=4.0), NX)


@suite.test("validate", points=2, name="failed runs count", hint="survivorship", reread="Exercise 5.1")
def validate_failed(student):
    rng = student.rng("failed")
    before = verdict.random_runs(
        rng, [150, math.inf, 160, math.inf, 900, 170, math.inf], [True, False, True, False, False, True, False]
    )
    after = verdict.random_runs(rng, [100, 105, 95, 300, 100, 110, 90], [True, True, True, False, True, True, True])
    verdict.compare_validation(student, before, after, ("speedup",))
    both = verdict.random_runs(rng, [150, math.inf, 160], [True, False, True])
    verdict.compare_validation(student, both, verdict.random_runs(rng, [100, math.inf, 90], [True, False, True]))
    worse = verdict.random_runs(rng, [100, math.inf, math.inf], [True, False, False])
    verdict.compare_validation(student, both, worse, ("speedup", "interval"))


@suite.test("validate", points=1, name="runs in another order", hint="pair-by-world", reread="Exercise 5.1")
def validate_order(student):
    rng = student.rng("order")
    scales = rng.uniform(150, 1500, 15)
    before = verdict.random_runs(rng, scales.tolist(), [True] * 15, first=40)
    after = verdict.random_runs(rng, (scales / rng.uniform(1.1, 4, 15)).tolist(), [True] * 15, first=40)
    after = [after[k] for k in rng.permutation(15)]
    verdict.compare_validation(student, before, after, ("speedup", "interval"))


@suite.test("validate", points=2, name="luck, harm, and too few worlds", reread="Exercise 5.1")
def validate_verdict(student):
    rng = student.rng("verdict")
    up = [1.4, 0.8, 1.5, 0.7, 1.6, 1.3, 0.9, 1.4]
    cases = [
        ([200.0 * u for u in up], [True, False] * 4, [200.0] * 8, [True] * 8),  # luck
        ([300.0] * 20, [True] * 20, [100.0] * 20, [True] * 14 + [False] * 6),  # harm
        ([300.0] * 4, [True] * 4, [100.0] * 4, [True] * 4),  # too few
        ([300.0] * 40, [True] * 40, [100.0] * 40, [True] * 40),  # enough
    ]
    for k in rng.permutation(len(cases)):
        slow, wins, quick, more_wins = cases[k]
        before, after = verdict.random_runs(rng, slow, wins), verdict.random_runs(rng, quick, more_wins)
        verdict.compare_validation(student, before, after, ("accept",))


for _key, _drive in known_drives():
    drives.KNOWN[_key] = _drive


@suite.warm
def make_recordings():
    """Let the brain drive whose traces tests read, and the planted pipelines run."""
    for stage, module, seconds, _ in RECORDED:
        traces.brain_run(stage, module, seconds)
    for cause, alone in PLANTED:
        for which in range(PIPELINES):
            _pipeline(cause, alone, which)


suite.warm(drives.warm_charges)
