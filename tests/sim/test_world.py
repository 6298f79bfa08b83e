"""Worlds: always solvable, never trivial, and the same for the same seed."""

from __future__ import annotations

import dataclasses
import json
import math
from collections import deque

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from robotbrain.errors import InputError
from robotbrain.sim import Pose2D, World, WorldSpec, generate_world, to_child, to_parent
from robotbrain.sim.generate import BLOCKER_OVERHANG, route_exists
from robotbrain.sim.geometry import distance_to_rectangle, rectangle_gap, segment_hits_rectangle
from robotbrain.sim.world import Obstacle

SEEDS = range(25)
RADIUS_WITH_MARGIN = 0.18 + 0.10


@pytest.fixture(scope="module")
def worlds() -> list[World]:
    return [generate_world(seed) for seed in SEEDS]


def occupancy(world: World, resolution: float) -> np.ndarray:
    """Cells whose middle lies in an obstacle, written out with corners and cross products (an oracle)."""
    n = round(2 * world.half_x / resolution)
    axis = (np.arange(n) + 0.5) * resolution - world.half_x
    px, py = np.meshgrid(axis, axis, indexing="ij")
    occupied = np.zeros((n, n), bool)
    for o in world.obstacles:
        corners = o.corners()
        inside = np.ones_like(occupied)
        for (ax, ay), (bx, by) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            inside &= (bx - ax) * (py - ay) - (by - ay) * (px - ax) >= 0
        occupied |= inside
    return np.pad(occupied, 1, constant_values=True)  # the outer walls


def reachable(free: np.ndarray, start: tuple[int, int], goal: tuple[int, int]) -> bool:
    """Breadth-first search over 4-neighbours."""
    seen, queue = {start}, deque([start])
    if not (free[start] and free[goal]):
        return False
    while queue:
        i, j = queue.popleft()
        if (i, j) == goal:
            return True
        for cell in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)):
            if free[cell] and cell not in seen:
                seen.add(cell)
                queue.append(cell)
    return False


def test_same_seed_same_world_and_other_seed_other_world(worlds: list[World]) -> None:
    assert generate_world(3) == worlds[3]
    assert len({json.dumps(w.to_dict()) for w in worlds}) == len(worlds)
    assert generate_world(np.int64(3)) == worlds[3]


def test_goal_can_be_reached_with_margin(worlds: list[World]) -> None:
    """Distance transform and breadth-first search, neither of which the generator uses."""
    resolution = 0.04
    for world in [*worlds, *(generate_world(seed, 1.0) for seed in range(8))]:
        distance = ndimage.distance_transform_edt(~occupancy(world, resolution)) * resolution
        # a cell's distance is measured between cell middles: half a cell short of the truth at worst
        free = distance >= RADIUS_WITH_MARGIN

        def cell(x: float, y: float, half: float = world.half_x) -> tuple[int, int]:
            return int((x + half) / resolution) + 1, int((y + half) / resolution) + 1

        start, goal = cell(world.start.x, world.start.y), cell(world.goal.x, world.goal.y)
        assert reachable(free, start, goal), world.spec


def test_start_and_goal_are_free_and_far_apart(worlds: list[World]) -> None:
    for w in worlds:
        assert math.hypot(w.start.x - w.goal.x, w.start.y - w.goal.y) >= 4.0
        assert w.clearance([w.start.x, w.start.y]) >= 0.5
        assert w.clearance([w.goal.x, w.goal.y]) >= 0.6


def test_straight_line_is_blocked_by_something_wide_that_stays(worlds: list[World]) -> None:
    for w in worlds:
        a, b = np.array([w.start.x, w.start.y]), np.array([w.goal.x, w.goal.y])
        side = np.array([-(b - a)[1], (b - a)[0]]) / np.hypot(*(b - a))
        reach = BLOCKER_OVERHANG - 0.01
        blocked = [
            all(segment_hits_rectangle(a + k * side, b + k * side, *o.footprint) for k in (-reach, 0.0, reach))
            for o in w.obstacles
            if not o.movable
        ]
        assert any(blocked), w.spec


def test_gaps_are_passable_or_closed(worlds: list[World]) -> None:
    for w in [*worlds, *(generate_world(seed, 1.0) for seed in range(8))]:
        for i, a in enumerate(w.obstacles):
            assert all(rectangle_gap(a.footprint, b.footprint) >= 0.75 for b in w.obstacles[:i])


def test_some_boxes_only_the_camera_can_see(worlds: list[World]) -> None:
    low = [[o for o in w.movable if o.height < 0.20] for w in worlds]
    assert all(0.10 <= o.height <= 0.14 for boxes in low for o in boxes)
    assert np.mean([len(boxes) > 0 for boxes in low]) > 0.9
    assert any(o.height > 0.25 for w in worlds for o in w.movable)


def test_clearance_is_positive_exactly_where_nothing_stands(worlds: list[World]) -> None:
    for w in worlds[:6]:
        occupied = occupancy(w, 0.05)[1:-1, 1:-1]
        axis = (np.arange(160) + 0.5) * 0.05 - 4.0
        clearance = w.clearance(np.stack(np.meshgrid(axis, axis, indexing="ij"), -1))
        sure = np.abs(clearance) > 1e-9
        assert np.array_equal((clearance < 0)[sure], occupied[sure])
        assert w.clearance([3.9, 0.0]) <= 0.1 + 1e-9
        assert w.clearance([0.0, -4.5]) < 0


def test_difficulty_adds_obstacles() -> None:
    count = [np.mean([len(generate_world(s, d).obstacles) for s in range(6)]) for d in (0.0, 0.5, 1.0)]
    assert count[0] <= 3 < count[1] < count[2]


def test_route_check_sees_a_closed_wall(worlds: list[World]) -> None:
    """A wall across the whole room between start and goal must make a world unsolvable."""
    w = worlds[0]
    middle = ((w.start.x + w.goal.x) / 2, (w.start.y + w.goal.y) / 2)
    yaw = math.atan2(w.goal.y - w.start.y, w.goal.x - w.start.x) + math.pi / 2
    wall = Obstacle("wall_x", "wall", *middle, yaw, 8.0, 0.05, 0.8, False, (1.0, 1.0, 1.0, 1.0))
    assert route_exists(w, RADIUS_WITH_MARGIN)
    assert not route_exists(dataclasses.replace(w, obstacles=(wall,)), RADIUS_WITH_MARGIN)


def test_json_round_trip(worlds: list[World]) -> None:
    for w in worlds[:5]:
        assert World.from_dict(json.loads(json.dumps(w.to_dict()))) == w


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda d: d.pop("goal"), "world"),
        (lambda d: d["goal"].update(x="far"), r"world\.goal\.x"),
        (lambda d: d["goal"].update(x=math.nan), r"world\.goal\.x"),
        (lambda d: d["start"].update(z=0.0), r"world\.start"),
        (lambda d: d["obstacles"][0].update(kind="sofa"), r"world\.obstacles\[0\]\.kind"),
        (lambda d: d["look"].update(light=[0.0, 1.0]), r"world\.look\.light"),
        (lambda d: d["spec"].update(seed=-1), "world seed"),
        (lambda d: d.update(format="other/9"), "world"),
    ],
)
def test_bad_json_is_named(worlds: list[World], change, named: str) -> None:
    data = json.loads(json.dumps(worlds[0].to_dict()))
    change(data)
    with pytest.raises(InputError, match=named):
        World.from_dict(data)


@pytest.mark.parametrize(
    ("seed", "difficulty"),
    [(-1, 0.5), (1.5, 0.5), (True, 0.5), ("1", 0.5), (1, -0.1), (1, 1.1), (1, math.nan), (1, None)],
)
def test_bad_specs_are_refused(seed: object, difficulty: object) -> None:
    with pytest.raises(InputError, match="world"):
        WorldSpec(seed, difficulty)  # type: ignore[arg-type]


rectangles = st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(-4, 4), st.floats(0.05, 1.5), st.floats(0.05, 1.5))


@settings(max_examples=60, deadline=None)
@given(rectangles, st.tuples(st.floats(-4, 4), st.floats(-4, 4)))
def test_rectangle_distance_against_sampled_boundary(r: tuple[float, ...], p: tuple[float, float]) -> None:
    x, y, yaw, hx, hy = r
    t = np.linspace(-1, 1, 401)
    edge = np.concatenate(
        [np.stack([t * hx, s * hy + 0 * t], -1) for s in (-1, 1)]
        + [np.stack([s * hx + 0 * t, t * hy], -1) for s in (-1, 1)]
    )
    c, s = math.cos(yaw), math.sin(yaw)
    boundary = edge @ np.array([[c, s], [-s, c]]) + (x, y)
    sampled = np.linalg.norm(boundary - p, axis=1).min()
    signed = float(distance_to_rectangle(p, x, y, yaw, hx, hy))
    assert abs(signed) == pytest.approx(sampled, abs=0.008)
    local = (c * (p[0] - x) + s * (p[1] - y), c * (p[1] - y) - s * (p[0] - x))
    if abs(signed) > 1e-6:
        assert (signed < 0) == (abs(local[0]) < hx and abs(local[1]) < hy)


@settings(max_examples=60, deadline=None)
@given(rectangles, rectangles)
def test_rectangle_gap_against_sampled_points(a: tuple[float, ...], b: tuple[float, ...]) -> None:
    """The gap is the least distance of any point of one to the other."""
    u = np.linspace(-1, 1, 41)
    grid = np.stack(np.meshgrid(u * a[3], u * a[4]), -1).reshape(-1, 2)
    points = to_parent(Pose2D(*a[:3]), grid)
    sampled = max(float(distance_to_rectangle(points, *b).min()), 0.0)
    assert rectangle_gap(a, b) == pytest.approx(sampled, abs=0.06)
    assert rectangle_gap(a, b) == pytest.approx(rectangle_gap(b, a), abs=1e-12)


def test_frames_are_inverse_and_map_frame_starts_at_the_robot() -> None:
    start = Pose2D(1.0, -2.0, 2.1)
    assert to_parent(start, [0.0, 0.0]) == pytest.approx([1.0, -2.0])
    assert to_parent(start, [1.0, 0.0]) == pytest.approx([1.0 + math.cos(2.1), -2.0 + math.sin(2.1)])
    points = np.random.default_rng(0).normal(size=(7, 2))
    assert to_child(start, to_parent(start, points)) == pytest.approx(points)
