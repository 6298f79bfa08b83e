"""The lesson on deployment: it runs, what it says of its figures is so, and its checks know right from wrong."""

from __future__ import annotations

import itertools
import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robotbrain.grading import load_suite
from robotbrain.grading.suites import lesson_03
from robotbrain.jetson.catalogue import list_modules
from robotbrain.jetson.deploy.program.engine import key_of, made_of
from robotbrain.jetson.deploy.program.trtexec import Trtexec
from robotbrain.jetson.software import load_jetpacks, newest_jetpack
from tests import lessons
from tests.lessons import hints

CLAIMS = """
from robotbrain.optimisation.networks import parameter_count
assert 0.8e6 < parameter_count(teacher) < 1.3e6 and 40e3 < parameter_count(student) < 65e3
assert np.abs(runs["fused"]() - torch_run()).max() < 1e-3 * np.abs(torch_run()).max()
assert not (folder / "fog.onnx").exists()
xavier, *others = [a.latency_ms / b.latency_ms for a, b in zip(race("fp32").predictions, race("fp16").predictions)][1:]
assert xavier > 5 and all(1.8 < gain < 2.6 for gain in others)  # "now it flies", "about twice as fast"
boards3 = [("nano-4gb", "MAXN"), ("orin-nano-8gb", "15W"), ("agx-orin-64gb", "MAXN")]
both = [[predict(networks[n], d, mode=m, precision="fp16") for n in ("student", "teacher")] for d, m in boards3]
assert all(b.macs > 9 * a.macs and b.latency_ms < 2.05 * a.latency_ms for a, b in both)
assert all(len(b.kernels) == len(a.kernels) + 2 for a, b in both)
launch = lambda p: sum(k.launch_ms for k in p.kernels) / sum(k.total_ms for k in p.kernels)
assert launch(both[0][1]) < launch(both[1][1]) < launch(both[2][1]) and min(map(launch, both[1])) > 0.6
assert large["teacher"] and abs(found["nano-4gb", "fp16"].macs / (75 * both[0][1].macs) - 1) < 0.01
assert all(abs(pair.error) < 0.25 for pair in pairs)
int8 = [pair.published for pair in pairs if pair.kind == "int8/fp16"]
assert round(min(int8), 2) == 0.63 and round(max(int8), 2) == 0.94
assert sum(pair.published < 0.5 for pair in pairs if pair.kind == "fp16/fp32") >= 3
xavier = [found["xavier-nx", p] for p in PRECISIONS]
assert xavier[0].latency_ms > 5 * xavier[1].latency_ms
width = lambda p: p.latency_high_ms / p.latency_low_ms
assert width(xavier[0]) > 1.5 * width(found["orin-nano-8gb", "fp32"])
assert quantised.size_bytes > 0.9 * quantised.source_bytes  # "the file does not shrink"
assert mean_iou(path, test, optimise=False).mean - mean_iou(quantised.path, test, optimise=False).mean < 0.01
errors = [[f for f in lint(x) if f.severity == "error"] for x in (quantised.path, folder / "default.onnx")]
assert not errors[0] and len(errors[1]) > 10
assert p.provenance == "predicted"
slow, half, quick = drives.values()
assert not slow.success and "did not arrive" in slow.reason and half.success and quick.success
assert 0.2 < slow.control_hz / 20 < 0.32 and 400 < np.median(slow.camera_age_ms) < 500
assert 0.4 < np.median(quick.camera_age_ms) / np.median(half.camera_age_ms) < 0.62
assert 55 < np.median(quick.perception_ms) < 66 and 2 < profile.network_ms(quantised.path, "int8", size) < 3
"""


class TestLesson(lessons.LessonTests):
    notebook = "03_tensorrt_deployment.ipynb"
    exercises = "123456"
    figures = 4
    tables = 6
    claims = CLAIMS
    timeout = 240

    def test_no_time_is_told_that_no_tensorrt_took(self, executed: Any) -> None:
        """Whatever the simulated runtime printed, there is no millisecond beside it."""
        printed = [
            line
            for cell in executed.cells
            for output in cell.get("outputs", [])
            for line in str(output.get("text", "")).splitlines()
            if "simulated" in line and "simulated time" not in line
        ]
        assert len(printed) >= 3
        assert not any(" ms" in line for line in printed)


def test_what_the_prose_says_about_versions_agrees_with_the_table() -> None:
    newest = load_jetpacks()[-1]
    assert (newest.version, newest.tensorrt.text) == ("7.2", "10.16")  # "TensorRT 11 does not come to Jetson yet"
    assert all(release.tensorrt.text.split(".")[0] != "11" for release in load_jetpacks())


# ---------------------------------------------------------------- the checks


check = partial(lessons.check, "lesson_03")


def fleet_opset(slugs: list[str], needed: int) -> Any:
    least = min(int(newest_jetpack(slug).onnx_opset.value) for slug in slugs)
    return least if least >= needed else None


def effective_gbs(kernel: Any, size: int, ms: float) -> float:
    return float((kernel.in_elems + kernel.weight_elems + kernel.out_elems) * size / (1e-3 * ms) / 1e9)


def int8_scale(low: float, high: float) -> float:
    top = max(abs(low), abs(high))
    return top / 127 if top else 1.0


def fit_batch(images: Any, least: int, most: int) -> list[tuple[Any, int]]:
    pieces = []
    for first in range(0, len(images), most):
        part = images[first : first + most]
        missing = max(0, least - len(part))
        padding = np.zeros((missing, *images.shape[1:]), images.dtype)
        pieces.append((np.concatenate([part, padding]), len(part)))
    return pieces


def fit_batch_in_place(images: Any, least: int, most: int) -> list[tuple[Any, int]]:
    """The same by another road: every piece full, cut from one padded array."""
    calls = math.ceil(len(images) / most)
    padded = np.zeros((calls * most, *images.shape[1:]), images.dtype)
    padded[: len(images)] = images
    return [(padded[k * most : (k + 1) * most], min(most, len(images) - k * most)) for k in range(calls)]


ORDER = [
    lesson_03.ADDRESSES,
    lesson_03.WRITE,
    lesson_03.COPY_IN,
    lesson_03.RUN,
    lesson_03.COPY_OUT,
    lesson_03.WAIT,
    lesson_03.READ,
]
BUILDS_AGAIN = {change: right for change, (right, _) in lesson_03._REBUILD.items()}


def test_right_answers_pass() -> None:
    assert check("opset", fleet_opset=fleet_opset).full
    assert check("bandwidth", effective_gbs=effective_gbs).full
    assert check("bandwidth", effective_gbs=lambda kernel, size, ms: kernel.elems * size / ms / 1e6).full
    assert check("scale", int8_scale=int8_scale).full
    assert check("profile", fit_batch=fit_batch).full
    assert check("profile", fit_batch=fit_batch_in_place).full
    assert check("stream", order=ORDER).full
    assert check("stream", order=tuple(ORDER)).full
    assert check("rebuild", builds_again=BUILDS_AGAIN).full


def test_every_order_that_cuda_allows_is_right_and_no_other() -> None:
    """Derived from what each step needs, not from the checker: 5 orders, in which only the addresses move."""
    needs = {
        lesson_03.COPY_IN: {lesson_03.WRITE},
        lesson_03.RUN: {lesson_03.COPY_IN, lesson_03.ADDRESSES},
        lesson_03.COPY_OUT: {lesson_03.RUN},
        lesson_03.WAIT: {lesson_03.COPY_OUT},
        lesson_03.READ: {lesson_03.WAIT},
    }
    rng = np.random.default_rng(0)
    orders = list(itertools.permutations(ORDER))
    right = [order for order in orders if all(needs.get(s, set()) <= set(order[:i]) for i, s in enumerate(order))]
    assert len(right) == 3 and all(check("stream", order=list(order)).full for order in right)
    wrong = [orders[i] for i in rng.integers(0, len(orders), 40) if orders[i] not in right]
    for order in wrong:
        report = check("stream", order=list(order))
        assert report.earned == 0 and len(hints(report)) == 1


def _swapped(first: str, second: str) -> list[str]:
    """The right order, with ``second`` moved to just before ``first``."""
    rest = [step for step in ORDER if step != second]
    rest.insert(rest.index(first), second)
    return rest


def _fit(part: Any = None, pad: Any = None, count: Any = None) -> Any:
    def answer(images: Any, least: int, most: int) -> Any:
        size = part(least, most) if part else most
        pieces = []
        for first in range(0, len(images), size):
            rows = images[first : first + size]
            missing = max(0, least - len(rows))
            full = (
                pad(rows, missing) if pad else np.concatenate([rows, np.zeros((missing, *rows.shape[1:]), rows.dtype)])
            )
            pieces.append((full, count(rows, full) if count else len(rows)))
        return pieces

    return answer


def _padding(images: Any, least: int) -> list[tuple[Any, int]]:
    return [(np.zeros((least, *images.shape[1:]), images.dtype), 0)]


def _front(rows: Any, missing: int) -> Any:
    return np.concatenate([np.zeros((missing, *rows.shape[1:]), rows.dtype), rows])


@pytest.mark.parametrize(
    ("exercise", "answers", "hint"),
    [
        ("opset", {"fleet_opset": lambda s, n: max(fleet_opset([x], 0) for x in s)}, "weakest-parser"),
        ("opset", {"fleet_opset": lambda s, n: int(newest_jetpack(s[0]).onnx_opset.value)}, "weakest-parser"),
        ("opset", {"fleet_opset": lambda s, n: fleet_opset(s, 0)}, "operators-too-new"),
        ("opset", {"fleet_opset": lambda s, n: max(n, fleet_opset(s, 0))}, "operators-too-new"),
        ("opset", {"fleet_opset": lambda s, n: newest_jetpack(s[0]).onnx_opset}, "plain-number"),
        ("bandwidth", {"effective_gbs": lambda k, b, ms: k.elems / ms / 1e6}, "elements-are-bytes"),
        ("bandwidth", {"effective_gbs": lambda k, b, ms: (k.in_elems + k.out_elems) * b / ms / 1e6}, "all-three-move"),
        ("bandwidth", {"effective_gbs": lambda k, b, ms: k.out_elems * b / ms / 1e6}, "all-three-move"),
        ("bandwidth", {"effective_gbs": lambda k, b, ms: k.elems * b / ms / 1e9}, "seconds-and-giga"),
        ("bandwidth", {"effective_gbs": lambda k, b, ms: k.elems * b / ms * 1e3}, "seconds-and-giga"),
        ("scale", {"int8_scale": lambda lo, hi: hi / 127 if hi else 1.0}, "symmetric-range"),
        ("scale", {"int8_scale": lambda lo, hi: max(-lo, hi) / 128 or 1.0}, "top-is-127"),
        ("scale", {"int8_scale": lambda lo, hi: max(-lo, hi) / 255 or 1.0}, "top-is-127"),
        ("scale", {"int8_scale": lambda lo, hi: (hi - lo) / 255 or 1.0}, "not-the-width"),
        ("scale", {"int8_scale": lambda lo, hi: 2 * max(-lo, hi) / 127 or 1.0}, "not-the-width"),
        ("scale", {"int8_scale": lambda lo, hi: max(-lo, hi) / 127}, "no-scale-of-zero"),
        ("profile", {"fit_batch": lambda i, a, b: [(i, len(i))]}, "too-many-rows"),
        ("profile", {"fit_batch": _fit(pad=lambda rows, missing: rows)}, "too-few-rows"),
        ("profile", {"fit_batch": lambda i, a, b: fit_batch(i[:b], a, b)}, "all-in-order"),
        ("profile", {"fit_batch": lambda i, a, b: fit_batch(i[::-1], a, b)}, "all-in-order"),
        ("profile", {"fit_batch": _fit(pad=_front)}, "pad-at-the-end"),
        ("profile", {"fit_batch": _fit(count=lambda rows, full: len(full))}, "pad-at-the-end"),
        ("profile", {"fit_batch": _fit(part=lambda least, most: least)}, "fewest-calls"),
        ("profile", {"fit_batch": lambda i, a, b: [(p.astype(float), n) for p, n in fit_batch(i, a, b)]}, "same-type"),
        ("profile", {"fit_batch": lambda i, a, b: fit_batch(i, a, b) or _padding(i, a)}, "nothing-to-run"),
        ("stream", {"order": ORDER[:-1]}, "each-step-once"),
        ("stream", {"order": [*ORDER[:-1], ORDER[0]]}, "each-step-once"),
        ("stream", {"order": _swapped(lesson_03.WRITE, lesson_03.COPY_IN)}, "copy-what-is-there"),
        ("stream", {"order": [*ORDER[1:4], ORDER[0], *ORDER[4:]]}, "addresses-first"),
        ("stream", {"order": _swapped(lesson_03.COPY_IN, lesson_03.RUN)}, "input-before-run"),
        ("stream", {"order": _swapped(lesson_03.RUN, lesson_03.COPY_OUT)}, "run-before-output"),
        ("stream", {"order": _swapped(lesson_03.COPY_OUT, lesson_03.WAIT)}, "sync-last"),
        ("stream", {"order": _swapped(lesson_03.WAIT, lesson_03.READ)}, "read-after-sync"),
    ],
)  # fmt: skip
def test_wrong_answers_get_their_hint(exercise: str, answers: dict[str, Any], hint: str) -> None:
    report = check(exercise, **answers)
    assert not report.full and hint in hints(report), (hints(report), report)


@pytest.mark.parametrize("change", list(BUILDS_AGAIN))
def test_each_change_is_asked_for(change: str) -> None:
    report = check("rebuild", builds_again={**BUILDS_AGAIN, change: not BUILDS_AGAIN[change]})
    assert report.earned == 0 and hints(report) == {lesson_03._REBUILD[change][1]}


def test_the_changes_are_those_of_the_key_on_the_board() -> None:
    """The answers of exercise 6 are what the board's own program does."""
    program = Trtexec("trtexec", "10.3.0", frozenset(), True)
    manifest: dict[str, Any] = {
        "calibration": None,
        "network": {"sha256": "a" * 64, "file": "model.onnx", "inputs": [], "dynamic": False},
        "target": {"module": "orin-nano-8gb", "mode": "15W", "tensorrt": "10.3"},
        "parameters": {"precision": "fp32", "batch": 1},
        "files": {},
    }
    board: dict[str, Any] = {"tensorrt_package": "10.3.0.30-1", "jetson_linux": "36.4.3", "parts": ["p3767-0003"]}
    before = key_of(made_of(program, manifest, board))
    assert key_of(made_of(program, manifest, board)) == before
    network = {**manifest["network"], "sha256": "b" * 64}
    others = [
        ({**manifest, "network": network}, board, program),
        ({**manifest, "target": {**manifest["target"], "mode": "7W"}}, board, program),
        (manifest, {**board, "parts": ["p3767-0005"]}, program),
        (manifest, {**board, "jetson_linux": "36.5.0"}, program),
        (manifest, board, Trtexec("trtexec", "10.4.0", frozenset(), True)),
    ]
    keys = {key_of(made_of(t, m, b)) for m, b, t in others}
    assert len(keys) == len(others) and before not in keys


@pytest.mark.parametrize("value", [None, "85", [85], math.nan, True, print, {"device": 1}])
def test_nonsense_gets_an_answer_and_no_points(value: Any) -> None:
    for exercise, entry in load_suite("lesson_03").exercises.items():
        report = check(exercise, **dict.fromkeys(entry.provides, value))
        assert report.earned == 0 and repr(report)


def test_open_answers_are_no_mistakes() -> None:
    open_answers: dict[str, Any] = {"order": [...], "builds_again": dict.fromkeys(BUILDS_AGAIN, ...)}
    for exercise, entry in load_suite("lesson_03").exercises.items():
        name = entry.provides[0]
        report = check(exercise, **{name: open_answers.get(name, lambda *_: ...)})
        assert report.earned == 0 and not hints(report) and "not written yet" in repr(report), exercise


def test_the_fleets_of_the_first_exercise_differ() -> None:
    """Modules must disagree about opsets, else the exercise teaches nothing."""
    assert len({fleet_opset([slug], 0) for slug in list_modules()}) >= 3
    assert fleet_opset(["nano-4gb", "t5000"], 17) is None


def test_every_hint_is_of_use() -> None:
    source = Path(lesson_03.__file__).read_text(encoding="utf-8")
    for key in load_suite("lesson_03").hints:
        assert source.count(f'"{key}"') >= 2, f"{key} is registered and never given"
