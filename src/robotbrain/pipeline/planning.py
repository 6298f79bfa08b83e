"""Planning on a grid: inflate obstacles, search with A*, straighten the path.

Sources: Hart, Nilsson and Raphael, "A Formal Basis for the Heuristic Determination of Minimum Cost Paths", 1968;
the inflation layer follows the exponential decay of Nav2's costmap_2d.
"""

from __future__ import annotations

import heapq
import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from robotbrain.errors import InputError
from robotbrain.pipeline.grid import OCCUPIED_FROM, UNKNOWN, Cell, GridFrame

LETHAL = np.inf
"""Traversal cost of a cell in which the robot's centre must never be."""

_ROOT2 = 2.0**0.5


@dataclass(frozen=True)
class InflationParams:
    """How obstacles grow into a costmap.

    Attributes:
        robot_radius: radius of the robot's footprint, m; closer cells are lethal.
        decay_length: distance over which the extra cost falls by e, m.
        weight: extra cost right outside the robot radius (a free cell costs 1).
        unknown_cost: extra cost of a cell that nobody has seen.
    """

    robot_radius: float = 0.22
    decay_length: float = 0.12
    weight: float = 12.0
    unknown_cost: float = 2.0


@dataclass(frozen=True)
class SearchResult:
    """What A* found and what it cost to find.

    Attributes:
        path: cells from start to goal, both included; None where there is no route.
        cost: sum of the edge costs along the path, in cell sides; inf without a route.
        expanded: number of cells taken off the open list (the planner's unit of CPU work).
    """

    path: list[Cell] | None
    cost: float
    expanded: int


def check_occupancy(occupancy: ArrayLike) -> NDArray[np.int8]:
    """Return ``occupancy`` as an (H, W) int8 array of percent (-1 unknown), or raise InputError."""
    grid = np.asarray(occupancy)
    if grid.ndim != 2 or grid.size == 0:
        raise InputError(
            "occupancy",
            given=grid.shape,
            expected="an array of shape (rows, columns)",
            fix="Reshape the map first.",
        )
    if not (np.issubdtype(grid.dtype, np.integer) or np.issubdtype(grid.dtype, np.bool_)):
        if not np.isfinite(grid).all():
            raise InputError(
                "occupancy",
                given="NaN or infinity",
                expected="integers -1 (unknown) or 0 to 100",
                fix="Write -1 where nothing is known.",
            )
        grid = np.rint(grid)
    if grid.dtype == np.bool_:
        grid = grid.astype(np.int8) * 100
    if grid.min() < -1 or grid.max() > 100:
        raise InputError(
            "occupancy",
            given=f"values {grid.min()} to {grid.max()}",
            expected="-1 (unknown) or 0 to 100 percent",
            fix="Scale probabilities by 100.",
        )
    return grid.astype(np.int8)


def inflate(occupancy: ArrayLike, resolution: float, params: InflationParams | None = None) -> NDArray[np.float64]:
    """Turn an occupancy grid into traversal costs.

    A cell's cost is inf within ``robot_radius`` of an obstacle cell's centre, else
    ``1 + weight * exp(-(d - robot_radius) / decay_length)``, plus ``unknown_cost`` where nothing is known.

    Args:
        occupancy: (H, W) percent, -1 unknown; from ``OCCUPIED_FROM`` on a cell is an obstacle.
        resolution: cell side, m.
        params: the radii and weights; defaults suit the kit's robot.

    Returns:
        (H, W) costs, each at least 1, inf where the robot's centre must not be.
    """
    params = params or InflationParams()
    grid = check_occupancy(occupancy)
    obstacle = grid >= OCCUPIED_FROM
    cost = np.ones(grid.shape)
    if obstacle.any():
        distance = ndimage.distance_transform_edt(~obstacle, sampling=resolution)
        cost += params.weight * np.exp(-(distance - params.robot_radius) / params.decay_length)
        cost[distance <= params.robot_radius] = LETHAL
    cost[grid == UNKNOWN] += params.unknown_cost
    return cost


def astar_search(cost: ArrayLike, start: Cell, goal: Cell) -> SearchResult:
    """Find the cheapest 8-connected path between two cells.

    An edge costs its length (1 or sqrt 2) times the mean cost of its two cells. A diagonal step needs both cells it
    passes between to be free, so a path never clips an obstacle's corner. The heuristic is the octile distance times
    the smallest cost, which never overestimates.

    Args:
        cost: (H, W) traversal costs, positive, inf where lethal.
        start: (row, column).
        goal: (row, column).

    Raises:
        InputError: for costs that are NaN or not positive, or cells outside the grid.
    """
    grid = np.asarray(cost, dtype=float)
    _check_search(grid, start, goal)
    rows, columns = grid.shape
    if not (np.isfinite(grid[start]) and np.isfinite(grid[goal])):
        return SearchResult(None, np.inf, 0)
    # A border of lethal cells and flat indices: no bounds checks in the loop.
    width = columns + 2
    padded = np.full((rows + 2, width), LETHAL)
    padded[1:-1, 1:-1] = grid
    cells = padded.ravel().tolist()
    scale = float(grid[np.isfinite(grid)].min())
    source, target = (start[0] + 1) * width + start[1] + 1, (goal[0] + 1) * width + goal[1] + 1

    down, across = np.abs(np.indices(padded.shape) - np.reshape((goal[0] + 1, goal[1] + 1), (2, 1, 1)))
    octile = np.maximum(down, across) + (_ROOT2 - 1) * np.minimum(down, across)
    heuristic = (octile * scale).ravel().tolist()

    straight = ((-width, 0.5), (-1, 0.5), (1, 0.5), (width, 0.5))
    diagonal = tuple((a + b, a, b) for a in (-width, width) for b in (-1, 1))
    half_root = _ROOT2 / 2
    infinity = float("inf")
    best = [infinity] * len(cells)
    parent = [-1] * len(cells)
    closed = bytearray(len(cells))
    best[source] = 0.0
    # Ties go to the cell nearer the goal, then to the smaller index: the same path on every machine.
    queue = [(heuristic[source], heuristic[source], source)]
    expanded = 0
    push, pop = heapq.heappush, heapq.heappop
    while queue:
        _, _, cell = pop(queue)
        if closed[cell]:
            continue
        closed[cell] = 1
        expanded += 1
        if cell == target:
            break
        here, spent = cells[cell], best[cell]
        for offset, half in straight:
            other = cell + offset
            there = cells[other]
            if there < infinity and not closed[other]:
                total = spent + half * (here + there)
                if total < best[other]:
                    best[other] = total
                    parent[other] = cell
                    push(queue, (total + heuristic[other], heuristic[other], other))
        for offset, side_a, side_b in diagonal:
            other = cell + offset
            there = cells[other]
            if (
                there < infinity
                and not closed[other]
                and cells[cell + side_a] < infinity
                and cells[cell + side_b] < infinity
            ):
                total = spent + half_root * (here + there)
                if total < best[other]:
                    best[other] = total
                    parent[other] = cell
                    push(queue, (total + heuristic[other], heuristic[other], other))
    if not closed[target]:
        return SearchResult(None, infinity, expanded)
    path: list[Cell] = []
    cell = target
    while cell != -1:
        path.append((cell // width - 1, cell % width - 1))
        cell = parent[cell]
    return SearchResult(path[::-1], best[target], expanded)


def astar(cost: ArrayLike, start: Cell, goal: Cell) -> list[Cell] | None:
    """Return the cheapest path of :func:`astar_search`, or None where there is no route."""
    return astar_search(cost, start, goal).path


def path_cost(cost: ArrayLike, path: list[Cell]) -> float:
    """Return the sum of edge costs along ``path`` as :func:`astar_search` counts them."""
    cells = np.asarray(path, dtype=int)
    if len(cells) < 2:
        return 0.0
    values = np.asarray(cost, dtype=float)[cells[:, 0], cells[:, 1]]
    rows, columns = (cells[1:] - cells[:-1]).T
    return float((np.hypot(rows, columns) * (values[1:] + values[:-1])).sum()) / 2


def cells_on_segment(start: Cell, end: Cell) -> NDArray[np.intp]:
    """Return the (N, 2) cells that the segment between two cell centres touches, in order of row and column.

    Exact, in integers. Where the segment passes through a corner, both cells beside the corner are included, as in A*'s
    rule for diagonal steps.
    """
    (row, column), (last, stop) = sorted(((int(start[0]), int(start[1])), (int(end[0]), int(end[1]))))
    height, width = last - row, stop - column
    if not height:
        found = [(row, c) for c in range(column, stop + 1)]
        return np.array(found, dtype=np.intp)
    found = []
    for k in range(height + 1):
        # Half rows above the start, where the segment enters and leaves this row of cells; there it is at column
        # + half * width / (2 * height), and touches cells up to half a cell away.
        near, far = sorted((max(2 * k - 1, 0) * width, min(2 * k + 1, 2 * height) * width))
        first, final = column - (height - near) // (2 * height), column + (height + far) // (2 * height)
        found += [(row + k, c) for c in range(first, final + 1)]
    return np.array(found, dtype=np.intp)


def segment_cost(cost: NDArray[np.float64], start: Cell, end: Cell) -> float:
    """Return length times mean cost of the cells on a straight segment; inf if any of them is lethal."""
    cells = cells_on_segment(start, end)
    mean = float(cost[cells[:, 0], cells[:, 1]].mean())
    return math.dist(start, end) * mean if math.isfinite(mean) else LETHAL


def smooth(path: list[Cell], cost: ArrayLike, slack: float = 1.05) -> list[Cell]:
    """Replace staircases by straight segments where that is safe and hardly dearer.

    From each kept cell the path is followed as far as one straight segment can stand in for it: it must cross no lethal
    cell and cost at most ``slack`` times the stretch it replaces (so a path around an obstacle keeps its distance).

    Args:
        path: cells from start to goal.
        cost: (H, W) traversal costs.
        slack: how much dearer a straight segment may be.

    Returns:
        The kept cells: a subsequence of ``path`` with the same first and last cell.
    """
    grid = np.asarray(cost, dtype=float)
    if len(path) < 3:
        return list(path)
    cells = np.asarray(path, dtype=int)
    steps = np.linalg.norm(np.diff(cells, axis=0), axis=1)
    values = grid[cells[:, 0], cells[:, 1]]
    travelled = np.concatenate([[0.0], np.cumsum(steps * (values[1:] + values[:-1]) / 2)])

    def straight_enough(first: int, last: int) -> bool:
        allowed = slack * (travelled[last] - travelled[first]) + 1e-9
        return bool(segment_cost(grid, path[first], path[last]) <= allowed)

    kept = [0]
    while kept[-1] < len(path) - 1:
        here = kept[-1]
        # Double the stride while it works, then close in by bisection: few segments are tried.
        good, bad = here + 1, len(path)
        stride = 2
        while here + stride < bad:
            if straight_enough(here, here + stride):
                good = here + stride
                stride *= 2
            else:
                bad = here + stride
        while bad - good > 1:
            middle = (good + bad) // 2
            if straight_enough(here, middle):
                good = middle
            else:
                bad = middle
        kept.append(good)
    return [path[index] for index in kept]


def nearest_free(cost: ArrayLike, cell: Cell, radius: int) -> Cell | None:
    """Return the cell with finite cost nearest to ``cell`` within ``radius`` cells (cheapest among equals), or None."""
    grid = np.asarray(cost, dtype=float)
    row0, col0 = max(cell[0] - radius, 0), max(cell[1] - radius, 0)
    window = grid[row0 : max(cell[0] + radius + 1, 0), col0 : max(cell[1] + radius + 1, 0)]
    if window.size == 0 or not np.isfinite(window).any():
        return None
    rows, columns = np.nonzero(np.isfinite(window))
    squared = (rows + row0 - cell[0]) ** 2 + (columns + col0 - cell[1]) ** 2
    order = np.lexsort((window[rows, columns], squared))[0]
    if squared[order] > radius**2:
        return None
    return int(rows[order] + row0), int(columns[order] + col0)


def resample(points: ArrayLike, spacing: float) -> NDArray[np.float64]:
    """Return (M, 2) points at most ``spacing`` metres apart along the polyline ``points`` (N, 2), corners kept."""
    line = np.asarray(points, dtype=float)
    if len(line) < 2:
        return line
    pieces = [line[:1]]
    for a, b in itertools.pairwise(line):
        count = max(int(np.ceil(np.linalg.norm(b - a) / spacing)), 1)
        pieces.append(a + (b - a) * (np.arange(1, count + 1) / count)[:, None])
    return np.concatenate(pieces)


@dataclass(frozen=True)
class PlanResult:
    """A path in metres and what finding it took.

    Attributes:
        points: (N, 2) x, y in the map frame, m; None where there is no route.
        expanded: cells expanded by A*.
        cells: of the grid that was inflated and searched.
        path_cells: cells of the path that A* found, before it was straightened.
    """

    points: NDArray[np.float64] | None
    expanded: int
    cells: int = 0
    path_cells: int = 0


def plan_path(
    occupancy: ArrayLike,
    frame: GridFrame,
    start: tuple[float, float],
    goal: tuple[float, float],
    *,
    tolerance: float = 0.3,
    params: InflationParams | None = None,
    crop: bool = True,
) -> PlanResult:
    """Inflate, search and straighten: from metres to metres.

    A start inside the lethal zone (the robot stopped close to an obstacle) is moved to the nearest free cell; a goal in
    it is moved to the nearest free cell within ``tolerance`` metres.

    Args:
        occupancy: (rows, columns) percent, -1 for unknown.
        frame: where its cells lie.
        start, goal: x, y in the map frame, m.
        tolerance: how far from a goal that cannot be reached the path may end, m.
        params: inflation.
        crop: plan on the part of the map that is known, and its surroundings, instead of on all of it.
    """
    grid = check_occupancy(occupancy)
    if crop:
        grid, frame = _crop(grid, frame, (start, goal))
    cost = inflate(grid, frame.resolution, params)
    start_cell, goal_cell = frame.to_cell(*start), frame.to_cell(*goal)
    begin = nearest_free(cost, start_cell, int(0.5 / frame.resolution))
    end = nearest_free(cost, goal_cell, int(tolerance / frame.resolution))
    if begin is None or end is None:
        return PlanResult(None, 0, grid.size)
    found = astar_search(cost, begin, end)
    if found.path is None:
        return PlanResult(None, found.expanded, grid.size)
    inner = frame.to_points(smooth(found.path, cost))[1:-1]
    last = np.asarray(goal, dtype=float) if end == goal_cell else frame.to_points(end)
    # A start in the lethal zone leaves it by the cell that the search began at, not across the zone.
    first = [start] if begin == start_cell else [start, frame.to_points(begin)]
    points = np.concatenate([first, inner, [last]])
    return PlanResult(resample(points, 2 * frame.resolution), found.expanded, grid.size, len(found.path))


def _crop(
    grid: NDArray[np.int8], frame: GridFrame, points: tuple[tuple[float, float], ...]
) -> tuple[NDArray[np.int8], GridFrame]:
    """Cut the grid to what is known, the given points and a margin of 1 m: planning takes time by the cell."""
    margin = int(1.0 / frame.resolution)
    known = grid != UNKNOWN
    rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    wanted = np.array([frame.to_cell(*point) for point in points])
    all_rows = np.concatenate([rows, wanted[:, 0]])
    all_columns = np.concatenate([columns, wanted[:, 1]])
    top, bottom = max(all_rows.min() - margin, 0), min(all_rows.max() + margin + 1, grid.shape[0])
    left, right = max(all_columns.min() - margin, 0), min(all_columns.max() + margin + 1, grid.shape[1])
    if top >= bottom or left >= right:
        return grid, frame
    origin = (frame.origin[0] + left * frame.resolution, frame.origin[1] + top * frame.resolution)
    cut = grid[top:bottom, left:right]
    return cut, GridFrame(frame.resolution, origin, (cut.shape[0], cut.shape[1]))


def _check_search(grid: NDArray[np.float64], start: Cell, goal: Cell) -> None:
    if grid.ndim != 2 or grid.size == 0:
        raise InputError(
            "cost",
            given=grid.shape,
            expected="an array of shape (rows, columns)",
            fix="Pass the output of inflate().",
        )
    if np.isnan(grid).any() or (grid <= 0).any():
        raise InputError(
            "cost",
            given="NaN, zero or negative cells",
            expected="positive costs, inf where lethal",
            fix="Start from np.ones(shape) and add; a negative cost would break A*.",
        )
    for name, cell in (("start", start), ("goal", goal)):
        if not (0 <= cell[0] < grid.shape[0] and 0 <= cell[1] < grid.shape[1]):
            raise InputError(
                name,
                given=tuple(cell),
                expected=f"(row, column) inside {grid.shape}",
                fix="Convert metres with GridFrame.to_cell; rows are y, columns are x.",
            )
