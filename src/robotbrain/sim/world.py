"""What a world is: room, obstacles, start, goal and look, as plain immutable data.

The world frame has its origin at the middle of the room, x and y along the walls, z up, the floor at z = 0.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from robotbrain.errors import InputError
from robotbrain.sim.checks import check_range, check_seed
from robotbrain.sim.codec import decode
from robotbrain.sim.geometry import Array, Point2D, Pose2D, distance_to_rectangle, rectangle_corners

Colour = tuple[float, float, float]
ObstacleKind = Literal["wall", "shelf", "box"]
MarkerPattern = Literal["stripes", "chequer"]

MARKER_MAT_RADIUS = 0.35
"""Radius of the goal's floor mat (m)."""
MARKER_SIGN_HALF = (0.225, 0.225, 0.35)
"""Half sizes of the goal's hanging sign (m)."""
MARKER_SIGN_BOTTOM = 0.70
"""Height of the sign's lower edge above the floor (m): the robot passes beneath it."""
WORLD_FORMAT = "robotbrain-world/1"
WALL_HEIGHT = 1.6
WALL_THICKNESS = 0.10


@dataclass(frozen=True, slots=True)
class WorldSpec:
    """What a world is generated from.

    Args:
        seed: any non-negative integer; one seed and difficulty always give the same world.
        difficulty: 0 (an almost empty room) to 1 (crowded, gaps of 0.75 m).

    Raises:
        InputError: a seed below zero or not an integer, a difficulty outside [0, 1] or not a number.
    """

    seed: int
    difficulty: float = 0.5

    def __post_init__(self) -> None:
        object.__setattr__(self, "seed", check_seed("world seed", self.seed))
        check_range("world difficulty", self.difficulty, 0.0, 1.0)
        object.__setattr__(self, "difficulty", float(self.difficulty))


@dataclass(frozen=True, slots=True)
class Obstacle:
    """A block standing on the floor.

    Args:
        name: unique in its world, e.g. ``"shelf_2"``.
        kind: ``"wall"``, ``"shelf"`` or ``"box"``.
        x: centre (m).
        y: centre (m).
        yaw: heading (rad).
        half_x: half length (m).
        half_y: half width (m).
        half_z: half height (m); the block reaches from the floor to ``2 * half_z``.
        movable: whether it can be pushed.
        rgba: colour and opacity, each in [0, 1].
    """

    name: str
    kind: ObstacleKind
    x: float
    y: float
    yaw: float
    half_x: float
    half_y: float
    half_z: float
    movable: bool
    rgba: tuple[float, float, float, float]

    @property
    def height(self) -> float:
        """Height of the top above the floor (m)."""
        return 2.0 * self.half_z

    @property
    def footprint(self) -> tuple[float, float, float, float, float]:
        """``(x, y, yaw, half_x, half_y)``, as the functions of ``geometry`` take it."""
        return (self.x, self.y, self.yaw, self.half_x, self.half_y)

    def corners(self) -> Array:
        """Corners of the footprint, anticlockwise, (4, 2), in metres."""
        return rectangle_corners(*self.footprint)

    def distance(self, points: ArrayLike) -> Array:
        """Signed distance (m) from points (..., 2) to the footprint; negative inside."""
        return distance_to_rectangle(points, *self.footprint)


@dataclass(frozen=True, slots=True)
class Look:
    """How a world looks to the camera. Colours are linear RGB in [0, 1].

    Args:
        light: unit vector from the scene towards the light.
        ambient: brightness of a surface turned away from the light, in [0, 1].
        floor: the two colours of the floor tiles.
        floor_tile: side of a tile (m).
        floor_yaw: heading of the tile grid (rad).
        wall: colour of the outer walls.
        background: colour where a ray meets nothing.
        marker: the two tones of the goal marker.
        marker_pattern: ``"stripes"`` or ``"chequer"``.
        marker_period: width of one stripe or chequer cell (m).
        tint: the illumination's colour, multiplied into every pixel.
    """

    light: tuple[float, float, float]
    ambient: float
    floor: tuple[Colour, Colour]
    floor_tile: float
    floor_yaw: float
    wall: Colour
    background: Colour
    marker: tuple[Colour, Colour]
    marker_pattern: MarkerPattern
    marker_period: float
    tint: Colour


@dataclass(frozen=True, slots=True)
class World:
    """A room with obstacles, a start pose and a goal marker.

    Args:
        spec: what it was generated from.
        half_x: half the room's inner length along x (m).
        half_y: half the room's inner length along y (m).
        obstacles: what stands in the room, without the four outer walls.
        start: where the robot begins.
        goal: centre of the goal marker.
        look: colours and light.
    """

    spec: WorldSpec
    half_x: float
    half_y: float
    obstacles: tuple[Obstacle, ...]
    start: Pose2D
    goal: Point2D
    look: Look

    @property
    def outer_walls(self) -> tuple[Obstacle, ...]:
        """The four walls around the room; their inner faces are at ``half_x`` and ``half_y``."""
        t = WALL_THICKNESS / 2.0
        rgba = (*self.look.wall, 1.0)
        places = (
            ("east", self.half_x + t, 0.0, t, self.half_y + 2 * t),
            ("west", -self.half_x - t, 0.0, t, self.half_y + 2 * t),
            ("north", 0.0, self.half_y + t, self.half_x + 2 * t, t),
            ("south", 0.0, -self.half_y - t, self.half_x + 2 * t, t),
        )
        return tuple(
            Obstacle(f"outer_{side}", "wall", x, y, 0.0, hx, hy, WALL_HEIGHT / 2.0, False, rgba)
            for side, x, y, hx, hy in places
        )

    @property
    def movable(self) -> tuple[Obstacle, ...]:
        """The obstacles that can be pushed, in order."""
        return tuple(o for o in self.obstacles if o.movable)

    def clearance(self, points: ArrayLike) -> Array:
        """Distance (m) from points (..., 2) to the nearest obstacle or outer wall; negative inside one."""
        p = np.asarray(points, float)
        inside = np.minimum(self.half_x - np.abs(p[..., 0]), self.half_y - np.abs(p[..., 1]))
        return np.asarray(np.minimum.reduce([inside, *(o.distance(p) for o in self.obstacles)]))

    def to_dict(self) -> dict[str, Any]:
        """Return the world as plain JSON types; ``from_dict`` restores an equal world."""
        return {"format": WORLD_FORMAT, **dataclasses.asdict(self)}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> World:
        """Build a world from what ``to_dict`` (or JSON made of it) gave.

        Raises:
            InputError: a key is missing or unknown, or a value is of the wrong kind or not finite.
        """
        if not isinstance(data, Mapping) or data.get("format") != WORLD_FORMAT:
            raise InputError(
                "world",
                given=data,
                expected=f"a mapping whose 'format' is {WORLD_FORMAT!r}",
                fix="Pass what World.to_dict() returned.",
            )
        return decode(cls, {key: value for key, value in data.items() if key != "format"}, "world")
