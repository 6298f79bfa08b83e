"""Accuracy is counted right, its intervals hold the truth as often as they say, and stand-ins warn."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from robotbrain.errors import InputError
from robotbrain.monitoring.accuracy import (
    OnlineSegmentationAccuracy,
    class_iou,
    confusion,
    wilson_interval,
)
from robotbrain.monitoring.proxies import (
    ClassDrift,
    ConfidenceDrift,
    entropy,
    lidar_disagreement,
    stability_index,
)
from robotbrain.pipeline.brain import drive

Mask = NDArray[np.uint8]


def masks(rng: np.random.Generator, count: int, error: float, classes: int = 4) -> list[tuple[Mask, Mask]]:
    pairs = []
    for _ in range(count):
        truth = rng.integers(0, classes, (6, 8)).astype(np.uint8)
        wrong = rng.random(truth.shape) < error
        prediction = np.where(wrong, (truth + rng.integers(1, classes, truth.shape)) % classes, truth).astype(np.uint8)
        pairs.append((prediction, truth))
    return pairs


def test_the_confusion_matrix_and_iou_are_what_sets_say() -> None:
    (prediction, truth), *_ = masks(np.random.default_rng(0), 1, 0.4)
    matrix = confusion(prediction, truth, 5)
    for a in range(5):
        for b in range(5):
            assert matrix[a, b] == np.sum((truth == a) & (prediction == b))
    for k, value in enumerate(class_iou(matrix)):
        union = np.sum((truth == k) | (prediction == k))
        both = np.sum((truth == k) & (prediction == k))
        assert math.isnan(value) if not union else value == both / union
    assert math.isnan(class_iou(matrix)[4])


def test_images_meet_in_any_order_and_totals_are_sums() -> None:
    rng = np.random.default_rng(1)
    pairs = masks(rng, 40, 0.2)
    online = OnlineSegmentationAccuracy(waiting=50)
    for stamp in rng.permutation(40).tolist():
        online.add_prediction(stamp, pairs[stamp][0])
    met = [online.add_truth(stamp, pairs[stamp][1]) for stamp in rng.permutation(40).tolist()]
    whole = sum(confusion(p, t, 4) for p, t in pairs)
    assert all(met) and online.compared == 40 and online.unmatched == 0
    np.testing.assert_array_equal(online.matrix, whole)
    everything = np.mean([p == t for p, t in pairs])
    assert online.pixel_accuracy == pytest.approx(everything) and online.interval().value == pytest.approx(everything)
    assert online.mean_iou == pytest.approx(np.mean(list(online.iou.values())))


def test_images_without_counterpart_make_way() -> None:
    online = OnlineSegmentationAccuracy(waiting=3)
    for stamp in range(10):
        assert not online.add_prediction(stamp, np.zeros((2, 2), np.uint8))
    assert online.unmatched == 7 and math.isnan(online.pixel_accuracy) and math.isnan(online.mean_iou)
    assert "no image" in str(online) and math.isnan(online.interval().value)
    assert not online.add_truth(0, np.zeros((2, 2), np.uint8)) and online.add_truth(9, np.zeros((2, 2), np.uint8))


def test_wrong_images_are_refused() -> None:
    with pytest.raises(InputError, match="shape"):
        confusion(np.zeros((2, 2), int), np.zeros((2, 3), int), 4)
    with pytest.raises(InputError, match="class ids 0 to 3"):
        confusion(np.full((2, 2), 4), np.zeros((2, 2), int), 4)
    with pytest.raises(InputError, match="class ids"):
        confusion(np.zeros((2, 2)), np.zeros((2, 2), int), 4)


def test_wilson_is_the_root_of_the_score_test() -> None:
    for successes, trials in ((0, 10), (3, 10), (10, 10), (95, 100)):
        found = wilson_interval(successes, trials)
        for bound in (found.low, found.high):
            if 1e-9 < bound < 1 - 1e-9:  # at the bound the observed share is exactly 1.96 standard errors away
                z = abs(successes / trials - bound) / math.sqrt(bound * (1 - bound) / trials)
                assert z == pytest.approx(1.959964, abs=1e-5)
    assert wilson_interval(0, 10).low == 0 and wilson_interval(10, 10).high == 1
    assert (wilson_interval(0, 0).low, wilson_interval(0, 0).high) == (0, 1)
    with pytest.raises(InputError):
        wilson_interval(3, 2)


def test_intervals_of_images_that_resemble_each_other_hold_the_truth() -> None:
    """Errors come in spells: of 80 % intervals about 80 % hold the truth; with single images far fewer would."""
    held = {"blocks": 0, "single": 0}
    runs = 60
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        level, rates = 0.0, []
        for _ in range(300):  # an autoregressive process around a rate of 0.1
            level = 0.9 * level + rng.normal(0, 0.015)
            rates.append(min(0.5, max(0.0, 0.1 + level)))
        online = OnlineSegmentationAccuracy()
        for stamp, rate in enumerate(rates):
            ((prediction, truth),) = masks(rng, 1, rate)
            online.add_prediction(stamp, prediction)
            online.add_truth(stamp, truth)
        for name, block in (("blocks", 30), ("single", 1)):
            found = online.interval(level=0.8, block=block, resamples=200, seed=seed)
            held[name] += found.low <= 0.9 <= found.high
    assert 0.65 <= held["blocks"] / runs <= 0.95
    assert held["single"] / runs < held["blocks"] / runs - 0.1


def test_intervals_are_a_function_of_the_seed() -> None:
    online = OnlineSegmentationAccuracy()
    for stamp, (prediction, truth) in enumerate(masks(np.random.default_rng(2), 30, 0.3)):
        online.add_prediction(stamp, prediction)
        online.add_truth(stamp, truth)
    assert online.interval(seed=1) == online.interval(seed=1) != online.interval(seed=2)
    with pytest.raises(InputError, match="block"):
        online.interval(block=31)
    with pytest.raises(InputError, match="level"):
        online.interval(level=95)


@pytest.mark.parametrize("robot", ["nominal", "surrogate"])
def test_the_kits_network_is_judged_while_it_drives(robot: Any) -> None:
    online = OnlineSegmentationAccuracy()
    watched = drive(1, time_limit=2.0, robot=robot, attach=[online.attach])
    assert online.compared >= 15 and online.pixel_accuracy > 0.9
    assert watched.log_sha256 == drive(1, time_limit=2.0, robot=robot).log_sha256


# ---- stand-ins ----


def test_the_stability_index_is_symmetric_and_zero_for_the_same() -> None:
    a, b = np.array([500, 300, 200]), np.array([200, 300, 500])
    assert stability_index(a, a) == 0
    assert stability_index(a, b) == pytest.approx(stability_index(b, a))
    p, q = b / 1000, a / 1000
    assert stability_index(a, b) == pytest.approx(np.sum((p - q) * np.log(p / q)), rel=0.02)
    assert math.isfinite(stability_index([1000, 0], [0, 1000]))
    with pytest.raises(InputError):
        stability_index([1, 2], [1, 2, 3])


def test_class_drift_tells_a_changed_scene_from_an_unchanged_one() -> None:
    rng = np.random.default_rng(0)
    drift = ClassDrift(window=20, learn=30)
    assert drift.verdict == "unknown"
    for _ in range(60):
        drift.add(rng.choice(4, (16, 16), p=[0.2, 0.5, 0.25, 0.05]))
    assert drift.verdict == "stable"
    for _ in range(25):
        drift.add(rng.choice(4, (16, 16), p=[0.2, 0.1, 0.65, 0.05]))
    assert drift.verdict == "drift" and drift.psi > 0.5
    with pytest.raises(InputError, match="class ids"):
        drift.add([[9]])


def test_entropy_is_nought_for_the_sure_and_one_for_the_clueless() -> None:
    sure = np.zeros((4, 2, 2))
    sure[1] = 1
    assert np.allclose(entropy(sure), 0) and np.allclose(entropy(np.full((4, 2, 2), 0.25)), 1)
    drift = ConfidenceDrift(window=5, learn=5)
    for _ in range(10):
        drift.add(0.97 * sure + 0.01)
    assert drift.verdict == "stable"
    for _ in range(5):
        drift.add(0.4 * sure + 0.15)
    assert drift.verdict == "drift" and 0.8 < drift.last_entropy < 1


def test_floor_behind_a_wall_contradicts_the_lidar() -> None:
    count = 360
    ranges = np.full(count, np.inf)
    angles = -math.pi + np.arange(count) * 2 * math.pi / count
    ranges[np.abs(angles) < 0.5] = 2.0  # a wall ahead
    points = [(1.0, 0.0), (1.9, 0.1), (3.0, 0.0), (4.0, 0.3), (0.0, 5.0), (2.05, 0.0)]
    found = lidar_disagreement(points, ranges, -math.pi, 2 * math.pi / count)
    assert found == pytest.approx(2 / 6)
    shifted = lidar_disagreement([(3.0, 0.0)], ranges, -math.pi, 2 * math.pi / count, lidar=(1.5, 0.0))
    assert shifted == 0
    assert math.isnan(lidar_disagreement([(-1.0, 0.0)], [1.0, 1.0], 0.0, 0.1))
