"""How the tests of `lab_integration` judge Parts 1, 4 and 5 and the goal tracker: inputs, oracles, typical mistakes.

Each ``compare_...`` function puts a question to the student's function, compares with an oracle, and, where the answer
is wrong, looks whether a typical mistake would have given just that answer; then the hint names the mistake.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from robotbrain.grading import expect, fail
from robotbrain.grading.suites import judging
from robotbrain.grading.suites.lab_integration_planning import untouched
from robotbrain.pipeline import segmentation
from robotbrain.pipeline.geometry import PoseBuffer, transform

if TYPE_CHECKING:
    from robotbrain.grading import Student

Array = NDArray[np.float64]
Pose = tuple[float, float, float]


# ---------------------------------------------------------------- Part 1


def image(rng: np.random.Generator, height: int, width: int) -> NDArray[np.uint8]:
    """Return an RGB image in which every value tells its place and channel: no two mistakes look alike."""
    rows, columns = np.indices((height, width))
    ramp = np.stack([40 * rows, 40 * columns, 20 * (rows + columns)], axis=-1)
    return ((ramp + rng.integers(0, 40, 3)) % 256).astype(np.uint8)


def compare_preprocess(student: Student, pixels: NDArray[np.uint8]) -> None:
    """Compare with the reference; the dtype is not judged here."""
    answer = student.preprocess(pixels.copy())
    expected = segmentation.preprocess(pixels).astype(float)

    def mistakes() -> list[tuple[str, Array]]:
        raw = pixels.astype(float)
        first = raw.transpose(2, 0, 1)[None]
        return [
            ("scale-pixels", (first - 0.45) / 0.25),
            ("normalise-channels", first / 255.0),
            ("normalise-channels", first / 255.0 - 0.45),
            ("reshape-is-not-transpose", ((raw / 255.0 - 0.45) / 0.25).reshape(expected.shape)),
            ("reshape-is-not-transpose", (raw / 255.0 - 0.45) / 0.25),
            ("batch-axis", expected[0]),
        ]

    given = f"an RGB image of shape {pixels.shape}"
    judging.compare(answer, expected, mistakes, atol=1e-4, match_atol=1e-4, given=given)


def camera(
    pitch: float, fx: float = 3.0, fy: float = 4.0, size: int = 5, position: tuple[float, float, float] = (0.1, 0, 0.26)
) -> segmentation.CameraModel:
    """Return a small camera whose axis goes through the middle pixel."""
    middle = (size - 1) / 2
    return segmentation.CameraModel(fx, fy, middle, middle, position, pitch)


def points_of(student: Student, depth: Array, model: segmentation.CameraModel) -> Array:
    """Return the student's points, checked for shape."""
    wanted = (*depth.shape, 3)
    points = judging.as_numbers(untouched(student, "back_project", depth, model))
    if points is None:
        fail("the points are no array of numbers", expected=f"an array of shape {wanted}")
    assert points is not None
    expect(points.shape == wanted, "the points have the wrong shape", got=points.shape, expected=wanted)
    return points


def compare_points(student: Student, depth: Array, model: segmentation.CameraModel) -> None:
    """Compare all points with the reference."""
    answer = points_of(student, depth, model)
    expected = segmentation.back_project(depth, model)

    def mistakes() -> list[tuple[str, Array]]:
        origin = np.asarray(model.position)
        rows, columns = np.indices(depth.shape)
        length = np.sqrt(1 + ((columns - model.cx) / model.fx) ** 2 + ((rows - model.cy) / model.fy) ** 2)
        found = [
            ("y-points-left", expected * [1, -1, 1] + [0, 2 * origin[1], 0]),
            ("camera-position", expected - origin),
            ("depth-is-not-range", segmentation.back_project(depth / length, model)),
        ]
        for pitch in (0.0, -model.pitch):
            other = segmentation.CameraModel(model.fx, model.fy, model.cx, model.cy, model.position, pitch)
            found.append(("pitch-rotates", segmentation.back_project(depth, other)))
        return found

    given = f"depth of shape {depth.shape}, fx {model.fx:g}, fy {model.fy:g}, pitch {model.pitch:g} rad"
    judging.compare(answer, expected, mistakes, match_atol=1e-5, given=given)


def profile(segmentation_ms: float, perception_ms: float) -> Any:
    """Return what the exercise reads of a Jetson profile, and a callback that it must not count."""
    return SimpleNamespace(segmentation_ms=segmentation_ms, callback_ms={"perception": perception_ms, "mapper": 7.0})


@functools.cache
def reference_profile(slug: str, mode: str) -> Any:
    """Return the same of a real module, from its reference profile in ``autograder/profiles``."""
    from robotbrain.jetson.reference import load_reference

    reference = load_reference(slug)
    return profile(reference.network("segmentation", mode).latency_ms, reference.callback_ms("perception", mode))


def compare_deadline(student: Student, module: Any, rate_hz: float) -> None:
    """Compare with the closed form."""
    inference, cpu = module.segmentation_ms, module.callback_ms["perception"]
    mistakes = [
        ("milliseconds", 1 / rate_hz - inference - cpu),
        ("milliseconds", rate_hz - inference - cpu),
        ("both-costs", 1000 / rate_hz - inference),
        ("both-costs", 1000 / rate_hz - cpu),
    ]
    given = f"{rate_hz:g} Hz, inference {inference:g} ms, CPU {cpu:g} ms"
    answer = student.deadline_slack_ms(module, rate_hz)
    judging.compare(answer, 1000 / rate_hz - inference - cpu, mistakes, given=given)


# ---------------------------------------------------------------- Part 3: the goal tracker


def steady_poses(pose: Pose, seconds: float = 1.0) -> list[tuple[int, Pose]]:
    """Return the poses (ns, pose) of a robot that stands still."""
    return [(0, pose), (round(seconds * 1e9), pose)]


def compare_tracker(student: Student, poses: Sequence[tuple[int, Pose]], rng: np.random.Generator) -> None:
    """Feed poses and sightings in the order in which they would arrive, and compare the goal with the closed form."""
    marker = rng.uniform(1.0, 4.0, 2)
    buffer = PoseBuffer()
    for stamp, pose in poses:
        buffer.add(stamp, pose)
    first, last = poses[0][0], poses[-1][0]
    stamps = [int(s) for s in np.linspace(first + 0.1 * (last - first), first + 0.8 * (last - first), 5)]
    places: list[Pose] = []
    sightings: list[tuple[float, float]] = []
    for stamp in stamps:
        there = buffer.at(stamp)
        assert there is not None
        x, y = marker + rng.normal(0, 0.02, 2) - np.array(there[:2])
        cos, sin = np.cos(there[2]), np.sin(there[2])
        places.append(there)
        sightings.append((float(cos * x + sin * y), float(-sin * x + cos * y)))
    tracker = student.GoalTracker()
    for stamp, pose in poses:
        tracker.add_pose(stamp, pose)
    for stamp, point in zip(stamps, sightings, strict=True):
        tracker.add_sighting(stamp, point)
    answer = tracker.goal()
    seen = np.array(sightings)

    def mean(used: Sequence[Pose]) -> Array:
        return np.asarray(np.mean([transform(p, q) for p, q in zip(used, seen, strict=True)], axis=0))

    correct = mean(places)
    expect(answer is not None, "no goal after five sightings", got="None", expected=correct)

    def mistakes() -> list[tuple[str, Array]]:
        return [
            ("rotate-then-add", mean([(x, y, 0.0) for x, y, _ in places])),
            ("rotate-then-add", mean([(x, y, -yaw) for x, y, yaw in places])),
            ("rotate-then-add", seen.mean(axis=0)),
            ("pose-at-stamp", mean([poses[-1][1]] * len(seen))),
        ]

    judging.compare(answer, correct, mistakes, given=f"five sightings between {len(poses)} poses")


# ---------------------------------------------------------------- Parts 4 and 5


def wilson(successes: int, runs: int, z: float = 1.96) -> tuple[float, float]:
    """Return Wilson's score interval."""
    rate = successes / runs
    centre, half = rate + z**2 / (2 * runs), z * np.sqrt(rate * (1 - rate) / runs + z**2 / (4 * runs**2))
    return float((centre - half) / (1 + z**2 / runs)), float((centre + half) / (1 + z**2 / runs))


def made_up_run(success: bool, perception_ms: Array) -> Any:
    """Return something with the fields of a run. It came near the goal either way: only the judge's verdict counts."""
    return SimpleNamespace(
        success=success,
        reason="",
        goal_distance=0.1,
        seconds=20.0,
        path_length=7.0,
        collisions=(),
        perception_ms=perception_ms,
        planning_ms=np.array([20.0]),
    )


def some_wins(rng: np.random.Generator) -> list[bool]:
    """Return verdicts of some runs, most of them successes, in any order."""
    successes, failures = (int(n) for n in rng.integers((6, 2), (14, 6)))
    return [bool(won) for won in rng.permutation([True] * successes + [False] * failures)]


def compare_evaluation(
    student: Student,
    successes: Sequence[bool],
    rng: np.random.Generator,
    keys: tuple[str, ...] = ("success_rate", "interval", "p95_ms"),
) -> None:
    """Let the student evaluate made-up runs and compare the given keys with the closed form."""
    latencies = [rng.exponential(4.0, rng.integers(5, 40)) + 3.0 for _ in successes]
    runs = [made_up_run(ok, ms) for ok, ms in zip(successes, latencies, strict=True)]
    answer = student.evaluate(lambda index: runs[index], list(range(len(runs))))
    if not isinstance(answer, dict) or not {"success_rate", "interval", "p95_ms"} <= set(answer):
        fail("the answer is not the dict asked for", got=answer, expected="keys success_rate, interval, p95_ms")
    n, k = len(runs), sum(successes)
    given = f"{k} successes in {n} runs"
    if "success_rate" in keys:
        wrong = [("percent-or-share", 100 * k / n)]
        hint = "success-is-the-judges"
        judging.compare(answer["success_rate"], k / n, wrong, hint=hint, given=given, what="success_rate")
    if "interval" in keys:
        _compare_interval(answer["interval"], k, n, given)
    if "p95_ms" in keys:
        pooled = float(np.percentile(np.concatenate(latencies), 95))

        def mistakes() -> list[tuple[str, float]]:
            return [("pool-latencies", float(np.mean([np.percentile(ms, 95) for ms in latencies])))]

        judging.compare(answer["p95_ms"], pooled, mistakes, rtol=0.02, given=given, what="p95_ms")


def _compare_interval(answer: Any, k: int, n: int, given: str) -> None:
    rate = k / n
    wald = 1.96 * np.sqrt(rate * (1 - rate) / n)
    mistakes = [
        ("wilson-not-wald", (rate - wald, rate + wald)),
        ("wilson-not-wald", (max(0.0, rate - wald), min(1.0, rate + wald))),
    ]
    judging.compare(answer, wilson(k, n), mistakes, atol=5e-4, match_atol=1e-3, given=given, what="interval")


@functools.cache
def student_t(n: int) -> float:
    """Return the 97.5 % quantile of Student's t for n pairs."""
    return float(stats.t.ppf(0.975, n - 1))


def compare_gap(student: Student, simulated: Sequence[float], surrogate: Sequence[float]) -> None:
    """Compare with the paired t interval."""
    a, b = np.asarray(simulated, dtype=float), np.asarray(surrogate, dtype=float)
    n, mean = len(a), float((b - a).mean())

    def around(half: float) -> tuple[float, float, float]:
        return mean, mean - half, mean + half

    deviation = float((b - a).std(ddof=1))
    expected = around(student_t(n) * deviation / np.sqrt(n))
    answer = student.paired_gap([float(v) for v in a], [float(v) for v in b])

    def mistakes() -> list[tuple[str, tuple[float, float, float]]]:
        welch = stats.ttest_ind(b, a, equal_var=False).confidence_interval(0.95)
        pooled = stats.ttest_ind(b, a).confidence_interval(0.95)
        return [
            ("surrogate-minus-simulated", (-mean, -expected[2], -expected[1])),
            ("pairs", (mean, welch.low, welch.high)),
            ("pairs", (mean, pooled.low, pooled.high)),
            ("pairs", around(student_t(n) * np.sqrt(a.var(ddof=1) / n + b.var(ddof=1) / n))),
            ("t-not-z", around(1.96 * deviation / np.sqrt(n))),
            ("sample-deviation", around(student_t(n) * float((b - a).std()) / np.sqrt(n))),
        ]

    given = f"simulated {np.round(a, 1).tolist()}, surrogate {np.round(b, 1).tolist()}"
    judging.compare(answer, expected, mistakes, atol=1e-4, match_atol=1e-3, given=given)
