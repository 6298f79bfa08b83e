"""Layouts of obstacles for the navigation task: many at once, as plain tensors, and the geometry they need.

A layout is K rectangles seen from above, (..., K, 5): centre x, y (m), yaw (rad), half length and half width (m).
Kinds and sizes are those of the lab's worlds (:mod:`robotbrain.sim.generate`), but every gap is wide enough for the
robot, so no search is needed to know that a goal can be reached, and thousands are drawn in a second.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from robotbrain.errors import InputError

PARKED = 40.0
"""Rectangles that are not in use have their centres beyond this distance from the room's middle (m)."""
_TRIES = 12
_KINDS = (
    # half length, half width (m), share, may stand against an outer wall
    ((0.6, 1.2), (0.05, 0.05), 0.2, True),  # wall
    ((0.4, 0.9), (0.15, 0.22), 0.25, True),  # shelf
    ((0.6, 1.0), (0.15, 0.23), 0.1, False),  # long box
    ((0.13, 0.25), (0.13, 0.25), 0.45, False),  # box
)


@dataclass(frozen=True)
class LayoutSpec:
    """What layouts are drawn from.

    Args:
        obstacles: rectangles in a layout; some of them may be parked.
        fewest: at least so many are tried to be placed.
        room_half: half the inner side of the square room (m).
        gap: bounds of the least distance between two obstacles, and to a wall that one does not touch (m).

    Raises:
        InputError: counts or distances that make no sense.
    """

    obstacles: int = 12
    fewest: int = 3
    room_half: float = 4.0
    gap: tuple[float, float] = (0.7, 1.1)

    def __post_init__(self) -> None:
        sound = 0 <= self.fewest <= self.obstacles and 0.36 < self.gap[0] <= self.gap[1] and self.room_half > 1.5
        if not sound:
            raise InputError(
                "LayoutSpec",
                given=self,
                expected="0 <= fewest <= obstacles, 0.36 < gap, room_half > 1.5",
                fix="The robot is 0.36 m wide.",
            )


def rectangle_distance(points: Tensor, rectangles: Tensor) -> Tensor:
    """Signed distance (m), negative inside, of points (..., 2) to rectangles (..., 5); leading axes broadcast."""
    cos, sin = torch.cos(rectangles[..., 2]), torch.sin(rectangles[..., 2])
    dx, dy = points[..., 0] - rectangles[..., 0], points[..., 1] - rectangles[..., 1]
    ahead = (cos * dx + sin * dy).abs() - rectangles[..., 3]
    aside = (cos * dy - sin * dx).abs() - rectangles[..., 4]
    return torch.hypot(ahead.clamp(min=0.0), aside.clamp(min=0.0)) + torch.maximum(ahead, aside).clamp(max=0.0)


def corners(rectangles: Tensor) -> Tensor:
    """Corners (..., 4, 2) of rectangles (..., 5), anticlockwise."""
    cos, sin = torch.cos(rectangles[..., 2, None]), torch.sin(rectangles[..., 2, None])
    along = rectangles[..., 3, None] * rectangles.new_tensor((1.0, -1.0, -1.0, 1.0))
    aside = rectangles[..., 4, None] * rectangles.new_tensor((1.0, 1.0, -1.0, -1.0))
    x = rectangles[..., 0, None] + cos * along - sin * aside
    y = rectangles[..., 1, None] + sin * along + cos * aside
    return torch.stack((x, y), -1)


def rectangle_gap(a: Tensor, b: Tensor) -> Tensor:
    """Distance (m) between rectangles (..., 5), 0 where they overlap; leading axes broadcast.

    Two convex shapes that are apart are nearest in a corner of one of them; whether they are apart is asked of the
    four directions of their sides (separating axes).
    """
    corners_a, corners_b = corners(a), corners(b)
    from_b = rectangle_distance(corners_a, b[..., None, :]).amin(-1)
    from_a = rectangle_distance(corners_b, a[..., None, :]).amin(-1)
    apart = torch.zeros_like(from_a, dtype=torch.bool)
    for yaw in (a[..., 2], a[..., 2] + math.pi / 2, b[..., 2], b[..., 2] + math.pi / 2):
        axis = torch.stack((torch.cos(yaw), torch.sin(yaw)), -1)[..., None, :]
        along_a, along_b = (corners_a * axis).sum(-1), (corners_b * axis).sum(-1)
        apart |= (along_a.amax(-1) < along_b.amin(-1)) | (along_b.amax(-1) < along_a.amin(-1))
    return torch.where(apart, torch.minimum(from_a, from_b).clamp(min=0.0), 0.0)


def clearance(points: Tensor, rectangles: Tensor, room_half: float) -> Tensor:
    """Distance (m) of points (N, M, 2) to the nearest obstacle of layouts (N, K, 5) or outer wall; negative inside."""
    walls = room_half - points.abs().amax(-1)
    if not rectangles.shape[-2]:
        return walls
    return torch.minimum(rectangle_distance(points[:, :, None], rectangles[:, None]).amin(-1), walls)


def draw_layouts(count: int, spec: LayoutSpec, generator: torch.Generator) -> Tensor:
    """Return ``count`` layouts, (count, spec.obstacles, 5).

    Obstacle after obstacle is drawn ``_TRIES`` times for all layouts together; each layout keeps the first draw that
    leaves its gaps free, or parks that obstacle.
    """
    parked = torch.zeros(spec.obstacles, 5)
    parked[:, 0] = 2.0 * PARKED + 3.0 * torch.arange(spec.obstacles)
    parked[:, 3:] = 0.1
    layouts = parked.repeat(count, 1, 1)
    gap = _uniform(generator, *spec.gap, (count, 1))
    wanted = torch.randint(spec.fewest, spec.obstacles + 1, (count,), generator=generator)
    for index in range(spec.obstacles):
        drawn, against = _draw(count, spec, generator)
        free = _wall_gap(drawn, spec.room_half, against) >= gap
        if index:
            free &= (rectangle_gap(drawn[:, :, None], layouts[:, None, :index]) >= gap[..., None]).all(-1)
        found = free.any(1) & (index < wanted)
        first = free.to(torch.int8).argmax(1)
        layouts[found, index] = drawn[found, first[found]]
    return layouts


def _draw(count: int, spec: LayoutSpec, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Rectangles (count, tries, 5) and the outer wall that each touches: 0 east, 1 north, ...; -1 none."""
    shape = (count, _TRIES)
    shares = torch.tensor([kind[2] for kind in _KINDS])
    kind = torch.multinomial(shares, count * _TRIES, replacement=True, generator=generator).view(shape)
    lengths, widths = (torch.tensor([k[i] for k in _KINDS])[kind] for i in (0, 1))
    half_x = lengths[..., 0] + (lengths[..., 1] - lengths[..., 0]) * torch.rand(shape, generator=generator)
    half_y = widths[..., 0] + (widths[..., 1] - widths[..., 0]) * torch.rand(shape, generator=generator)
    x, y = (_uniform(generator, -spec.room_half, spec.room_half, shape) for _ in range(2))
    yaw = _uniform(generator, -math.pi, math.pi, shape)
    side = torch.randint(4, shape, generator=generator)
    can_lean = torch.tensor([k[3] for k in _KINDS])[kind]
    leans = can_lean & (torch.rand(shape, generator=generator) < 0.5)
    # A wall stands out from the outer wall; a shelf has its back to it.
    deep = torch.where(kind == 0, half_x, half_y)
    out = side * (math.pi / 2)
    reach, slide = spec.room_half - deep, y
    x = torch.where(leans, reach * torch.cos(out) - slide * torch.sin(out), x)
    y = torch.where(leans, reach * torch.sin(out) + slide * torch.cos(out), y)
    yaw = torch.where(leans, out + torch.where(kind == 0, 0.0, math.pi / 2), yaw)
    return torch.stack((x, y, yaw, half_x, half_y), -1), torch.where(leans, side, -1)


def _wall_gap(rectangles: Tensor, room_half: float, against: Tensor) -> Tensor:
    """Least distance of rectangles (..., 5) to the outer walls (m), without the one that each stands against."""
    points = corners(rectangles)
    gaps = room_half - torch.stack(
        (points[..., 0].amax(-1), points[..., 1].amax(-1), (-points[..., 0]).amax(-1), (-points[..., 1]).amax(-1)), -1
    )
    return gaps.masked_fill(torch.arange(4) == against[..., None], math.inf).amin(-1)


def _uniform(generator: torch.Generator, low: float, high: float, size: tuple[int, ...]) -> Tensor:
    return low + (high - low) * torch.rand(size, generator=generator)
