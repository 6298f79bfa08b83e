"""What the lab's visible and hidden tests share: inputs, oracles, and how typical mistakes look.

Each ``compare_...`` function puts a question to the student's function, compares with an oracle, and, where the answer
is wrong, looks whether a typical mistake would have given just that answer; then the hint names the mistake.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robotbrain.grading import expect, expect_close, fail
from robotbrain.pipeline import planning, segmentation
from robotbrain.pipeline.geometry import PoseBuffer, transform

Array = NDArray[np.float64]


def _first_match(answer: Any, mistakes: Sequence[tuple[str, Any]], atol: float = 1e-5) -> str:
    """Return the hint of the first mistake that gives ``answer``, or ''."""
    try:
        given = np.asarray(answer, dtype=float)
    except (TypeError, ValueError):
        return ""
    for hint, wrong in mistakes:
        expected = np.asarray(wrong, dtype=float)
        if expected.shape == given.shape and np.allclose(given, expected, atol=atol, rtol=1e-5, equal_nan=True):
            return hint
    return ""


# ---------------------------------------------------------------- Part 1


def gradient_image(height: int, width: int) -> NDArray[np.uint8]:
    """Return an image in which every value tells its place and channel."""
    rows, columns = np.indices((height, width))
    return np.stack([40 * rows, 40 * columns, 20 * (rows + columns)], axis=-1).astype(np.uint8)


def compare_preprocess(preprocess: Callable[[Any], Any], image: NDArray[np.uint8]) -> None:
    """Compare with the reference; the dtype is not judged here."""
    answer = preprocess(image.copy())
    expected = segmentation.preprocess(image).astype(float)
    raw = image.astype(float)
    mistakes = [
        ("scale-pixels", (raw.transpose(2, 0, 1)[None] - 0.45) / 0.25),
        ("normalise-channels", raw.transpose(2, 0, 1)[None] / 255.0),
        ("normalise-channels", raw.transpose(2, 0, 1)[None] / 255.0 - 0.45),
        ("reshape-is-not-transpose", ((raw / 255.0 - 0.45) / 0.25).reshape(expected.shape)),
        ("reshape-is-not-transpose", (raw / 255.0 - 0.45) / 0.25),
        ("batch-axis", expected[0]),
    ]
    hint = _first_match(answer, mistakes)
    expect_close(answer, expected, atol=1e-4, given=f"an RGB image of shape {image.shape}", hint=hint)


def camera(pitch: float, fx: float = 3.0, fy: float = 4.0, size: int = 5) -> segmentation.CameraModel:
    """Return a small camera whose axis goes through the middle pixel."""
    middle = (size - 1) / 2
    return segmentation.CameraModel(fx, fy, middle, middle, (0.1, 0.0, 0.26), pitch)


def points_of(back_project: Callable[[Any, Any], Any], depth: Array, model: segmentation.CameraModel) -> Array:
    """Return the student's points, checked for shape."""
    answer = np.asarray(untouched(back_project, depth, model), dtype=float)
    wanted = (*depth.shape, 3)
    expect(answer.shape == wanted, "the points have the wrong shape", got=answer.shape, expected=wanted)
    return answer


def compare_points(back_project: Callable[[Any, Any], Any], depth: Array, model: segmentation.CameraModel) -> None:
    """Compare all points with the reference."""
    answer = points_of(back_project, depth, model)
    expected = segmentation.back_project(depth, model)
    origin = np.asarray(model.position)
    mirrored = expected * [1, -1, 1] + [0, 2 * origin[1], 0]
    level = segmentation.CameraModel(model.fx, model.fy, model.cx, model.cy, model.position, 0.0)
    rows, columns = np.indices(depth.shape)
    length = np.sqrt(1 + ((columns - model.cx) / model.fx) ** 2 + ((rows - model.cy) / model.fy) ** 2)
    upward = segmentation.CameraModel(model.fx, model.fy, model.cx, model.cy, model.position, -model.pitch)
    mistakes = [
        ("y-points-left", mirrored),
        ("camera-position", expected - origin),
        ("depth-is-not-range", segmentation.back_project(depth / length, model)),
    ]
    if model.pitch:
        mistakes += [
            ("pitch-rotates", segmentation.back_project(depth, level)),
            ("pitch-rotates", segmentation.back_project(depth, upward)),
        ]
    hint = _first_match(answer, mistakes)
    given = f"depth of shape {depth.shape}, fx {model.fx:g}, fy {model.fy:g}, pitch {model.pitch:g} rad"
    expect_close(answer, expected, atol=1e-6, given=given, hint=hint)


def profile(segmentation_ms: float, perception_ms: float) -> Any:
    """Return what the exercise reads of a Jetson profile, and a callback that it must not count."""
    return SimpleNamespace(segmentation_ms=segmentation_ms, callback_ms={"perception": perception_ms, "mapper": 7.0})


def reference_profile(slug: str, mode: str) -> Any:
    """Return the same of a real module, from its reference profile in ``autograder/profiles``."""
    from robotbrain.jetson.reference import load_reference

    reference = load_reference(slug)
    return profile(reference.network("segmentation", mode).latency_ms, reference.callback_ms("perception", mode))


def compare_deadline(slack: Callable[[Any, float], Any], module: Any, rate_hz: float) -> None:
    """Compare with the closed form."""
    inference, cpu = module.segmentation_ms, module.callback_ms["perception"]
    answer = slack(module, rate_hz)
    mistakes = [
        ("milliseconds", 1 / rate_hz - inference - cpu),
        ("milliseconds", rate_hz - inference - cpu),
        ("both-costs", 1000 / rate_hz - inference),
        ("both-costs", 1000 / rate_hz - cpu),
    ]
    given = f"{rate_hz:g} Hz, inference {inference:g} ms, CPU {cpu:g} ms"
    hint = _first_match(answer, mistakes)
    expect_close(answer, 1000 / rate_hz - inference - cpu, atol=1e-6, given=given, hint=hint)


# ---------------------------------------------------------------- Part 2


def inflate(
    occupancy: Any, resolution: float, radius: float = 0.22, decay: float = 0.12, weight: float = 12.0
) -> Array:
    """Call the library's costmap with the exercise's arguments."""
    return planning.inflate(occupancy, resolution, planning.InflationParams(radius, decay, weight, 2.0))


def untouched(function: Callable[..., Any], array: NDArray[Any], *arguments: Any, **options: Any) -> Any:
    """Return ``function(array, ...)``, or fail if it changed the array."""
    given = array.copy()
    answer = function(given, *arguments, **options)
    same = np.array_equal(given, array, equal_nan=array.dtype.kind == "f")
    expect(same, "the function changed the array it was given", hint="leave-inputs-alone")
    return answer


def compare_inflation(
    student: Callable[..., Any], occupancy: NDArray[np.int8], resolution: float, **params: float
) -> None:
    """Compare with the reference."""
    answer = untouched(student, occupancy, resolution, **params)
    expected = inflate(occupancy, resolution, **params)
    radius, decay, weight = params["radius"], params["decay"], params["weight"]
    known = np.where(occupancy == -1, 0, occupancy).astype(np.int8)
    distance = np.full(occupancy.shape, np.inf)
    obstacles = np.argwhere(occupancy >= 65)
    if len(obstacles):
        cells = np.indices(occupancy.shape).transpose(1, 2, 0)
        squared = ((cells[:, :, None, :] - obstacles[None, None]) ** 2).sum(-1)
        distance = resolution * np.sqrt(squared.min(axis=2))
    unknown = 2.0 * (occupancy == -1)
    soft = 1 + weight * np.exp(-(distance - radius) / decay) + unknown
    mistakes = [
        ("cells-or-metres", inflate(occupancy, 1.0, **params)),
        ("unknown-costs-more", inflate(known, resolution, **params)),
        ("unknown-costs-more", np.where(occupancy == -1, np.inf, expected)),
        ("lethal-radius", soft),
        ("lethal-radius", np.where(distance == 0, np.inf, soft)),
        ("decay-from-radius", np.where(distance <= radius, np.inf, 1 + weight * np.exp(-distance / decay) + unknown)),
        ("threshold-65", inflate(np.where(occupancy == 64, 100, occupancy), resolution, **params)),
        ("threshold-65", inflate(np.where((occupancy > 0) & (occupancy < 65), 100, occupancy), resolution, **params)),
        ("threshold-65", inflate(np.where(occupancy == 65, 64, occupancy), resolution, **params)),
    ]
    hint = _first_match(answer, mistakes)
    given = f"a {occupancy.shape} grid of {resolution:g} m cells, " + ", ".join(f"{k} {v:g}" for k, v in params.items())
    expect_close(answer, expected, atol=1e-6, given=given, hint=hint)


def checked_path(answer: Any, cost: Array, start: tuple[int, int], goal: tuple[int, int]) -> list[tuple[int, int]]:
    """Return the student's path as a list of cells, or fail with what is wrong about it."""
    if answer is None:
        fail("the answer is None, but there is a route", expected="a list of (row, column)", got="None")
    try:
        path = [(int(row), int(column)) for row, column in answer]
    except (TypeError, ValueError):
        fail("the path is not a list of (row, column) pairs", got=answer, expected="[(row, column), ...]")
    expect(len(path) > 0, "the path is empty", got=path)
    ends = path[0] == tuple(start) and path[-1] == tuple(goal)
    expect(ends, "the path's ends are wrong", got=(path[0], path[-1]), expected=(start, goal), hint="path-ends")
    for a, b in itertools.pairwise(path):
        step = max(abs(a[0] - b[0]), abs(a[1] - b[1]))
        expect(step == 1, "two cells of the path are no neighbours", got=(a, b))
        inside = 0 <= b[0] < cost.shape[0] and 0 <= b[1] < cost.shape[1]
        expect(inside and np.isfinite(cost[b]), "the path enters a lethal cell", got=b)
        if a[0] != b[0] and a[1] != b[1]:
            free = np.isfinite(cost[a[0], b[1]]) and np.isfinite(cost[b[0], a[1]])
            expect(free, "the path cuts a corner", got=(a, b), hint="corner-cutting")
    return path


def compare_astar(
    student: Callable[..., Any], cost: Array, start: tuple[int, int], goal: tuple[int, int], hint: str = ""
) -> list[tuple[int, int]]:
    """Check that the path is valid and as cheap as the reference's; return it."""
    reference = planning.astar_search(cost, start, goal)
    answer = untouched(student, cost, start, goal)
    if reference.path is None:
        expect(answer is None, "there is no route", got=answer, expected="None", hint="no-route")
        return []
    path = checked_path(answer, cost, start, goal)
    spent = planning.path_cost(cost, path)
    given = f"a {cost.shape} grid, start {start}, goal {goal}"
    expect(
        spent <= reference.cost * (1 + 1e-9) + 1e-9,
        "the path is valid, but not the cheapest",
        got=f"cost {spent:.4f}",
        expected=f"cost {reference.cost:.4f}",
        given=given,
        hint=hint or why_dear(cost, start, goal, spent, path),
    )
    return path


def why_dear(
    cost: Array, start: tuple[int, int], goal: tuple[int, int], spent: float, path: list[tuple[int, int]]
) -> str:
    """Return the hint of the mistake that explains a path that is too dear."""
    steps = len(path) - 1
    length = planning.path_cost(np.where(np.isfinite(cost), 1.0, np.inf), path)
    flat = planning.astar_search(np.where(np.isfinite(cost), 1.0, np.inf), start, goal)
    if flat.path is not None and abs(length - flat.cost) < 1e-9 and np.ptp(cost[np.isfinite(cost)]) > 1e-9:
        return "use-the-costs"
    if steps <= min_steps(cost, start, goal):
        return "diagonal-cost"
    return "admissible-heuristic"


def min_steps(cost: Array, start: tuple[int, int], goal: tuple[int, int]) -> int:
    """Return the fewest steps between two cells, whatever their length (breadth first)."""
    frontier, seen, steps = {start}, {start}, 0
    while frontier and goal not in seen:
        steps += 1
        frontier = {
            other
            for row, column in frontier
            for other in ((row + dr, column + dc) for dr in (-1, 0, 1) for dc in (-1, 0, 1))
            if 0 <= other[0] < cost.shape[0]
            and 0 <= other[1] < cost.shape[1]
            and np.isfinite(cost[other])
            and np.isfinite(cost[row, other[1]])
            and np.isfinite(cost[other[0], column])
            and other not in seen
        }
        seen |= frontier
    return steps


def smoothed(
    student: Callable[..., Any], path: list[tuple[int, int]], cost: Array, **options: float
) -> list[tuple[int, int]]:
    """Return the kept cells, checked to be a sub-list with the same ends."""
    answer = student(list(path), cost.copy(), **options)
    try:
        kept = [(int(row), int(column)) for row, column in answer]
    except (TypeError, ValueError):
        fail("the answer is not a list of (row, column) pairs", got=answer, expected="cells of the path")
    remaining = iter(path)
    expect(all(cell in remaining for cell in kept), "the kept cells are no sub-list of the path", got=kept, given=path)
    ends = len(kept) > 0 and kept[0] == path[0] and kept[-1] == path[-1]
    expect(ends, "the ends must be kept", got=kept, expected=f"first {path[0]}, last {path[-1]}", hint="path-ends")
    return kept


def check_smoothed(
    student: Callable[..., Any], path: list[tuple[int, int]], cost: Array, slack: float | None = None
) -> None:
    """Check each kept segment: safe, not too dear, and as long as it may be (``slack`` None: the default, 1.05)."""
    kept = smoothed(student, path, cost) if slack is None else smoothed(student, path, cost, slack=slack)
    asked = slack is not None
    slack = 1.05 if slack is None else slack
    index = {cell: k for k, cell in enumerate(path)}
    for a, b in itertools.pairwise(kept):
        first, last = index[a], index[b]
        if last - first > 1:
            price = planning.segment_cost(cost, a, b)
            stretch = planning.path_cost(cost, path[first : last + 1])
            expect(np.isfinite(price), "a segment crosses a lethal cell", got=(a, b), hint="lethal-shortcut")
            expect(
                price <= slack * stretch + 1e-6,
                "a segment is much dearer than the stretch it replaces",
                got=f"{a} to {b}: {price:.2f}",
                expected=f"at most {slack:g} x {stretch:.2f}",
                hint="use-slack" if asked else "keep-the-distance",
            )
        for later in range(len(path) - 1, last, -1):
            stretch = planning.path_cost(cost, path[first : later + 1])
            allowed = planning.segment_cost(cost, a, path[later]) <= slack * stretch - 1e-6
            expect(
                not allowed,
                "a farther cell was within reach",
                got=(a, b),
                expected=(a, path[later]),
                hint="farthest-first",
            )


# ---------------------------------------------------------------- Part 3


def compare_tracker(
    make: Callable[[], Any], poses: list[tuple[int, tuple[float, float, float]]], seed: int = 0
) -> None:
    """Feed poses and sightings in the order in which they would arrive, and compare the goal with the closed form."""
    rng = np.random.default_rng(seed)
    marker = np.array([3.0, 1.0])
    buffer = PoseBuffer()
    for stamp, pose in poses:
        buffer.add(stamp, pose)
    first, last = poses[0][0], poses[-1][0]
    stamps = [int(s) for s in np.linspace(first + 0.1 * (last - first), first + 0.8 * (last - first), 5)]
    sightings = []
    for stamp in stamps:
        there = buffer.at(stamp)
        assert there is not None
        offset = marker + rng.normal(0, 0.02, 2) - np.array(there[:2])
        cos, sin = np.cos(there[2]), np.sin(there[2])
        sightings.append((cos * offset[0] + sin * offset[1], -sin * offset[0] + cos * offset[1]))
    tracker = make()
    for stamp, pose in poses:
        tracker.add_pose(stamp, pose)
    for stamp, point in zip(stamps, sightings, strict=True):
        tracker.add_sighting(stamp, point)
    answer = tracker.goal()
    seen = np.array(sightings)
    at_stamp = [buffer.at(stamp) for stamp in stamps]
    correct = np.mean([transform(p, q) for p, q in zip(at_stamp, seen, strict=True) if p is not None], axis=0)
    newest = np.mean([transform(poses[-1][1], q) for q in seen], axis=0)
    unrotated = np.mean([np.add(p[:2], q) for p, q in zip(at_stamp, seen, strict=True) if p is not None], axis=0)
    reverse = np.mean(
        [transform((p[0], p[1], -p[2]), q) for p, q in zip(at_stamp, seen, strict=True) if p is not None], axis=0
    )
    mistakes = [
        ("rotate-then-add", unrotated),
        ("rotate-then-add", reverse),
        ("rotate-then-add", seen.mean(axis=0)),
        ("pose-at-stamp", newest),
    ]
    expect(answer is not None, "no goal after five sightings", got="None", expected=correct)
    hint = _first_match(answer, mistakes, atol=1e-6)
    expect_close(answer, correct, atol=1e-6, given=f"five sightings between {len(poses)} poses", hint=hint)


def walled_map() -> tuple[NDArray[np.int8], float, tuple[float, float]]:
    """Return occupancy, resolution and origin of a 4 x 3 m room with a wall across most of it."""
    occupancy = np.zeros((60, 80), dtype=np.int8)
    occupancy[[0, -1], :] = occupancy[:, [0, -1]] = 100
    occupancy[18:, 39:41] = 100
    return occupancy, 0.05, (-2.0, -1.5)


def ask_for_plan(
    make: Callable[[], Any],
    room: tuple[NDArray[np.int8], float, tuple[float, float]] | None,
    start: tuple[float, float],
    goal: tuple[float, float],
    tolerance: float = 0.3,
) -> Array:
    """Run the student's node beside a client in simulated time; return the answered path, (N, 2) in metres."""
    from robotbrain.ros import SimContext  # first: it makes the imports below resolve

    from nav_msgs.msg import OccupancyGrid  # isort: skip
    from nav_msgs.srv import GetPlan  # isort: skip
    from rclpy.node import Node  # isort: skip
    from rclpy.qos import DurabilityPolicy, QoSProfile  # isort: skip

    from robotbrain.ros.conversions import numpy_to_grid, path_to_numpy

    context = SimContext()
    with context.as_default():
        make()
        tester = Node("tester")
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        publisher = tester.create_publisher(OccupancyGrid, "map", latched)
        client = tester.create_client(GetPlan, "plan")
        expect(client.service_is_ready(), "the node offers no service called `plan`", hint="return-response")
        if room is not None:
            occupancy, resolution, origin = room
            publisher.publish(numpy_to_grid(occupancy, resolution, origin))
        context.run_for(0.1)
        request = GetPlan.Request()
        request.start.pose.position.x, request.start.pose.position.y = start
        request.goal.pose.position.x, request.goal.pose.position.y = goal
        request.tolerance = tolerance
        future = client.call_async(request)
        try:
            context.run_for(5.0)
        except Exception as error:
            cause = error.__cause__ or error
            forgot = "must return" in str(cause)
            hint = "return-response" if forgot else "empty-when-stuck" if "NoneType" in str(cause) else ""
            if isinstance(cause, NotImplementedError):
                raise cause from None
            fail(f"the service callback raised {type(cause).__name__}: {cause}", hint=hint)
        expect(future.done(), "the service did not answer within 5 s", hint="return-response")
        return path_to_numpy(future.result().plan)


def compare_plan(
    make: Callable[[], Any],
    room: tuple[NDArray[np.int8], float, tuple[float, float]],
    start: tuple[float, float],
    goal: tuple[float, float],
    tolerance: float = 0.3,
) -> Array:
    """Check that the answered path starts at the start, ends at the goal and stays off the obstacles; return it."""
    points = ask_for_plan(make, room, start, goal, tolerance)
    given = f"start {start}, goal {goal} in a walled room"
    expect(len(points) > 1, "the path is empty, but there is a route", got=f"{len(points)} poses", given=given)
    occupancy, resolution, origin = room
    mirrored = (points - np.asarray(origin))[:, ::-1] + np.asarray(origin)
    lost = np.hypot(*(points[0] - start)) > 0.4 and np.hypot(*(mirrored[0] - start)) < 0.4
    hint = "row-is-y" if lost else ""
    expect(np.hypot(*(points[0] - start)) < 0.6, "the path does not begin at the start", got=points[0], hint=hint)
    reach = tolerance + 1.5 * resolution
    expect(np.hypot(*(points[-1] - goal)) < reach, "the path does not end at the goal", got=points[-1], hint=hint)
    dense = planning.resample(points, resolution / 2)
    cells = np.floor((dense - np.asarray(origin)) / resolution).astype(int)[:, ::-1]
    inside = ((cells >= 0) & (cells < occupancy.shape)).all(axis=1)
    expect(inside.all(), "the path leaves the map", got=dense[~inside][:1], hint="row-is-y")
    hits = occupancy[cells[:, 0], cells[:, 1]] >= 65
    expect(not hits.any(), "the path goes through an obstacle", got=dense[hits][:1], given=given, hint=hint)
    return points


def clearance(points: Array, room: tuple[NDArray[np.int8], float, tuple[float, float]]) -> float:
    """Return the smallest distance from a path to the centre of an obstacle cell, m."""
    occupancy, resolution, origin = room
    cells = np.argwhere(occupancy >= 65)[:, ::-1]
    centres = np.asarray(origin) + (cells + 0.5) * resolution
    dense = planning.resample(points, resolution / 2)
    return float(np.sqrt(((dense[:, None] - centres[None]) ** 2).sum(axis=2)).min())


# ---------------------------------------------------------------- Parts 4 and 5


def wilson(successes: int, runs: int, z: float = 1.96) -> tuple[float, float]:
    """Return Wilson's score interval."""
    rate = successes / runs
    centre, half = rate + z**2 / (2 * runs), z * np.sqrt(rate * (1 - rate) / runs + z**2 / (4 * runs**2))
    return float((centre - half) / (1 + z**2 / runs)), float((centre + half) / (1 + z**2 / runs))


def made_up_run(success: bool, perception_ms: Array) -> Any:
    """Return something with the fields of a run. It came near the goal either way: only the judge's verdict counts."""
    return SimpleNamespace(
        success=success,
        reason="",
        goal_distance=0.1,
        seconds=20.0,
        path_length=7.0,
        collisions=(),
        perception_ms=perception_ms,
        planning_ms=np.array([20.0]),
    )


def compare_evaluation(
    evaluate: Callable[..., Any],
    successes: Sequence[bool],
    keys: tuple[str, ...] = ("success_rate", "interval", "p95_ms"),
    seed: int = 0,
) -> None:
    """Let the student evaluate made-up runs and compare the given keys with the closed form."""
    rng = np.random.default_rng(seed)
    latencies = [rng.exponential(4.0, rng.integers(5, 40)) + 3.0 for _ in successes]
    runs = [made_up_run(ok, ms) for ok, ms in zip(successes, latencies, strict=True)]
    answer = evaluate(lambda index: runs[index], range(len(runs)))
    if not isinstance(answer, dict) or not {"success_rate", "interval", "p95_ms"} <= set(answer):
        fail("the answer is not the dict asked for", got=answer, expected="keys success_rate, interval, p95_ms")
    n, k = len(runs), sum(successes)
    given = f"{k} successes in {n} runs"
    if "success_rate" in keys:
        hint = _first_match(answer["success_rate"], [("percent-or-share", 100 * k / n)]) if k else ""
        hint = hint or "success-is-the-judges"
        expect_close(answer["success_rate"], k / n, given=given, hint=hint, what="success_rate")
    if "interval" in keys:
        _compare_interval(answer["interval"], k, n, given)
    if "p95_ms" in keys:
        pooled = float(np.percentile(np.concatenate(latencies), 95))
        means = float(np.mean([np.percentile(ms, 95) for ms in latencies]))
        hint = _first_match(answer["p95_ms"], [("pool-latencies", means)], atol=1e-6)
        expect_close(answer["p95_ms"], pooled, rtol=0.02, given=given, hint=hint, what="p95_ms")


def _compare_interval(answer: Any, k: int, n: int, given: str) -> None:
    rate = k / n
    wald = 1.96 * np.sqrt(rate * (1 - rate) / n)
    mistakes = [
        ("wilson-not-wald", (rate - wald, rate + wald)),
        ("wilson-not-wald", (max(0.0, rate - wald), min(1.0, rate + wald))),
    ]
    hint = _first_match(answer, mistakes, atol=1e-3)
    expect_close(answer, wilson(k, n), atol=5e-4, given=given, hint=hint, what="interval")


def compare_gap(paired_gap: Callable[..., Any], simulated: Sequence[float], surrogate: Sequence[float]) -> None:
    """Compare with SciPy's paired t interval."""
    from scipy import stats

    a, b = np.asarray(simulated, dtype=float), np.asarray(surrogate, dtype=float)
    interval = stats.ttest_rel(b, a).confidence_interval(0.95)
    mean, n = float((b - a).mean()), len(a)
    answer = paired_gap(list(simulated), list(surrogate))
    welch = stats.ttest_ind(b, a, equal_var=False).confidence_interval(0.95)
    pooled = stats.ttest_ind(b, a).confidence_interval(0.95)
    deviation = float((b - a).std(ddof=1))
    half_z = 1.96 * deviation / np.sqrt(n)
    half_population = float(stats.t.ppf(0.975, n - 1)) * float((b - a).std()) / np.sqrt(n)
    spread = float(stats.t.ppf(0.975, n - 1)) * np.sqrt(a.var(ddof=1) / n + b.var(ddof=1) / n)
    mistakes = [
        ("surrogate-minus-simulated", (-mean, -interval.high, -interval.low)),
        ("pairs", (mean, welch.low, welch.high)),
        ("pairs", (mean, pooled.low, pooled.high)),
        ("pairs", (mean, mean - spread, mean + spread)),
        ("t-not-z", (mean, mean - half_z, mean + half_z)),
        ("sample-deviation", (mean, mean - half_population, mean + half_population)),
    ]
    hint = _first_match(answer, mistakes, atol=1e-3)
    given = f"simulated {np.round(a, 1).tolist()}, surrogate {np.round(b, 1).tolist()}"
    expect_close(answer, (mean, interval.low, interval.high), atol=1e-4, given=given, hint=hint)
