"""How the tests of `hw3_performance` try a student's planner and repaired brain out."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robotbrain.grading import expect, fail
from robotbrain.grading.suites.hw3_performance_verdict import p95

if TYPE_CHECKING:
    from robotbrain.pipeline.brain import RunResult
    from robotbrain.pipeline.inherited import BrainSetup
    from robotbrain.sim import World

Array = NDArray[np.float64]
Room = tuple[NDArray[np.int8], float, tuple[float, float]]

RADIUS = 0.22
"""What the planner keeps from the centre of an occupied cell, m."""

BUDGET_MS = {"orin-nano-8gb:15W": 130.0, "xavier-nx:15W": 180.0}
"""End-to-end latency that a repaired brain may have at the 95th percentile, by module, ms."""


class CountedWork:
    """A cost model in which work is free, but counted."""

    def __init__(self) -> None:
        self.units: dict[str, float] = {}

    def cost(self, node_name: str, kind: str, name: str) -> int:
        """Nothing costs anything."""
        return 0

    def work_ns(self, kind: str, units: float) -> int:
        """Count work of a callback."""
        self.units[kind] = self.units.get(kind, 0.0) + units
        return 0


def open_room() -> Room:
    """Return occupancy, resolution and origin of an empty 4 x 3 m room."""
    occupancy = np.zeros((60, 80), dtype=np.int8)
    occupancy[[0, -1], :] = occupancy[:, [0, -1]] = 100
    return occupancy, 0.05, (-2.0, -1.5)


def walled_room() -> Room:
    """Return the same with a wall across most of it; the way around is at small y."""
    occupancy, resolution, origin = open_room()
    occupancy[22:, 39:41] = 100
    return occupancy, resolution, origin


def with_box(room: Room, x: float, y: float, half: float = 0.12) -> Room:
    """Return a room with one more box."""
    occupancy, resolution, origin = room[0].copy(), room[1], room[2]
    columns = slice(int((x - half - origin[0]) / resolution), int((x + half - origin[0]) / resolution) + 1)
    rows = slice(int((y - half - origin[1]) / resolution), int((y + half - origin[1]) / resolution) + 1)
    occupancy[rows, columns] = 100
    return occupancy, resolution, origin


class Bench:
    """A student's planner node beside a client, in simulated time.

    Args:
        make: makes the node.
    """

    def __init__(self, make: Callable[[], Any]) -> None:
        from robotbrain.ros import SimContext  # first: it makes the imports below resolve

        from nav_msgs.msg import OccupancyGrid  # isort: skip
        from nav_msgs.srv import GetPlan  # isort: skip
        from rclpy.node import Node  # isort: skip
        from rclpy.qos import DurabilityPolicy, QoSProfile  # isort: skip

        self.work = CountedWork()
        self._context = SimContext(cost_model=self.work)
        self._request: Callable[[], Any] = GetPlan.Request
        with self._context.as_default():
            make()
            tester = Node("tester")
            latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            self._maps = tester.create_publisher(OccupancyGrid, "map", latched)
            self._client = tester.create_client(GetPlan, "plan")
        expect(self._client.service_is_ready(), "the node offers no service called `plan`", hint="return-response")

    def show(self, room: Room) -> None:
        """Publish a map."""
        from robotbrain.ros.conversions import numpy_to_grid

        self._maps.publish(numpy_to_grid(*room))
        self._run(0.1)

    def ask(self, start: tuple[float, float], goal: tuple[float, float], tolerance: float = 0.3) -> Array:
        """Return the answered path, (N, 2) m; ``work.units`` then holds what the answer alone was charged."""
        from robotbrain.ros.conversions import path_to_numpy

        self.work.units.clear()
        request = self._request()
        request.start.pose.position.x, request.start.pose.position.y = start
        request.goal.pose.position.x, request.goal.pose.position.y = goal
        request.tolerance = tolerance
        future = self._client.call_async(request)
        self._run(1.0)
        expect(future.done(), "the service did not answer", hint="return-response")
        return path_to_numpy(future.result().plan)

    def _run(self, seconds: float) -> None:
        try:
            self._context.run_for(seconds)
        except Exception as error:
            cause = error.__cause__ or error
            if isinstance(cause, NotImplementedError):
                raise cause from None
            stuck = "empty-when-stuck" if "NoneType" in str(cause) else ""
            hint = "return-response" if "must return" in str(cause) else stuck
            fail(f"a callback of the node raised {type(cause).__name__}: {cause}", hint=hint)


def clearance(points: Array, room: Room) -> float:
    """Return the distance from a path to the nearest centre of an occupied cell, m."""
    from robotbrain.pipeline.planning import resample

    occupancy, resolution, origin = room
    centres = np.asarray(origin) + (np.argwhere(occupancy >= 65)[:, ::-1] + 0.5) * resolution
    dense = resample(points, resolution / 2)
    return float(np.sqrt(((dense[:, None] - centres[None]) ** 2).sum(axis=2)).min())


def check_path(
    points: Array,
    room: Room,
    start: tuple[float, float],
    goal: tuple[float, float],
    *,
    hint: str = "check-the-rest",
    near: float = 0.3,
    astray: str = "from-the-robot-on",
) -> None:
    """Check that a path leads from near ``start`` to ``goal`` and keeps its distance.

    Args:
        hint: for a path through an obstacle.
        near: how far from ``start`` it may begin, m.
        astray: hint for one that begins elsewhere.
    """
    given = f"start {start}, goal {goal}"
    expect(len(points) > 1, "the path is empty, but there is a route", got=f"{len(points)} poses", given=given)
    gap = float(np.hypot(*(points[0] - start)))
    expect(
        gap <= near,
        "the path does not begin at the robot",
        got=f"{np.round(points[0], 2)}, {gap:.2f} m away",
        expected=f"within {near:g} m of {start}",
        given=given,
        hint=astray,
    )
    gap = float(np.hypot(*(points[-1] - goal)))
    expect(
        gap <= 0.15,
        "the path does not end at the goal",
        got=f"{np.round(points[-1], 2)}, {gap:.2f} m away",
        expected=f"within 0.15 m of {goal}",
        given=given,
        hint="goal-moved",
    )
    room_left = clearance(points, room)
    expect(
        room_left > RADIUS - 0.03,
        "the path leads through an obstacle, or scrapes along it",
        got=f"{room_left:.2f} m to an occupied cell",
        expected=f"more than {RADIUS:g} m",
        given=given,
        hint=hint,
    )


def share_kept(points: Array, earlier: Array) -> float:
    """Return which share of a path's points, the first aside, lies on an earlier path (to 1 mm)."""
    from robotbrain.pipeline.planning import resample

    dense = resample(earlier, 0.001)
    rest = points[1:]
    gaps = np.sqrt(((rest[:, None] - dense[None]) ** 2).sum(axis=2)).min(axis=1)
    return float((gaps < 2e-3).mean()) if len(rest) else 0.0


# ---------------------------------------------------------------- the repaired brain

_RUNS: dict[tuple[Any, ...], RunResult] = {}


def repaired(student: Any, module: str = "") -> BrainSetup:
    """Return what the student's ``repair`` makes of the inherited brain (on another module)."""
    from robotbrain.pipeline.inherited import BrainSetup, inherited_brain

    given = inherited_brain()
    if module:
        given = replace(given, module=module)
    answer: object = student.repair(given)
    if not isinstance(answer, BrainSetup):
        wanted = "a BrainSetup, made with dataclasses.replace"
        fail("`repair` should return a BrainSetup", got=type(answer).__name__, expected=wanted)
        raise AssertionError  # `fail` has raised already
    return answer


def easy_world(seed: int, distance: float = 1.6) -> World:
    """Return an almost empty world in which the robot starts ``distance`` m from the marker and half turned to it."""
    from robotbrain.sim import Pose2D, generate_world

    world = generate_world(seed, 0.0)
    goal, start = world.goal, world.start
    away = math.hypot(start.x - goal.x, start.y - goal.y)
    x, y = (g + distance * (s - g) / away for g, s in ((goal.x, start.x), (goal.y, start.y)))
    return replace(world, start=Pose2D(x, y, math.atan2(goal.y - y, goal.x - x) + 0.4))


def drive_repaired(student: Any, world: int, module: str = "", time_limit: float = 15.0) -> RunResult:
    """Return a run of the student's repaired brain in an easy world, driven once for all tests that look at it."""
    from robotbrain.ros import CallbackError

    planner = student["ReusingPlanner"] if student.has("ReusingPlanner") else None
    key = (student.repair, planner, world, module, time_limit)
    if key not in _RUNS:
        setup = repaired(student, module)
        try:
            _RUNS[key] = setup.drive(easy_world(world), time_limit=time_limit)
        except CallbackError as error:
            fail(f"a node raised {type(error.cause).__name__} on the way: {error.cause}")
    return _RUNS[key]


def check_latency(run: RunResult, module: str) -> None:
    """Check the end-to-end latency against the module's budget; half the points for up to half as much again."""
    budget = BUDGET_MS[module]
    latency = p95(run)
    shown = "no command was ever built on an image" if latency == math.inf else f"{latency:.0f} ms"
    expect(
        latency <= budget,
        "the end-to-end latency is above the budget",
        got=f"95th percentile: {shown}",
        expected=f"at most {budget:g} ms",
        given=f"an easy world on {module}",
        hint="measure-again",
        credit=0.5 if latency <= 1.5 * budget else 0.0,
    )
