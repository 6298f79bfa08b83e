"""Hidden tests of `capstone`. They never ship to students, who see a test's name and its hint only."""

from __future__ import annotations

import numpy as np

from robotbrain.grading import Suite, expect, fail
from robotbrain.grading.suites import capstone_drives as drives
from robotbrain.grading.suites import capstone_parts as parts
from robotbrain.grading.suites import hw2_optimisation_judge as scenes
from robotbrain.grading.suites import lab_integration_planning as plans
from robotbrain.grading.suites import planner_bench as bench

suite = Suite.extending("capstone")

SCENES = range(771_406_000, 771_406_075)
"""Worlds of the final judgement of the network, four scenes each, the same for everybody."""
LOOKS = ((16, 0.02), (40, 0.02), (75, 0.05))
ROOMS_SEED = 77

WORLDS = tuple(
    7_310_000 + k for k in (0, 1, 2, 3, 5, 8, 11, 13, 16, 18, 19, 22, 23, 24, 25, 27, 29, 30, 32, 33, 34, 35)
)
"""Worlds that take the reference 13 to 18 s, without faults: each student meets some of them, all alike in difficulty."""
FIRST, MOST = 3, 6
"""Worlds that are enough if all are won, and worlds at most."""
FAULTY = tuple(7_310_000 + k for k in (2, 3, 13, 22, 23, 24, 27, 29))
"""Those of them in which there is little left to drive when the faults begin, and so little to wait for."""
DARK_S, FAILS_AT_S = (3.0, 6.0), 8.0
"""While the camera fails, and from when on the policy does."""


@suite.warm
def fill_caches():
    for seed in SCENES[: LOOKS[0][0]]:
        scenes.world(seed)


@suite.test("network", points=4, name="your own, 300 scenes that nobody has seen", reread="Exercise 1", time_limit_s=90)
def network_final(student):
    parts.judge_scenes(student, SCENES, LOOKS)


@suite.test("policy", points=3, name="100 rooms that nobody has seen", reread="Exercise 2", time_limit_s=60)
def policy_final(student):
    parts.judge_policy(student, parts.ROOMS, seed=ROOMS_SEED)


@suite.test("observe", points=4, name="other poses, other points", reread="Exercise 3.1")
def observe_random(student):
    rng = student.rng("other")
    for _ in range(3):
        parts.compare_observe(student, parts.random_question(rng))


@suite.test("observe", points=2, name="far goals, and nothing in sight", reread="Exercise 3.1, the table")
def observe_far(student):
    rng = student.rng("far")
    parts.compare_observe(student, parts.random_question(rng, far=True))
    pose, velocity, waypoint, _, last = parts.random_question(rng)
    parts.compare_observe(student, (pose, velocity, waypoint, np.zeros((0, 2)), last))


@suite.test("planner", points=3, name="keeps the robot's radius", hint="robots-radius", time_limit_s=20)
def planner_radius(student):
    planner = bench.PlannerBench.of(student, "MyPlanner")
    gap = bench.with_box(bench.walled_room(gap=-1.5), 0.0, -0.8, half=0.0)
    gap[0][3:11, 20] = 0
    planner.show(gap)
    path = plans.compare_plan(planner, gap, (-1.5, 0.0), (1.5, 0.0))
    expect(bench.clearance(path, gap) > 0.25, "the path scrapes along an obstacle", hint="robots-radius")
    narrow = bench.walled_room(gap=-1.5)
    narrow[0][14:17, 20] = 0
    planner.show(narrow)
    points = planner.ask((-1.5, 0.0), (1.5, 0.0))
    expect(len(points) == 0, "a path through a gap too narrow for the robot", hint="robots-radius")


@suite.test("planner", points=2, name="drives a robot through an unknown room", time_limit_s=60)
def planner_drives(student):
    rng = student.rng("drive")
    start, goal = ((side * float(rng.uniform(0.8, 1.1)), float(rng.uniform(-0.2, 0.2))) for side in (-1, 1))
    room = bench.with_box(bench.walled_room(gap=float(rng.uniform(-0.6, -0.4))), -0.4, -1.3)
    wrong = bench.approach(bench.PlannerBench.of(student, "MyPlanner"), room, start, goal)
    if wrong:
        fail(f"in a room that it does not know yet, the robot {wrong}", hint="robots-radius")


@suite.test("supervise", points=4, name="long stories", reread="Exercise 4", time_limit_s=20)
def supervise_stories(student):
    rng = student.rng("stories")
    for _ in range(4):
        drives.compare_decisions(student, drives.random_story(rng))


@suite.test("supervise", points=2, name="edges and numbers that are none", reread="Exercise 4", time_limit_s=20)
def supervise_edges(student):
    nan = float("nan")
    fine = ({}, {"scan_age_s": 0.5, "pose_age_s": 0.5, "image_age_s": 0.5}, drives.with_input(3, -2.0))
    for changes in fine:
        drives.compare_decisions(student, [(1.0, changes), (1.5, changes)])
    for changes in (
        {"scan_age_s": nan},
        {"image_age_s": nan},
        {"image_age_s": 2.0},
        drives.with_input(42, nan),
        drives.with_input(0, -2.5),
        {"action": (0.0, nan)},
    ):
        drives.compare_decisions(student, [(0.5, {}), (1.0, changes), (1.4, {}), (2.1, {})])


@suite.test("integrate", points=8, name="worlds that nobody has seen", reread="Exercise 5", time_limit_s=240)
def integrate_worlds(student):
    drawn = student.rng("worlds").choice(WORLDS, MOST, replace=False)
    drives.judge_worlds(student, [int(seed) for seed in drawn], FIRST)


@suite.test("integrate", points=6, name="a camera and a policy that fail", reread="Exercise 4", time_limit_s=120)
def integrate_faults(student):
    world = int(student.rng("faults").choice(FAULTY))
    drives.judge_faults(student, world, DARK_S, FAILS_AT_S)
