"""The lesson on model optimisation: it runs, what it says is so, and its checks know right from wrong."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robotbrain.grading import load_suite
from robotbrain.grading.suites import lesson_08
from robotbrain.optimisation import soft_targets_loss
from tests import lessons
from tests.lessons import hints

CLAIMS = """
assert late.control_hz < 5 and 0.3 < 0.5 * 1e-3 * np.median(late.camera_age_ms) < 0.5  # "40 cm"
assert 15 < origin["teacher"]["parameters"] / origin["student"]["parameters"] < 17
assert np.allclose(np.array(lost[False][:-1]) / lost[False][1:], 2, atol=0.35)  # "each further bit halves the error"
assert all(per_channel < tensor for per_channel, tensor in zip(lost[True], lost[False], strict=True))
reach = [np.abs(w).reshape(len(w), -1).max(1) for w in layers.values()]
medians = [np.median(np.log2(one.max() / one)) for one in reach]
assert sum(0.6 < m < 1.6 for m in medians) > 0.8 * len(medians)  # "about one bit"
if lite:
    assert 0.55 < lite[False].top1 < 0.78 and lite[True].top1 > 0.85  # "a third", "a few at most"
assert all(best[8, n] != "99.9 %" and best[4, n] == "99.9 %" for n in places)
error = {(b, n, m): relative_error(v, fake_quantize(v, choose_qparams(0.0, ends[n, m], bits=b, symmetric=True)))
         for b in (4, 8) for n, v in seen.items() for m in methods}
assert all(error[8, n, "99.9 %"] == max(error[8, n, m] for m in methods) for n in places)
assert all(accuracy["FP32"] - accuracy[name] < 0.001 for name in accuracy)
assert 3.5 < files["FP32"].stat().st_size / files["INT8 for a CPU"].stat().st_size < 4
assert files["INT8 for TensorRT"].stat().st_size > files["FP32"].stat().st_size
from robotbrain.jetson.catalogue import load_module
assert load_module("nano-4gb").int8_tops is None  # "has no fast INT8 at all"
assert "down.0.0" in worst[0].name and worst[0].sqnr_db < 20 < 40 < worst[1].sqnr_db
assert (exact != cut_off).mean() < 0.02
assert ruin < 0.75 < after_training["4 bits per tensor"] < after_training["8 bits per channel"]
assert repaired - ruin > 0.5 * (after_training["FP32"] - ruin) and result.steps == 20
assert all(not any(isinstance(m, torch.nn.Linear) for m in load_network(n).modules()) for n in ("teacher", "student"))
assert packed["90 % zeros"] < 0.3 * packed["as it was"]
assert len({round(size[name]) for name in size if "channels" not in name}) == 1
assert board["50 % zeros"] == board["as it was"] and board["50 % fewer channels"] > 0.9 * board["as it was"]
assert [m.out_channels for m in slim.modules() if isinstance(m, torch.nn.Conv2d)][0] == 6  # "leaves six"
assert before < 0.8 and after > before + 0.5 * (after_training["FP32"] - before)
assert soft[1].argmax() == 1 and np.argsort(soft[1])[-2] == 2 and soft[8].max() < 0.6  # floor, or perhaps obstacle
assert (np.diff(strength) > 0).all() and strength[-1] < 1.2 * strength[-3] and strength[-1] / 256 < 0.1
taught, alone = origin["student"]["recipe"], origin["student_plain"]["recipe"]
assert taught["distil"] and not alone["distil"] and taught["labelled"] == alone["labelled"]
assert taught["unlabelled"] > 0 == alone["unlabelled"]
assert abs(origin["student"]["steps"] / origin["student_plain"]["steps"] - 1) < 0.05
assert taught["distil"]["temperature"] == 1
assert iou["student"] > iou["student_plain"]
stored = {name: origin[name]["test_1200_images"]["mean_iou"] for name in names}
assert stored["student"] > stored["student_plain"]
by = {row["name"]: row for row in rows}
assert by["student, taught"]["board"] < by["teacher, INT8"]["board"]
network_ms = {n: nano.network_ms(network_path(n), p, (640, 480)) for n, p in (("teacher", "fp32"), ("student", "fp16"))}
assert 18 < network_ms["teacher"] / network_ms["student"] < 26  # "a twentieth"
assert 2.6 < drives["student, FP16"].control_hz / late.control_hz < 4  # "three times as many"
"""


class TestLesson(lessons.LessonTests):
    notebook = "08_model_optimisation.ipynb"
    exercises = "123456"
    figures = 11
    tables = 8
    claims = CLAIMS
    timeout = 300


# ---------------------------------------------------------------- the checks


check = partial(lessons.check, "lesson_08")

HAND = {line: right for line, (right, _) in lesson_08._HAND.items()}


def sqnr_db(x: Any, approximation: Any) -> float:
    noise = ((x - approximation) ** 2).sum()
    return math.inf if noise == 0 else float(10 * np.log10((x**2).sum() / noise))


def bits_lost(weight: Any, log: Any = np.log2, axis: int = 0) -> Any:
    largest = np.moveaxis(np.abs(weight), axis, 0).reshape(weight.shape[axis], -1).max(1)
    return np.array([log(largest.max() / one) if one else 0.0 for one in largest])


def softmax(z: Any) -> Any:
    e = np.exp(z - z.max())
    return e / e.sum()


def soft_gradient(z: Any, v: Any, T: float) -> Any:
    return T * (softmax(z / T) - softmax(v / T))


def choose(rows: Any, most_drop: float, most_kb: float) -> Any:
    able = sorted((r["here"], r["name"]) for r in rows if r["drop"] <= most_drop and r["kB"] <= most_kb)
    return able[0][1] if able else None


def list_bytes(count: float, sparsity: float, value: float, index: float) -> float:
    return count * (1 - sparsity) * (value + index)


def break_even(value: float, index: float) -> float:
    return index / (value + index)


def test_right_answers_pass() -> None:
    assert check("hand", hand=HAND).full
    assert check("hand", hand={**HAND, "scale": 2.55 / 255}).full
    assert check("sqnr", sqnr_db=sqnr_db, db_per_bit=6.02).full
    assert check("sqnr", sqnr_db=sqnr_db, db_per_bit=20 * math.log10(2)).full
    assert check("lost", bits_lost=bits_lost).full
    assert check("lost", bits_lost=lambda w: bits_lost(w).tolist()).full
    assert check("list", list_bytes=list_bytes, break_even=break_even).full
    assert check("gradient", soft_gradient=soft_gradient).full
    assert check("choose", choose=choose).full


def test_the_gradient_that_is_asked_for_is_that_of_the_library_s_loss() -> None:
    import torch

    z, v = torch.randn(2, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for temperature in (1.0, 3.0):
        student = z.clone().requires_grad_()
        soft_targets_loss(student[None], v[None], temperature).backward()
        wanted = soft_gradient(z.numpy(), v.numpy(), temperature)
        assert student.grad is not None
        np.testing.assert_allclose(student.grad.numpy(), wanted, atol=1e-9)


def test_the_five_numbers_are_what_the_library_says() -> None:
    from robotbrain.optimisation import choose_qparams, fake_quantize, quantize

    q = choose_qparams(-0.5, 2.05, signed=False)
    inside = np.linspace(-0.5, 2.05, 20_001)
    found = [q.scale, q.zero_point, quantize(1.0, q), np.abs(fake_quantize(inside, q) - inside).max()]
    np.testing.assert_allclose([float(one) for one in (*found, fake_quantize(3.0, q))], list(HAND.values()), rtol=2e-3)


def _sqnr(noise: Any = lambda e: (e**2).sum(), scale: Any = lambda ratio: 10 * math.log10(ratio)) -> Any:
    def answer(x: Any, approximation: Any) -> float:
        error = noise(x - approximation)
        return float(scale((x**2).sum() / error)) if error else math.inf

    return answer


@pytest.mark.parametrize(
    ("exercise", "answers", "hint"),
    [
        ("hand", {"hand": {**HAND, "scale": 2.55 / 256}}, "gaps-not-posts"),
        ("hand", {"hand": {**HAND, "scale": 2.05 / 127}}, "whole-range"),
        ("hand", {"hand": {**HAND, "zero point": 0}}, "zero-point-is-an-integer"),
        ("hand", {"hand": {**HAND, "integer that stands for 1.0": 100}}, "add-the-zero-point"),
        ("hand", {"hand": {**HAND, "largest rounding error within the range": 0.01}}, "half-a-scale"),
        ("hand", {"hand": {**HAND, "what 3.0 comes back as": 3.0}}, "saturates"),
        ("sqnr", {"sqnr_db": _sqnr(scale=lambda r: 20 * math.log10(r)), "db_per_bit": 6.02}, "power-not-amplitude"),
        ("sqnr", {"sqnr_db": _sqnr(scale=lambda r: 10 * math.log(r)), "db_per_bit": 6.02}, "decimal-logarithm"),
        ("sqnr", {"sqnr_db": _sqnr(scale=lambda r: 10 * math.log2(r)), "db_per_bit": 6.02}, "decimal-logarithm"),
        ("sqnr", {"sqnr_db": _sqnr(scale=lambda r: -10 * math.log10(r)), "db_per_bit": 6.02}, "signal-over-noise"),
        ("sqnr", {"sqnr_db": _sqnr(noise=lambda e: np.abs(e).sum()), "db_per_bit": 6.02}, "squares"),
        ("sqnr", {"sqnr_db": lambda x, a: sqnr_db(x, a) if (x - a).any() else 0.0}, "no-error-is-infinite"),
        ("sqnr", {"sqnr_db": sqnr_db, "db_per_bit": 3.01}, "half-is-a-quarter"),
        ("lost", {"bits_lost": partial(bits_lost, log=np.log)}, "binary-logarithm"),
        ("lost", {"bits_lost": partial(bits_lost, log=np.log10)}, "binary-logarithm"),
        ("lost", {"bits_lost": lambda w: -bits_lost(w)}, "tensor-over-channel"),
        ("lost", {"bits_lost": partial(bits_lost, axis=1)}, "output-channels"),
        ("lost", {"bits_lost": lambda w: float(bits_lost(w).mean())}, "output-channels"),
        ("lost", {"bits_lost": lambda w: np.log2(w.max() / w.reshape(len(w), -1).max(1))}, "magnitudes"),
        (
            "lost",
            {"bits_lost": lambda w: np.log2(abs(w).max() / abs(w).reshape(len(w), -1).max(1))},
            "zeros-lose-nothing",
        ),
        ("list", {"list_bytes": lambda n, s, v, i: n * (1 - s) * v, "break_even": break_even}, "index-too"),
        ("list", {"list_bytes": lambda n, s, v, i: n * s * (v + i), "break_even": break_even}, "survivors-only"),
        ("list", {"list_bytes": list_bytes, "break_even": lambda v, i: v / (v + i)}, "equate-them"),
        ("gradient", {"soft_gradient": lambda z, v, T: soft_gradient(z, v, T) / T**2}, "times-the-square"),
        ("gradient", {"soft_gradient": lambda z, v, T: soft_gradient(z, v, T) * T}, "times-the-square"),
        ("gradient", {"soft_gradient": lambda z, v, T: soft_gradient(v, z, T)}, "student-minus-teacher"),
        ("gradient", {"soft_gradient": lambda z, v, T: T * (softmax(z) - softmax(v / T))}, "soften-both"),
        ("gradient", {"soft_gradient": lambda z, v, T: T * (_naive(z / T) - _naive(v / T))}, "large-logits"),
        ("choose", {"choose": lambda r, d, k: choose(r, 9, k)}, "both-limits"),
        ("choose", {"choose": lambda r, d, k: choose(r, d, 1e9)}, "both-limits"),
        ("choose", {"choose": lambda r, d, k: choose(r, d - 1e-6, k)}, "both-limits"),
        ("choose", {"choose": lambda r, d, k: _by(r, d, k, "drop")}, "fastest-of-these"),
        ("choose", {"choose": lambda r, d, k: choose(r, d, k) or "large"}, "none-fits"),
        (
            "choose",
            {"choose": lambda r, d, k: next((x for x in r if x["name"] == choose(r, d, k)), None)},
            "return-the-name",
        ),
    ],
)
def test_wrong_answers_get_their_hint(exercise: str, answers: dict[str, Any], hint: str) -> None:
    report = check(exercise, **answers)
    assert not report.full and hint in hints(report), (hints(report), report)


def _naive(z: Any) -> Any:
    e = np.exp(z)
    return e / e.sum()


def _by(rows: Any, most_drop: float, most_kb: float, key: str) -> Any:
    able = [r for r in rows if r["drop"] <= most_drop and r["kB"] <= most_kb]
    return min(able, key=lambda r: r[key])["name"] if able else None


@pytest.mark.parametrize("value", [None, "85", [85], True, print])
def test_nonsense_gets_an_answer_and_no_points(value: Any) -> None:
    for exercise, entry in load_suite("lesson_08").exercises.items():
        assert not check(exercise, **{entry.provides[0]: value}).full
        report = check(exercise, **{name: (lambda *_: value) for name in entry.provides})
        assert not report.full and not any("Traceback" in (r.message or "") for r in report.results)


def test_every_hint_is_of_use() -> None:
    source = Path(lesson_08.__file__).read_text(encoding="utf-8")
    for key in load_suite("lesson_08").hints:
        assert source.count(f'"{key}"') >= 2, key
