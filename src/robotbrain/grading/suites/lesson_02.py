"""Checks of the lesson `02_jetson_platforms`. Nothing here is graded: an answer that is still open is no mistake."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

from robotbrain.grading import Suite, expect, expect_close, fail
from robotbrain.jetson.catalogue import list_modules, load_module

suite = Suite("lesson_02")

suite.exercise("headline", title="1 What is left of 275 TOPS", points=1, provides=("dense_gpu_tops",))
suite.exercise("peak", title="2 A peak from cores and clock", points=2, provides=("fp32_peak_gflops",))
suite.exercise("ridge", title="3a The ridge point", points=1, provides=("ridge_7w",))
suite.exercise("floor", title="3b The roofline as a function", points=3, provides=("floor_us",))
suite.exercise("memory", title="4 How much memory do the weights take?", points=1, provides=("weights_gib",))
suite.exercise("cheapest", title="5 In time, at the least energy", points=3, provides=("cheapest",))
suite.exercise("choice", title="6 Choose the module", points=2)

_HINTS = {
    "sparse-counts-zeros": "Sparse TOPS count the zeros that 2:4 sparsity skips. A network that was not pruned for it "
    "gets half.",
    "gpu-without-dla": "The DLAs are other processors beside the GPU: leave their part out.",
    "two-flop-per-mac": "A core does one multiply-accumulate in each clock, and that counts as two operations.",
    "sms-that-are-on": "A mode may switch SMs off: only the share mode.sms_on / module.sm_count of the cores works.",
    "clock-of-the-mode": "The mode caps the clock: use mode.gpu_mhz, not module.gpu_max_mhz.",
    "mega-and-giga": "MHz times cores is millions per second; a GFLOP is 1000 millions.",
    "ridge-units": "Divide FLOP/s by bytes/s: with TFLOP/s and GB/s there is a factor of 1000 between them.",
    "ridge-in-this-mode": "The mode matters: take the peak that 7W leaves.",
    "bytes-not-elements": "Memory moves bytes: multiply the elements by bytes_per_elem.",
    "longer-of-the-two": "Arithmetic and traffic overlap: the longer of the two decides, so take the maximum.",
    "microseconds": "FLOP over FLOP/s is seconds; a second has a million microseconds.",
    "two-bytes-each": "In FP16 a parameter takes 2 bytes.",
    "gib-is-not-gb": "A GB is 10^9 bytes, a GiB 2^30 bytes, which is 7 % more.",
    "upper-end": "Half of the risk lies above the predicted latency: compare the upper end, latency_high_ms.",
    "period-in-ms": "At rate_hz images a second the period is 1000 / rate_hz milliseconds.",
    "energy-not-power": "Energy is power times time: a mode that draws more but is done sooner may need less.",
    "nothing-fits": "If no prediction is in time, return None.",
}
for _key, _text in _HINTS.items():
    suite.hint(_key, _text)


def _number(student: Any, name: str, unit: str) -> float:
    """Return the student's number; an ellipsis is an answer not yet given."""
    value = student[name]
    if value is ...:
        raise NotImplementedError(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        fail(f"`{name}` should be a plain number, in {unit}", got=value)
    return float(value)


def _judge(got: float, right: float, unit: str, wrong: Sequence[tuple[float, str, str]], within: float = 0.01) -> None:
    """Compare a number with the right one, then with those that known mistakes lead to: (number, mistake, hint)."""
    if abs(got - right) <= within * right:
        return
    for value, mistake, hint in wrong:
        if abs(got - value) <= within * abs(value):
            fail(f"{got:g} {unit} is not right", got=f"{got:g} {unit}", misconception=mistake, hint=hint)
    fail(f"{got:g} {unit} is not right", got=f"{got:g} {unit}")


# ---------------------------------------------------------------- 1


@suite.test("headline", points=1, name="dense INT8 on the GPU alone", reread="What the numbers on the box count")
def _headline(student: Any) -> None:
    got = _number(student, "dense_gpu_tops", "TOPS")
    wrong = [
        (275, "this is the advertised number itself", "sparse-counts-zeros"),
        (137.5, "sparsity is out, the DLAs are still in", "gpu-without-dla"),
        (170, "the DLAs are out, sparsity is still in", "sparse-counts-zeros"),
        (105, "this is what the DLAs do", "gpu-without-dla"),
        (52.5, "this is what the DLAs do without sparsity", "gpu-without-dla"),
        (42.5, "halved twice: this is about the FP16 rate", "sparse-counts-zeros"),
        (340, "sparsity doubles the number; leaving it out halves it", "sparse-counts-zeros"),
    ]
    _judge(got, 85, "TOPS", wrong)


# ---------------------------------------------------------------- 2

_PEAK_CASES = (("nano-4gb", "5W"), ("orin-nano-8gb", "7W"), ("agx-orin-64gb", "MODE_30W"), ("xavier-nx", "10W"))


def _peak_mistakes(module: Any, mode: Any) -> list[tuple[float, str, str]]:
    right = 2e-3 * module.cuda_cores * mode.sms_on / module.sm_count * mode.gpu_mhz
    return [
        (right / 2, "a multiply-accumulate was counted as one operation", "two-flop-per-mac"),
        (right * module.sm_count / mode.sms_on, "SMs that are off were counted", "sms-that-are-on"),
        (right * module.gpu_max_mhz / mode.gpu_mhz, "the highest clock was taken", "clock-of-the-mode"),
        (
            right * module.gpu_max_mhz / mode.gpu_mhz * module.sm_count / mode.sms_on,
            "this is the module's peak in its fastest mode",
            "clock-of-the-mode",
        ),
        (right * 1e3, "this is in MFLOP/s", "mega-and-giga"),
        (right / 1e3, "this is in TFLOP/s", "mega-and-giga"),
        (right * 1e9, "this is in FLOP/s", "mega-and-giga"),
    ]


def _check_peak(student: Any, module: Any, mode: Any, right: float) -> None:
    got = student.fp32_peak_gflops(module, mode)
    given = f"{module.name}, {mode.name}"
    if isinstance(got, int | float):
        for value, mistake, hint in _peak_mistakes(module, mode):
            if abs(value - right) > 0.01 * right and abs(got - value) <= 0.005 * value:
                fail("not the peak of this mode", given=given, got=got, misconception=mistake, hint=hint)
    expect_close(got, right, rtol=0.005, given=given, what="the peak in GFLOP/s")


@suite.test("peak", points=1, name="modes of the catalogue", reread="A peak by hand")
def _peak_catalogue(student: Any) -> None:
    for slug, name in _PEAK_CASES:
        module = load_module(slug)
        mode = module.mode(name)
        _check_peak(student, module, mode, module.peak_flops("fp32", mode) / 1e9)


@suite.test("peak", points=1, name="a module that nobody sells", reread="A peak by hand")
def _peak_invented(student: Any) -> None:
    module = SimpleNamespace(name="an invented module", cuda_cores=1000, sm_count=10, gpu_max_mhz=2000.0)
    mode = SimpleNamespace(name="half speed, 4 of 10 SMs on", sms_on=4, gpu_mhz=1000.0)
    _check_peak(student, module, mode, 800.0)


# ---------------------------------------------------------------- 3


@suite.test("ridge", points=1, name="Orin Nano 8GB in 7W, FP16", reread="Rooflines from first principles")
def _ridge(student: Any) -> None:
    got = _number(student, "ridge_7w", "FLOP per byte")
    module = load_module("orin-nano-8gb")
    right = module.peak_flops("fp16", "7W") / module.bandwidth("7W")
    wrong = [
        (right / 1e3, "TFLOP/s were divided by GB/s as they stand", "ridge-units"),
        (1 / right, "upside down: this is bytes per FLOP", "ridge-units"),
        (1e3 / right, "upside down, and TFLOP/s beside GB/s", "ridge-units"),
        (right / 2, "multiply-accumulates were counted instead of FLOP", "two-flop-per-mac"),
        (right / 8, "bits were taken for bytes", "ridge-units"),
        (
            module.peak_flops("fp16", "15W") / module.bandwidth("15W"),
            "this is the ridge of the mode 15W",
            "ridge-in-this-mode",
        ),
        (module.peak_flops("fp32", "7W") / module.bandwidth("7W"), "this is for FP32", "ridge-in-this-mode"),
    ]
    _judge(got, right, "FLOP/byte", wrong, within=0.02)


def _check_floor(student: Any, macs: int, elems: int, peak: float, bandwidth: float, size: int) -> None:
    got = student.floor_us(macs, elems, peak, bandwidth, size)
    compute, memory = 2 * macs / peak, elems * size / bandwidth
    right = 1e6 * max(compute, memory)
    wrong = [
        (1e6 * max(compute / 2, memory), "multiply-accumulates were not doubled", "two-flop-per-mac"),
        (1e6 * max(compute, memory / size), "elements were taken for bytes", "bytes-not-elements"),
        (1e6 * max(compute / 2, memory / size), "neither FLOP nor bytes yet", "two-flop-per-mac"),
        (1e6 * (compute + memory), "the two times were added", "longer-of-the-two"),
        (1e6 * min(compute, memory), "the shorter of the two was taken", "longer-of-the-two"),
        (1e6 * memory * 2, "the default of 2 bytes was doubled again", "bytes-not-elements"),
        (right / 1e3, "this is in milliseconds", "microseconds"),
        (right / 1e6, "this is in seconds", "microseconds"),
    ]
    given = f"{macs} MACs, {elems} elements of {size} bytes, {peak:g} FLOP/s, {bandwidth:g} bytes/s"
    if isinstance(got, int | float):
        for value, mistake, hint in wrong:
            if abs(value - right) > 0.01 * right and abs(got - value) <= 0.005 * value:
                fail("not the roofline's time", given=given, got=got, misconception=mistake, hint=hint)
    expect_close(got, right, rtol=0.005, given=given, what="the time in µs")


@suite.test("floor", points=1, name="a kernel that arithmetic bounds", reread="Rooflines from first principles")
def _floor_compute(student: Any) -> None:
    _check_floor(student, 115_605_504, 438_272, 10e12, 68e9, 2)


@suite.test("floor", points=1, name="a kernel that memory bounds", reread="Rooflines from first principles")
def _floor_memory(student: Any) -> None:
    _check_floor(student, 1_806_336, 401_984, 10e12, 68e9, 2)


@suite.test("floor", points=1, name="other sizes of an element", reread="Rooflines from first principles")
def _floor_precision(student: Any) -> None:
    for size in (1, 4):
        _check_floor(student, 1_806_336, 401_984, 10e12, 68e9, size)
        _check_floor(student, 115_605_504, 438_272, 5e12, 204e9, size)


# ---------------------------------------------------------------- 4


@suite.test("memory", points=1, name="three billion parameters in FP16", reread="One memory for everything")
def _memory(student: Any) -> None:
    got = _number(student, "weights_gib", "GiB")
    right = 3e9 * 2 / 2**30
    wrong = [
        (6.0, "this is in GB", "gib-is-not-gb"),
        (2 * right, "this is for 4 bytes each, that is FP32", "two-bytes-each"),
        (12.0, "this is in GB, and for FP32", "two-bytes-each"),
        (right / 2, "this is for 1 byte each, that is INT8", "two-bytes-each"),
        (3.0, "parameters were taken for bytes", "two-bytes-each"),
        (right * 1024, "this is in MiB", "gib-is-not-gb"),
        (6e9, "this is in bytes", "gib-is-not-gb"),
        (right * 8, "this is in gibibits", "gib-is-not-gb"),
        (6e9 / 1e6 / 1024, "1024 once and 1000 twice: a mix of both", "gib-is-not-gb"),
        (6e9 / 1e3 / 1024**2, "1024 twice and 1000 once: a mix of both", "gib-is-not-gb"),
    ]
    _judge(got, right, "GiB", wrong, within=0.005)


# ---------------------------------------------------------------- 5


def _candidate(name: str, latency: float, high: float, power: float) -> Any:
    """Return a stand-in for a prediction."""
    return SimpleNamespace(
        device="orin-nano-8gb",
        mode=name,
        latency_ms=latency,
        latency_low_ms=2 * latency - high,
        latency_high_ms=high,
        power_w=power,
        energy_mj=power * latency,
    )


def _check_cheapest(
    student: Any, candidates: list[Any], rate_hz: float, right: str | None, hints: dict[str, str]
) -> None:
    got = student.cheapest(list(candidates), rate_hz)
    given = f"{rate_hz:g} Hz; " + "; ".join(
        f"{c.mode}: {c.latency_ms:g} ms (to {c.latency_high_ms:g}), {c.energy_mj:g} mJ" for c in candidates
    )
    if right is None:
        expect(got is None, "nothing is in time here", given=given, expected=None, got=got, hint="nothing-fits")
        return
    expect(got is not None, "one of these is in time", given=given, expected=right, got=None, hint="period-in-ms")
    name = getattr(got, "mode", None)
    expect(name is not None, "return one of the predictions you were given", given=given, got=got)
    expect(
        name == right, f"{name} is not the one", given=given, expected=right, got=name, hint=hints.get(str(name), "")
    )


@suite.test("cheapest", points=1, name="least energy, not least power", reread="Energy")
def _cheapest_energy(student: Any) -> None:
    slow, fast = _candidate("slow", 30, 31, 5), _candidate("fast", 10, 11, 9)
    late = _candidate("late", 50, 52, 1)
    for order in ([slow, fast, late], [late, fast, slow]):
        _check_cheapest(student, order, 30, "fast", {"slow": "energy-not-power", "late": "period-in-ms"})
    quick = _candidate("quick", 5, 6, 30)
    _check_cheapest(student, [quick, fast], 30, "fast", {"quick": "energy-not-power"})


@suite.test("cheapest", points=1, name="in time even at the upper end", reread="Energy")
def _cheapest_upper(student: Any) -> None:
    risky, safe = _candidate("risky", 30, 40, 3), _candidate("safe", 20, 25, 9)
    _check_cheapest(student, [risky, safe], 30, "safe", {"risky": "upper-end"})


@suite.test("cheapest", points=1, name="other rates, and none in time", reread="Energy")
def _cheapest_none(student: Any) -> None:
    slow, fast = _candidate("slow", 80, 90, 1), _candidate("fast", 10, 11, 20)
    _check_cheapest(student, [slow, fast], 10, "slow", {"fast": "energy-not-power"})
    _check_cheapest(student, [slow, fast], 60, "fast", {"slow": "period-in-ms"})
    _check_cheapest(student, [slow, fast], 200, None, {})


# ---------------------------------------------------------------- 6

NETWORK, HARNESS, PRECISION, RATE_HZ, BUDGET_W, OLDEST_JETPACK = "yolo11s", "ultralytics", "fp16", 30.0, 5.0, 6
"""What exercise 6 asks for."""


def _recent(module: Any) -> bool:
    return int(module.jetpacks[-1].partition(".")[0]) >= OLDEST_JETPACK


def shortfalls(prediction: Any) -> list[str]:
    """Return the requirements of exercise 6 that a prediction does not meet, in words; empty if it meets all."""
    period = 1e3 / RATE_HZ
    problems = []
    if prediction.latency_high_ms > period:
        problems.append(f"may take {prediction.latency_high_ms:.1f} ms, the period is {period:.1f} ms")
    if prediction.power_w > BUDGET_W:
        problems.append(f"draws {prediction.power_w:.1f} W, the budget is {BUDGET_W:g} W")
    if not _recent(prediction.module):
        problems.append(f"its newest JetPack is {prediction.module.jetpacks[-1]}, at least {OLDEST_JETPACK} is wanted")
    if not prediction.fits:
        problems.append("runs out of memory")
    return problems


def _chosen(student: Any) -> Any:
    from robotbrain.jetson.twin import predict
    from robotbrain.jetson.twin.data import load_kernel_lists

    choice = student["choice"]
    if not (isinstance(choice, dict) and {"device", "mode"} <= choice.keys()):
        fail('`choice` should be a dict with "device" and "mode"', got=choice)
    if choice["device"] is ... or choice["mode"] is ...:
        raise NotImplementedError("choice")
    network = load_kernel_lists()[NETWORK]
    return predict(network, choice["device"], mode=choice["mode"], precision=PRECISION, harness=HARNESS)


@suite.test("choice", points=1, name="meets every requirement", reread="Exercise 6")
def _choice_meets(student: Any) -> None:
    prediction = _chosen(student)
    problems = shortfalls(prediction)
    expect(not problems, f"{prediction.device} in {prediction.mode} " + "; ".join(problems))


@suite.test("choice", points=1, name="least energy of those that do", reread="Exercise 6")
def _choice_best(student: Any) -> None:
    from robotbrain.jetson.twin import compare
    from robotbrain.jetson.twin.data import load_kernel_lists

    prediction = _chosen(student)
    expect(not shortfalls(prediction), "first meet every requirement")
    devices = [slug for slug in list_modules() if _recent(load_module(slug))]  # the others need no prediction
    every = compare(load_kernel_lists()[NETWORK], devices, precision=PRECISION, harness=HARNESS, modes="all")
    least = min((p.energy_mj for p in every if not shortfalls(p)), default=math.inf)
    expect(
        prediction.energy_mj <= least * 1.001,
        f"it needs {prediction.energy_mj:.0f} mJ for an image; another choice needs {least:.0f} mJ",
        hint="energy-not-power",
    )
