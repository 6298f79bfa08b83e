"""The filter against closed forms and a room whose geometry is known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robotbrain.pipeline.estimation import PoseFilter, ScanMatcher, scan_normals
from robotbrain.pipeline.geometry import PoseBuffer, compose, interpolate, inverse, transform, wrap

poses = st.tuples(*[st.floats(-5, 5) for _ in range(2)], st.floats(-3.1, 3.1))


@given(first=poses, second=poses)
@settings(max_examples=100, deadline=None)
def test_poses_form_a_group(first, second) -> None:
    assert compose(first, inverse(first)) == pytest.approx((0, 0, 0), abs=1e-9)
    points = np.array([[1.0, 2.0], [-0.3, 0.4]])
    np.testing.assert_allclose(
        transform(compose(first, second), points), transform(first, transform(second, points)), atol=1e-9
    )


def test_interpolation_turns_the_short_way() -> None:
    halfway = interpolate((0, 0, 3.0), (1, 0, -3.0), 0.5)
    assert abs(wrap(halfway[2] - np.pi)) < 1e-9


def test_pose_buffer_answers_for_the_past_and_not_for_the_far_future() -> None:
    buffer = PoseBuffer(tolerance_ns=10)
    assert buffer.latest() is None and buffer.at(0) is None
    for k in range(200):
        buffer.add(k * 100, (float(k), 0.0, 0.0))
    buffer.add(150, (-9.0, 0.0, 0.0))  # late: ignored
    assert buffer.at(12_345)[0] == pytest.approx(123.45)
    assert buffer.at(199 * 100 + 10)[0] == 199.0
    assert buffer.at(199 * 100 + 11) is None
    assert buffer.at(-1) is None


def test_dead_reckoning_follows_the_circle_in_closed_form() -> None:
    filter_ = PoseFilter()
    radius, rate, steps, dt = 1.5, 0.4, 2000, 0.005
    for _ in range(steps):
        filter_.predict(radius * rate * dt, rate, dt)
    angle = rate * steps * dt
    expected = (radius * np.sin(angle), radius * (1 - np.cos(angle)), wrap(angle))
    assert filter_.pose == pytest.approx(expected, abs=1e-4)


def test_covariance_of_prediction_matches_monte_carlo() -> None:
    rng = np.random.default_rng(0)
    params = PoseFilter().params
    samples, travel, rate, dt, steps = 4000, 0.01, 0.3, 0.02, 100
    state = np.zeros((samples, 3))
    bias = rng.normal(0, params.bias_initial, samples)
    for _ in range(steps):
        turn_noise = np.sqrt(params.gyro_noise**2 * dt + (params.slip_noise * rate * dt) ** 2)
        turn = (rate - bias) * dt + rng.normal(0, turn_noise, samples)
        step = travel + rng.normal(0, params.wheel_noise * np.sqrt(travel), samples)
        state[:, 0] += step * np.cos(state[:, 2] + turn / 2)
        state[:, 1] += step * np.sin(state[:, 2] + turn / 2)
        state[:, 2] += turn
        bias += rng.normal(0, params.bias_walk * np.sqrt(dt), samples)
    filter_ = PoseFilter()
    for _ in range(steps):
        filter_.predict(travel, rate, dt)
    np.testing.assert_allclose(np.sqrt(np.diag(filter_.covariance)[:3]), state.std(axis=0), rtol=0.1, atol=1e-4)


def test_covariance_stays_symmetric_and_positive() -> None:
    rng = np.random.default_rng(1)
    filter_ = PoseFilter()
    for k in range(500):
        filter_.predict(rng.uniform(-0.02, 0.02), rng.uniform(-1, 1), 0.02)
        if k % 5 == 0:
            filter_.observe_pose(rng.normal(0, 0.01, 3), np.diag([1e-4, 1e-4, 1e-5]))
        if k % 50 == 0:
            filter_.observe_standstill(0.02)
        np.testing.assert_allclose(filter_.covariance, filter_.covariance.T, atol=1e-12)
        assert np.linalg.eigvalsh(filter_.covariance).min() > 0


def test_standstill_reveals_the_gyro_bias() -> None:
    rng = np.random.default_rng(2)
    filter_ = PoseFilter()
    for _ in range(200):
        filter_.predict(0.0, 0.05 + rng.normal(0, 0.005), 0.02)
        filter_.observe_standstill(0.05 + rng.normal(0, 0.005))
    assert filter_.bias == pytest.approx(0.05, abs=0.003)
    assert abs(filter_.pose[2]) < 0.02


def test_an_outlier_is_refused_and_changes_nothing() -> None:
    filter_ = PoseFilter()
    filter_.predict(0.1, 0.0, 0.02)
    before = filter_.state.copy()
    assert not filter_.observe_pose(np.array([3.0, 0.0, 0.0]), np.diag([1e-4, 1e-4, 1e-5]))
    np.testing.assert_array_equal(filter_.state, before)


def room_scan(pose: tuple[float, float, float], rays: int = 120) -> np.ndarray:
    """Exact lidar points, in the robot's frame, of a 6 x 4 m room with a pillar, seen from ``pose``."""
    segments = []
    for box in ((-3, -2, 3, 2), (0.8, 0.5, 1.2, 0.9)):
        x0, y0, x1, y1 = box
        corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], dtype=float)
        segments += [(corners[i], corners[(i + 1) % 4]) for i in range(4)]
    angles = -np.pi + 2 * np.pi / rays * np.arange(rays)
    origin, points = np.array(pose[:2]), []
    for angle in angles:
        d = np.array([np.cos(angle + pose[2]), np.sin(angle + pose[2])])
        best = np.inf
        for a, b in segments:
            matrix = np.column_stack([d, a - b])
            if abs(np.linalg.det(matrix)) < 1e-12:
                continue
            t, u = np.linalg.solve(matrix, a - origin)
            if t > 0 and 0 <= u <= 1:
                best = min(best, t)
        points.append(best * np.array([np.cos(angle), np.sin(angle)]))
    return np.array(points)


@pytest.mark.parametrize("offset", [(0.1, -0.05, 0.06), (-0.15, 0.1, -0.1), (0.0, 0.0, 0.15)])
def test_scan_matching_recovers_the_pose(offset) -> None:
    matcher = ScanMatcher()
    start = (-1.0, 0.2, 0.4)
    assert matcher.keep(room_scan(start), start)
    truth = (-0.8, 0.1, 0.55)
    guess = tuple(np.add(truth, offset))
    match = matcher.match(room_scan(truth), guess)
    assert match is not None
    assert match.pose == pytest.approx(truth, abs=0.01)
    assert match.rms < 0.02


def test_scan_matching_declines_without_enough_points() -> None:
    matcher = ScanMatcher()
    assert matcher.match(np.zeros((60, 2)), (0, 0, 0)) is None
    matcher.keep(room_scan((0, 0, 0)), (0, 0, 0))
    assert matcher.match(np.zeros((5, 2)), (0, 0, 0)) is None
    assert matcher.match(room_scan((0, 0, 0)) + 50.0, (0, 0, 0)) is None


def test_keyframes_are_kept_by_distance_and_forgotten_by_age() -> None:
    matcher = ScanMatcher()
    assert matcher.keep(room_scan((0, 0, 0)), (0.0, 0.0, 0.0))
    assert not matcher.keep(room_scan((0, 0, 0)), (0.1, 0.0, 0.1))
    assert matcher.keep(room_scan((0, 0, 0.7)), (0.0, 0.0, 0.7))
    assert matcher.keyframe_count == 2


def test_normals_of_a_room_are_axis_aligned_and_corners_are_left_out() -> None:
    scan = room_scan((0.0, 0.0, 0.0), rays=240)
    normals, valid = scan_normals(scan)
    assert valid.mean() > 0.7
    alignment = np.abs(normals[valid]).max(axis=1)
    assert alignment.min() > 0.9  # a point next to a corner may be a little off
    assert np.quantile(alignment, 0.05) > 0.999
