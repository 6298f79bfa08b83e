"""How the tests of `lab_integration` judge Part 2 and the planner node: costmaps, paths, straightened paths.

Searching is what costs time here, so puzzles come from small pools whose oracles are computed once; each student gets
some of them, turned and mirrored by chance. A costmap that is turned has a path that is turned: the oracle stays.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robotbrain.grading import expect, fail
from robotbrain.grading.suites import judging
from robotbrain.grading.suites.planner_bench import PlannerBench, Point, Room
from robotbrain.pipeline import planning

if TYPE_CHECKING:
    from robotbrain.grading import Student

Array = NDArray[np.float64]
Cell = tuple[int, int]
Path = list[Cell]


def untouched(student: Student, name: str, array: NDArray[Any], *arguments: Any, **options: Any) -> Any:
    """Return ``student.name(array, ...)``, or fail if that changed the array."""
    held = student.hold(array.copy())
    answer = student[name](held, *arguments, **options)
    after = judging.as_numbers(student.fetch(held))
    same = after is not None and np.array_equal(after, array, equal_nan=True)
    expect(
        same, "the function changed the array it was given", hint="leave-inputs-alone", expected="the array as it was"
    )
    return answer


# ---------------------------------------------------------------- the costmap


def inflate(
    occupancy: Any, resolution: float, radius: float = 0.22, decay: float = 0.12, weight: float = 12.0
) -> Array:
    """Call the library's costmap with the exercise's arguments."""
    return planning.inflate(occupancy, resolution, planning.InflationParams(radius, decay, weight, 2.0))


def compare_inflation(student: Student, occupancy: NDArray[np.int8], resolution: float, **params: float) -> None:
    """Compare with the reference."""
    answer = untouched(student, "inflate", occupancy, resolution, **params)
    expected = inflate(occupancy, resolution, **params)
    radius, decay, weight = params["radius"], params["decay"], params["weight"]

    def mistakes() -> list[tuple[str, Array]]:
        def other(where: Any, value: int) -> Array:
            return inflate(np.where(where, value, occupancy).astype(np.int8), resolution, **params)

        distance = np.full(occupancy.shape, np.inf)
        obstacles = np.argwhere(occupancy >= 65)
        if len(obstacles):
            cells = np.indices(occupancy.shape).transpose(1, 2, 0)
            squared = ((cells[:, :, None, :] - obstacles[None, None]) ** 2).sum(-1)
            distance = resolution * np.sqrt(squared.min(axis=2))
        unknown = 2.0 * (occupancy == -1)
        soft = 1 + weight * np.exp(-(distance - radius) / decay) + unknown
        late = np.where(distance <= radius, np.inf, 1 + weight * np.exp(-distance / decay) + unknown)
        return [
            ("cells-or-metres", inflate(occupancy, 1.0, **params)),
            ("unknown-costs-more", other(occupancy == -1, 0)),
            ("unknown-costs-more", np.where(occupancy == -1, np.inf, expected)),
            ("lethal-radius", soft),
            ("lethal-radius", np.where(distance == 0, np.inf, soft)),
            ("decay-from-radius", late),
            ("threshold-65", other(occupancy == 64, 100)),
            ("threshold-65", other((occupancy > 0) & (occupancy < 65), 100)),
            ("threshold-65", other(occupancy == 65, 64)),
        ]

    given = f"a {occupancy.shape} grid of {resolution:g} m cells, " + ", ".join(f"{k} {v:g}" for k, v in params.items())
    judging.compare(answer, expected, mistakes, match_atol=1e-5, given=given)


# ---------------------------------------------------------------- the search


@dataclass(frozen=True)
class Turn:
    """One of the eight ways to lay a grid down: transposed or not, each axis reversed or not."""

    transposed: bool
    reversed_rows: bool
    reversed_columns: bool

    @classmethod
    def random(cls, rng: np.random.Generator) -> Turn:
        """Return one of the eight."""
        return cls(*(bool(bit) for bit in rng.integers(2, size=3)))

    def grid(self, cells: NDArray[Any]) -> NDArray[Any]:
        """Return a grid laid down so."""
        turned = cells.T if self.transposed else cells
        return turned[:: -1 if self.reversed_rows else 1, :: -1 if self.reversed_columns else 1].copy()

    def cell(self, cell: Cell, shape: tuple[int, ...]) -> Cell:
        """Return where a cell of a grid of this shape comes to lie."""
        row, column = cell[::-1] if self.transposed else cell
        rows, columns = shape[::-1] if self.transposed else shape
        return (
            rows - 1 - row if self.reversed_rows else row,
            columns - 1 - column if self.reversed_columns else column,
        )


@dataclass(frozen=True, eq=False)
class Maze:
    """A costmap, two cells, and what the cheapest path between them costs (inf: there is none)."""

    cost: Array
    start: Cell
    goal: Cell
    best: float = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "best", planning.astar_search(self.cost, self.start, self.goal).cost)

    def turned(self, rng: np.random.Generator) -> Maze:
        """Return the same maze laid down another way."""
        turn = Turn.random(rng)
        maze = object.__new__(Maze)  # not searched again: turning changes no cost
        for name, value in (
            ("cost", turn.grid(self.cost)),
            ("start", turn.cell(self.start, self.cost.shape)),
            ("goal", turn.cell(self.goal, self.cost.shape)),
            ("best", self.best),
        ):
            object.__setattr__(maze, name, value)
        return maze


def draw(pool: Sequence[Maze], count: int, rng: np.random.Generator) -> list[Maze]:
    """Return some mazes of a pool, each turned by chance."""
    return [pool[int(k)].turned(rng) for k in rng.choice(len(pool), count, replace=False)]


def checked_path(answer: Any, cost: Array, start: Cell, goal: Cell) -> Path:
    """Return the student's path as a list of cells, or fail with what is wrong about it."""
    if answer is None:
        fail("the answer is None, but there is a route", expected="a list of (row, column)", got="None")
    path = as_cells(answer)
    if path is None:
        fail("the path is not a list of (row, column) pairs", got=answer, expected="[(row, column), ...]")
    assert path is not None
    expect(len(path) > 0, "the path is empty", got=path, expected="a list of cells")
    ends = path[0] == tuple(start) and path[-1] == tuple(goal)
    expect(ends, "the path's ends are wrong", got=(path[0], path[-1]), expected=(start, goal), hint="path-ends")
    for a, b in itertools.pairwise(path):
        step = max(abs(a[0] - b[0]), abs(a[1] - b[1]))
        expect(
            step == 1,
            "two cells of the path are no neighbours",
            got=(a, b),
            expected="a step to one of the eight cells around",
        )
        inside = 0 <= b[0] < cost.shape[0] and 0 <= b[1] < cost.shape[1]
        expect(
            inside and np.isfinite(cost[b]),
            "the path enters a lethal cell",
            got=b,
            expected="a cell on the map that is not lethal",
        )
        if a[0] != b[0] and a[1] != b[1]:
            free = np.isfinite(cost[a[0], b[1]]) and np.isfinite(cost[b[0], a[1]])
            expect(
                free,
                "the path cuts a corner",
                got=(a, b),
                hint="corner-cutting",
                expected="a diagonal step only where both cells beside it are free",
            )
    return path


def as_cells(answer: Any) -> Path | None:
    """Return an answer as a list of (row, column), or None if it is no such list."""
    try:
        return [(int(row), int(column)) for row, column in answer]
    except (TypeError, ValueError):
        return None


def compare_astar(student: Student, maze: Maze, hint: str = "") -> Path:
    """Check that the path is valid and as cheap as the cheapest; return it."""
    answer = untouched(student, "astar", maze.cost, maze.start, maze.goal)
    if maze.best == np.inf:
        expect(answer is None, "there is no route", got=answer, expected="None", hint="no-route")
        return []
    path = checked_path(answer, maze.cost, maze.start, maze.goal)
    spent = planning.path_cost(maze.cost, path)
    if spent > maze.best * (1 + 1e-9) + 1e-9:
        fail(
            "the path is valid, but not the cheapest",
            got=f"cost {spent:.4f}",
            expected=f"cost {maze.best:.4f}",
            given=f"a {maze.cost.shape} grid, start {maze.start}, goal {maze.goal}",
            hint=hint or why_dear(maze, path),
        )
    return path


def why_dear(maze: Maze, path: Path) -> str:
    """Return the hint of the mistake that explains a path that is too dear."""
    flat = np.where(np.isfinite(maze.cost), 1.0, np.inf)
    shortest = planning.astar_search(flat, maze.start, maze.goal)
    uneven = np.ptp(maze.cost[np.isfinite(maze.cost)]) > 1e-9
    if uneven and abs(planning.path_cost(flat, path) - shortest.cost) < 1e-9:
        return "use-the-costs"
    if len(path) - 1 <= min_steps(maze):
        return "diagonal-cost"
    return "admissible-heuristic"


def min_steps(maze: Maze) -> int:
    """Return the fewest steps between start and goal, whatever their length (breadth first)."""
    cost = maze.cost
    frontier, seen, steps = {maze.start}, {maze.start}, 0
    while frontier and maze.goal not in seen:
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


# ---------------------------------------------------------------- the straightened path


class Detour:
    """A costmap and a path through it, with the prices of its stretches and of the segments that may replace them."""

    def __init__(self, cost: Array, path: Path) -> None:
        self.cost, self.path = cost, path
        self._segments: dict[tuple[int, int], float] = {}
        steps = [planning.path_cost(cost, [a, b]) for a, b in itertools.pairwise(path)]
        self._travelled = np.concatenate([[0.0], np.cumsum(steps)])

    def stretch(self, first: int, last: int) -> float:
        """Return what the path costs between two of its cells, by index."""
        return float(self._travelled[last] - self._travelled[first])

    def segment(self, first: int, last: int) -> float:
        """Return what the straight line between them costs."""
        key = (first, last)
        if key not in self._segments:
            self._segments[key] = planning.segment_cost(self.cost, self.path[first], self.path[last])
        return self._segments[key]

    def fill(self) -> None:
        """Compute all prices now."""
        for first, last in itertools.combinations(range(len(self.path)), 2):
            self.segment(first, last)


def smoothed(student: Student, path: Path, cost: Array, **options: float) -> Path:
    """Return the kept cells, checked to be a sub-list with the same ends."""
    answer = student.smooth(list(path), cost.copy(), **options)
    kept = as_cells(answer)
    if kept is None:
        fail("the answer is not a list of (row, column) pairs", got=answer, expected="cells of the path")
    assert kept is not None
    remaining = iter(path)
    expect(
        all(cell in remaining for cell in kept),
        "the kept cells are no sub-list of the path",
        got=kept,
        given=path,
        expected="cells of the path, in its order",
    )
    ends = len(kept) > 0 and kept[0] == path[0] and kept[-1] == path[-1]
    expect(ends, "the ends must be kept", got=kept, expected=f"first {path[0]}, last {path[-1]}", hint="path-ends")
    return kept


def check_smoothed(
    student: Student, detour: Detour, slack: float | None = None, turn: Turn = Turn(False, False, False)
) -> None:
    """Check each kept segment: safe, not too dear, and as long as it may be (``slack`` None: the default, 1.05)."""
    shape = detour.cost.shape
    path = [turn.cell(cell, shape) for cell in detour.path]
    options = {} if slack is None else {"slack": slack}
    kept = smoothed(student, path, turn.grid(detour.cost), **options)
    hint = "keep-the-distance" if slack is None else "use-slack"
    slack = 1.05 if slack is None else slack
    index = {cell: k for k, cell in enumerate(path)}
    for a, b in itertools.pairwise(kept):
        first, last = index[a], index[b]
        if last - first > 1:
            price, stretch = detour.segment(first, last), detour.stretch(first, last)
            expect(
                np.isfinite(price),
                "a segment crosses a lethal cell",
                got=(a, b),
                hint="lethal-shortcut",
                expected="segments through cells that are not lethal",
            )
            expect(
                price <= slack * stretch + 1e-6,
                "a segment is much dearer than the stretch it replaces",
                got=f"{a} to {b}: {price:.2f}",
                expected=f"at most {slack:g} x {stretch:.2f}",
                hint=hint,
            )
        for later in range(len(path) - 1, last, -1):
            if detour.segment(first, later) <= slack * detour.stretch(first, later) - 1e-6:
                fail("a farther cell was within reach", got=(a, b), expected=(a, path[later]), hint="farthest-first")


# ---------------------------------------------------------------- the planner node


def compare_plan(bench: PlannerBench, room: Room, start: Point, goal: Point, tolerance: float = 0.3) -> Array:
    """Check that the answered path starts at the start, ends at the goal and stays off the obstacles; return it."""
    points = bench.ask(start, goal, tolerance)
    given = f"start {start}, goal {goal} in a walled room"
    expect(
        len(points) > 1,
        "the path is empty, but there is a route",
        got=f"{len(points)} poses",
        given=given,
        expected="at least 2 poses",
    )
    occupancy, resolution, origin = room
    mirrored = (points - np.asarray(origin))[:, ::-1] + np.asarray(origin)
    lost = np.hypot(*(points[0] - start)) > 0.4 and np.hypot(*(mirrored[0] - start)) < 0.4
    hint = "row-is-y" if lost else ""
    expect(
        np.hypot(*(points[0] - start)) < 0.6,
        "the path does not begin at the start",
        got=points[0],
        hint=hint,
        expected=f"within 0.6 m of {start}",
    )
    reach = tolerance + 1.5 * resolution
    expect(
        np.hypot(*(points[-1] - goal)) < reach,
        "the path does not end at the goal",
        got=points[-1],
        hint=hint,
        expected=f"within {reach:g} m of {goal}",
    )
    dense = planning.resample(points, resolution / 2)
    cells = np.floor((dense - np.asarray(origin)) / resolution).astype(int)[:, ::-1]
    inside = ((cells >= 0) & (cells < occupancy.shape)).all(axis=1)
    expect(
        inside.all(),
        "the path leaves the map",
        got=dense[~inside][:1],
        hint="row-is-y",
        expected="points within the map",
    )
    hits = occupancy[cells[:, 0], cells[:, 1]] >= 65
    expect(
        not hits.any(),
        "the path goes through an obstacle",
        got=dense[hits][:1],
        given=given,
        hint=hint,
        expected="a path through free cells only",
    )
    return points
