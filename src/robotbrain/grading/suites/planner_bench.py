"""How labs try a student's planner node out: beside a client in simulated time, and in a closed loop.

The node lives where the student's code does, in a :class:`PlannerHost`; the :class:`PlannerBench` that judges it lives
with the tests and sends it maps and requests. Rooms are small and coarse, so that a search in plain Python stays quick.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robotbrain.grading import expect, fail
from robotbrain.grading.suites.judging import as_numbers
from robotbrain.grading.suites.planner_probes import PlannerHost, host

if TYPE_CHECKING:
    from robotbrain.grading import Student

Array = NDArray[np.float64]
Point = tuple[float, float]
Room = tuple[NDArray[np.int8], float, Point]
"""Occupancy (row, column) in percent, side of a cell in m, and the outer corner of cell (0, 0) in m."""

RADIUS = 0.22
"""What a planner keeps from the centre of an occupied cell, m."""


# ---------------------------------------------------------------- rooms


def open_room(resolution: float = 0.1) -> Room:
    """Return an empty room of 4 x 3 m between walls."""
    occupancy = np.zeros((round(3 / resolution), round(4 / resolution)), dtype=np.int8)
    occupancy[[0, -1], :] = occupancy[:, [0, -1]] = 100
    return occupancy, resolution, (-2.0, -1.5)


def walled_room(resolution: float = 0.1, gap: float = -0.5) -> Room:
    """Return the same with a wall across it that ends at y = ``gap`` m: the way around is at smaller y."""
    occupancy, resolution, origin = open_room(resolution)
    middle = occupancy.shape[1] // 2
    occupancy[round((gap - origin[1]) / resolution) :, middle : middle + 1] = 100
    return occupancy, resolution, origin


def with_box(room: Room, x: float, y: float, half: float = 0.12) -> Room:
    """Return a room with one more box."""
    occupancy, resolution, origin = room[0].copy(), room[1], room[2]
    columns = slice(int((x - half - origin[0]) / resolution), int((x + half - origin[0]) / resolution) + 1)
    rows = slice(int((y - half - origin[1]) / resolution), int((y + half - origin[1]) / resolution) + 1)
    occupancy[rows, columns] = 100
    return occupancy, resolution, origin


def clearance(points: Array, room: Room) -> float:
    """Return the distance from a path to the nearest centre of an occupied cell, m."""
    from robotbrain.pipeline.planning import resample

    occupancy, resolution, origin = room
    centres = np.asarray(origin) + (np.argwhere(occupancy >= 65)[:, ::-1] + 0.5) * resolution
    dense = resample(points, resolution / 2)
    return float(np.sqrt(((dense[:, None] - centres[None]) ** 2).sum(axis=2)).min())


# ---------------------------------------------------------------- where the tests are


class PlannerBench:
    """Asks a hosted planner and judges whether it answers at all.

    Args:
        hosted: a :class:`PlannerHost`, or the stand-in of one in the student's process.

    Attributes:
        work: what the last answer was charged, by kind of work.
        most_work: the most that any answer was charged, by kind.
    """

    def __init__(self, hosted: Any) -> None:
        self._host = hosted
        self.work: dict[str, float] = {}
        self.most_work: dict[str, float] = {}
        expect(
            self._host.ready() is True,
            "the node offers no service called `plan`",
            hint="return-response",
            expected="a service `plan`, of type GetPlan",
        )

    @classmethod
    def of(cls, student: Student, name: str) -> PlannerBench:
        """Return a bench for the student's class of this name."""
        student[name]  # a class that is missing is reported before anything else
        return cls(_call(lambda: student.run(host, name)))

    def show(self, room: Room) -> dict[str, float]:
        """Publish a map; return what the node charged for it, by kind of work."""
        return _plain(_call(lambda: self._host.show(*room)))

    def ask(self, start: Point, goal: Point, tolerance: float = 0.3) -> Array:
        """Return the answered path, (N, 2) m."""
        path, work = _call(lambda: self._host.ask(tuple(start), tuple(goal), tolerance))
        expect(
            path is not None,
            "the service did not answer",
            hint="return-response",
            expected="the response, with its plan filled in",
        )
        self.work = _plain(work)
        for kind, units in self.work.items():
            self.most_work[kind] = max(units, self.most_work.get(kind, 0.0))
        points = as_numbers(path)
        if points is None or points.ndim != 2 or points.shape[1] != 2 or not np.isfinite(points).all():
            fail("the answered path is no list of finite points", got=path, expected="finite points (x, y)")
        assert points is not None
        return points


def _plain(work: Mapping[Any, Any]) -> dict[str, float]:
    return {str(kind): float(units) for kind, units in work.items()}


def _call(ask: Callable[[], Any]) -> Any:
    """Return ``ask()``, or fail with what the student's callback raised."""
    try:
        return ask()
    except NotImplementedError:
        raise
    except Exception as error:
        kind, said = getattr(error, "type_name", type(error).__name__), str(error)
        stuck = "empty-when-stuck" if "NoneType" in said else ""
        hint = "return-response" if "must return" in said else stuck
        fail(f"a callback of the node raised {kind}: {said}", hint=hint, expected="no exception")


def approach(
    bench: PlannerBench, room: Room, start: Point, goal: Point, *, sight: float = 1.4, stride: float = 0.9
) -> str:
    """Let a robot that sees ``sight`` m around it drive by the answered paths; return what went wrong, or ''.

    It starts in an unknown room, asks for a path, follows it for ``stride`` m, has seen more, and asks again.
    """
    from robotbrain.pipeline.planning import resample

    occupancy, resolution, origin = room
    centres = np.asarray(origin) + (np.indices(occupancy.shape)[::-1].transpose(1, 2, 0) + 0.5) * resolution
    known = np.full_like(occupancy, -1)
    here = np.asarray(start, dtype=float)
    for _ in range(math.ceil(3 * math.dist(start, goal) / stride)):
        seen = np.hypot(*(centres - here).transpose(2, 0, 1)) < sight
        known[seen] = occupancy[seen]
        bench.show((known, resolution, origin))
        path = bench.ask((float(here[0]), float(here[1])), goal)
        if len(path) < 2:
            return "was given no path on the way"
        line = resample(np.vstack([here, path]), resolution / 4)
        driven = line[np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))]) <= stride]
        if clearance(driven, room) < RADIUS / 2:
            return "touched an obstacle"
        here = driven[-1]
        if math.dist(here, goal) < 0.3:
            return ""
    return "did not arrive"


def warm_students() -> None:
    """Ask the kit's own planner for a path: what is imported and made for it, copies of this process have."""
    from robotbrain.pipeline.nodes.planner import PlannerNode

    kits = PlannerHost(PlannerNode)
    kits.ready()
    kits.show(*walled_room())
    kits.ask((-1.5, 0.0), (1.5, 0.0), 0.3)
