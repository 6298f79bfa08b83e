"""Visible tests of homework 3, `hw3_performance`: what `lab.check` runs, and half of what is graded."""

# ruff: noqa: D103, E501 - a test's name says what it tests

from __future__ import annotations

import math

import numpy as np

from robotbrain.grading import Student, Suite, expect
from robotbrain.grading.suites import hw3_performance_drives as drives
from robotbrain.grading.suites import hw3_performance_tools as tools
from robotbrain.grading.suites import hw3_performance_traces as traces
from robotbrain.grading.suites import hw3_performance_verdict as verdict
from robotbrain.grading.suites.planner_bench import PlannerBench, open_room, walled_room, warm_students, with_box
from robotbrain.ros.context import CallbackRecord

suite = Suite("hw3_performance")

suite.exercise("ages", title="1.1 How old?", points=10, provides=("command_ages_ms", "summarise"))
suite.exercise("deadlines", title="1.2 How often too late?", points=6, provides=("deadline_misses",))
suite.exercise("rhythm", title="1.3 How regular?", points=6, provides=("timer_rhythm",))
suite.exercise("utilisation", title="2.1 Who is busy?", points=8)
suite.exercise("chain", title="2.2 What is behind a command?", points=10, provides=("causal_chain", "latency_budget"))
suite.exercise("bottleneck", title="2.3 Find the bottleneck", points=10, provides=("find_bottleneck",))
suite.exercise("gain", title="3.1 What would it gain?", points=6, provides=("predict_gain",))
suite.exercise("prediction", title="3.2 Predict the next repair", points=4, provides=("predict_service_ms",))
suite.exercise("planner", title="4.1 A planner that remembers", points=12, provides=("ReusingPlanner",))
suite.exercise("repair", title="4.2 The repair", points=8, upstream=("planner",))
suite.exercise("validate", title="5.1 Is it really better?", points=10)

# A student's planner that is not right yet must not spoil the repair: the kit's own stands in.
suite.reference("ReusingPlanner", "robotbrain.pipeline.nodes.planner:PlannerNode")
suite.warm_students(warm_students)
suite.crosses(CallbackRecord)

HELPERS = (
    "GridFrame",
    "InflationParams",
    "cropped_planner",
    "grid_from_msg",
    "inflate",
    "inherited_brain",
    "plan_path",
    "resample",
    "unmet_requirements",
    "whole_map_planner",
)
for _exercise in suite.exercises:
    suite.forbid(
        _exercise,
        imports=("robotbrain.pipeline", "robotbrain.grading", "robotbrain.monitoring"),
        allow=HELPERS,
    )

_HINTS = {
    "ns-to-ms": "Records hold nanoseconds. A millisecond is 1,000,000 of them: divide by 1e6.",
    "stamp-is-the-truth": "Where a message was SENT says nothing about when its image was TAKEN: that is its header's "
    "stamp, `trace.stamps[message]`.",
    "newest-input": "The controller acts on the NEWEST input that it took before; of several takes, the last one "
    "counts.",
    "leaves-at-the-end": "A command leaves when its callback is over: use the message's `released_ns`.",
    "taken-before-start": "What the callback works with was in the node's hands when it STARTED; what arrives "
    "meanwhile is for the next one.",
    "callback-is-not-latency": "How long one callback takes is not how old its result is: go back to the stamp of the "
    "image that the command was built on.",
    "no-input-no-age": "A command that was sent before any image arrived is built on none: leave it out.",
    "percentile-not-mean": "Latencies have long tails: the 95th percentile does not follow from mean and standard "
    "deviation. Use `np.percentile`.",
    "quantile-or-percent": "`np.percentile` wants percent: 95, not 0.95.",
    "nothing-is-nan": "Of nothing there are no percentiles: n is 0 and the rest is `float('nan')`, never 0.",
    "lost-is-late": "A message that never met its callback (dropped, or still in the queue) missed its deadline most "
    "of all. Count messages, not callbacks.",
    "from-ready-on": "The deadline runs from the moment the message was there, not from the moment its callback got "
    "the thread: waiting counts.",
    "waiting-is-late": "Without a limit a queue drops nothing, but what has been waiting in it for longer than the "
    "deadline is late all the same.",
    "not-due-yet": "A message whose deadline lies after the end of the recording is not due: nobody knows yet.",
    "just-in-time": "Exactly at the deadline is in time.",
    "spread-of-intervals": "Jitter is about the INTERVALS between successive starts: the standard deviation of "
    "`np.diff(starts)`.",
    "drift-per-second": "Drift is wanted per second: how many ms the mean interval is too long, per second of nominal "
    "time, that is 1000 (mean interval / period - 1).",
    "late-is-positive": "A timer that falls behind has intervals that are too long: positive drift.",
    "all-the-cores": "A resource with n units can be busy n times the recording's length; a thread only once.",
    "percent-or-share": "A share lies between 0 and 1.",
    "waiting-is-not-busy": "A callback that waits for the GPU holds its thread, but no core. Use its segments to see "
    "what it really asked of each resource.",
    "thread-is-held": "A thread is held from the callback's start to its end, also while it waits for the GPU.",
    "whole-recording": "Divide by the length of the whole recording, `trace.end_ns - trace.start_ns`: idle time at the "
    "ends is idle time, too.",
    "idle-is-zero": "`trace.capacity` lists what the device has. What nobody used was used 0.0 of the time.",
    "thread-is-a-pair": "Worker 0 of executor 1 and worker 0 of executor 2 are different threads: the key is "
    "(executor, worker).",
    "timers-have-inputs": "A timer is set off by no message, but its callback uses what its node took before. Go on "
    "from the newest such input, named in `follow`.",
    "sensor-first": "The chain is wanted from the sensor to the command.",
    "both-callbacks": "The callback that took the input and the timer's callback are both links of the chain.",
    "holding-is-waiting": "Waiting is the time since the link BEFORE was over, so that nothing is lost between two "
    "links: points that lie in the controller until its timer fires wait, too.",
    "work-as-it-was": "Working is from start to end as it was, including waits for a core or the GPU.",
    "long-is-not-full": "A callback that takes long but comes rarely leaves its thread idle most of the time. Look for "
    "the thread that is full.",
    "often-is-not-full": "A callback that comes often may be so short that its thread is idle most of the time. Look "
    "for the thread that is full.",
    "nothing-is-full": "No thread is occupied 90 % of the time or more, so nothing is saturated: ('', 'none').",
    "sharing-or-not": "If the role that holds the full thread longest has less than two thirds of the thread's "
    "occupied time, the trouble is the sharing; otherwise it is that role itself.",
    "where-the-time-goes": "Compare what the role's callbacks IN THAT THREAD asked of the CPU with what they asked of "
    "the GPU, over all of their segments.",
    "before-over-after": "A gain is before / after: 2 means twice as good. Faster means less time.",
    "slowest-stage": "One after the other, both go by the SUM of the stages. In a pipeline, throughput goes by the "
    "slowest stage AFTER the change, and latency still by the sum.",
    "gains-do-not-add": "Speed-ups of stages neither add nor multiply: compute the times after the change, then "
    "compare.",
    "amdahl": "Only the part that is made faster gets faster; the rest takes as long as before (Amdahl, 1967).",
    "return-response": "A service callback must return its response, also when the path is empty.",
    "empty-when-stuck": "Without a map or a route the response's path stays empty, and the callback still returns.",
    "from-the-robot-on": "Begin with the point of the old path that is nearest to where the robot IS, and drop what "
    "lies behind it.",
    "goal-moved": "A path to another goal is of no use: compare the request's goal with the one that the path was "
    "planned for.",
    "check-the-rest": "The map has changed since: check every point of the rest against the NEWEST map, inflated by "
    "the robot's radius.",
    "same-path": "Goal unchanged and the rest still free: answer with the rest of the last path, not with a new one.",
    "behind-does-not-matter": "What was put on the part that has been driven already is in nobody's way: check the "
    "rest only.",
    "lost-the-path": "A robot that is far from the path (more than 0.3 m) has lost it: plan anew from where it is.",
    "charge-the-search": "Charge what planning took: map_read for the cells read, and costmap, astar and smooth with "
    "the counts in the result of `plan_path`.",
    "charge-the-check": "Checking is work, too: charge the cells that you read and inflated (map_read, costmap).",
    "keep-requirements": "The requirements are not yours to change; `unmet_requirements(setup)` lists what is broken.",
    "build-on-the-argument": "Make the answer from the argument with `replace(setup, ...)`, so that whatever you do "
    "not name stays as it was.",
    "measure-again": "Curing one bottleneck brings up the next. Drive, run find_bottleneck on the trace, cure, and "
    "measure again; also on the other module.",
    "survivorship": "Runs that failed are part of the comparison. Leaving them out compares the easy worlds only.",
    "pair-by-world": "The two lists need not be in the same order: pair runs by their `seed`.",
    "ratio-of-pairs": "Worlds differ more than brains do. Take the ratio in each world first, then the median of the "
    "ratios.",
    "no-run-is-inf": "A run without a single end-to-end latency never acted on an image: count its latency as inf.",
    "ranks-of-the-median": "The interval goes from the k-th smallest to the k-th largest ratio, k = max(1, "
    "binom.ppf(0.025, n, 0.5)).",
    "wilson-not-wald": "p ± z·sqrt(p(1-p)/n) collapses to a point at 0 and 1. Wilson's interval does not.",
    "interval-decides": "A median above 1 may be luck. Accept only if the WHOLE interval of the speed-up lies above 1.",
    "not-worse": "Not worse means: the lower end of the interval after is at least the rate before minus 0.1. Seeing "
    "no failure is not the same.",
}
for _key, _text in _HINTS.items():
    suite.hint(_key, _text)


# ---------------------------------------------------------------- Part 1: monitor


@suite.test("ages", points=3, name="four images, five commands", reread="Exercise 1.1")
def ages_small(student: Student) -> None:
    late = int(student.rng("late").integers(8))  # ms
    trace = traces.camera_to_command(
        [(0, 2), (100, 101), (200, 240 + late), (300, 301)], [10, 60, 160, 288 + late, 360]
    )
    tools.compare_ages(
        student,
        trace,
        f"images taken at 0, 100, 200, 300 ms, their points in the controller's hands at 41, 140, {279 + late}, 340 ms; "
        f"commands started at 10, 60, 160, {288 + late}, 360 ms, each 2 ms long",
    )


@suite.test("ages", points=1, name="percentiles of a long tail", reread="Exercise 1.1, last paragraph")
def ages_summary(student: Student) -> None:
    slow = float(student.rng("tail").integers(300, 600))
    tools.compare_summary(student, [20.0] * 90 + [slow] * 7 + [900.0, 1500.0, 2500.0])


@suite.test("ages", points=1, name="percentiles of nothing", hint="nothing-is-nan", reread="Exercise 1.1")
def ages_nothing(student: Student) -> None:
    tools.compare_summary(student, [])
    # Something is not nothing.
    tools.compare_summary(student, [float(student.rng("something").integers(20, 90))])


@suite.test("deadlines", points=3, name="one slow, one stuck, one not due", reread="Exercise 1.2")
def deadlines_small(student: Student) -> None:
    rng = student.rng("deadlines")
    fates = rng.permutation(
        ["in time", "late", "stuck", *rng.choice(["in time", "late", "stuck"], rng.integers(3, 10))]
    )
    starts = {"in time": 2.0, "late": 90.0, "stuck": math.inf}  # ms after the image was taken; then 38 ms of work
    images = [(100.0 * k, 100.0 * k + starts[fate]) for k, fate in enumerate((*fates, "stuck"))]
    trace = traces.camera_to_command(images, [], end=images[-1][0] + 60)
    given = f"an image every 100 ms, in this order: {', '.join(fates)}; the last is not due yet; deadline 100 ms"
    tools.compare_misses(student, trace, 100.0, given)


@suite.test("rhythm", points=3, name="a timer that stumbles", reread="Exercise 1.3")
def rhythm_small(student: Student) -> None:
    late = 150 + int(student.rng("late").integers(20))  # ms
    trace = traces.camera_to_command([], [0, 50, 103, late, 212, 250, 301])
    tools.compare_rhythm(student, trace, 50.0, f"a 50 ms timer that started at 0, 50, 103, {late}, 212, 250 and 301 ms")


# ---------------------------------------------------------------- Part 2: identify


@suite.test("utilisation", points=4, name="camera, network, controller", reread="Exercise 2.1")
def utilisation_small(student: Student) -> None:
    inference, end = int(student.rng("network").integers(25, 36)), int(student.rng("end").integers(380, 420))  # ms
    trace = traces.camera_to_command([(0, 0), (100, 100), (200, 200)], [50, 100, 150], inference=inference, end=end)
    tools.compare_utilisation(
        student,
        trace,
        f"4 cores and a GPU for {end} ms; three images cost 8 ms CPU + {inference} ms GPU each in thread (1, 0); "
        "in (2, 0) run three callbacks of 1 ms and three of 2 ms",
    )


@suite.test("chain", points=3, name="from a command back to the camera", reread="Exercise 2.2")
def chain_small(student: Student) -> None:
    rng = student.rng("chain")
    count = int(rng.integers(3, 9))
    images = [(100.0 * k, 100.0 * k + float(rng.integers(1, 40))) for k in range(count)]
    times = [60.0, *(100.0 * k + 60 for k in sorted(rng.choice(np.arange(1, count), 2, replace=False)))]
    trace = traces.camera_to_command(images, times)
    commands = [m.id for m in trace.messages if m.name == tools.COMMAND]
    tools.compare_chains(
        student,
        trace,
        commands,
        f"{count} images and three commands; follow {{'/controller': '/perception/points'}}",
    )


@suite.test("chain", points=2, name="the parts add up", reread="Exercise 2.2, the budget")
def budget_small(student: Student) -> None:
    wait, at = 12, 70 + int(student.rng("timer").integers(20))  # ms
    links = list(traces.camera_to_command([(0, wait)], [at]).callbacks)
    tools.compare_budget(
        student,
        links,
        "taken at 0; perception from 12 to 50 ms, the controller takes the points until 51, its timer runs from "
        f"{at} to {at + 2}",
    )


@suite.test("bottleneck", points=2, name="a network that fills its thread", reread="Exercise 2.3")
def bottleneck_gpu(student: Student) -> None:
    trace, answer = traces.random_pipeline(student.rng("gpu"), "gpu")
    tools.compare_bottleneck(
        student, trace, answer, "four stages, each with a thread of its own; one of them infers for long"
    )


@suite.test("bottleneck", points=2, name="four stages in one thread", reread="Exercise 2.3")
def bottleneck_sharing(student: Student) -> None:
    trace, answer = traces.random_pipeline(student.rng("sharing"), "sharing")
    tools.compare_bottleneck(student, trace, answer, "four stages of about 45 ms in one thread, ten messages a second")


# ---------------------------------------------------------------- Part 3: propose


@suite.test("gain", points=3, name="one stage twice as fast", reread="Exercise 3.1")
def gain_small(student: Student) -> None:
    camera = float(student.rng("gain").integers(6, 15))
    tools.compare_gain(student, {"camera": camera, "network": 60.0, "planner": 30.0}, {"network": 3.0})


@suite.test("prediction", points=2, name="a faster network in a planted pipeline", reread="Exercise 3.2")
def prediction_small(student: Student) -> None:
    inference = float(student.rng("prediction").integers(50, 70))
    trace = traces.camera_to_command([(0, 0), (100, 100), (200, 200)], [50], inference=inference)
    tools.compare_prediction(student, trace, (tools.PERCEPTION, tools.IMAGE), "gpu", 4.0)


# ---------------------------------------------------------------- Part 4: implement


def _around(student: Student, label: str, x: float, y: float) -> tuple[float, float]:
    """A place within 10 cm of (x, y), another one for each student."""
    dx, dy = student.rng(label).uniform(-0.1, 0.1, 2)
    return round(x + float(dx), 3), round(y + float(dy), 3)


@suite.test("planner", points=2, name="a first path around a wall", reread="Exercise 4.1", time_limit_s=20)
def planner_first(student: Student) -> None:
    room, start, goal = walled_room(), _around(student, "start", -1.5, 0.4), _around(student, "goal", 1.5, 0.4)
    bench = PlannerBench.of(student, "ReusingPlanner")
    bench.show(room)
    drives.check_path(bench.ask(start, goal), room, start, goal)


@suite.test(
    "planner", points=2, name="the same goal: the rest of the same path", reread="Exercise 4.1", time_limit_s=20
)
def planner_reuses(student: Student) -> None:
    room, goal = walled_room(), _around(student, "goal", 1.5, 0.4)
    bench = PlannerBench.of(student, "ReusingPlanner")
    bench.show(room)
    path = bench.ask((-1.5, 0.4), goal)
    expect(len(path) > 4, "the first path is empty or very short", got=path)
    here = path[len(path) // 3] + np.array([0.06, 0.05])
    rest = bench.ask((float(here[0]), float(here[1])), goal)
    drives.check_path(rest, room, (float(here[0]), float(here[1])), goal, near=0.15)
    kept = drives.share_kept(rest, path)
    expect(kept > 0.9, "this is a new path", got=f"{kept:.0%} of its points lie on the old one", hint="same-path",
           given="the robot is 8 cm beside the path, a third of the way along")  # fmt: skip


@suite.test("planner", points=2, name="a new obstacle on the path", reread="Exercise 4.1", time_limit_s=20)
def planner_obstacle(student: Student) -> None:
    room, start, goal = open_room(), (-1.5, 0.0), (1.5, 0.0)
    bench = PlannerBench.of(student, "ReusingPlanner")
    bench.show(room)
    bench.ask(start, goal)
    blocked = with_box(room, 0.4 + float(student.rng("box").uniform(0, 0.4)), 0.0)
    bench.show(blocked)
    drives.check_path(bench.ask((-1.2, 0.0), goal), blocked, (-1.2, 0.0), goal, hint="check-the-rest")


@suite.test(
    "repair", points=1, name="keeps the requirements", hint="keep-requirements", reread="Exercise 4.2", time_limit_s=20
)
def repair_requirements(student: Student) -> None:
    from robotbrain.pipeline.inherited import inherited_brain, unmet_requirements

    repair = drives.repaired(student)
    expect(repair.own_planner or repair.setup != inherited_brain(), "nothing has changed")
    broken = unmet_requirements(repair.setup)
    expect(not broken, "a requirement is broken", got="; ".join(broken), expected="all requirements met")


@suite.test("repair", points=2, name="drives to the marker, in time", reread="Exercise 4.2", time_limit_s=60)
def repair_drives(student: Student) -> None:
    drives.check_planner(student, "", student.rng("drive"))
    run = drives.drive_repaired(student, 1)
    expect(run.success, "the robot does not arrive", got=run.reason, hint="measure-again")
    drives.check_latency(run, drives.NANO)


# ---------------------------------------------------------------- Part 5: validate


@suite.test("validate", points=2, name="speed-up in seven worlds", reread="Exercise 5.1")
def validate_speedup(student: Student) -> None:
    rng = student.rng("speedup")
    before = verdict.random_runs(
        rng, [300, 420, 900, 350, 280, 610, 380], [True, False, False, True, True, False, True]
    )
    after = verdict.random_runs(rng, [100, 110, 95, 120, 100, 90, 105], [True] * 7)
    verdict.compare_validation(student, before, after, ("speedup", "interval"))


@suite.test("validate", points=1, name="success before and after", reread="Exercise 5.1")
def validate_success(student: Student) -> None:
    rng = student.rng("success")
    worlds, won = int(rng.integers(7, 14)), int(rng.integers(2, 6))
    wins = [k < won for k in rng.permutation(worlds)]
    before = verdict.random_runs(rng, [300.0] * worlds, wins)
    after = verdict.random_runs(rng, [100.0] * worlds, [True] * worlds)
    verdict.compare_validation(student, before, after, ("before", "after"))


@suite.test("validate", points=2, name="a clear case", reread="Exercise 5.1")
def validate_clear(student: Student) -> None:
    rng = student.rng("clear")
    wins = [True, False, False, True, False, False, True, False]
    slow = verdict.random_runs(rng, [300.0] * 8, wins)
    quick = verdict.random_runs(rng, [100.0] * 8, [True] * 8)
    # Better, and the other way round: who accepts everything, or nothing, has not decided anything.
    for better in rng.permutation([True, True, False]):
        pair = (slow, quick) if better else (quick, slow)
        verdict.compare_validation(student, *pair, ("accept",))
