"""Visible tests of the capstone `capstone`: what `lab.check` runs, and half of what is graded."""

# ruff: noqa: D103 - a test's name says what it tests

from __future__ import annotations

import numpy as np

from robotbrain.grading import Student, Suite, expect
from robotbrain.grading.suites import capstone_drives as drives
from robotbrain.grading.suites import capstone_parts as parts
from robotbrain.grading.suites import hw2_optimisation_judge as scenes
from robotbrain.grading.suites import hw2_optimisation_network as network_file
from robotbrain.grading.suites import lab_integration_planning as plans
from robotbrain.grading.suites.planner_bench import PlannerBench, open_room, walled_room
from robotbrain.pipeline.capstone import Launch

suite = Suite("capstone")

suite.exercise("network", title="1 A network that fits", points=14, provides=("NETWORK",))
suite.exercise("policy", title="2 A policy that drives", points=8, provides=("POLICY",))
suite.exercise("observe", title="3.1 What the policy is shown", points=10)
suite.exercise("planner", title="3.2 A planner", points=12, provides=("MyPlanner",))
suite.exercise("supervise", title="4 Who drives?", points=12, provides=("Supervisor",))
suite.exercise(
    "integrate",
    title="5 The whole brain",
    points=24,
    upstream=("network", "policy", "observe", "planner", "supervise"),
    provides=("LAUNCH", "BUDGET"),
)

# Starter parts for a student's that is not right yet, so that the whole can still be graded.
suite.reference("NETWORK", lambda: None)
suite.reference("POLICY", lambda: None)
suite.reference("observe", lambda: parts.observe)
suite.reference("MyPlanner", lambda: parts.stand_in_planner)
suite.reference("Supervisor", lambda: drives.Watchdog)

suite.crosses(Launch)
suite.forbid("observe", imports=("robotbrain.pipeline", "robotbrain.rl"), allow=("sector_ranges",))
suite.forbid("supervise", imports=("robotbrain.pipeline",))

for _key, _text in (parts.HINTS | drives.HINTS).items():
    suite.hint(_key, _text)
for _key in ("row-is-y", "return-response", "empty-when-stuck"):
    suite.hint(_key, parts.HINTS["answer-the-service"])


@suite.warm
def warm() -> None:
    """Prepare what all submissions share."""
    parts.warm()
    drives.warm()


# ---------------------------------------------------------------- 1 and 2: the files


@suite.test("network", points=2, name="the file", reread="Exercise 1", time_limit_s=30)
def network_loads(student: Student) -> None:
    network_file.load(parts.handed_in(student))


@suite.test("network", points=3, name="INT8, as TensorRT takes it", reread="Exercise 1", time_limit_s=30)
def network_int8(student: Student) -> None:
    parts.check_int8(student)


@suite.test("network", points=3, name="fits the module", reread="Exercise 1 and the brief", time_limit_s=30)
def network_fits(student: Student) -> None:
    parts.check_fits(student)


@suite.test("network", points=2, name="your own, 100 scenes to practise", reread="Exercise 1", time_limit_s=90)
def network_practice(student: Student) -> None:
    parts.judge_scenes(student, scenes.PRACTICE_WORLDS, scenes.PRACTICE_LOOKS)


@suite.test("policy", points=1, name="the file", reread="Exercise 2", time_limit_s=30)
def policy_loads(student: Student) -> None:
    parts.load_policy(student)


@suite.test("policy", points=2, name="your own", reread="Exercise 2", time_limit_s=30)
def policy_own(student: Student) -> None:
    parts.check_own_policy(student)


@suite.test("policy", points=2, name="40 rooms to practise", reread="Exercise 2", time_limit_s=60)
def policy_practice(student: Student) -> None:
    parts.judge_policy(student, parts.PRACTICE_ROOMS, seed=1)


# ---------------------------------------------------------------- 3: the glue and the planner


@suite.test("observe", points=2, name="the goal in the robot's frame", reread="Exercise 3.1, the second row")
def observe_goal(student: Student) -> None:
    rng = student.rng("goal")
    for _ in range(2):
        parts.compare_observe(student, parts.random_question(rng), slice(0, 5))


@suite.test("observe", points=2, name="36 sectors, and the last action", reread="Exercise 3.1, the table")
def observe_rest(student: Student) -> None:
    rng = student.rng("rest")
    for _ in range(2):
        parts.compare_observe(student, parts.random_question(rng), slice(5, None))


@suite.test("planner", points=4, name="your own", reread="Exercise 3.2")
def planner_own(student: Student) -> None:
    parts.check_own_planner(student)


@suite.test("planner", points=2, name="a path around a wall", reread="Exercise 3.2", time_limit_s=20)
def planner_answers(student: Student) -> None:
    gap, *ys = (float(v) for v in student.rng("wall").uniform((-0.6, 0.2, 0.2), (-0.4, 0.6, 0.6)))
    room = walled_room(gap=gap)
    bench = PlannerBench.of(student, "MyPlanner")
    bench.show(room)
    plans.compare_plan(bench, room, (-1.5, ys[0]), (1.5, ys[1]))


@suite.test("planner", points=1, name="an empty path without a map", hint="empty-when-stuck", time_limit_s=20)
def planner_without_map(student: Student) -> None:
    bench = PlannerBench.of(student, "MyPlanner")
    points = bench.ask((0.0, 0.0), (1.0, 0.0))
    expect(len(points) == 0, "a path without a map", got=points, expected="an empty path")
    # A node that never answers with a path has not understood the question.
    room = open_room()
    bench.show(room)
    plans.compare_plan(bench, room, (-1.0, 0.0), (1.0, 0.5))


# ---------------------------------------------------------------- 4: the supervisor


@suite.test("supervise", points=2, name="stops when it knows too little", reread="Exercise 4, the first row")
def supervise_stops(student: Student) -> None:
    for name, old in (("scan_age_s", 0.6), ("pose_age_s", 0.7), ("image_age_s", 2.5), ("scan_age_s", np.inf)):
        drives.compare_decisions(student, [(1.0, {}), (1.1, {name: old}), (1.2, {name: old})])


@suite.test("supervise", points=2, name="falls back to pure pursuit", reread="Exercise 4, the second row")
def supervise_falls_back(student: Student) -> None:
    place = int(student.rng("place").integers(0, 43))
    for changes in ({"image_age_s": 0.8}, {"action": (float("nan"), 0.0)}, drives.with_input(place, float("inf"))):
        drives.compare_decisions(student, [(1.0, {}), (1.1, changes), (1.2, changes)])


@suite.test("supervise", points=2, name="comes back after a second", reread="Exercise 4, the last row")
def supervise_comes_back(student: Student) -> None:
    late = {"image_age_s": 0.9}
    times = (2.1, 2.4, 2.9, 3.05, 3.5, 4.0)
    drives.compare_decisions(student, [(1.0, {}), (1.5, late), (2.0, late), *((t, {}) for t in times)])


# ---------------------------------------------------------------- 5: all together


@suite.test("integrate", points=2, name="the launch", reread="Exercise 5, the launch")
def integrate_launch(student: Student) -> None:
    drives.check_launch(student)


@suite.test("integrate", points=4, name="the practice world, in real time", reread="Exercise 5", time_limit_s=90)
def integrate_practice(student: Student) -> None:
    drives.judge_practice(student)


@suite.test("integrate", points=4, name="the budget holds", reread="Exercise 5, the budget", time_limit_s=90)
def integrate_budget(student: Student) -> None:
    drives.check_budget(student, drives.practise(student, again=False))
