"""Tracking: geometry in closed form, and behaviour in a kinematic robot of a few lines."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from robotbrain.pipeline.control import ControlParams, PathTracker, arc_clearance, lookahead_point

EMPTY = np.zeros((0, 2))


def test_lookahead_is_exact_on_sparse_paths() -> None:
    path = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0]])
    np.testing.assert_allclose(lookahead_point(path, np.array([1.0, 0.3]), 0.4), [1.4, 0.0])
    np.testing.assert_allclose(lookahead_point(path, np.array([1.9, 0.0]), 0.4), [2.0, 0.3])
    np.testing.assert_allclose(lookahead_point(path, np.array([2.0, 1.9]), 0.4), [2.0, 2.0])
    np.testing.assert_allclose(lookahead_point(path[:1], np.array([5.0, 5.0]), 0.4), [0.0, 0.0])


def test_arc_clearance_in_closed_form() -> None:
    wall = np.array([[1.0, 0.0]])
    assert arc_clearance(0.5, 0.0, wall, 1.0) == pytest.approx(0.5)
    assert arc_clearance(0.0, 1.0, wall, 2.0) == pytest.approx(1.0)
    # half a circle of radius 0.5 to the left ends at (0, 1)
    assert arc_clearance(0.5, 1.0, np.array([[0.0, 1.0]]), np.pi, 60) == pytest.approx(0.0, abs=1e-9)
    assert arc_clearance(1.0, 0.0, EMPTY, 1.0) == np.inf


def drive(path, obstacles=EMPTY, pose=(0.0, 0.0, 0.0), seconds=40.0, final_yaw=None):
    """Integrate the unicycle under the tracker; obstacles in the map frame."""
    tracker, dt = PathTracker(), 0.05
    trace, status = [pose], "idle"
    for k in range(int(seconds / dt)):
        x, y, yaw = pose
        local = np.asarray(obstacles, dtype=float) - (x, y)
        cos, sin = np.cos(yaw), np.sin(yaw)
        local = local @ np.array([[cos, -sin], [sin, cos]]) if len(local) else EMPTY
        command = tracker.command(k * dt, pose, np.asarray(path, dtype=float), final_yaw, local)
        status = command.status
        if status == "arrived":
            break
        pose = (
            x + command.speed * np.cos(yaw) * dt,
            y + command.speed * np.sin(yaw) * dt,
            yaw + command.turn * dt,
        )
        trace.append(pose)
    return np.array(trace), status


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (0.2, -0.1, 2.5), (0.0, 0.3, -1.5)])
def test_reaches_the_end_of_a_bent_path(pose) -> None:
    path = [(0.0, 0.0), (2.0, 0.0), (2.0, 1.5), (3.0, 2.5)]
    trace, status = drive(path, pose=pose)
    assert status == "arrived"
    assert np.hypot(*(trace[-1, :2] - path[-1])) < ControlParams().arrive
    # it stays near the polyline once it is on it
    dense = np.concatenate([np.linspace(a, b, 60) for a, b in itertools.pairwise(path)])
    late = trace[len(trace) // 4 :, :2]
    assert max(np.linalg.norm(dense - p, axis=1).min() for p in late) < 0.2


def test_takes_the_final_heading() -> None:
    trace, status = drive([(0.0, 0.0)], final_yaw=2.0)
    assert status == "arrived"
    assert trace[-1, 2] == pytest.approx(2.0, abs=ControlParams().arrive_yaw)
    np.testing.assert_allclose(trace[:, :2], 0.0)


def test_stops_in_front_of_a_wall_across_the_path() -> None:
    wall = np.stack([np.full(40, 1.0), np.linspace(-1, 1, 40)], axis=1)
    trace, status = drive([(0.0, 0.0), (3.0, 0.0)], wall, seconds=20.0)
    assert status != "arrived"
    clearance = min(np.linalg.norm(wall - p[:2], axis=1).min() for p in trace)
    assert clearance >= ControlParams().radius


def test_backs_up_only_after_its_patience() -> None:
    tracker = PathTracker()
    wall = np.stack([np.full(21, 0.22), np.linspace(-0.5, 0.5, 21)], axis=1)
    path = np.array([(0.0, 0.0), (3.0, 0.0)])
    waiting = tracker.command(0.0, (0, 0, 0), path, None, wall)
    assert (waiting.speed, waiting.status) == (0.0, "blocked")
    assert tracker.command(1.0, (0, 0, 0), path, None, wall).speed == 0.0
    backing = tracker.command(2.0, (0, 0, 0), path, None, wall)
    assert backing.status == "backing" and backing.speed < 0
    cornered, between = PathTracker(), np.concatenate([wall, -wall])
    for time in (0.0, 1.0, 2.0, 3.0):
        assert cornered.command(time, (0, 0, 0), path, None, between).speed == 0.0


def test_without_a_path_it_stays() -> None:
    command = PathTracker().command(0.0, (0, 0, 0), np.zeros((0, 2)), None, EMPTY)
    assert (command.speed, command.turn, command.status) == (0.0, 0.0, "idle")


def test_never_exceeds_its_limits() -> None:
    rng = np.random.default_rng(3)
    tracker, limits = PathTracker(), ControlParams()
    for k in range(300):
        path = rng.uniform(-3, 3, (4, 2))
        points = rng.uniform(-2, 2, (30, 2))
        command = tracker.command(k * 0.05, tuple(rng.uniform(-3, 3, 3)), path, None, points)
        assert abs(command.speed) <= limits.max_speed + 1e-9
        assert abs(command.turn) <= limits.max_turn + 1e-9
