"""Rigid transforms as plain tuples: translation (x, y, z) in metres, unit quaternion (x, y, z, w).

Quaternions have the order of ROS, and rotate as ``q v q*`` (Hamilton). Tuples of floats, because a lookup handles
a few transforms at a time: numpy would spend longer on its overhead than on the arithmetic.
"""

from __future__ import annotations

import math

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

IDENTITY: Quaternion = (0.0, 0.0, 0.0, 1.0)
ZERO: Vector = (0.0, 0.0, 0.0)


def canonical(q: Quaternion) -> Quaternion:
    """Return the unit quaternion of the same rotation in the sign that tf2 reports.

    tf2 passes rotations through matrices. What comes back has w > 0 where the matrix has a positive trace (the rotation
    angle is below 120 degrees), and otherwise a positive largest component among x, y and z.

    Args:
        q: any quaternion; zero or NaN gives NaN.
    """
    x, y, z, w = q
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    if not norm > 0.0:
        return (math.nan, math.nan, math.nan, math.nan)
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    lead = w if 4.0 * w * w > 1.0 else max((x, y, z), key=abs)
    return (-x, -y, -z, -w) if lead < 0.0 else (x, y, z, w)


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return the product: first the rotation ``b``, then ``a``."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by + ay * bw + az * bx - ax * bz,
        aw * bz + az * bw + ax * by - ay * bx,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def conjugate(q: Quaternion) -> Quaternion:
    """Return the inverse rotation of a unit quaternion."""
    return (-q[0], -q[1], -q[2], q[3])


def rotate(q: Quaternion, v: Vector) -> Vector:
    """Return ``v`` rotated by the unit quaternion ``q``: v + w t + u x t with t = 2 u x v."""
    x, y, z, w = q
    vx, vy, vz = v
    tx, ty, tz = 2.0 * (y * vz - z * vy), 2.0 * (z * vx - x * vz), 2.0 * (x * vy - y * vx)
    return (
        vx + w * tx + y * tz - z * ty,
        vy + w * ty + z * tx - x * tz,
        vz + w * tz + x * ty - y * tx,
    )


def compose(a: tuple[Vector, Quaternion], b: tuple[Vector, Quaternion]) -> tuple[Vector, Quaternion]:
    """Return the transform that applies ``b`` first, then ``a``."""
    x, y, z = rotate(a[1], b[0])
    return (x + a[0][0], y + a[0][1], z + a[0][2]), multiply(a[1], b[1])


def invert(transform: tuple[Vector, Quaternion]) -> tuple[Vector, Quaternion]:
    """Return the inverse transform."""
    back = conjugate(transform[1])
    x, y, z = rotate(back, transform[0])
    return (-x, -y, -z), back


def lerp(a: Vector, b: Vector, ratio: float) -> Vector:
    """Return the point on the line from ``a`` (ratio 0) to ``b`` (ratio 1)."""
    rest = 1.0 - ratio
    return (rest * a[0] + ratio * b[0], rest * a[1] + ratio * b[1], rest * a[2] + ratio * b[2])


def slerp(a: Quaternion, b: Quaternion, ratio: float) -> Quaternion:
    """Return the rotation on the shorter arc from ``a`` to ``b``, at constant speed.

    K. Shoemake, "Animating rotation with quaternion curves", SIGGRAPH 1985. The angle comes from chord lengths
    (atan2), which keeps its digits for nearly equal rotations, where an arc cosine loses half of them.
    """
    if a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3] < 0.0:
        b = (-b[0], -b[1], -b[2], -b[3])
    half = math.atan2(math.dist(a, b), math.hypot(a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3]))
    sine = math.sin(2.0 * half)
    if sine < 1e-12:
        return a
    s, t = math.sin((1.0 - ratio) * 2.0 * half) / sine, math.sin(ratio * 2.0 * half) / sine
    return (s * a[0] + t * b[0], s * a[1] + t * b[1], s * a[2] + t * b[2], s * a[3] + t * b[3])
