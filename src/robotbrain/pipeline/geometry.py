"""Plane geometry shared by the nodes: poses (x, y, yaw) in metres and radians."""

from __future__ import annotations

import math
from bisect import bisect_left

import numpy as np
from numpy.typing import ArrayLike, NDArray

Pose = tuple[float, float, float]
"""x, y in metres and yaw in radians, counter-clockwise from the x axis."""


def wrap_angle(angle: ArrayLike) -> NDArray[np.float64]:
    """Return angles wrapped to [-pi, pi), rad."""
    return (np.asarray(angle, dtype=float) + np.pi) % (2 * np.pi) - np.pi


def wrap(angle: float) -> float:
    """Return one angle wrapped to [-pi, pi), rad: the fast path of :func:`wrap_angle`."""
    return (float(angle) + math.pi) % (2 * math.pi) - math.pi


def transform(pose: ArrayLike, points: ArrayLike) -> NDArray[np.float64]:
    """Return (..., 2) points given in the frame of ``pose`` (x, y, yaw) in the frame in which the pose is given."""
    x, y, yaw = np.asarray(pose, dtype=float)
    local = np.asarray(points, dtype=float)
    cos, sin = np.cos(yaw), np.sin(yaw)
    out = np.empty_like(local)
    out[..., 0] = x + cos * local[..., 0] - sin * local[..., 1]
    out[..., 1] = y + sin * local[..., 0] + cos * local[..., 1]
    return out


def inverse(pose: Pose) -> Pose:
    """Return the pose of the outer frame seen from ``pose``."""
    x, y, yaw = pose
    cos, sin = float(np.cos(yaw)), float(np.sin(yaw))
    return (-cos * x - sin * y, sin * x - cos * y, -yaw)


def compose(first: Pose, second: Pose) -> Pose:
    """Return ``second``, given in the frame of ``first``, in the frame in which ``first`` is given."""
    x, y = transform(first, second[:2])
    return (float(x), float(y), wrap(first[2] + second[2]))


def interpolate(first: Pose, second: Pose, fraction: float) -> Pose:
    """Return the pose a ``fraction`` in [0, 1] of the way from ``first`` to ``second``, turning the short way round."""
    turn = wrap(second[2] - first[2])
    return (
        first[0] + fraction * (second[0] - first[0]),
        first[1] + fraction * (second[1] - first[1]),
        wrap(first[2] + fraction * turn),
    )


class PoseBuffer:
    """Recent poses by time stamp: where was the robot when this image was taken?

    Args:
        horizon_ns: how long poses are kept, ns.
        tolerance_ns: how far beyond the newest pose a query may lie (it then gets the newest pose), ns.
    """

    def __init__(self, horizon_ns: int = 5_000_000_000, tolerance_ns: int = 60_000_000) -> None:
        self.horizon_ns = horizon_ns
        self.tolerance_ns = tolerance_ns
        self._stamps: list[int] = []
        self._poses: list[Pose] = []

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, stamp_ns: int, pose: Pose) -> None:
        """Store a pose; stamps that go backwards are ignored."""
        if self._stamps and stamp_ns <= self._stamps[-1]:
            return
        self._stamps.append(stamp_ns)
        self._poses.append(pose)
        # Trim in blocks, so that adding stays cheap.
        if len(self._stamps) > 64 and self._stamps[32] < stamp_ns - self.horizon_ns:
            del self._stamps[:32]
            del self._poses[:32]

    def latest(self) -> Pose | None:
        """Return the newest pose, or None."""
        return self._poses[-1] if self._poses else None

    def latest_stamp(self) -> int | None:
        """Return the stamp of the newest pose in ns, or None."""
        return self._stamps[-1] if self._stamps else None

    def at(self, stamp_ns: int) -> Pose | None:
        """Return the pose at ``stamp_ns``, linearly interpolated; None where the buffer does not reach."""
        index = bisect_left(self._stamps, stamp_ns)
        if index == len(self._stamps):
            if self._stamps and stamp_ns - self._stamps[-1] <= self.tolerance_ns:
                return self._poses[-1]
            return None
        if self._stamps[index] == stamp_ns:
            return self._poses[index]
        if index == 0:
            return None
        before, after = self._stamps[index - 1], self._stamps[index]
        return interpolate(self._poses[index - 1], self._poses[index], (stamp_ns - before) / (after - before))
