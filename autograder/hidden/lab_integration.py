"""Hidden tests of `lab_integration`. They never ship to students, who see a test's name and its hint only."""

from __future__ import annotations

import math

import numpy as np

from robotbrain.grading import Suite, expect, fail
from robotbrain.grading.suites import lab_integration_tools as tools

suite = Suite.extending("lab_integration")

DEPLOYED = "orin-nano-8gb:15W"
"""Module and power mode of the reference profile on which a student's node must drive."""


@suite.test("preprocess", points=2, name="random images of other sizes", reread="Exercise 1.1")
def preprocess_random(student):
    rng = student.rng("preprocess")
    for shape in ((64, 64, 3), (3, 7, 3), (8, 3, 3)):
        tools.compare_preprocess(student.preprocess, rng.integers(0, 256, shape, dtype=np.uint8))


@suite.test("back_project", points=3, name="a tilted camera, every pixel", reread="Exercise 1.2")
def back_project_tilted(student):
    rng = student.rng("back_project")
    for pitch in (0.14, 0.5):
        depth = rng.uniform(0.3, 6.0, (5, 5))
        tools.compare_points(student.back_project, depth, tools.camera(pitch, fx=38.1, fy=50.8))


@suite.test("back_project", points=1, name="images that are not square", reread="Exercise 1.2")
def back_project_oblong(student):
    depth = student.rng("oblong").uniform(0.5, 4.0, (4, 9))
    tools.compare_points(student.back_project, depth, tools.camera(0.2, size=7))
    mounted_aside = tools.segmentation.CameraModel(38.1, 50.8, 3.2, 1.4, (0.1, -0.03, 0.26), 0.2)
    tools.compare_points(student.back_project, depth, mounted_aside)


@suite.test("deadline", points=1, name="other modules and rates", reread="Exercise 1.3")
def deadline_random(student):
    rng = student.rng("deadline")
    for rate_hz in (5.0, 12.5, 30.0, 24.0):
        module = tools.profile(float(rng.uniform(1, 80)), float(rng.uniform(1, 40)))
        tools.compare_deadline(student.deadline_slack_ms, module, rate_hz)


@suite.test("deadline", points=1, name="the reference profiles of real modules", reread="Exercise 1.3")
def deadline_reference(student):
    for slug, mode, rate_hz in (("nano-4gb", "5W", 30.0), ("xavier-nx", "15W", 60.0), ("agx-orin-64gb", "MAXN", 90.0)):
        tools.compare_deadline(student.deadline_slack_ms, tools.reference_profile(slug, mode), rate_hz)


@suite.test("inflate", points=4, name="random maps with unknown cells", reread="Exercise 2.1")
def inflate_random(student):
    rng = student.rng("inflate")
    for _ in range(6):
        occupancy = rng.choice([0, 0, 0, 0, -1, 30, 64, 65, 100], (13, 19)).astype(np.int8)
        tools.compare_inflation(student.inflate, occupancy, 0.05, radius=0.07, decay=0.1, weight=6.0)
    # Exact in binary: two cells are exactly a radius apart, and that is lethal.
    occupancy = np.zeros((7, 7), np.int8)
    occupancy[3, 3] = 100
    tools.compare_inflation(student.inflate, occupancy, 0.25, radius=0.5, decay=0.25, weight=4.0)


def _random_cost(rng, size=16, walls=0.28):
    cost = rng.uniform(1.0, 6.0, (size, size))
    cost[rng.random((size, size)) < walls] = np.inf
    cost[0, 0] = cost[-1, -1] = 1.0
    return cost


@suite.test(
    "astar", points=4, name="as cheap as the optimum on random costmaps", reread="Exercise 2.2", time_limit_s=20
)
def astar_random(student):
    rng = student.rng("astar")
    for _ in range(30):
        tools.compare_astar(student.astar, _random_cost(rng), (0, 0), (15, 15))
    dear = np.ones((5, 9))
    dear[:, 4] = 150.0  # dear, but finite
    tools.compare_astar(student.astar, dear, (2, 0), (2, 8))
    expect(tools.checked_path(student.astar(dear, (1, 1), (1, 1)), dear, (1, 1), (1, 1)) == [(1, 1)])


@suite.test("astar", points=3, name="optimal on open ground with few obstacles", reread="Exercise 2.2", time_limit_s=20)
def astar_open(student):
    rng = student.rng("astar-open")
    for _ in range(15):
        cost = np.ones((24, 24))
        cost[rng.random(cost.shape) < 0.15] = np.inf
        cost[0, 0] = cost[11, 23] = 1.0
        tools.compare_astar(student.astar, cost, (0, 0), (11, 23))
    tools.compare_astar(student.astar, np.ones((60, 60)), (2, 3), (50, 58))
    # The goal is first seen from the dear crossing, but cheaper to reach by the far one.
    cost = np.ones((9, 9))
    cost[:, 4] = np.inf
    cost[4, 4], cost[1, 4] = 10.0, 1.0
    tools.compare_astar(student.astar, cost, (4, 3), (4, 5), hint="expand-by-f")


@suite.test("astar", points=2, name="no corner is cut", reread="Exercise 2.2", time_limit_s=10)
def astar_corners(student):
    cost = np.ones((6, 6))
    cost[2, 3] = cost[3, 2] = np.inf
    tools.compare_astar(student.astar, cost, (2, 2), (3, 3))
    rng = student.rng("corners")
    for _ in range(10):
        cost = np.ones((12, 12))
        cost[rng.random(cost.shape) < 0.35] = np.inf
        cost[0, 0] = cost[11, 11] = 1.0
        tools.compare_astar(student.astar, cost, (0, 0), (11, 11))


@suite.test(
    "smooth", points=4, name="safe, not dearer, and as straight as allowed", reread="Exercise 2.3", time_limit_s=20
)
def smooth_random(student):
    expect(tools.smoothed(student.smooth, [(3, 3)], np.ones((5, 5))) == [(3, 3)], "a path of one cell")
    rng = np.random.default_rng(20)  # the same maps for everybody: few of them punish each mistake
    for slack in (None, None, None, None, 1.0, 1.5):
        occupancy = np.zeros((40, 40), dtype=np.int8)
        for _ in range(5):
            row, column = rng.integers(5, 32, 2)
            occupancy[row : row + 6, column : column + 4] = 100
        occupancy[:3, :3] = occupancy[-3:, -3:] = 0
        cost = tools.inflate(occupancy, 0.05, radius=0.08, decay=0.15, weight=20.0)
        path = tools.planning.astar(cost, (0, 0), (39, 39))
        if path is not None:
            tools.check_smoothed(student.smooth, path, cost, slack)


@suite.test("goal_tracker", points=3, name="a robot that drives and turns", reread="Exercise 3.1")
def tracker_driving(student):
    for seed in range(3):
        poses = [(k * 50_000_000, (0.03 * k, 0.01 * k * seed, 0.08 * k)) for k in range(40)]
        tools.compare_tracker(student.GoalTracker, poses, seed)
    # Through the jump of yaw from pi to -pi.
    turning = [(k * 100_000_000, (0.0, 0.0, math.remainder(2.6 + 0.11 * k, 2 * math.pi))) for k in range(20)]
    tools.compare_tracker(student.GoalTracker, turning, 7)
    tracker = student.GoalTracker()
    tracker.add_pose(0, (0.0, 0.0, 0.0))
    for k in range(40):
        tracker.add_sighting(0, (float(k), 0.0))
    expect(math.dist(tracker.goal(), (19.5, 0.0)) < 1e-6, "the mean of all sightings", got=tracker.goal())


@suite.test("goal_tracker", points=2, name="sightings without a known pose", hint="drop-unknown-pose")
def tracker_unknown(student):
    tracker = student.GoalTracker()
    for k in range(10):
        tracker.add_pose(10**9 + k * 10**8, (0.0, 0.0, 0.0))
    for stamp in (0, 10**6, 10**8, 5 * 10**8):
        tracker.add_sighting(stamp, (9.0, 9.0))  # from before the first pose
    expect(tracker.goal() is None, "a goal from sightings that have no pose", got=tracker.goal(), expected="None")
    for _ in range(3):
        tracker.add_sighting(11 * 10**8, (1.0, 0.5))
    goal = tracker.goal()
    expect(goal is not None and math.dist(goal, (1.0, 0.5)) < 1e-6, "the wrong sightings were kept", got=goal)


@suite.test("planner_node", points=2, name="blocked goals and no route", hint="off-the-map", time_limit_s=20)
def planner_edges(student):
    room = tools.walled_map()
    occupancy = room[0].copy()
    occupancy[28:32, 58:62] = 100
    blocked = (occupancy, room[1], room[2])
    tools.compare_plan(student.MyPlanner, blocked, (-1.5, 0.4), (1.0, 0.0), tolerance=0.5)
    tools.compare_plan(student.MyPlanner, room, (-1.85, 0.4), (1.5, 0.4))
    occupancy[20:40, 55:75] = 100
    far = (occupancy, room[1], room[2])
    points = tools.ask_for_plan(student.MyPlanner, far, (-1.5, 0.4), (1.25, 0.0), tolerance=0.2)
    expect(len(points) == 0, "a path to somewhere else than asked for", hint="off-the-map")
    closed = room[0].copy()
    closed[:, 39:41] = 100
    points = tools.ask_for_plan(student.MyPlanner, (closed, room[1], room[2]), (-1.5, 0.4), (1.5, 0.4))
    expect(len(points) == 0, "a path through a closed wall", hint="empty-when-stuck")
    # Cells of another size; first with a gap that the robot fits through, then with one that it does not (0.3 m).
    coarse = np.zeros((30, 40), dtype=np.int8)
    coarse[[0, -1], :] = coarse[:, [0, -1]] = 100
    coarse[:, 20] = 100
    coarse[3:11, 20] = 0
    gap = (coarse, 0.1, (-2.0, -1.5))
    path = tools.compare_plan(student.MyPlanner, gap, (-1.5, 0.0), (1.5, 0.0))
    expect(tools.clearance(path, gap) > 0.25, "the path scrapes along an obstacle", hint="robot-has-a-radius")
    coarse[:, 20] = 100
    coarse[14:17, 20] = 0
    points = tools.ask_for_plan(student.MyPlanner, (coarse, 0.1, (-2.0, -1.5)), (-1.5, 0.0), (1.5, 0.0))
    expect(len(points) == 0, "a path through a gap too narrow for the robot", hint="robot-has-a-radius")


@suite.test("planner_node", points=3, name="drives a robot to the marker", time_limit_s=120)
def planner_drives(student):
    from robotbrain.pipeline.brain import drive
    from robotbrain.ros import CallbackError

    try:
        run = drive(5, difficulty=0.2, profile=DEPLOYED, parts={"planner": student.MyPlanner}, time_limit=60.0)
    except CallbackError as error:
        fail(f"the node raised {type(error.cause).__name__} on the way")
    expect(run.success, f"on the {DEPLOYED} the robot {run.reason}")


@suite.test("evaluate", points=3, name="no success, all successes, one run", reread="Exercise 4")
def evaluate_extremes(student):
    for successes in ([True] * 12, [False] * 9, [True], [True, False, False]):
        tools.compare_evaluation(student.evaluate, successes, ("success_rate", "interval"), seed=len(successes))


@suite.test("evaluate", points=2, name="latencies of runs of very different length")
def evaluate_pooled(student):
    for seed in range(3):
        tools.compare_evaluation(student.evaluate, [True] * 5 + [False] * 2, ("p95_ms",), seed=seed + 50)


@suite.test("gap", points=4, name="other pairs", reread="Exercise 5.1")
def gap_random(student):
    rng = student.rng("gap")
    for n in (2, 4, 9, 30):
        worlds = rng.uniform(15, 60, n)
        tools.compare_gap(student.paired_gap, worlds, worlds + rng.normal(2.0, 1.5, n))
