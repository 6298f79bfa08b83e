"""The lesson on Jetson platforms: it runs, its checks know right from wrong, and its prose agrees with the data."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Any

import nbformat
import pytest

from robotbrain.grading import Verdict, load_suite
from robotbrain.grading.suites import lesson_02
from robotbrain.jetson.catalogue import list_modules, load_module
from robotbrain.jetson.software import load_headlines, load_jetpacks, newest_jetpack
from robotbrain.jetson.twin import Prediction, compare
from robotbrain.jetson.twin.data import load_kernel_lists
from tests import lessons
from tests.lessons import hints


@pytest.fixture(scope="module")
def lesson(repo: Path) -> Any:
    return nbformat.read(repo / "course" / TestLesson.notebook, as_version=4)


CLAIMS = """
gap, small_gap = large[0].latency_ms / large[-1].latency_ms, small[0].latency_ms / small[-1].latency_ms
assert gap > 3 * small_gap  # the field closes up
assert parts(small[-1])[0] < 0.1 * small[-1].latency_ms  # work on kernels hardly shows
assert {k.bound for k in resnet.kernels} >= {"launch", "memory"}
assert resnet.fits and all(k.kernel.intensity(2) < peak / bandwidth for k in slowest)  # left of the ridge
assert spread > 1.8
misses = [p.latency_high_ms < r.latency_ms for p, r, ok in zip(said, outside, inside) if not ok]
assert len(said) == 10 and len(misses) >= 3 and all(misses)  # wherever it is wrong, it is too fast
energy = {(p.device, p.mode): p.energy_mj for p in candidates}
for device, slow in (("orin-nano-8gb", "7W"), ("orin-nano-8gb-super", "15W"), ("agx-orin-64gb", "MODE_15W")):
    assert energy[device, slow] == max(e for (d, _), e in energy.items() if d == device)  # thrifty modes cost most
best = min(candidates, key=lambda p: p.energy_mj)
large = next(p for p in candidates if (p.device, p.mode) == ("agx-orin-64gb", "MAXN"))
assert large.energy_mj < 1.15 * best.energy_mj  # level for an image
assert average_w(large) > min(map(average_w, candidates)) + 1  # and dearer by the hour
assert traces["fan"].throttled_s == 0 and traces["passive"].throttled_s > 300
assert not traces["passive"].shut_down
"""


# ---------------------------------------------------------------- the notebook


class TestLesson(lessons.LessonTests):
    notebook = "02_jetson_platforms.ipynb"
    exercises = "123456"
    figures = 6
    tables = 8
    claims = CLAIMS

    def test_the_two_plots_of_the_twin_are_drawn(self, executed: Any) -> None:
        page = "\n".join(lessons.outputs(executed, "text/html"))
        assert [tag for tag, _ in lessons.Tags(page).found].count("svg") == 2


# ---------------------------------------------------------------- prose against the catalogue


def test_numbers_in_the_prose_agree_with_the_catalogue(lesson: Any) -> None:
    text = {cell.id: cell.source for cell in lesson.cells}
    nano, xavier, agx = (headline.module for headline in load_headlines())
    orin = load_module("orin-nano-8gb")
    ridge = orin.peak_flops("fp16", "15W") / orin.bandwidth("15W")
    macs, elems = 56 * 56 * 64 * 9 * 64, 2 * 56 * 56 * 64 + 9 * 64 * 64
    compute, memory = 2 * macs / orin.peak_flops("fp16", "15W"), 2 * elems / orin.bandwidth("15W")
    claims = {
        "headlines-factor": [
            f"{agx.fp32_tflops / nano.fp32_tflops:.0f} in FP32",
            f"{agx.fp16_tflops / nano.fp16_tflops:.0f} in FP16",
            f"{275e12 / 472e9:.0f} only on the boxes",
            f"{nano.bandwidth_gbs:g} against {agx.bandwidth_gbs:g}",
            f"a factor of {agx.bandwidth_gbs / nano.bandwidth_gbs:g}",
        ],
        "peak-by-hand": [
            f"{orin.cuda_cores} CUDA cores in {orin.sm_count} SMs, and {orin.mode('15W').gpu_mhz:g} MHz",
            f"{orin.fp32_tflops:.2f} TFLOPS",
            f"{orin.tensor_cores} tensor cores",
            f"{orin.fp16_tflops:.2f}$ TFLOPS",
            f"{orin.mode('7W').sms_on} of the {orin.sm_count} SMs and {orin.mode('7W').gpu_mhz:g} MHz",
        ],
        "roofline": [
            f"${macs / 1e6:.1f}$ million MACs, $F = {2 * macs / 1e6:.0f}$ MFLOP",
            f"{elems:,} elements".replace(",", " "),
            f"$B = {2 * elems / 1e6:.3f}$ MB",
            f"$I = {2 * macs / (2 * elems):.0f}$",
            f"ridge at {ridge:.0f}",
            f"{1e6 * compute:.1f} µs of arithmetic, beside {1e6 * memory:.1f} µs",
        ],
        "changed": [f"{nano.fp16_tflops:.2f}, {xavier.fp16_tflops:.1f} and {agx.fp16_tflops:.1f} TFLOPS"],
    }
    for cell, expected in claims.items():
        for claim in expected:
            assert claim in text[cell], (cell, claim)
    assert agx.peak_flops("fp16") < agx.peak_flops("fp16", "MAXN") / 4 and agx.default_mode.name == "MODE_30W"
    assert abs(agx.peak_flops("fp16") / orin.peak_flops("fp16", "15W") - 1) < 0.1  # "about that of an Orin Nano"
    assert agx.tf32_tflops is not None and abs(agx.tf32_tflops / agx.fp32_tflops - 4) < 0.01


def test_what_the_prose_says_about_jetpack_agrees_with_the_table() -> None:
    for slug, release in {"nano-4gb": "4.6", "tx2": "4.6", "xavier-nx": "5.1", "agx-xavier-32gb": "5.1"}.items():
        assert newest_jetpack(slug).version.startswith(release)
    last = newest_jetpack("nano-4gb")
    assert (last.ubuntu.text, last.python.text, last.tensorrt.text) == ("18.04", "3.6", "8.2")
    assert all(j.l4t.text.startswith("36.") for j in load_jetpacks() if j.version.startswith("6."))
    without = {slug for slug in list_modules() if not load_module(slug).dla_count}
    assert without == {s for s in list_modules() if s.startswith(("nano", "tx2", "orin-nano", "t4000", "t5000"))}


# ---------------------------------------------------------------- the checks


check = partial(lessons.check, "lesson_02")


def fp32_peak_gflops(module: Any, mode: Any) -> float:
    return float(2e-3 * module.cuda_cores * mode.sms_on / module.sm_count * mode.gpu_mhz)


def floor_us(macs: int, elems: int, peak: float, bandwidth: float, bytes_per_elem: int = 2) -> float:
    return 1e6 * max(2 * macs / peak, elems * bytes_per_elem / bandwidth)


def cheapest(predictions: list[Any], rate_hz: float) -> Any:
    in_time = [p for p in predictions if p.latency_high_ms <= 1e3 / rate_hz]
    return min(in_time, key=lambda p: p.energy_mj, default=None)


@pytest.fixture(scope="module")
def every() -> list[Prediction]:
    network = load_kernel_lists()[lesson_02.NETWORK]
    return compare(network, precision=lesson_02.PRECISION, harness=lesson_02.HARNESS, modes="all")


@pytest.fixture(scope="module")
def qualified(every: list[Prediction]) -> list[Prediction]:
    """Derived from the exercise's text, not from the checker."""
    return sorted(
        (
            p
            for p in every
            if p.latency_high_ms <= 1000 / 30 and p.power_w <= 5 and float(p.module.jetpacks[-1][0]) >= 6 and p.fits
        ),
        key=lambda p: p.energy_mj,
    )


def test_right_answers_pass(qualified: list[Prediction]) -> None:
    orin = load_module("orin-nano-8gb")
    assert check("headline", dense_gpu_tops=85).full
    assert check("headline", dense_gpu_tops=85.23).full  # from the catalogue
    assert check("peak", fp32_peak_gflops=fp32_peak_gflops).full
    assert check("ridge", ridge_7w=round(orin.peak_flops("fp16", "7W") / orin.bandwidth("7W"))).full
    assert check("floor", floor_us=floor_us).full
    assert check("memory", weights_gib=5.59).full
    assert check("cheapest", cheapest=cheapest).full
    best = qualified[0]
    assert check("choice", choice={"device": best.device, "mode": best.mode}).full


RIDGE = load_module("orin-nano-8gb").peak_flops("fp16", "7W") / load_module("orin-nano-8gb").bandwidth("7W")


@pytest.mark.parametrize(
    ("exercise", "name", "value", "hint"),
    [
        ("headline", "dense_gpu_tops", 275, "sparse-counts-zeros"),
        ("headline", "dense_gpu_tops", 170, "sparse-counts-zeros"),
        ("headline", "dense_gpu_tops", 137.5, "gpu-without-dla"),
        ("headline", "dense_gpu_tops", 42.6, "sparse-counts-zeros"),
        ("ridge", "ridge_7w", RIDGE / 1000, "ridge-units"),
        ("ridge", "ridge_7w", 1 / RIDGE, "ridge-units"),
        ("ridge", "ridge_7w", RIDGE / 2, "two-flop-per-mac"),
        ("ridge", "ridge_7w", 151, "ridge-in-this-mode"),
        ("memory", "weights_gib", 6, "gib-is-not-gb"),
        ("memory", "weights_gib", 5.72, "gib-is-not-gb"),
        ("memory", "weights_gib", 5.86, "gib-is-not-gb"),
        ("memory", "weights_gib", 11.18, "two-bytes-each"),
    ],
)
def test_wrong_numbers_get_their_hint(exercise: str, name: str, value: float, hint: str) -> None:
    report = check(exercise, **{name: value})
    assert report.earned == 0 and hints(report) == {hint}
    assert report.results[0].misconception


def _peak(factor: float = 2e-3, gate: bool = True, mode_clock: bool = True) -> Any:
    def answer(module: Any, mode: Any) -> float:
        share = mode.sms_on / module.sm_count if gate else 1
        return float(factor * module.cuda_cores * share * (mode.gpu_mhz if mode_clock else module.gpu_max_mhz))

    return answer


def _floor(flop: float = 2, size: bool = True, join: Any = max, scale: float = 1e6) -> Any:
    def answer(macs: int, elems: int, peak: float, bandwidth: float, bytes_per_elem: int = 2) -> float:
        return float(scale * join((flop * macs / peak, elems * (bytes_per_elem if size else 1) / bandwidth)))

    return answer


def _cheapest(
    latency: str = "latency_high_ms", goal: str = "energy_mj", period: float = 1e3, default: str = "none"
) -> Any:
    def answer(predictions: list[Any], rate_hz: float) -> Any:
        in_time = [p for p in predictions if getattr(p, latency) <= period / rate_hz]
        return min(in_time, key=lambda p: getattr(p, goal), default=None if default == "none" else predictions[0])

    return answer


@pytest.mark.parametrize(
    ("exercise", "answer", "hint"),
    [
        ("peak", _peak(factor=1e-3), "two-flop-per-mac"),
        ("peak", _peak(gate=False), "sms-that-are-on"),
        ("peak", _peak(mode_clock=False), "clock-of-the-mode"),
        ("peak", _peak(factor=2), "mega-and-giga"),
        ("peak", _peak(factor=2e-6), "mega-and-giga"),
        ("floor", _floor(flop=1), "two-flop-per-mac"),
        ("floor", _floor(size=False), "bytes-not-elements"),
        ("floor", _floor(join=sum), "longer-of-the-two"),
        ("floor", _floor(join=min), "longer-of-the-two"),
        ("floor", _floor(scale=1e3), "microseconds"),
        ("floor", _floor(scale=1), "microseconds"),
        ("cheapest", _cheapest(latency="latency_ms"), "upper-end"),
        ("cheapest", _cheapest(latency="latency_low_ms"), "upper-end"),
        ("cheapest", _cheapest(goal="power_w"), "energy-not-power"),
        ("cheapest", _cheapest(goal="latency_ms"), "energy-not-power"),
        ("cheapest", _cheapest(period=1), "period-in-ms"),
        ("cheapest", _cheapest(period=1e6), "period-in-ms"),
        ("cheapest", _cheapest(default="first"), "nothing-fits"),
    ],
)
def test_wrong_functions_get_their_hint(exercise: str, answer: Any, hint: str) -> None:
    name = load_suite("lesson_02").exercises[exercise].provides[0]
    report = check(exercise, **{name: answer})
    assert not report.full and hint in hints(report)


@pytest.mark.parametrize("value", [None, "85", [85], math.nan, True, print, {"device": 1, "mode": 2}])
def test_nonsense_gets_an_answer_and_no_points(value: Any) -> None:
    for exercise, entry in load_suite("lesson_02").exercises.items():
        name = "choice" if exercise == "choice" else entry.provides[0]
        report = check(exercise, **{name: value})
        assert report.earned == 0 and repr(report)
        assert all(r.verdict in (Verdict.FAILED, Verdict.ERROR) for r in report.results)


def test_open_answers_are_no_mistakes() -> None:
    def todo(*_: Any) -> None:
        raise NotImplementedError()

    functions = {"peak", "floor", "cheapest"}
    for exercise, entry in load_suite("lesson_02").exercises.items():
        value = {"device": ..., "mode": ...} if exercise == "choice" else todo if exercise in functions else ...
        name = "choice" if exercise == "choice" else entry.provides[0]
        report = check(exercise, **{name: value})
        assert all(r.verdict is Verdict.NOT_WRITTEN for r in report.results) and not hints(report)


def test_the_choice_is_refused_for_the_requirement_it_misses(qualified: list[Prediction]) -> None:
    reasons = {
        ("nano-4gb", "MAXN"): ["may take", "newest JetPack is 4.6"],
        ("xavier-nx", "MODE_10W_4CORE"): ["newest JetPack is 5.1"],
        ("agx-orin-64gb", "MAXN"): ["the budget is 5 W"],
    }
    for (device, mode), words in reasons.items():
        report = check("choice", choice={"device": device, "mode": mode})
        assert report.earned == 0 and all(word in report.results[0].message for word in words)
    worst = qualified[-1]
    report = check("choice", choice={"device": worst.device, "mode": worst.mode})
    assert report.results[0].passed and not report.results[1].passed
    unknown = check("choice", choice={"device": "orin-nano", "mode": "15W"})
    assert "orin-nano-8gb" in repr(unknown)  # the catalogue's own suggestion comes through


def test_the_exercises_have_an_answer_worth_looking_for(every: list[Prediction], qualified: list[Prediction]) -> None:
    """Least energy must not be what a guess by power or speed would give, else exercise 6 teaches nothing."""
    assert 2 <= len(qualified) < len(every)
    assert len({p.device for p in qualified}) >= 2
    assert min(every, key=lambda p: p.energy_mj).device != qualified[0].device
    assert min(qualified, key=lambda p: p.power_w).energy_mj > 1.05 * qualified[0].energy_mj


def test_every_hint_is_of_use() -> None:
    suite = load_suite("lesson_02")
    source = Path(lesson_02.__file__).read_text(encoding="utf-8")
    for key in suite.hints:
        assert source.count(f'"{key}"') >= 2, f"{key} is registered and never given"
