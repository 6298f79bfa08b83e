"""Plane geometry of poses and oriented rectangles. Metres and radians; x forward, y left, angles anticlockwise."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Point2D:
    """A point in the plane (m)."""

    x: float
    y: float


@dataclass(frozen=True, slots=True)
class Pose2D:
    """A position (m) and heading (rad, anticlockwise from +x)."""

    x: float
    y: float
    yaw: float


def wrap_angle(angle: float) -> float:
    """Return ``angle`` (rad) brought into [-pi, pi)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def rectangle_corners(x: float, y: float, yaw: float, half_x: float, half_y: float) -> Array:
    """Corners of an oriented rectangle, anticlockwise, shape (4, 2)."""
    c, s = math.cos(yaw), math.sin(yaw)
    local = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]]) * (half_x, half_y)
    return np.asarray(local @ np.array([[c, s], [-s, c]]) + (x, y))


def distance_to_rectangle(points: ArrayLike, x: float, y: float, yaw: float, half_x: float, half_y: float) -> Array:
    """Signed Euclidean distance (m) from points (..., 2) to an oriented rectangle; negative inside.

    Source: the exact box distance function, https://iquilezles.org/articles/distfunctions2d/.
    """
    offset = np.asarray(points, float) - (x, y)
    c, s = math.cos(yaw), math.sin(yaw)
    qx = np.abs(offset[..., 0] * c + offset[..., 1] * s) - half_x
    qy = np.abs(offset[..., 1] * c - offset[..., 0] * s) - half_y
    outside = np.hypot(np.maximum(qx, 0.0), np.maximum(qy, 0.0))
    return np.asarray(outside + np.minimum(np.maximum(qx, qy), 0.0))


def rectangle_gap(a: tuple[float, float, float, float, float], b: tuple[float, float, float, float, float]) -> float:
    """Distance (m) between two oriented rectangles ``(x, y, yaw, half_x, half_y)``; 0 where they overlap.

    Two convex shapes are disjoint when a separating axis exists (normals of either are enough); the nearest
    pair of points of disjoint rectangles then has a corner of one of them at its end.
    """
    corners_a, corners_b = rectangle_corners(*a), rectangle_corners(*b)
    separated = False
    for yaw in (a[2], a[2] + math.pi / 2, b[2], b[2] + math.pi / 2):
        axis = np.array([math.cos(yaw), math.sin(yaw)])
        along_a, along_b = corners_a @ axis, corners_b @ axis
        separated |= bool(along_a.max() < along_b.min() or along_b.max() < along_a.min())
    if not separated:
        return 0.0
    return float(min(distance_to_rectangle(corners_a, *b).min(), distance_to_rectangle(corners_b, *a).min()))


def segment_hits_rectangle(
    start: ArrayLike, end: ArrayLike, x: float, y: float, yaw: float, half_x: float, half_y: float
) -> bool:
    """Whether the segment from ``start`` to ``end`` (2,) meets an oriented rectangle (slab method)."""
    c, s = math.cos(yaw), math.sin(yaw)
    to_local = np.array([[c, s], [-s, c]])
    p = to_local @ (np.asarray(start, float) - (x, y))
    d = to_local @ (np.asarray(end, float) - (x, y)) - p
    near, far = 0.0, 1.0
    for position, step, half in ((p[0], d[0], half_x), (p[1], d[1], half_y)):
        if abs(step) < 1e-12:
            if abs(position) > half:
                return False
            continue
        t = sorted(((-half - position) / step, (half - position) / step))
        near, far = max(near, t[0]), min(far, t[1])
    return bool(near <= far)


def to_parent(frame: Pose2D, points: ArrayLike) -> Array:
    """Points (..., 2) given in ``frame``, in the frame that ``frame`` is given in.

    With ``world.start`` for ``frame`` it takes points of the map frame to the world frame.
    """
    c, s = math.cos(frame.yaw), math.sin(frame.yaw)
    return np.asarray(np.asarray(points, float) @ np.array([[c, s], [-s, c]]) + (frame.x, frame.y))


def to_child(frame: Pose2D, points: ArrayLike) -> Array:
    """Inverse of ``to_parent``: points (..., 2) of the parent frame, in ``frame``."""
    c, s = math.cos(frame.yaw), math.sin(frame.yaw)
    return np.asarray((np.asarray(points, float) - (frame.x, frame.y)) @ np.array([[c, -s], [s, c]]))
