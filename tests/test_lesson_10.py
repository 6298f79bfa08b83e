"""The lesson on troubleshooting: it runs, its numbers are true, and its checks know right from wrong."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
import pytest

from tests import lessons
from tests.lessons import hints

CLAIMS = """
import warnings

assert run.success and sick.path_length < 0.01 and not sick.collisions
assert slope(wheels, gyro) < -0.98 and slope(wheels, turned) > 0.98

assert diagnosis.bottleneck.name == "slow inference in /perception", diagnosis.bottleneck
e2e = [np.median(tried.e2e_ms) for tried in (slow, quantised, small)]
assert e2e[0] > 2 * e2e[1] > 4 * e2e[2]
assert round(images.latency.p50) == 172 and slow.deadline_misses["perception"] > 0

swapped, now = judge(data.images[..., ::-1])
assert swapped[3] < 0.5 * usual[3] and min(swapped[:3]) > 0.9 and stability_index(shares, now) < 0.1
by_gain = dict(zip(gains.tolist(), zip(mean_iou, psi)))
assert min(by_gain[g][0] for g in (0.75, 1.0, 1.25)) > 0.96 and by_gain[2.0][0] < 0.92
assert by_gain[0.4][0] < 2 / 3 * by_gain[1.0][0] and 0.1 < by_gain[0.4][1] < 0.25 < by_gain[0.3][1]
assert by_gain[2.5][1] < 0.1 and by_gain[2.5][0] < 0.8
assert judge(normalised(exposed(0.4)))[0].mean() > 0.95
assert judge(normalised(exposed(2.5)))[0].mean() < by_gain[2.5][0]

most = [error.max() for error in errors.values()]
assert most[1] > 10 * max(most[0], most[2]) and most[0] < 0.04
assert errors["wheels and a warming gyro"][-1] < 0.5 * most[1]
made = []
clinic.replay_into(
    BAG, [ODOMETRY], node=lambda: made.append(EstimatorNode()), topics=inside, faults=[warming]
)
assert 0.005 < made[0]._filter.bias < 0.02  # it has begun to see the new offset, once it stood still again

assert abs(uses["int8"].weights_mb / uses["fp32"].weights_mb - 0.25) < 0.01
assert all(m.context_mb > m.total_mb / 2 for m in uses.values())
grown = run_queue("keep_all", arrival_hz=10, service_ms=images.latency.p50, seconds=30)
assert grown.memory_mb > uses["fp32"].total_mb - uses["int8"].total_mb and 12 < grown.latency_ms[-1] / 1000 < 13

trip = cool.module.gpu_throttle_c
for name, (cold, heat) in cases.items():
    assert bool(heat.throttled_s) == ("no fan" in name)
    if heat.throttled_s:
        assert trip - 4 < heat.temperature_c[-600:].min() and heat.temperature_c.max() < trip + 1.5
        assert heat.clock[-600:].mean() < 1
cold, heat = cases["INT8, no fan"]
assert 5 < cases["FP32, no fan"][0].latency_ms / (cold.latency_ms / heat.clock[-600:].mean()) < 6
for precision in ("fp32", "int8"):
    p = predictions[precision, "15W"]
    mean_w = (p.energy_mj + p.module.idle_power_w * (100 - p.latency_ms)) / 100
    assert thermal_model(p.module, "passive", ambient_c=50).steady_c(mean_w) < 80

whole = {c: p.energy_mj + p.module.idle_power_w * (100 - p.latency_ms) for c, p in predictions.items()}
first, second, third = whole.values()
assert 0.33 < 1 - second / first < 0.4 and third > second
assert abs(1 - predictions["int8", "15W"].energy_mj / second - 7 / 8) < 0.02
assert predictions["int8", "MODE_10W_DESKTOP"].energy_mj > predictions["int8", "15W"].energy_mj
assert round(1e9 / loop_times("sleep", 50 * MS, 200 * [8 * MS]).mean_period_ns) == 17

raw, half = ages(921_600), ages(230_400)
assert raw[-1] > 10 * raw[0] and half[-1] == half[0] and raw[0] > 100
assert 921_600 == 640 * 480 * 3 and 921_600 * 80 / 50e6 > 1 > 230_400 * 80 / 50e6
with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    assert min(1.0, np.mean([])) == 1.0
"""


class TestLesson(lessons.LessonTests):
    notebook = "10_troubleshooting.ipynb"
    exercises = "123456"
    figures = 6
    tables = 8
    claims = CLAIMS


# ---------------------------------------------------------------- the checks


check = partial(lessons.check, "lesson_10")


def yaw_error(estimated: Any, true: Any) -> Any:
    return np.arctan2(np.sin(estimated - true), np.cos(estimated - true))


def by_remainder(estimated: Any, true: Any) -> Any:
    return (estimated - true + np.pi) % (2 * np.pi) - np.pi


def full(free: float, frame: float, arrival: float, service: float) -> float:
    return free / (frame * (arrival - service)) if arrival > service else math.inf


def period(busy: float, idle: float, work: float, every: float) -> float:
    return busy * work + idle * (every - work) if work <= every else math.nan


def to_base(point: Any, mount: Any, sign: int = 1, first: bool = False, degrees: bool = False) -> Any:
    yaw = sign * (math.radians(mount[2]) if degrees else mount[2])
    x, y = (point[0] + mount[0], point[1] + mount[1]) if first else point
    turned = (math.cos(yaw) * x - math.sin(yaw) * y, math.sin(yaw) * x + math.cos(yaw) * y)
    return turned if first else (turned[0] + mount[0], turned[1] + mount[1])


VERDICTS = {"A": "fresh stamp on old data", "B": "unknown taken for free", "C": "blocking callback"}

REPAIRED = {
    "brighter": lambda image, amount: np.clip(image.astype(int) + amount, 0, 255).astype(np.uint8),
    "keep": lambda history, scan: history.append(scan.copy()),
    "to_network": lambda image: image.transpose(2, 0, 1),
}


def test_right_answers_pass() -> None:
    for right in (yaw_error, by_remainder):
        assert check("yaw", yaw_error=right).full
    assert check("full", seconds_until_full=full).full
    assert check("energy", period_mj=period).full
    assert check("frames", to_base=to_base).full
    assert check("frames", to_base=lambda p, m: np.array(to_base(p, m))).full
    assert check("verdicts", verdicts=VERDICTS).full
    assert check("repairs", **REPAIRED).full
    assert check("repairs", **{**REPAIRED, "to_network": lambda image: np.moveaxis(image, -1, 0)}).full


def clipped_late(image: Any, amount: int) -> Any:
    return np.clip(image + np.array(amount % 256, np.uint8), 0, 255)


def replaced(history: list[Any], scan: Any) -> None:
    history[:] = [scan.copy()]


@pytest.mark.parametrize(
    ("exercise", "answers", "hint"),
    [
        ("yaw", {"yaw_error": lambda e, t: e - t}, "wrap-the-difference"),
        ("yaw", {"yaw_error": lambda e, t: abs(yaw_error(e, t))}, "estimate-minus-truth"),
        ("yaw", {"yaw_error": lambda e, t: yaw_error(t, e)}, "estimate-minus-truth"),
        ("yaw", {"yaw_error": lambda e, t: (e - t + 180) % 360 - 180}, "wrap-the-difference"),
        ("yaw", {"yaw_error": lambda e, t: np.degrees(yaw_error(e, t))}, "radians"),
        ("yaw", {"yaw_error": lambda e, t: math.remainder(e - t, 2 * math.pi)}, "works-for-arrays"),
        ("full", {"seconds_until_full": lambda f, m, a, s: f / (m * a) if a > s else math.inf}, "the-difference-grows"),
        ("full", {"seconds_until_full": lambda f, m, a, s: f / (a - s) if a > s else math.inf}, "frames-have-size"),
        ("full", {"seconds_until_full": lambda f, m, a, s: f / (m * (a - s))}, "never-is-infinite"),
        ("energy", {"period_mj": lambda b, i, w, p: b * w}, "rest-is-idle"),
        ("energy", {"period_mj": lambda b, i, w, p: period(b, i, w, p) / 1000}, "watt-milliseconds"),
        ("energy", {"period_mj": lambda b, i, w, p: b * w + i * p}, "idle-only-rests"),
        ("energy", {"period_mj": lambda b, i, w, p: b * w + i * (p - w)}, "does-not-fit"),
        ("energy", {"period_mj": lambda b, i, w, p: period(b, i, w, p) if w < p else math.nan}, "just-fits"),
        ("frames", {"to_base": lambda p, m: to_base(p, m, sign=-1)}, "turn-with-the-mount"),
        ("frames", {"to_base": lambda p, m: to_base(p, m, first=True)}, "rotate-then-shift"),
        ("frames", {"to_base": lambda p, m: to_base(p, m, degrees=True)}, "radians"),
        ("verdicts", {"verdicts": {**VERDICTS, "A": "wrong frame"}}, "stamp-is-when-measured"),
        ("verdicts", {"verdicts": {**VERDICTS, "B": "wrong unit"}}, "empty-means-unknown"),
        ("verdicts", {"verdicts": {**VERDICTS, "C": "aliasing"}}, "nobody-else-runs"),
        ("repairs", {**REPAIRED, "brighter": clipped_late}, "clip-before-uint8"),
        (
            "repairs",
            {**REPAIRED, "brighter": lambda image, amount: np.clip(image.astype(int) + amount, 0, 255)},
            "stays-uint8",
        ),
        ("repairs", {**REPAIRED, "keep": lambda history, scan: history.append(scan)}, "keep-a-copy"),
        ("repairs", {**REPAIRED, "keep": replaced}, "all-that-came"),
        (
            "repairs",
            {**REPAIRED, "to_network": lambda image: image.reshape(3, *image.shape[:2])},
            "move-the-axis",
        ),
        ("repairs", {**REPAIRED, "to_network": lambda image: image.T}, "height-then-width"),
    ],
)
def test_wrong_answers_get_their_hint(exercise: str, answers: dict[str, Any], hint: str) -> None:
    report = check(exercise, **answers)
    assert not report.full and hint in hints(report), (hints(report), report)


def test_an_answer_of_the_wrong_kind_is_named() -> None:
    for exercise, answers in (
        ("frames", {"to_base": lambda p, m: 5}),
        ("frames", {"to_base": lambda p, m: "left"}),
        ("yaw", {"yaw_error": lambda e, t: None}),
        ("full", {"seconds_until_full": lambda *a: "soon"}),
        ("verdicts", {"verdicts": 5}),
        ("verdicts", {"verdicts": {**VERDICTS, "A": "gremlins"}}),
        ("repairs", {**REPAIRED, "brighter": lambda image, amount: None}),
    ):
        report = check(exercise, **answers)
        assert not report.full and not any("Traceback" in (r.message or "") for r in report.results), exercise


def test_the_faulty_pieces_of_the_lesson_are_not_accepted_as_repairs() -> None:
    report = check(
        "repairs",
        brighter=lambda image, amount: image + np.uint8(amount % 256),
        keep=lambda history, scan: history.append(scan),
        to_network=lambda image: image.reshape(3, *image.shape[:2]),
    )
    assert report.earned == 0
