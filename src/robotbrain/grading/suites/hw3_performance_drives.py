"""How the tests of `hw3_performance` try a student's planner and repaired brain out.

The brain that drives is the course's own, deployed as the student's ``repair`` says; only their planner runs where
their code does. A run without it depends on the deployment alone, so it is made once (:func:`driven`).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from robotbrain.grading import expect, fail
from robotbrain.grading.suites.hw3_performance_probes import describe_repair, host_repaired
from robotbrain.grading.suites.hw3_performance_verdict import p95
from robotbrain.grading.suites.planner_bench import (
    RADIUS,
    Array,
    PlannerBench,
    Point,
    Room,
    approach,
    clearance,
    walled_room,
)
from robotbrain.grading.suites.planner_probes import PlannerHost

if TYPE_CHECKING:
    from robotbrain.grading import Student
    from robotbrain.pipeline.brain import RunResult
    from robotbrain.pipeline.inherited import BrainSetup
    from robotbrain.sim import World

NANO, NX = "orin-nano-8gb:15W", "xavier-nx:15W"

BUDGET_MS = {NANO: 130.0, NX: 180.0}
"""End-to-end latency that a repaired brain may have at the 95th percentile, by module, ms."""

HALF_BUDGETS = 1.5
"""Half of the points are for a latency of at most so many budgets."""

SPREAD = 1.15
"""How many times as long as with the kit's planners the latency of a deployment on one thread may be, or the kit's as
long as with another, at the most; 1.09 was seen where a queue holds one image."""

TIME_LIMIT = 10.0
"""Of a drive in an easy world, s; a repaired brain takes half of it."""

SLOWEST_PLAN_MS = 500.0
"""Time that one answer of a planner may take on the module: longer, and the robot waits for its path."""


# ---------------------------------------------------------------- the planner


def check_path(
    points: Array,
    room: Room,
    start: Point,
    goal: Point,
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
        room_left > RADIUS - 0.75 * room[1],  # a path is checked by the cells that it crosses, not by its points
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


# ---------------------------------------------------------------- the repair


@dataclass(frozen=True)
class Repair:
    """A repaired brain: its setup with a planner of the kit's, and whether a student's own belongs in its place."""

    setup: BrainSetup
    own_planner: bool


def repaired(student: Student, module: str = "") -> Repair:
    """Return what the student's ``repair`` makes of the inherited brain (on another module)."""
    from robotbrain.pipeline.deployment import Deployment
    from robotbrain.pipeline.inherited import BrainSetup, cropped_planner, whole_map_planner

    student["repair"]  # a function that is missing is reported before anything else
    answer = student.run(describe_repair, module)
    if not isinstance(answer, Mapping):
        wanted = "a BrainSetup, made with dataclasses.replace"
        fail("`repair` should return a BrainSetup", got=str(answer), expected=wanted)
    kits: Mapping[str, Callable[[], Any]] = {"whole_map_planner": whole_map_planner}
    given = dict(answer["deployment"])
    if isinstance(given["image_size"], list):
        given["image_size"] = tuple(given["image_size"])
    setup = BrainSetup(
        module=str(answer["module"]),
        deployment=Deployment(**given),
        planner=kits.get(answer["planner"], cropped_planner),
        replan_after=answer["replan_after"],
    )
    return Repair(setup, answer["planner"] == "")


@functools.cache
def easy_world(seed: int, distance: float = 1.2) -> World:
    """Return an almost empty world in which the robot starts ``distance`` m from the marker and half turned to it."""
    from robotbrain.sim import Pose2D, generate_world

    world = generate_world(seed, 0.0)
    goal, start = world.goal, world.start
    away = math.hypot(start.x - goal.x, start.y - goal.y)
    x, y = (g + distance * (s - g) / away for g, s in ((goal.x, start.x), (goal.y, start.y)))
    return replace(world, start=Pose2D(x, y, math.atan2(goal.y - y, goal.x - x) + 0.4))


@dataclass(frozen=True)
class Drive:
    """What a test wants to know of a run.

    Attributes:
        success, reason: as in RunResult.
        e2e_p95_ms: 95th percentile of the end-to-end latency; inf if no command was ever built on an image.
        image_p95_ms: 95th percentile of the time from an image to its segmentation; inf without any.
    """

    success: bool
    reason: str
    e2e_p95_ms: float
    image_p95_ms: float

    @classmethod
    def of(cls, run: RunResult) -> Drive:
        """Return it for a run."""
        image = float(np.percentile(run.perception_ms, 95)) if len(run.perception_ms) else math.inf
        return cls(run.success, run.reason, p95(run), image)


Key = tuple[str | int | float | bool | None, ...]
KNOWN: dict[Key, Drive] = {}
"""Runs that were made before, by :func:`key_of`: while grading, those of the likely repairs."""


def key_of(setup: BrainSetup, world: int, time_limit: float) -> Key | None:
    """Return all that a run depends on, as plain values; None where that is more than the known runs differ in."""
    from robotbrain.pipeline.inherited import inherited_brain

    deployed, given = setup.deployment, inherited_brain().deployment
    unusual = (deployed.network, deployed.scan_rays) != (given.network, given.scan_rays) or deployed.image_size is None
    name = getattr(setup.planner, "__name__", "")
    if unusual or name not in ("whole_map_planner", "cropped_planner", "free_planner"):
        return None
    return (
        setup.module,
        *(deployed.image_size or ()),
        deployed.precision,
        deployed.camera_queue,
        deployed.one_thread,
        name,
        setup.replan_after,
        world,
        time_limit,
    )


def driven(setup: BrainSetup, world: int, time_limit: float = TIME_LIMIT) -> Drive:
    """Return a run of a brain with a planner of the kit's in an easy world; runs are deterministic."""
    key = key_of(setup, world, time_limit)
    known = None if key is None else KNOWN.get(key)
    return known or _driven(setup, world, time_limit)


@functools.lru_cache(maxsize=64)
def _driven(setup: BrainSetup, world: int, time_limit: float) -> Drive:
    return Drive.of(setup.drive(easy_world(world), time_limit=time_limit))


def drive_repaired(student: Student, world: int, module: str = "", time_limit: float = TIME_LIMIT) -> Drive:
    """Return a run of the student's repaired brain in an easy world.

    A planner that has a thread of its own delays neither perception nor control, so the kit's may drive in its place
    (:func:`check_planner` tries the student's). On one thread with all others it has to come along, unless the outcome
    is known without it: the latency earns nothing with any of the kit's planners, one that takes next to no time among
    them, or is safely within the budget with one of them that takes at least the student's time for the same questions.
    """
    from robotbrain.ros import CallbackError

    repair = repaired(student, module)
    if not (repair.own_planner and repair.setup.deployment.one_thread):
        return driven(repair.setup, world, time_limit)
    known = _known_on_one_thread(student, repair.setup, module, world, time_limit)
    if known is not None:
        return known
    hosted = student.run(host_repaired, module)
    setup = replace(repair.setup, planner=lambda: relay(hosted))
    try:
        return Drive.of(setup.drive(easy_world(world), time_limit=time_limit))
    except CallbackError as error:
        fail(f"the planner raised {getattr(error.cause, 'type_name', type(error.cause).__name__)} on the way")
        raise


def _known_on_one_thread(
    student: Student, setup: BrainSetup, module: str, world: int, time_limit: float
) -> Drive | None:
    """Return the known run that decides over a student's planner on one thread; None if it has to drive itself."""
    keys = {p: key_of(replace(setup, planner=p), world, time_limit) for p in (*_kits_planners(), free_planner)}
    known = {planner: KNOWN[key] for planner, key in keys.items() if key in KNOWN}
    budget = BUDGET_MS[module or NANO]
    best = min(known.values(), key=lambda run: run.e2e_p95_ms, default=None)
    if best and known.keys() == keys.keys() and best.e2e_p95_ms > SPREAD * HALF_BUDGETS * budget:
        return best
    likely = {p: known[p] for p in _kits_planners() if p in known}
    good = {p: run for p, run in likely.items() if run.success and SPREAD * run.e2e_p95_ms <= budget}
    if not good:
        return None
    try:
        charged = _charges(PlannerBench(student.run(host_repaired, module)))
        return next((run for p, run in good.items() if _never_more(charged, _charges_of(p), setup.module)), None)
    except Exception:  # whatever is wrong with this planner, its own drive shows
        return None


def _kits_planners() -> tuple[Callable[[], Any], ...]:
    from robotbrain.pipeline.inherited import cropped_planner, whole_map_planner

    return cropped_planner, whole_map_planner


Charges = tuple[list[dict[str, float]], list[dict[str, float]]]
"""What a planner charged for some maps, each, and for its answers, by kind of work."""


def _charges(bench: PlannerBench) -> Charges:
    """Ask a planner what it is asked on the way to the marker of an easy world; return what it charges."""
    occupancy = np.full((440, 440), -1, dtype=np.int8)  # as large as the map of the brain, and known as far as the room
    occupancy[132:308, 132:308] = 100
    occupancy[133:307, 133:307] = 0
    room, shown, answered = (occupancy, 0.05, (-11.0, -11.0)), [], []
    for along, goal in ((0.0, (1.11, -0.47)), (0.3, (1.07, -0.46)), (0.6, (1.03, -0.44)), (0.85, (1.12, -0.48))):
        start = along * goal[0], along * goal[1]
        shown.append(bench.show(room))
        check_path(bench.ask(start, goal, tolerance=0.4), room, start, goal)
        answered.append(bench.work)
    return shown, answered


@functools.cache
def _charges_of(planner: Callable[[], Any]) -> Charges:
    return _charges(PlannerBench(PlannerHost(planner)))


def _never_more(charges: Charges, others: Charges, module: str) -> bool:
    """Tell whether ``charges`` come to no more time on a module than ``others``, each compared with its like.

    An answer that charges nothing has the time that is assumed of foreign code, which may be more.
    """
    from robotbrain.jetson import load_profile

    profile, kinds = load_profile(module), {kind for works in others for work in works for kind in work}

    def times(works: list[dict[str, float]]) -> list[int]:
        return sorted(sum(profile.work_ns(kind, units) for kind, units in work.items()) for work in works)

    charged = [pair for works in charges for work in works for pair in work.items()]
    if not all(kind in kinds and 0.0 <= units < math.inf for kind, units in charged) or not all(charges[1]):
        return False
    return all(
        time <= limit
        for mine, theirs in zip(charges, others, strict=True)
        for time, limit in zip(times(mine), times(theirs), strict=True)
    )


def warm_charges() -> None:
    """Find out what the kit's planners charge, once for all students."""
    for planner in _kits_planners():
        _charges_of(planner)


_NEXT_TO_NOTHING = {"map_read": 100.0}  # an answer that charges nothing at all has the time assumed of foreign code


class _FreeAnswers:
    """A host of the kit's planner that says that its work took next to no time."""

    def __init__(self) -> None:
        from robotbrain.pipeline.inherited import cropped_planner

        self._host = PlannerHost(cropped_planner)

    def show(self, *room: Any) -> dict[str, float]:
        """Publish a map."""
        self._host.show(*room)
        return _NEXT_TO_NOTHING

    def ask(self, start: Point, goal: Point, tolerance: float) -> tuple[Array | None, dict[str, float]]:
        """Return the answered path, (N, 2) m, and that it cost next to nothing."""
        return self._host.ask(start, goal, tolerance)[0], _NEXT_TO_NOTHING


def free_planner() -> Any:
    """Return a planner node that plans like the kit's, in next to no time."""
    return relay(_FreeAnswers())


def relay(hosted: Any) -> Any:
    """Return a planner node that hands maps and requests to a :class:`PlannerHost` and charges what it charges."""
    from robotbrain.ros import SimContext  # noqa: F401 - first: it makes the imports below resolve

    from nav_msgs.msg import OccupancyGrid  # isort: skip
    from nav_msgs.srv import GetPlan  # isort: skip
    from rclpy.node import Node  # isort: skip
    from rclpy.qos import DurabilityPolicy, QoSProfile  # isort: skip

    from robotbrain.ros.conversions import grid_to_numpy, numpy_to_path

    class Relay(Node):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__("planner")
            latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            self.create_subscription(OccupancyGrid, "map", self.on_map, latched)
            self.create_service(GetPlan, "plan", self.plan)

        def charge(self, work: Mapping[str, float]) -> None:
            for kind, units in work.items():
                self.context.charge_work(str(kind), float(units))

        def on_map(self, message: Any) -> None:
            grid = grid_to_numpy(message)
            self.charge(hosted.show(grid.cells, grid.resolution, grid.origin[:2]))

        def plan(self, request: Any, response: Any) -> Any:
            start, goal = ((p.pose.position.x, p.pose.position.y) for p in (request.start, request.goal))
            points, work = hosted.ask(start, goal, float(request.tolerance))
            self.charge(work)
            if points is not None and len(points):
                response.plan = numpy_to_path(points, stamp=self.get_clock().now().to_msg())
            return response

    return Relay()


def check_planner(student: Student, module: str, rng: np.random.Generator) -> None:
    """Let a robot drive by the planner of the repaired brain, if it is the student's own, and time its answers."""
    from robotbrain.jetson import load_profile

    if not repaired(student, module).own_planner:
        return
    bench = PlannerBench(student.run(host_repaired, module))
    start, goal = ((side * float(rng.uniform(0.8, 1.2)), float(rng.uniform(-0.2, 0.4))) for side in (-1, 1))
    room = walled_room(gap=float(rng.uniform(-0.6, -0.4)))
    wrong = approach(bench, room, start, goal)
    expect(not wrong, f"with your planner the robot {wrong}", hint="measure-again")
    profile = load_profile(module or NANO)
    slowest = sum(profile.work_ns(kind, units) for kind, units in bench.most_work.items()) / 1e6
    expect(slowest <= SLOWEST_PLAN_MS, "your planner takes too long", got=f"{slowest:.0f} ms", hint="measure-again",
           expected=f"at most {SLOWEST_PLAN_MS:g} ms for an answer")  # fmt: skip


def check_latency(run: Drive, module: str) -> None:
    """Check the end-to-end latency against the module's budget; half the points for up to half as much again."""
    budget = BUDGET_MS[module]
    latency = run.e2e_p95_ms
    shown = "no command was ever built on an image" if latency == math.inf else f"{latency:.0f} ms"
    expect(
        latency <= budget,
        "the end-to-end latency is above the budget",
        got=f"95th percentile: {shown}",
        expected=f"at most {budget:g} ms",
        given=f"an easy world on {module}",
        hint="measure-again",
        credit=0.5 if latency <= HALF_BUDGETS * budget else 0.0,
    )
