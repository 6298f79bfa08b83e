"""Seeded worlds that are always solvable.

A candidate world is drawn and kept when the goal can be reached; otherwise the next candidate is drawn from the
same seed, so a seed and a difficulty always name one world. Obstacles keep a gap wide enough for the robot
between each other and to the outer walls (or stand flush against one outer wall), which makes nearly every
candidate solvable; the grid search of ``route_exists`` then proves it.
"""

from __future__ import annotations

import colorsys
import math

import numpy as np
from scipy import ndimage

from robotbrain.errors import RobotBrainError
from robotbrain.sim.geometry import Point2D, Pose2D, rectangle_gap, segment_hits_rectangle
from robotbrain.sim.world import (
    WALL_HEIGHT,
    WALL_THICKNESS,
    Colour,
    Look,
    Obstacle,
    ObstacleKind,
    World,
    WorldSpec,
)

ROOM_HALF = 4.0
"""Half the inner side of the square room (m)."""
ROUTE_RADIUS = 0.28
"""Radius (m) of the disc that fits through from start to goal: the robot's 0.18 and 0.10 to spare."""
START_CLEARANCE = 0.55
GOAL_CLEARANCE = 0.65
MIN_START_GOAL = 4.0
BLOCKED_FROM = 0.25
"""Difficulty from which the straight line from start to goal is guaranteed to be blocked."""
BLOCKER_OVERHANG = 0.35
"""How far (m) the blocking obstacle reaches at least to either side of the straight line."""

_STREAM = 0x5EED_0A12
_MAX_CANDIDATES = 200
_TRIES_PER_OBSTACLE = 60


def generate_world(seed: int, difficulty: float = 0.5) -> World:
    """Return the world named by ``seed`` and ``difficulty``.

    Guarantees: a disc of radius ``ROUTE_RADIUS`` fits through from start to goal; start and goal are at least
    ``MIN_START_GOAL`` apart, with ``START_CLEARANCE`` and ``GOAL_CLEARANCE`` free around them; from difficulty
    ``BLOCKED_FROM`` an immovable obstacle stands across the straight line between them.

    Args:
        seed: integer >= 0.
        difficulty: 0 (almost empty) to 1 (crowded); more walls, shelves and boxes with narrower gaps.

    Raises:
        InputError: the seed or the difficulty is out of range.
    """
    spec = WorldSpec(seed, difficulty)
    for candidate in range(_MAX_CANDIDATES):
        rng = np.random.default_rng(np.random.SeedSequence([_STREAM, spec.seed, candidate]))
        world = _candidate(spec, rng)
        if world is not None and route_exists(world, ROUTE_RADIUS):
            return world
    raise RobotBrainError(f"no solvable world found for {spec}; please report this seed")


def route_exists(world: World, radius: float, resolution: float = 0.05) -> bool:
    """Whether a disc of ``radius`` (m) can move from start to goal, on a grid of ``resolution`` (m).

    Grid cells are kept free only if the disc fits at their centre; a connected component (4-neighbours) that
    holds both start and goal is a route. Movable obstacles count as fixed.
    """
    nx, ny = (round(2 * half / resolution) for half in (world.half_x, world.half_y))
    xs = (np.arange(nx) + 0.5) * resolution - world.half_x
    ys = (np.arange(ny) + 0.5) * resolution - world.half_y
    free = world.clearance(np.stack(np.meshgrid(xs, ys, indexing="ij"), -1)) >= radius
    labels, _ = ndimage.label(free)

    def label_at(x: float, y: float) -> int:
        return int(labels[int((x + world.half_x) / resolution), int((y + world.half_y) / resolution)])

    start = label_at(world.start.x, world.start.y)
    return start != 0 and start == label_at(world.goal.x, world.goal.y)


def direct_line_blocked(world: World) -> bool:
    """Whether an immovable obstacle stands across the straight line from start to goal."""
    ends = (world.start.x, world.start.y), (world.goal.x, world.goal.y)
    return any(not o.movable and segment_hits_rectangle(*ends, *o.footprint) for o in world.obstacles)


def _candidate(spec: WorldSpec, rng: np.random.Generator) -> World | None:
    look = draw_look(rng)
    inner = ROOM_HALF - 0.8
    start, goal = rng.uniform(-inner, inner, 2), rng.uniform(-inner, inner, 2)
    yaw = float(rng.uniform(-math.pi, math.pi))
    if np.hypot(*(goal - start)) < MIN_START_GOAL:
        return None
    builder = _Builder(spec, rng, look, start, goal)
    if spec.difficulty >= BLOCKED_FROM and not builder.add_blocker():
        return None
    d = spec.difficulty
    for kind, count in (("wall", 3 * d), ("shelf", 1 + 5 * d), ("low_box", 1 + 5 * d), ("tall_box", 6 * d)):
        for _ in range(round(count)):
            builder.add(kind)
    return World(
        spec,
        ROOM_HALF,
        ROOM_HALF,
        tuple(builder.obstacles),
        Pose2D(float(start[0]), float(start[1]), yaw),
        Point2D(float(goal[0]), float(goal[1])),
        look,
    )


class _Builder:
    """Obstacles placed one after another so that each keeps its distance from all before it."""

    def __init__(
        self, spec: WorldSpec, rng: np.random.Generator, look: Look, start: np.ndarray, goal: np.ndarray
    ) -> None:
        self.rng, self.look, self.start, self.goal = rng, look, start, goal
        self.gap = 1.1 - 0.35 * spec.difficulty
        self.obstacles: list[Obstacle] = []

    def add_blocker(self) -> bool:
        """Stand an immovable obstacle across the straight line; half of them low enough to look over."""
        rng = self.rng
        line = self.goal - self.start
        length = float(np.hypot(*line))
        for _ in range(_TRIES_PER_OBSTACLE):
            turn, shift = rng.uniform(-0.5, 0.5), rng.uniform(-0.3, 0.3)
            half = rng.uniform(0.6, 1.0)
            along = rng.uniform(0.35, 0.65)
            kind: ObstacleKind = "box" if rng.random() < 0.6 else "shelf"
            low, high = (0.13, 0.19) if kind == "box" else (0.5, 0.65)
            half_y, half_z = rng.uniform(0.15, 0.23), rng.uniform(low, high)
            if half * math.cos(turn) - abs(shift) < BLOCKER_OVERHANG + half_y * abs(math.sin(turn)):
                continue
            normal = np.array([-line[1], line[0]]) / length
            x, y = self.start + along * line + shift * normal
            yaw = math.atan2(line[1], line[0]) + math.pi / 2 + turn
            if self._place(kind, x, y, yaw, half, half_y, half_z, movable=False):
                return True
        return False

    def add(self, kind: str) -> bool:
        """Place one obstacle of a kind at random; False when no free place was found."""
        draw = {"wall": self._wall, "shelf": self._shelf, "tall_box": self._tall_box, "low_box": self._low_box}
        return any(draw[kind]() for _ in range(_TRIES_PER_OBSTACLE))

    def _anywhere(self) -> tuple[float, float]:
        x, y = self.rng.uniform(-ROOM_HALF, ROOM_HALF, 2)
        return float(x), float(y)

    def _between(self) -> tuple[float, float]:
        """A place near the way from start to goal, where it matters."""
        middle = self.start + self.rng.uniform(0.15, 0.85) * (self.goal - self.start)
        x, y = middle + self.rng.normal(0.0, 0.9, 2)
        return float(x), float(y)

    def _wall(self) -> bool:
        half, half_y = float(self.rng.uniform(0.6, 1.2)), WALL_THICKNESS / 2
        side = int(self.rng.integers(8))
        if side >= 4:
            x, y = self._anywhere()
            quarter = math.pi / 2 * int(self.rng.integers(2))
            return self._place("wall", x, y, quarter, half, half_y, WALL_HEIGHT / 2)
        # standing out from the outer wall at angle `out`
        out = side * math.pi / 2
        reach, slide = ROOM_HALF - half, float(self.rng.uniform(-ROOM_HALF, ROOM_HALF))
        x = reach * math.cos(out) - slide * math.sin(out)
        y = reach * math.sin(out) + slide * math.cos(out)
        return self._place("wall", x, y, out, half, half_y, WALL_HEIGHT / 2, against=side)

    def _shelf(self) -> bool:
        half, half_y = float(self.rng.uniform(0.4, 0.9)), float(self.rng.uniform(0.15, 0.22))
        half_z, side = float(self.rng.uniform(0.5, 0.65)), int(self.rng.integers(8))
        if side >= 4:
            x, y = self._anywhere()
            yaw = math.pi / 2 * int(self.rng.integers(2)) + float(self.rng.normal(0.0, 0.1))
            return self._place("shelf", x, y, yaw, half, half_y, half_z)
        # its back flush against an outer wall
        out = side * math.pi / 2
        reach, slide = ROOM_HALF - half_y, float(self.rng.uniform(-ROOM_HALF, ROOM_HALF))
        x = reach * math.cos(out) - slide * math.sin(out)
        y = reach * math.sin(out) + slide * math.cos(out)
        return self._place("shelf", x, y, out + math.pi / 2, half, half_y, half_z, against=side)

    def _tall_box(self) -> bool:
        x, y = self._between() if self.rng.random() < 0.5 else self._anywhere()
        hx, hy = self.rng.uniform(0.13, 0.25, 2)
        yaw, hz = self.rng.uniform(-math.pi, math.pi), self.rng.uniform(0.14, 0.28)
        return self._place("box", x, y, yaw, hx, hy, hz, movable=True)

    def _low_box(self) -> bool:
        x, y = self._between() if self.rng.random() < 0.7 else self._anywhere()
        hx, hy = self.rng.uniform(0.13, 0.25, 2)
        yaw, hz = self.rng.uniform(-math.pi, math.pi), self.rng.uniform(0.05, 0.07)
        return self._place("box", x, y, yaw, hx, hy, hz, movable=True)

    def _place(
        self,
        kind: ObstacleKind,
        x: float,
        y: float,
        yaw: float,
        half_x: float,
        half_y: float,
        half_z: float,
        *,
        movable: bool = False,
        against: int | None = None,
    ) -> bool:
        """Keep the obstacle if it leaves the gaps free; ``against`` is the outer wall it may touch (0 east, …)."""
        name = f"{kind}_{sum(o.kind == kind for o in self.obstacles)}"
        rgba = (*draw_colour(kind, self.rng, self.look), 1.0)
        size = (float(half_x), float(half_y), float(half_z))
        new = Obstacle(name, kind, float(x), float(y), float(yaw), *size, movable, rgba)
        corners = new.corners()
        for side in range(4):
            outward = np.array([math.cos(side * math.pi / 2), math.sin(side * math.pi / 2)])
            if side != against and ROOM_HALF - (corners @ outward).max() < self.gap:
                return False
        if new.distance(self.start) < START_CLEARANCE or new.distance(self.goal) < GOAL_CLEARANCE:
            return False
        if any(self._too_near(new, other) for other in self.obstacles):
            return False
        self.obstacles.append(new)
        return True

    def _too_near(self, a: Obstacle, b: Obstacle) -> bool:
        apart = math.hypot(a.x - b.x, a.y - b.y)
        if apart >= math.hypot(a.half_x, a.half_y) + math.hypot(b.half_x, b.half_y) + self.gap:
            return False  # their circumscribed circles alone are far enough apart
        return rectangle_gap(a.footprint, b.footprint) < self.gap


def _rgb(hue: float, saturation: float, value: float) -> Colour:
    return colorsys.hsv_to_rgb(hue % 1.0, min(max(saturation, 0.0), 1.0), min(max(value, 0.0), 1.0))


def draw_colour(kind: ObstacleKind, rng: np.random.Generator, look: Look) -> Colour:
    """A plain colour. One in six boxes and shelves takes a marker tone: only the pattern tells them apart."""
    if kind == "wall":
        return _rgb(rng.uniform(0.0, 1.0), rng.uniform(0.0, 0.15), rng.uniform(0.55, 0.9))
    if rng.random() < 1 / 6:
        hue, saturation, value = colorsys.rgb_to_hsv(*look.marker[int(rng.integers(2))])
        return _rgb(hue + rng.normal(0.0, 0.03), saturation * rng.uniform(0.6, 0.9), value * rng.uniform(0.6, 0.9))
    if rng.random() < 0.5:  # cardboard and wood
        return _rgb(rng.uniform(0.06, 0.11), rng.uniform(0.3, 0.6), rng.uniform(0.35, 0.75))
    return _rgb(rng.uniform(0.0, 1.0), rng.uniform(0.1, 0.55), rng.uniform(0.25, 0.8))


def draw_look(rng: np.random.Generator) -> Look:
    """Draw colours and light of a world. The marker is magenta against yellow-green, give or take."""
    azimuth, height = rng.uniform(-math.pi, math.pi), rng.uniform(0.6, 1.3)
    light = (math.cos(height) * math.cos(azimuth), math.cos(height) * math.sin(azimuth), math.sin(height))
    hue, base = rng.uniform(0.0, 1.0), rng.uniform(0.35, 0.75)
    saturation, contrast = rng.uniform(0.0, 0.2), rng.uniform(0.75, 0.92)
    first = 0.87 + rng.normal(0.0, 0.025)  # magenta against yellow-green
    second = 0.19 + rng.normal(0.0, 0.025)
    tint = tuple(float(t) for t in rng.uniform(0.93, 1.07, 3))
    return Look(
        light=light,
        ambient=float(rng.uniform(0.35, 0.55)),
        floor=(_rgb(hue, saturation, base), _rgb(hue, saturation, base * contrast)),
        floor_tile=float(rng.uniform(0.4, 0.7)),
        floor_yaw=float(rng.uniform(-math.pi / 4, math.pi / 4)),
        wall=_rgb(rng.uniform(0.0, 1.0), rng.uniform(0.0, 0.15), rng.uniform(0.6, 0.95)),
        background=_rgb(rng.uniform(0.5, 0.65), rng.uniform(0.05, 0.3), rng.uniform(0.75, 1.0)),
        marker=(_rgb(first, 0.85, rng.uniform(0.7, 0.9)), _rgb(second, 0.85, rng.uniform(0.8, 1.0))),
        marker_pattern="stripes" if rng.random() < 0.5 else "chequer",
        marker_period=float(rng.uniform(0.14, 0.2)),
        tint=(tint[0], tint[1], tint[2]),
    )
