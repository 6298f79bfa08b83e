"""Hidden tests of `lab_integration`. They never ship to students, who see a test's name and its hint only."""

from __future__ import annotations

import functools
import math

import numpy as np

from robotbrain.grading import Suite, expect, fail
from robotbrain.grading.suites import lab_integration_planning as plans
from robotbrain.grading.suites import lab_integration_tools as tools
from robotbrain.grading.suites import planner_bench as bench

suite = Suite.extending("lab_integration")

PROFILES = (("nano-4gb", "5W", 30.0), ("xavier-nx", "15W", 60.0), ("agx-orin-64gb", "MAXN", 90.0))


@suite.test("preprocess", points=2, name="random images of other sizes", reread="Exercise 1.1")
def preprocess_random(student):
    rng = student.rng("preprocess")
    for shape in ((64, 64, 3), (3, 7, 3), (8, 3, 3)):
        tools.compare_preprocess(student, rng.integers(0, 256, shape, dtype=np.uint8))


@suite.test("back_project", points=3, name="a tilted camera, every pixel", reread="Exercise 1.2")
def back_project_tilted(student):
    rng = student.rng("back_project")
    for pitch in (0.14, 0.5):
        depth = rng.uniform(0.3, 6.0, (5, 5))
        tools.compare_points(student, depth, tools.camera(pitch, fx=38.1, fy=50.8))


@suite.test("back_project", points=1, name="images that are not square", reread="Exercise 1.2")
def back_project_oblong(student):
    depth = student.rng("oblong").uniform(0.5, 4.0, (4, 9))
    tools.compare_points(student, depth, tools.camera(0.2, size=7))
    mounted_aside = tools.segmentation.CameraModel(38.1, 50.8, 3.2, 1.4, (0.1, -0.03, 0.26), 0.2)
    tools.compare_points(student, depth, mounted_aside)


@suite.test("deadline", points=1, name="other modules and rates", reread="Exercise 1.3")
def deadline_random(student):
    rng = student.rng("deadline")
    for rate_hz in (5.0, 12.5, 30.0, 24.0):
        module = tools.profile(float(rng.uniform(1, 80)), float(rng.uniform(1, 40)))
        tools.compare_deadline(student, module, rate_hz)


@suite.test("deadline", points=1, name="the reference profiles of real modules", reread="Exercise 1.3")
def deadline_reference(student):
    for slug, mode, rate_hz in PROFILES:
        tools.compare_deadline(student, tools.reference_profile(slug, mode), rate_hz)


@suite.test("inflate", points=4, name="random maps with unknown cells", reread="Exercise 2.1")
def inflate_random(student):
    rng = student.rng("inflate")
    for _ in range(4):
        occupancy = rng.choice([0, 0, 0, 0, -1, 30, 64, 65, 100], (13, 19)).astype(np.int8)
        plans.compare_inflation(student, occupancy, 0.05, radius=0.07, decay=0.1, weight=6.0)
    # Exact in binary: two cells are exactly a radius apart, and that is lethal.
    occupancy = np.zeros((7, 7), np.int8)
    occupancy[3, 3] = 100
    plans.compare_inflation(student, occupancy, 0.25, radius=0.5, decay=0.25, weight=4.0)


# Seeds whose mazes, however they are turned, catch the wrong searches that such mazes are for, with their own hint
# (tests/test_lab_integration.py makes sure): few of them then say as much as many others.
WEIGHTED, OPEN, CORNERED = (2, 7, 20, 29, 37), (5, 19, 24, 25), (0, 2, 5, 6)


def weighted_maze(seed):
    """Costs that differ from cell to cell, and walls."""
    rng = np.random.default_rng((1, seed))
    cost = rng.uniform(1.0, 6.0, (14, 14))
    cost[rng.random(cost.shape) < 0.25] = np.inf
    cost[0, 0] = cost[-1, -1] = 1.0
    return plans.Maze(cost, (0, 0), (13, 13))


def open_maze(seed):
    """Open ground with few obstacles."""
    rng = np.random.default_rng((2, seed))
    cost = np.ones((18, 18))
    cost[rng.random(cost.shape) < 0.15] = np.inf
    cost[0, 0] = cost[8, 17] = 1.0
    return plans.Maze(cost, (0, 0), (8, 17))


def cornered_maze(seed):
    """So many obstacles that a shortest way would like to cut their corners."""
    rng = np.random.default_rng((3, seed))
    cost = np.ones((11, 11))
    cost[rng.random(cost.shape) < 0.35] = np.inf
    cost[0, 0] = cost[-1, -1] = 1.0
    return plans.Maze(cost, (0, 0), (10, 10))


@functools.cache
def mazes():
    """All mazes, by kind, with what the cheapest path through each costs."""
    made = {"weighted": (weighted_maze, WEIGHTED), "open": (open_maze, OPEN), "cornered": (cornered_maze, CORNERED)}
    return {kind: [make(seed) for seed in seeds] for kind, (make, seeds) in made.items()}


@suite.test(
    "astar", points=4, name="as cheap as the optimum on random costmaps", reread="Exercise 2.2", time_limit_s=20
)
def astar_random(student):
    for maze in plans.draw(mazes()["weighted"], 3, student.rng("weighted")):
        plans.compare_astar(student, maze)
    dear = np.ones((5, 9))
    dear[:, 4] = 150.0  # dear, but finite
    plans.compare_astar(student, plans.Maze(dear, (2, 0), (2, 8)))
    expect(plans.checked_path(student.astar(dear, (1, 1), (1, 1)), dear, (1, 1), (1, 1)) == [(1, 1)])


@suite.test("astar", points=3, name="optimal on open ground with few obstacles", reread="Exercise 2.2", time_limit_s=20)
def astar_open(student):
    for maze in plans.draw(mazes()["open"], 2, student.rng("open")):
        plans.compare_astar(student, maze)
    # The goal is first seen from the dear crossing, but cheaper to reach by the far one.
    cost = np.ones((9, 9))
    cost[:, 4] = np.inf
    cost[4, 4], cost[1, 4] = 10.0, 1.0
    plans.compare_astar(student, plans.Maze(cost, (4, 3), (4, 5)), hint="expand-by-f")


@suite.test("astar", points=2, name="no corner is cut", reread="Exercise 2.2", time_limit_s=10)
def astar_corners(student):
    rng = student.rng("corners")
    cost = np.ones((6, 6))
    cost[2, 3] = cost[3, 2] = np.inf
    for maze in (plans.Maze(cost, (2, 2), (3, 3)).turned(rng), *plans.draw(mazes()["cornered"], 2, rng)):
        plans.compare_astar(student, maze)
    shut = np.ones((5, 5))
    shut[3, 4] = shut[4, 3] = np.inf  # the goal can be reached between two corners only, that is not at all
    plans.compare_astar(student, plans.Maze(shut, (0, 0), (4, 4)).turned(rng))


@functools.cache
def detours():
    """Maps with boxes and the cheapest paths through them; few of them punish each mistake."""
    rng = np.random.default_rng(20)
    found = []
    while len(found) < 3:
        occupancy = np.zeros((26, 26), dtype=np.int8)
        for _ in range(4):
            row, column = rng.integers(4, 19, 2)
            occupancy[row : row + 5, column : column + 3] = 100
        occupancy[:3, :3] = occupancy[-3:, -3:] = 0
        cost = plans.inflate(occupancy, 0.05, radius=0.08, decay=0.15, weight=20.0)
        path = plans.planning.astar(cost, (0, 0), (25, 25))
        if path is not None:
            found.append(plans.Detour(cost, path))
    return found


@suite.test(
    "smooth", points=4, name="safe, not dearer, and as straight as allowed", reread="Exercise 2.3", time_limit_s=20
)
def smooth_random(student):
    expect(plans.smoothed(student, [(3, 3)], np.ones((5, 5))) == [(3, 3)], "a path of one cell")
    rng = student.rng("smooth")
    for detour, slack in zip(detours(), (None, 1.5, 1.0), strict=True):
        plans.check_smoothed(student, detour, slack, plans.Turn.random(rng))


@suite.test("goal_tracker", points=3, name="a robot that drives and turns", reread="Exercise 3.1")
def tracker_driving(student):
    rng = student.rng("tracker")
    vx, vy = rng.uniform(-0.6, 0.6, 2)
    driving = [(k * 50_000_000, (0.05 * vx * k, 0.05 * vy * k, 0.11 * k)) for k in range(20)]
    tools.compare_tracker(student, driving, rng)
    # Through the jump of yaw from pi to -pi.
    turning = [(k * 100_000_000, (0.0, 0.0, math.remainder(2.6 + 0.11 * k, 2 * math.pi))) for k in range(15)]
    tools.compare_tracker(student, turning, rng)
    tracker = student.GoalTracker()
    tracker.add_pose(0, (0.0, 0.0, 0.0))
    for k in range(12):
        tracker.add_sighting(0, (float(k), 0.0))
    goal = tracker.goal()
    expect(math.dist(goal, (5.5, 0.0)) < 1e-6, "the mean of all sightings", got=goal)


@suite.test("goal_tracker", points=2, name="sightings without a known pose", hint="drop-unknown-pose")
def tracker_unknown(student):
    x, y = (float(v) for v in student.rng("unknown").uniform(0.5, 2.0, 2))
    tracker = student.GoalTracker()
    for k in range(5):
        tracker.add_pose(10**9 + k * 10**8, (0.0, 0.0, 0.0))
    for stamp in (0, 10**6, 10**8, 5 * 10**8):
        tracker.add_sighting(stamp, (9.0, 9.0))  # from before the first pose
    goal = tracker.goal()
    expect(goal is None, "a goal from sightings that have no pose", got=goal, expected="None")
    for _ in range(3):
        tracker.add_sighting(12 * 10**8, (x, y))
    goal = tracker.goal()
    expect(goal is not None and math.dist(goal, (x, y)) < 1e-6, "the wrong sightings were kept", got=goal)


def closed_room():
    """Return a room with a wall across it near the start: a search that finds no way out has soon seen everything."""
    room = bench.open_room()
    room[0][:, 10] = 100
    return room


@suite.test("planner_node", points=2, name="blocked goals and no route", hint="off-the-map", time_limit_s=20)
def planner_edges(student):
    room = bench.walled_room()
    planner = bench.PlannerBench.of(student, "MyPlanner")
    blocked = bench.with_box(room, 1.0, 0.0)
    planner.show(blocked)
    plans.compare_plan(planner, blocked, (-1.85, 0.0), (1.0, 0.0), tolerance=0.5)  # so is the start, by the wall
    planner.show(bench.with_box(room, 1.0, 0.0, half=0.5))
    points = planner.ask((-1.5, 0.4), (1.0, 0.0), tolerance=0.2)
    expect(len(points) == 0, "a path to somewhere else than asked for", hint="off-the-map")
    planner.show(closed_room())
    points = planner.ask((-1.5, 0.4), (1.5, 0.4))
    expect(len(points) == 0, "a path through a closed wall", hint="empty-when-stuck")
    # A gap that the robot fits through, then one that it does not (0.3 m).
    gap = bench.with_box(bench.walled_room(gap=-1.5), 0.0, -0.8, half=0.0)
    gap[0][3:11, 20] = 0
    planner.show(gap)
    path = plans.compare_plan(planner, gap, (-1.5, 0.0), (1.5, 0.0))
    expect(bench.clearance(path, gap) > 0.25, "the path scrapes along an obstacle", hint="robot-has-a-radius")
    narrow = closed_room()
    narrow[0][14:17, 10] = 0
    planner.show(narrow)
    points = planner.ask((-1.5, 0.0), (1.5, 0.0))
    expect(len(points) == 0, "a path through a gap too narrow for the robot", hint="robot-has-a-radius")
    # Cells of another size.
    fine = bench.walled_room(0.075)
    planner.show(fine)
    plans.compare_plan(planner, fine, (-0.6, -0.3), (0.6, -0.3))


@suite.test("planner_node", points=3, name="drives a robot to the marker", time_limit_s=60)
def planner_drives(student):
    rng = student.rng("drive")
    start, goal = ((side * float(rng.uniform(0.8, 1.1)), float(rng.uniform(-0.2, 0.2))) for side in (-1, 1))
    room = bench.with_box(bench.walled_room(gap=float(rng.uniform(-0.6, -0.4))), -0.4, -1.3)
    wrong = bench.approach(bench.PlannerBench.of(student, "MyPlanner"), room, start, goal)
    if wrong:
        fail(f"in a room that it does not know yet, the robot {wrong}")


@suite.test("evaluate", points=3, name="no success, all successes, one run", reread="Exercise 4")
def evaluate_extremes(student):
    rng = student.rng("extremes")
    many, none = (int(n) for n in rng.integers(8, 20, 2))
    for successes in ([True] * many, [False] * none, [True], tools.some_wins(rng)):
        tools.compare_evaluation(student, successes, rng, ("success_rate", "interval"))


@suite.test("evaluate", points=2, name="latencies of runs of very different length")
def evaluate_pooled(student):
    rng = student.rng("pooled")
    for _ in range(2):
        tools.compare_evaluation(student, tools.some_wins(rng), rng, ("p95_ms",))


@suite.test("gap", points=4, name="other pairs", reread="Exercise 5.1")
def gap_random(student):
    rng = student.rng("gap")
    for n in (2, 4, 9, 30):
        worlds = rng.uniform(15, 60, n)
        tools.compare_gap(student, worlds, worlds + rng.normal(2.0, 1.5, n))


@suite.warm
def fill_caches():
    """Compute what all submissions are compared with."""
    mazes()
    for detour in detours():
        detour.fill()
    for slug, mode, _ in PROFILES:
        tools.reference_profile(slug, mode)
    for n in (2, 4, 5, 9, 30):
        tools.student_t(n)
