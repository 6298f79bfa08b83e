"""Path tracking for a differential-drive robot: regulated pure pursuit with an obstacle stop.

Sources: Coulter, "Implementation of the Pure Pursuit Path Tracking Algorithm", CMU-RI-TR-92-01; Macenski, Singh, Martin
and Gines, "Regulated pure pursuit for robot path tracking", Autonomous Robots, 2023; the arc check follows Fox, Burgard
and Thrun, "The dynamic window approach to collision avoidance", 1997.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robotbrain.pipeline.geometry import Pose, inverse, transform, wrap

Status = Literal["tracking", "turning", "blocked", "backing", "arrived", "idle"]


@dataclass(frozen=True)
class ControlParams:
    """Limits and gains of the tracker.

    Attributes:
        max_speed, max_turn: m/s and rad/s.
        lookahead: distance of the pursued point along the path, m.
        turn_in_place: bearing to the pursued point from which the robot turns on the spot, rad.
        arrive: distance to the path's end that counts as arrived, m.
        arrive_yaw: heading error that counts as arrived where a final heading is asked for, rad.
        radius: radius of the robot, m.
        margin: clearance the predicted motion must keep, m.
        horizon: how far ahead motion is predicted, s.
        slow_distance: within this clearance of an obstacle the speed falls, m.
        patience: how long the robot waits in front of an obstacle before it backs up, s.
    """

    max_speed: float = 0.5
    max_turn: float = 1.2
    lookahead: float = 0.4
    turn_in_place: float = 0.6
    arrive: float = 0.08
    arrive_yaw: float = 0.15
    radius: float = 0.18
    margin: float = 0.04
    horizon: float = 1.2
    slow_distance: float = 0.35
    patience: float = 1.5


@dataclass(frozen=True)
class Command:
    """Forward speed m/s (x forward), turn rate rad/s (counter-clockwise) and why."""

    speed: float
    turn: float
    status: Status


def lookahead_point(path: NDArray[np.float64], position: NDArray[np.float64], distance: float) -> NDArray[np.float64]:
    """Return the point of the polyline that lies ``distance`` metres beyond its point nearest to ``position``.

    The path's end is returned where less than that is left. Exact along segments, so sparse paths work too.

    Args:
        path: (N, 2), N >= 1.
        position: (2,).
        distance: m.
    """
    if len(path) == 1:
        return np.asarray(path[0])
    start, delta = path[:-1], np.diff(path, axis=0)
    squared = np.maximum((delta**2).sum(axis=1), 1e-12)
    fraction = np.clip(((position - start) * delta).sum(axis=1) / squared, 0.0, 1.0)
    nearest = start + fraction[:, None] * delta
    gap = np.linalg.norm(nearest - position, axis=1)
    # Among equals the later segment: a path that doubles back is followed forwards.
    segment = int(len(gap) - 1 - np.argmin(gap[::-1]))
    left = distance
    point = nearest[segment]
    for index in range(segment, len(delta)):
        end = path[index + 1]
        step = float(np.linalg.norm(end - point))
        if step >= left:
            return np.asarray(point + (end - point) * (left / step))
        left -= step
        point = end
    return np.asarray(path[-1])


def arc_clearance(speed: float, turn: float, points: NDArray[np.float64], horizon: float, steps: int = 12) -> float:
    """Return the smallest distance from the robot's centre to any point while it drives one arc, m.

    Args:
        speed: m/s, negative backwards.
        turn: rad/s.
        points: (N, 2) obstacles in the robot's frame, m.
        horizon: length of the prediction, s.
        steps: positions checked along the arc.
    """
    if len(points) == 0:
        return float("inf")
    t = np.linspace(0.0, horizon, steps)
    if abs(turn) < 1e-6:
        centres = np.stack([speed * t, np.zeros_like(t)], axis=1)
    else:
        centres = (speed / turn) * np.stack([np.sin(turn * t), 1.0 - np.cos(turn * t)], axis=1)
    ahead, aside = points[:, 0] - centres[:, :1], points[:, 1] - centres[:, 1:]
    return float(np.sqrt((ahead**2 + aside**2).min()))


class PathTracker:
    """Follows the newest path; keeps only the state it needs to give up on a blocked one.

    Args:
        params: limits and gains.

    Attributes:
        arcs: arcs that the last :meth:`command` checked.
        distances: distances from a position along an arc to an obstacle point that it computed for that. These two are
            its units of CPU work.
    """

    def __init__(self, params: ControlParams | None = None) -> None:
        self.params = params or ControlParams()
        self.arcs = self.distances = 0
        self._blocked_since: float | None = None
        self._backing_until = -1.0

    def command(
        self,
        time: float,
        pose: Pose,
        path: NDArray[np.float64],
        final_yaw: float | None,
        obstacles: NDArray[np.float64],
    ) -> Command:
        """Return the next command.

        Args:
            time: now, s.
            pose: estimated pose in the map frame.
            path: (N, 2) in the map frame, m; empty means stay.
            final_yaw: heading to take at the end, rad; None leaves it open.
            obstacles: (M, 2) points in the robot's frame, m.
        """
        p = self.params
        self.arcs = self.distances = 0
        if len(path) == 0:
            self._blocked_since = None
            return Command(0.0, 0.0, "idle")
        near = obstacles[(np.abs(obstacles) < 1.5).all(axis=1)] if len(obstacles) else obstacles
        if time < self._backing_until:
            return self._back_up(near)
        position = np.asarray(pose[:2])
        remaining = float(np.linalg.norm(path[-1] - position))
        if remaining < p.arrive:
            self._blocked_since = None
            return self._turn_to(pose, final_yaw)
        target = transform(inverse(pose), lookahead_point(path, position, p.lookahead))
        bearing = float(np.arctan2(target[1], target[0]))
        if abs(bearing) > p.turn_in_place:
            self._blocked_since = None
            return Command(0.0, float(np.clip(2.0 * bearing, -p.max_turn, p.max_turn)), "turning")
        curvature = 2.0 * float(target[1]) / max(float(target @ target), 1e-4)
        speed = min(p.max_speed, 0.08 + 0.9 * remaining, p.max_turn / max(abs(curvature), 1e-6))
        speed *= max(0.25, np.cos(bearing) ** 2)
        ahead = near[near[:, 0] > -0.05] if len(near) else near
        clearance = self._clearance(0.0, 0.0, ahead, 0.0, 1) - p.radius
        speed *= float(np.clip(clearance / p.slow_distance, 0.3, 1.0))
        for factor in (1.0, 0.7, 0.45, 0.25):
            tried = factor * speed
            # At most this far ahead: stopping distance matters, what lies beyond the next metre does not.
            horizon = min(p.horizon, 0.5 / max(tried, 1e-3))
            if self._free(tried, tried * curvature, near, horizon):
                self._blocked_since = None
                return Command(tried, tried * curvature, "tracking")
        return self._blocked(time, bearing, near)

    def _free(self, speed: float, turn: float, points: NDArray[np.float64], horizon: float) -> bool:
        """Whether an arc keeps its margin, or at least leads away from what is already too near."""
        limit = self.params.radius + self.params.margin
        now = self._clearance(0.0, 0.0, points, 0.0, 1)
        along = self._clearance(speed, turn, points, horizon)
        if now >= limit:
            return along >= limit
        return along >= now - 1e-3

    def _clearance(
        self, speed: float, turn: float, points: NDArray[np.float64], horizon: float, steps: int = 12
    ) -> float:
        self.arcs += 1
        self.distances += len(points) * steps
        return arc_clearance(speed, turn, points, horizon, steps)

    def _turn_to(self, pose: Pose, final_yaw: float | None) -> Command:
        if final_yaw is None:
            return Command(0.0, 0.0, "arrived")
        error = wrap(final_yaw - pose[2])
        if abs(error) < self.params.arrive_yaw:
            return Command(0.0, 0.0, "arrived")
        return Command(0.0, float(np.clip(2.0 * error, -self.params.max_turn, self.params.max_turn)), "turning")

    def _blocked(self, time: float, bearing: float, points: NDArray[np.float64]) -> Command:
        if self._blocked_since is None:
            self._blocked_since = time
        if abs(bearing) > 0.1:
            return Command(0.0, float(np.clip(2.0 * bearing, -self.params.max_turn, self.params.max_turn)), "blocked")
        if time - self._blocked_since > self.params.patience:
            self._backing_until = time + 1.0
            self._blocked_since = None
            return self._back_up(points)
        return Command(0.0, 0.0, "blocked")

    def _back_up(self, points: NDArray[np.float64]) -> Command:
        if self._free(-0.12, 0.0, points, 1.0):
            return Command(-0.12, 0.0, "backing")
        return Command(0.0, 0.0, "blocked")
