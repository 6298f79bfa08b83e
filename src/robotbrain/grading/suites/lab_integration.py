"""Visible tests of the lab `lab_integration`: what `lab.check` runs, and half of what is graded."""

from __future__ import annotations

from typing import Any

import numpy as np

from robotbrain.grading import Student, Suite, expect
from robotbrain.grading.suites import judging
from robotbrain.grading.suites import lab_integration_planning as plans
from robotbrain.grading.suites import lab_integration_tools as tools
from robotbrain.grading.suites.planner_bench import PlannerBench, open_room, walled_room, warm_students

suite = Suite("lab_integration")

suite.exercise("preprocess", title="1.1 What the network eats", points=6)
suite.exercise("back_project", title="1.2 From pixels to metres", points=10)
suite.exercise("deadline", title="1.3 Does it keep up?", points=4, provides=("deadline_slack_ms",))
suite.exercise("inflate", title="2.1 A costmap", points=8)
suite.exercise("astar", title="2.2 A*", points=16)
suite.exercise("smooth", title="2.3 Straighten the path", points=8)
suite.exercise("goal_tracker", title="3.1 Where was I when I saw that?", points=10, provides=("GoalTracker",))
suite.exercise(
    "planner_node",
    title="3.2 The planner as a ROS 2 node",
    points=10,
    upstream=("inflate", "astar", "smooth"),
    provides=("MyPlanner",),
)
suite.exercise("evaluate", title="4 How good is it?", points=10)
suite.exercise("gap", title="5.1 The gap", points=8, provides=("paired_gap",))

# Stand-ins for a student's part that is not right yet, so that what builds on it can still be graded.
suite.reference("preprocess", "robotbrain.pipeline.segmentation:preprocess")
suite.reference("back_project", "robotbrain.pipeline.segmentation:back_project")
suite.reference("inflate", lambda: plans.inflate)
suite.reference("astar", "robotbrain.pipeline.planning:astar")
suite.reference("smooth", "robotbrain.pipeline.planning:smooth")
suite.reference("MyPlanner", "robotbrain.pipeline.nodes.planner:PlannerNode")
suite.warm_students(warm_students)

HELPERS = (
    "PoseBuffer",
    "cells_on_segment",
    "grid_from_msg",
    "interpolate",
    "nearest_free",
    "path_cost",
    "resample",
    "segment_cost",
    "transform",
    "wrap",
    "wrap_angle",
)
for _exercise in suite.exercises:
    suite.forbid(_exercise, imports=("robotbrain.pipeline", "robotbrain.grading"), allow=HELPERS)

_HINTS = {
    "scale-pixels": "The network was trained on pixels divided by 255. Unscaled, every input is far outside what it knows.",
    "normalise-channels": "After dividing by 255, subtract 0.45 and divide by 0.25.",
    "reshape-is-not-transpose": "`reshape` keeps the numbers in their order and only cuts them up anew, so colours and "
    "places get mixed. To move an axis use `transpose(2, 0, 1)`.",
    "batch-axis": "The network takes a batch: one image needs a leading axis of length 1, as in `x[None]`.",
    "float32": "NumPy computes in float64 unless told otherwise; ONNX Runtime wants float32: end with `.astype(np.float32)`.",
    "y-points-left": "In the base frame y points LEFT (REP 103), in the image u grows to the RIGHT: y = p_y - x_c.",
    "pitch-rotates": "The camera is tilted: a pixel on the optical axis lies not only ahead but also lower. Rotate by the "
    "pitch before adding the camera's position.",
    "depth-is-not-range": "Depth is measured along the optical axis, so z_c IS the depth. Only a range along the ray "
    "would have to be divided by the ray's length.",
    "nan-without-depth": "Where nothing returned, depth is inf; a point there is no point. Turn it into NaN first.",
    "camera-position": "The points are wanted from the base's origin, not from the camera: add camera.position.",
    "milliseconds": "A period is 1 / rate seconds, that is 1000 / rate milliseconds.",
    "both-costs": "One image costs CPU time (callback_ms) AND inference (segmentation_ms): subtract both.",
    "cells-or-metres": "`distance_transform_edt` counts cells unless you pass `sampling=resolution`; radius and decay are metres.",
    "unknown-costs-more": "-1 means that nobody has looked there: no obstacle, but 2 dearer than seen floor.",
    "empty-map": "With no obstacle in the map there is nothing to measure a distance to: handle that case before calling "
    "`distance_transform_edt`, and let the costs be floats.",
    "lethal-radius": "Within the radius (d <= radius) the robot's centre must never be: the cost is inf there.",
    "threshold-65": "From 65 percent on a cell is an obstacle; 64 is not.",
    "decay-from-radius": "The extra cost is `weight` right at the radius and falls from there: the exponent is "
    "-(d - radius) / decay.",
    "diagonal-cost": "A diagonal step is sqrt(2) long. With a length of 1, zigzag looks as short as straight.",
    "admissible-heuristic": "A path that is too dear has one of three causes: h overestimates somewhere (Manhattan distance "
    "does where diagonal steps are allowed), a step does not cost length times mean, or the search stops too early.",
    "corner-cutting": "A diagonal step between two cells is only allowed if both cells beside it are finite.",
    "use-the-costs": "A step costs its length times the MEAN of the two cells' costs. Counting steps alone ignores the costmap.",
    "expand-by-f": "Order the queue by f = g + h, and stop when the goal is taken OFF the queue, not when it is first seen.",
    "no-route": "When the queue runs empty without reaching the goal there is no route: return None.",
    "path-ends": "The path holds both ends, as (row, column): it starts with `start` and ends with `goal`.",
    "leave-inputs-alone": "The array you are given belongs to the caller: work on a copy.",
    "next-cell-always": "The next cell of the path is always allowed, even if no longer segment is; else the loop never ends.",
    "use-slack": "How much dearer a segment may be is the argument `slack`.",
    "lethal-shortcut": "A segment may be used only if segment_cost is finite: check the cells in between, not only its ends.",
    "keep-the-distance": "Compare the segment's cost with `slack` times the cost of the stretch it replaces; a shortcut "
    "that is merely free of collisions hugs the corner.",
    "farthest-first": "From each kept cell take the FARTHEST cell that is allowed, not the next best one.",
    "pose-at-stamp": "The sighting belongs to the moment its image was taken. Ask the buffer for the pose AT that stamp, "
    "not for the newest one.",
    "rotate-then-add": "The sighting is given in the robot's frame: rotate it by the yaw, then add the robot's position.",
    "yaw-wraps": "Yaw jumps from pi to -pi. Between two poses turn the short way round (PoseBuffer does).",
    "three-sightings": "Fewer than three sightings are no goal yet: return None.",
    "drop-unknown-pose": "If the buffer has no pose for the stamp, `at` returns None: drop that sighting.",
    "row-is-y": "Cells are (row, column), rows are y. Let frame.to_cell and frame.to_points do the swapping.",
    "return-response": "A service callback must return the response, also when it is empty.",
    "empty-when-stuck": "Without a map or a route the response's path stays empty, and the callback still returns.",
    "off-the-map": "Start or goal may lie in a blocked cell. nearest_free finds a free one within a number of CELLS (for the "
    "goal: the tolerance), or returns None: then there is no route.",
    "robot-has-a-radius": "The path must keep the robot's radius from every obstacle: inflate with the map's own resolution "
    "(frame.resolution), in metres.",
    "percent-or-share": "A rate is a share between 0 and 1.",
    "wilson-not-wald": "p ± z·sqrt(p(1-p)/n) collapses to a point at 0 and 1. Wilson's interval does not.",
    "once-per-seed": "Call drive exactly once for each seed: runs are dear, and a second call would be another sample.",
    "pool-latencies": "Take the percentile of all latencies of all runs together, not the mean of each run's percentile.",
    "success-is-the-judges": "`run.success` is the judge's verdict (arrived, on the mat, nothing touched); use that.",
    "pairs": "Each world was driven by both robots: take differences first, then their mean and spread. Unpaired "
    "intervals drown the gap in the differences between worlds.",
    "sample-deviation": "s_d divides by n - 1: `std(ddof=1)`.",
    "t-not-z": "With a handful of pairs use Student's t with n - 1 degrees of freedom; 1.96 is too narrow.",
    "surrogate-minus-simulated": "The gap is surrogate minus simulated: positive when the surrogate is slower.",
}
for _key, _text in _HINTS.items():
    suite.hint(_key, _text)


# ---------------------------------------------------------------- Part 1


@suite.test("preprocess", points=3, name="right values for a known image", reread="Exercise 1.1")
def preprocess_values(student: Student) -> None:
    tools.compare_preprocess(student, tools.image(student.rng("image"), 6, 5))


@suite.test("preprocess", points=1, name="float32, as the network wants it", hint="float32", reread="Exercise 1.1")
def preprocess_dtype(student: Student) -> None:
    pixels = student.rng("dtype").integers(0, 256, (6, 5, 3), dtype=np.uint8)
    answer = student.preprocess(pixels.copy())
    dtype = str(getattr(answer, "dtype", "that of a plain list, float64")).removeprefix("torch.")
    expect(dtype == "float32", "the dtype is not float32", got=dtype, expected="float32")
    # Scaled somehow and put in any order, but the image's values: the other tests judge the rest.
    numbers = judging.as_numbers(answer)
    same = numbers is not None and numbers.size == pixels.size and np.ptp(numbers) > 0
    expect(
        same and np.allclose(_spread(numbers), _spread(pixels), atol=1e-3),
        "these are not the image's 90 values",
        expected="the image's own values, each once, however they are scaled",
    )


def _spread(values: Any) -> Any:
    """The values in ascending order, moved and scaled to [0, 1]."""
    return (np.sort(np.ravel(values)).astype(float) - np.min(values)) / float(np.ptp(values))


@suite.test("back_project", points=2, name="the pixel on the optical axis", reread="Exercise 1.2")
def back_project_axis(student: Student) -> None:
    pitch, far = (float(v) for v in student.rng("axis").uniform((0.2, 1.5), (0.5, 3.0)))
    camera = tools.camera(pitch=pitch)
    point = tools.points_of(student, np.full((5, 5), far), camera)[2, 2]
    expected = (0.1 + far * np.cos(pitch), 0.0, 0.26 - far * np.sin(pitch))
    mistakes = [
        ("pitch-rotates", (0.1 + far, 0.0, 0.26)),
        ("camera-position", np.subtract(expected, camera.position)),
    ]
    given = f"depth {far:.2f} m everywhere, pixel (row 2, column 2) on the axis, pitch {pitch:.2f} rad"
    judging.compare(point, expected, mistakes, given=given)


@suite.test("back_project", points=3, name="left stays left, on a level camera", reread="Exercise 1.2")
def back_project_level(student: Student) -> None:
    far = float(student.rng("level").uniform(1.5, 3.0))
    tools.compare_points(student, np.full((5, 5), far), tools.camera(pitch=0.0))


@suite.test(
    "back_project", points=1, name="no depth, no point", hint="nan-without-depth", reread="Exercise 1.2, last paragraph"
)
def back_project_nan(student: Student) -> None:
    depth = np.full((5, 5), 2.0)
    row, column = (int(k) for k in student.rng("nan").integers(5, size=2))
    depth[row, column] = np.inf
    points = tools.points_of(student, depth, tools.camera(pitch=0.2))
    gone = points[row, column]
    expect(np.isnan(gone).all(), "a pixel without depth should be NaN", got=gone, expected="three NaN")
    expect(
        np.isfinite(points).sum() == 72,
        "pixels with a depth should be finite",
        got=points,
        expected="72 finite numbers",
    )


@suite.test("deadline", points=2, name="a period of 100 ms", reread="Exercise 1.3")
def deadline_simple(student: Student) -> None:
    inference, cpu = (round(float(v), 1) for v in student.rng("deadline").uniform((10, 2), (30, 8)))
    tools.compare_deadline(student, tools.profile(inference, cpu), 10.0)


# ---------------------------------------------------------------- Part 2


@suite.test("inflate", points=2, name="one obstacle in an open field", reread="Exercise 2.1")
def inflate_point(student: Student) -> None:
    occupancy = np.zeros((15, 17), dtype=np.int8)
    occupancy[tuple(student.rng("obstacle").integers(5, 10, 2))] = 100
    plans.compare_inflation(student, occupancy, 0.1, radius=0.25, decay=0.2, weight=8.0)


@suite.test("inflate", points=1, name="a map without obstacles", hint="empty-map", reread="Exercise 2.1")
def inflate_empty(student: Student) -> None:
    occupancy = np.where(student.rng("empty").random((3, 4)) < 0.3, -1, 0).astype(np.int8)
    expected = np.where(occupancy == -1, 3.0, 1.0)
    given = f"3 x 4 cells, int8, no obstacle, {int((occupancy == -1).sum())} of them unknown"
    judging.compare(student.inflate(occupancy, 0.05), expected, given=given)


@suite.test("inflate", points=1, name="unknown cells cost 2 more", reread="Exercise 2.1")
def inflate_unknown(student: Student) -> None:
    occupancy = np.zeros((9, 9), dtype=np.int8)
    occupancy[0, int(student.rng("unknown").integers(4))] = 100
    occupancy[4:, 4:] = -1
    plans.compare_inflation(student, occupancy, 0.1, radius=0.15, decay=0.1, weight=5.0)


@suite.test("astar", points=2, name="straight across an empty field", reread="Exercise 2.2")
def astar_straight(student: Student) -> None:
    rng = student.rng("straight")
    row, columns = int(rng.integers(5)), int(rng.integers(7, 16))
    plans.compare_astar(student, plans.Maze(np.ones((5, columns)), (row, 0), (row, columns - 1)).turned(rng))


@suite.test("astar", points=2, name="diagonal steps are longer", hint="diagonal-cost", reread="Exercise 2.2")
def astar_diagonal(student: Student) -> None:
    rng = student.rng("diagonal")
    row, columns = int(rng.integers(5)), int(rng.integers(10, 16))
    maze = plans.Maze(np.ones((7, columns)), (row, 0), (row + 2, columns - 1)).turned(rng)
    path = plans.compare_astar(student, maze)
    # Any optimal path has exactly two diagonal steps; a zigzag that is as long in steps has more.
    diagonals = int((np.abs(np.diff(path, axis=0)).sum(axis=1) == 2).sum())
    expect(diagonals == 2, "the path zigzags", got=f"{diagonals} diagonal steps", expected="2 diagonal steps")


@suite.test("astar", points=2, name="around a dear patch", hint="use-the-costs", reread="Exercise 2.2")
def astar_weights(student: Student) -> None:
    rng = student.rng("patch")
    cost = np.ones((9, 11))
    cost[2:7, 4:7] = 9.0
    start, goal = (int(row) for row in rng.integers(3, 6, 2))
    plans.compare_astar(student, plans.Maze(cost, (start, int(rng.integers(3))), (goal, 10)).turned(rng))


@suite.test("astar", points=1, name="no route is None", hint="no-route", reread="Exercise 2.2, last paragraph")
def astar_no_route(student: Student) -> None:
    rng = student.rng("no route")
    # An answer that is None for every map has not understood the question.
    ends = [(int(row), column) for row, column in zip(rng.integers(9, size=2), (0, 2), strict=True)]
    plans.compare_astar(student, plans.Maze(np.ones((9, 3)), ends[0], ends[1]).turned(rng))
    cost = np.ones((5, 5))
    cost[:, 2] = np.inf
    plans.compare_astar(student, plans.Maze(cost, (2, 0), (2, 4)).turned(rng))


@suite.test("smooth", points=2, name="a staircase in the open becomes one segment", hint="farthest-first")
def smooth_open(student: Student) -> None:
    rng = student.rng("staircase")
    turn, columns = plans.Turn.random(rng), int(rng.integers(6, 14))
    path = [turn.cell(((column + 1) // 2, column), (8, 16)) for column in range(columns)]
    kept = plans.smoothed(student, path, turn.grid(np.ones((8, 16))))
    ends = [path[0], path[-1]]
    expect(kept == ends, got=kept, expected=ends, given=path)


@suite.test("smooth", points=1, name="the next cell is always allowed", hint="next-cell-always", time_limit_s=2.0)
def smooth_next(student: Student) -> None:
    rng = student.rng("next")
    size = int(rng.integers(3, 9))
    cost = np.full((size, size), 40.0)
    np.fill_diagonal(cost, 1.0)
    turn = plans.Turn.random(rng)
    path = [turn.cell((k, k), cost.shape) for k in range(size)]
    kept = plans.smoothed(student, path, turn.grid(cost))
    expect(kept == path, got=kept, expected=path, given="dear cells on both sides of a diagonal path")


@suite.test("smooth", points=1, name="never through a wall", hint="lethal-shortcut", reread="Exercise 2.3")
def smooth_wall(student: Student) -> None:
    cost = np.ones((8, 9))
    cost[0:6, 4] = np.inf
    path = [(1, 1), (2, 2), (3, 3), (4, 3), (5, 3), (6, 3), (6, 4), (6, 5), (5, 5), (4, 5), (3, 5), (2, 6), (1, 7)]
    plans.check_smoothed(student, plans.Detour(cost, path), turn=plans.Turn.random(student.rng("wall")))


# ---------------------------------------------------------------- Part 3


@suite.test("goal_tracker", points=2, name="three sightings from one place", reread="Exercise 3.1")
def tracker_still(student: Student) -> None:
    tools.compare_tracker(student, tools.steady_poses((1.0, 2.0, np.pi / 2)), student.rng("still"))


@suite.test("goal_tracker", points=2, name="a robot that turns while the network thinks", reread="Exercise 3.1")
def tracker_turning(student: Student) -> None:
    poses = [(k * 10**8, (0.0, 0.0, 0.1 * k)) for k in range(11)]
    tools.compare_tracker(student, poses, student.rng("turning"))


@suite.test("goal_tracker", points=1, name="two sightings are no goal", hint="three-sightings", reread="Exercise 3.1")
def tracker_patience(student: Student) -> None:
    tracker = student.GoalTracker()
    tracker.add_pose(0, (0.0, 0.0, 0.0))
    for count in ("without any sighting", "after one sighting", "after two sightings"):
        goal = tracker.goal()
        expect(goal is None, f"a goal {count}", got=goal, expected="None")
        tracker.add_sighting(0, (1.0, 0.0))
    expect(tracker.goal() is not None, "no goal after three sightings", got="None", expected="a point (x, y)")


@suite.test("planner_node", points=3, name="answers with a path around a wall", reread="Exercise 3.2", time_limit_s=20)
def planner_answers(student: Student) -> None:
    gap, *ys = (float(v) for v in student.rng("wall").uniform((-0.6, 0.2, 0.2), (-0.4, 0.6, 0.6)))
    room = walled_room(gap=gap)
    bench = PlannerBench.of(student, "MyPlanner")
    bench.show(room)
    plans.compare_plan(bench, room, (-1.5, ys[0]), (1.5, ys[1]))


@suite.test(
    "planner_node",
    points=2,
    name="an empty path without a map",
    hint="empty-when-stuck",
    reread="Exercise 3.2",
    time_limit_s=20,
)
def planner_without_map(student: Student) -> None:
    bench = PlannerBench.of(student, "MyPlanner")
    points = bench.ask((0.0, 0.0), (1.0, 0.0))
    expect(len(points) == 0, "a path without a map", got=points, expected="an empty path")
    # A node that never answers with a path has not understood the question.
    bench.show(open_room())
    expect(
        len(bench.ask((0.0, 0.0), (1.0, 0.0))) > 0,
        "no path with a map either",
        got="an empty path",
        expected="a path: there is a map now",
    )


# ---------------------------------------------------------------- Parts 4 and 5


@suite.test("evaluate", points=1, name="the rate of made-up runs", reread="Exercise 4")
def evaluate_rate(student: Student) -> None:
    rng = student.rng("rate")
    tools.compare_evaluation(student, tools.some_wins(rng), rng, ("success_rate",))


@suite.test("evaluate", points=1, name="Wilson's interval of made-up runs", reread="Exercise 4")
def evaluate_interval(student: Student) -> None:
    rng = student.rng("interval")
    tools.compare_evaluation(student, tools.some_wins(rng), rng, ("interval",))


@suite.test("evaluate", points=1, name="the 95th percentile of made-up runs", reread="Exercise 4")
def evaluate_percentile(student: Student) -> None:
    rng = student.rng("percentile")
    tools.compare_evaluation(student, tools.some_wins(rng), rng, ("p95_ms",))


@suite.test("evaluate", points=2, name="one drive per seed", hint="once-per-seed", reread="Exercise 4")
def evaluate_calls(student: Student) -> None:
    calls: list[int] = []

    def drive(seed: int) -> Any:
        calls.append(seed)
        return tools.made_up_run(True, np.array([5.0]))

    seeds = [int(seed) for seed in student.rng("seeds").choice(50, 6, replace=False)]
    student.evaluate(drive, seeds)
    expect(sorted(calls) == sorted(seeds), got=calls, expected=seeds, given=f"seeds {seeds}")


@suite.test("gap", points=4, name="five pairs worked out by hand", reread="Exercise 5.1")
def gap_by_hand(student: Student) -> None:
    shift = round(float(student.rng("pairs").uniform(0, 5)), 1)
    tools.compare_gap(
        student, [20.0, 31.0, 44.0, 25.0, 38.0], [21.5 + shift, 33.0 + shift, 44.5 + shift, 27.5 + shift, 41.0 + shift]
    )
