"""Planning against oracles: scipy's Dijkstra, exact geometry, and what must hold for any map."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from robotbrain.errors import InputError
from robotbrain.pipeline.grid import GridFrame
from robotbrain.pipeline.planning import (
    InflationParams,
    astar_search,
    cells_on_segment,
    inflate,
    nearest_free,
    path_cost,
    plan_path,
    resample,
    smooth,
)


def random_cost(seed: int, size: int = 14, walls: float = 0.3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    cost = rng.uniform(1.0, 5.0, (size, size))
    cost[rng.random((size, size)) < walls] = np.inf
    cost[0, 0] = cost[-1, -1] = 1.0
    return cost


def dijkstra_cost(cost: np.ndarray, start: tuple[int, int], goal: tuple[int, int]) -> float:
    """Build the same 8-connected graph edge by edge and let scipy solve it."""
    rows, columns = cost.shape
    sources, targets, weights = [], [], []
    for r in range(rows):
        for c in range(columns):
            for dr, dc in ((0, 1), (1, 0), (1, 1), (1, -1)):
                r2, c2 = r + dr, c + dc
                if not (0 <= r2 < rows and 0 <= c2 < columns) or np.isinf(cost[r, c]) or np.isinf(cost[r2, c2]):
                    continue
                if dr and dc and (np.isinf(cost[r, c2]) or np.isinf(cost[r2, c])):
                    continue
                sources.append(r * columns + c)
                targets.append(r2 * columns + c2)
                weights.append(np.hypot(dr, dc) * (cost[r, c] + cost[r2, c2]) / 2)
    graph = coo_matrix((weights, (sources, targets)), shape=(cost.size, cost.size)).tocsr()
    distance = dijkstra(graph, directed=False, indices=start[0] * columns + start[1])
    return float(distance[goal[0] * columns + goal[1]])


@given(seed=st.integers(0, 10_000), walls=st.sampled_from([0.0, 0.2, 0.35, 0.5]))
@settings(max_examples=60, deadline=None)
def test_astar_is_as_cheap_as_dijkstra(seed: int, walls: float) -> None:
    cost = random_cost(seed, walls=walls)
    goal = (cost.shape[0] - 1, cost.shape[1] - 1)
    found = astar_search(cost, (0, 0), goal)
    best = dijkstra_cost(cost, (0, 0), goal)
    assert found.cost == pytest.approx(best) or (np.isinf(best) and found.path is None)
    if found.path is not None:
        assert path_cost(cost, found.path) == pytest.approx(best)
        assert found.path[0] == (0, 0) and found.path[-1] == goal
        assert np.abs(np.diff(found.path, axis=0)).max() == 1


def test_astar_expands_fewer_cells_than_dijkstra_would() -> None:
    cost = np.ones((60, 60))
    found = astar_search(cost, (30, 5), (30, 55))
    assert found.expanded == 51  # a straight line of ties broken towards the goal
    assert found.cost == pytest.approx(50.0)


def test_astar_never_squeezes_between_diagonal_obstacles() -> None:
    cost = np.ones((4, 4))
    cost[1, 2] = cost[2, 1] = np.inf
    found = astar_search(cost, (1, 1), (2, 2))
    assert found.path is not None
    assert len(found.path) > 2


@pytest.mark.parametrize(
    ("cost", "start", "goal", "words"),
    [
        (np.ones(5), (0, 0), (0, 0), "shape"),
        (np.array([[1.0, np.nan]]), (0, 0), (0, 1), "positive"),
        (np.array([[1.0, 0.0]]), (0, 0), (0, 1), "positive"),
        (np.ones((3, 3)), (0, 3), (0, 0), "start"),
        (np.ones((3, 3)), (0, 0), (-1, 0), "goal"),
    ],
)
def test_astar_refuses_what_it_cannot_search(cost, start, goal, words) -> None:
    with pytest.raises(InputError, match=words):
        astar_search(cost, start, goal)


def test_inflation_is_lethal_within_the_radius_and_decays_beyond() -> None:
    occupancy = np.zeros((41, 41), dtype=np.int8)
    occupancy[20, 20] = 100
    params = InflationParams(robot_radius=0.3, decay_length=0.2, weight=8.0)
    cost = inflate(occupancy, 0.05, params)
    rows, columns = np.indices(occupancy.shape)
    distance = 0.05 * np.hypot(rows - 20, columns - 20)
    np.testing.assert_array_equal(np.isinf(cost), distance <= 0.3)
    outside = distance > 0.3
    np.testing.assert_allclose(cost[outside], 1 + 8.0 * np.exp(-(distance[outside] - 0.3) / 0.2))


def test_inflation_counts_unknown_cells_as_dearer_not_lethal() -> None:
    occupancy = np.array([[0, -1, 64]], dtype=np.int8)
    params = InflationParams(unknown_cost=2.5)
    np.testing.assert_allclose(inflate(occupancy, 0.05, params), [[1.0, 3.5, 1.0]])


@pytest.mark.parametrize("bad", [np.zeros(3), np.full((2, 2), 101), np.array([[np.nan, 0.0]]), np.zeros((0, 4))])
def test_inflation_refuses_what_is_no_map(bad: np.ndarray) -> None:
    with pytest.raises(InputError, match="occupancy"):
        inflate(bad, 0.05)


@given(
    a=st.tuples(st.integers(0, 15), st.integers(0, 15)),
    b=st.tuples(st.integers(0, 15), st.integers(0, 15)),
)
@settings(max_examples=80, deadline=None)
def test_cells_on_segment_cover_every_point_of_it(a: tuple[int, int], b: tuple[int, int]) -> None:
    cells = {tuple(int(v) for v in cell) for cell in cells_on_segment(a, b)}
    for t in np.linspace(0, 1, 997):
        point = np.array(a) + t * (np.array(b) - np.array(a))
        candidates = {tuple(int(v) for v in np.floor(point + 0.5 + e)) for e in (-1e-9, 1e-9)}
        assert candidates & cells
    assert {a, b} <= cells
    # and nothing that the segment does not touch: a cell's centre is at most half a diagonal away
    direction = np.subtract(b, a) / max(np.linalg.norm(np.subtract(b, a)), 1e-9)
    for cell in cells:
        offset = np.subtract(cell, a)
        assert abs(direction[0] * offset[1] - direction[1] * offset[0]) <= np.sqrt(0.5) + 1e-6


@given(seed=st.integers(0, 10_000))
@settings(max_examples=40, deadline=None)
def test_smoothing_is_safe_and_not_dearer(seed: int) -> None:
    cost = random_cost(seed, size=18, walls=0.2)
    found = astar_search(cost, (0, 0), (17, 17))
    if found.path is None:
        return
    kept = smooth(found.path, cost)
    assert kept[0] == found.path[0] and kept[-1] == found.path[-1]
    assert set(kept) <= set(found.path)
    total = 0.0
    for a, b in itertools.pairwise(kept):
        cells = cells_on_segment(a, b)
        values = cost[cells[:, 0], cells[:, 1]]
        if max(abs(a[0] - b[0]), abs(a[1] - b[1])) > 1:
            assert np.isfinite(values).all()
            total += np.hypot(a[0] - b[0], a[1] - b[1]) * values.mean()
        else:
            total += path_cost(cost, [a, b])
    assert total <= 1.05 * found.cost + 1e-6


def test_smoothing_straightens_an_open_staircase() -> None:
    cost = np.ones((20, 40))
    found = astar_search(cost, (2, 2), (12, 37))
    assert found.path is not None
    assert smooth(found.path, cost) == [(2, 2), (12, 37)]


def test_nearest_free_is_the_nearest_by_euclid() -> None:
    cost = np.full((9, 9), np.inf)
    cost[4, 7] = cost[7, 6] = 1.0
    assert nearest_free(cost, (4, 4), 4) == (4, 7)
    assert nearest_free(cost, (4, 4), 2) is None
    assert nearest_free(cost, (40, 40), 2) is None


def test_plan_in_metres_goes_round_a_wall_and_keeps_clear() -> None:
    frame = GridFrame.centred(3.0, 0.05)
    occupancy = np.zeros(frame.shape, dtype=np.int8)
    wall = frame.to_cells([[0.0, y] for y in np.arange(-1.0, 2.9, 0.02)])
    occupancy[wall[:, 0], wall[:, 1]] = 100
    plan = plan_path(occupancy, frame, (-1.0, 0.5), (1.0, 0.5))
    assert plan.points is not None
    np.testing.assert_allclose(plan.points[[0, -1]], [(-1.0, 0.5), (1.0, 0.5)])
    from_wall = np.hypot(plan.points[:, 0], np.maximum(-1.0 - plan.points[:, 1], 0.0))
    assert from_wall.min() > 0.2
    assert plan.points[:, 1].min() < -1.0
    assert plan.expanded > 0


def test_plan_without_a_route_says_so() -> None:
    frame = GridFrame.centred(2.0, 0.05)
    occupancy = np.zeros(frame.shape, dtype=np.int8)
    wall = frame.to_cells([[0.0, y] for y in np.arange(-2.0, 2.0, 0.02)])
    occupancy[wall[:, 0], wall[:, 1]] = 100
    assert plan_path(occupancy, frame, (-1.0, 0.0), (1.0, 0.0)).points is None


def test_resample_keeps_corners_and_spacing() -> None:
    line = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.55]])
    points = resample(line, 0.1)
    gaps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert gaps.max() <= 0.1 + 1e-9
    assert gaps.sum() == pytest.approx(1.55)
    assert any(np.allclose(p, (1.0, 0.0)) for p in points)


def test_frame_round_trip() -> None:
    frame = GridFrame(0.1, (-2.0, 1.0), (30, 50))
    cells = np.array([[0, 0], [29, 49], [7, 3]])
    np.testing.assert_array_equal(frame.to_cells(frame.to_points(cells)), cells)
    assert frame.to_cell(-1.95, 1.25) == (2, 0)
    assert list(frame.inside([[0, 0], [30, 0], [-1, 2]])) == [True, False, False]
    with pytest.raises(InputError, match="resolution"):
        GridFrame(0.0, (0, 0), (3, 3))
