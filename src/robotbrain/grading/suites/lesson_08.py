"""Checks of the lesson `08_model_optimisation`. Nothing here is graded: an answer that is still open is no mistake."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robotbrain.grading import Suite, expect, fail
from robotbrain.grading.suites.lesson_tools import answered, equals

suite = Suite("lesson_08")

suite.exercise("hand", title="1 By hand", points=2, provides=("hand",))
suite.exercise("sqnr", title="2 In decibels", points=3, provides=("sqnr_db", "db_per_bit"))
suite.exercise("lost", title="3 Who profits?", points=3, provides=("bits_lost",))
suite.exercise("list", title="4 When does a list of survivors pay?", points=2, provides=("list_bytes", "break_even"))
suite.exercise("gradient", title="5 The gradient itself", points=2, provides=("soft_gradient",))
suite.exercise("choose", title="6 Choose", points=2, provides=("choose",))

_HINTS = {
    "gaps-not-posts": "256 integers have 255 gaps between them: divide the width of the range by 255.",
    "whole-range": "Asymmetric: the scale spreads the whole width, from -0.5 to 2.05, over the gaps.",
    "zero-point-is-an-integer": "The zero point is the integer that stands for 0: so many steps of a scale above -0.5.",
    "add-the-zero-point": "An integer is round(x / scale) plus the zero point.",
    "half-a-scale": "Between two neighbours of the grid the farthest point is halfway: half a scale.",
    "saturates": "What lies beyond the range becomes the last integer, and that comes back as the end of the range.",
    "power-not-amplitude": "Of sums of squares, that is of powers, it is 10 times log10; 20 is for amplitudes.",
    "decimal-logarithm": "Decibels use the logarithm to base 10: np.log10.",
    "signal-over-noise": "Signal over noise: the larger the error, the smaller the ratio.",
    "squares": "Both sums are of squares; plain differences cancel.",
    "no-error-is-infinite": "Without any error the ratio is infinite: return float('inf'), without a division by 0.",
    "half-is-a-quarter": "Half the error is a quarter of its square: 10 times log10(4).",
    "magnitudes": "Of magnitudes: a channel with a weight of -1 reaches as far as one with +1.",
    "output-channels": "Output channels lie on axis 0: one number for each of them, over all other axes.",
    "binary-logarithm": "Bits are counted by the logarithm to base 2: np.log2.",
    "tensor-over-channel": "Largest of the tensor over largest of the channel: 0 or more, never below.",
    "zeros-lose-nothing": "A channel of zeros is met exactly by every scale: 0 bits lost, and no infinity.",
    "survivors-only": "Only weights that are not zero are in the list: the share 1 - sparsity.",
    "index-too": "Each entry of the list is a value and an index.",
    "equate-them": "Set (1 - s) (value + index) equal to value, and solve for s.",
    "times-the-square": "The soft loss has the factor T squared: of the 1/T it leaves T.",
    "student-minus-teacher": "Where the student says more than the teacher, the gradient is positive: q - p.",
    "soften-both": "Both softmaxes are of logits divided by T.",
    "large-logits": "exp(1000) is infinite: subtract the largest logit first, which changes no probability.",
    "fastest-of-these": "Within the budget it is the fastest that is wanted, not the most accurate or smallest.",
    "both-limits": "Drop and size must both be within the budget; exactly at a limit is within.",
    "none-fits": "If nothing is within the budget, return None.",
    "return-the-name": 'Return the row\'s "name", not the row.',
}
for _key, _text in _HINTS.items():
    suite.hint(_key, _text)


# ---------------------------------------------------------------- 1

_HAND: dict[str, tuple[float, str]] = {
    "scale": (0.01, "gaps-not-posts"),
    "zero point": (50.0, "zero-point-is-an-integer"),
    "integer that stands for 1.0": (150.0, "add-the-zero-point"),
    "largest rounding error within the range": (0.005, "half-a-scale"),
    "what 3.0 comes back as": (2.05, "saturates"),
}


@suite.test("hand", points=2, name="the five numbers", reread="Quantisation from first principles")
def _hand(student: Any) -> None:
    answers = student["hand"]
    expect(isinstance(answers, Mapping), "`hand` should still be the dictionary of the cell", got=answers)
    if all(answers.get(line) is ... for line in _HAND):
        raise NotImplementedError("hand")
    for line, (right, hint) in _HAND.items():
        got = answers.get(line)
        if equals(got, right):
            continue
        if line == "scale" and any(equals(got, 2.05 / steps) for steps in (255, 256, 127, 128)):
            hint = "whole-range"
        fail(f'"{line}" is another number', got=got, hint=hint)


# ---------------------------------------------------------------- 2


@suite.test("sqnr", points=1, name="rounded signals", reread="Exercise 2")
def _sqnr(student: Any) -> None:
    rng = student.rng("sqnr")
    cases = [(np.array([3.0, 4.0]), np.array([3.0, 3.0])), (np.array([1.0, -1.0]), np.array([0.5, -0.5]))]
    for size in (7, 200):
        x = rng.normal(0.0, 3.0, size)
        cases.append((x, np.round(x, 1)))
    for x, approximation in cases:
        got = answered(student.sqnr_db(x.copy(), approximation.copy()), "sqnr_db")
        signal, noise = float((x**2).sum()), float(((x - approximation) ** 2).sum())
        right = 10 * math.log10(signal / noise)
        if equals(got, right):
            continue
        hint = "squares"
        if equals(got, 2 * right):
            hint = "power-not-amplitude"
        elif equals(got, right * math.log(10)) or equals(got, right / math.log10(2)):
            hint = "decimal-logarithm"
        elif equals(got, -right):
            hint = "signal-over-noise"
        fail(f"signal {signal:.4g} over noise {noise:.4g} (sums of squares) are {right:.3f} dB", got=got, hint=hint)


@suite.test("sqnr", points=1, name="no error at all", reread="Exercise 2")
def _sqnr_exact(student: Any) -> None:
    x = np.array([1.0, 2.0])
    with np.errstate(all="ignore"):
        got = answered(student.sqnr_db(x, x.copy()), "sqnr_db")
    expect(equals(got, math.inf), "without any error", got=got, hint="no-error-is-infinite")


@suite.test("sqnr", points=1, name="what a bit is worth", reread="What is a bit worth?")
def _sqnr_bit(student: Any) -> None:
    got = answered(student["db_per_bit"], "db_per_bit")
    close = equals(got, got) and abs(got - 20 * math.log10(2)) < 0.011
    expect(close, "the rise when the error is halved, in dB", got=got, hint="half-is-a-quarter")


# ---------------------------------------------------------------- 3


def _right_bits(weight: NDArray[Any]) -> NDArray[Any]:
    largest = np.abs(weight).reshape(len(weight), -1).max(axis=1)
    return np.where(largest > 0, np.log2(largest.max() / np.where(largest > 0, largest, largest.max())), 0.0)


def _bits(student: Any, weight: NDArray[Any]) -> NDArray[Any]:
    with np.errstate(all="ignore"):
        got = answered(student.bits_lost(weight.copy()), "bits_lost")
    try:
        array = np.asarray(got, dtype=float)
    except (TypeError, ValueError):
        fail("`bits_lost` should return an array of numbers", got=got, hint="output-channels")
    expect(
        array.shape == (len(weight),),
        f"for a weight of shape {weight.shape} the array has the shape ({len(weight)},)",
        got=array.shape,
        hint="output-channels",
    )
    return array


@suite.test("lost", points=2, name="weights of convolutions and products", reread="One scale, or one for each channel?")
def _lost(student: Any) -> None:
    rng = student.rng("lost")
    hand = np.array([[4.0, -1.0], [-8.0, 2.0], [0.5, 1.0]])
    for weight in (hand, rng.normal(size=(5, 3, 3, 3)) * rng.uniform(0.05, 2.0, (5, 1, 1, 1)), rng.normal(size=(4, 4))):
        got, right = _bits(student, weight), _right_bits(weight)
        if np.allclose(got, right, atol=1e-5):
            continue
        hint = "magnitudes"
        if np.allclose(got, -right, atol=1e-5):
            hint = "tensor-over-channel"
        elif np.allclose(got, right * math.log(2), atol=1e-5) or np.allclose(got, right * math.log10(2), atol=1e-5):
            hint = "binary-logarithm"
        elif weight.shape[0] == weight.shape[1] and np.allclose(got, _right_bits(weight.T), atol=1e-5):
            hint = "output-channels"
        words = " ".join(f"{value:.3f}" for value in right)
        fail(f"the channels of a weight of shape {weight.shape} lose {words} bits", got=got.round(3), hint=hint)


@suite.test("lost", points=1, name="a channel of zeros", reread="Exercise 3")
def _lost_zero(student: Any) -> None:
    for weight in (np.array([[0.0, 0.0], [2.0, -4.0], [1.0, 1.0]]), np.zeros((2, 3))):
        got = _bits(student, weight)
        if not np.allclose(got, _right_bits(weight), atol=1e-5):
            fail(f"the weights are {weight.tolist()}", got=got.tolist(), hint="zeros-lose-nothing")


# ---------------------------------------------------------------- 4


@suite.test("list", points=1, name="the size of a list", reread="Exercise 4")
def _list(student: Any) -> None:
    for count, sparsity, value, index in ((1000, 0.75, 4, 2), (57_000, 0.5, 1, 2), (64, 0.0, 2, 4), (64, 1.0, 4, 4)):
        got = answered(student.list_bytes(count, sparsity, value, index), "list_bytes")
        right = count * (1 - sparsity) * (value + index)
        if equals(got, right):
            continue
        hint = "index-too" if equals(got, count * (1 - sparsity) * value) else "survivors-only"
        words = f"{count} weights of which {sparsity:.0%} are zero, values of {value} and indices of {index} bytes"
        fail(f"{words}: {right:g} bytes", got=got, hint=hint)


@suite.test("list", points=1, name="where the two are equal", reread="Exercise 4")
def _break_even(student: Any) -> None:
    for value, index in ((4, 2), (1, 2), (2, 2), (4, 0)):
        got = answered(student.break_even(value, index), "break_even")
        right = index / (value + index)
        expect(
            equals(got, right),
            f"values of {value} bytes and indices of {index}: from a sparsity of {right:.4g} on",
            got=got,
            hint="equate-them",
        )


# ---------------------------------------------------------------- 5


def _softmax(z: NDArray[Any]) -> NDArray[Any]:
    e = np.exp(z - z.max())
    return np.asarray(e / e.sum())


def _right_gradient(z: NDArray[Any], v: NDArray[Any], temperature: float) -> NDArray[Any]:
    return np.asarray(temperature * (_softmax(z / temperature) - _softmax(v / temperature)))


def _gradient(student: Any, z: NDArray[Any], v: NDArray[Any], temperature: float) -> NDArray[Any]:
    with np.errstate(all="ignore"):
        got = answered(student.soft_gradient(z.copy(), v.copy(), temperature), "soft_gradient")
    try:
        array = np.asarray(got, dtype=float)
    except (TypeError, ValueError):
        fail("`soft_gradient` should return an array of numbers", got=got)
    expect(array.shape == z.shape, f"one number for each of {len(z)} classes", got=array.shape)
    return array


@suite.test("gradient", points=1, name="gradients of random logits", reread="Distillation")
def _gradients(student: Any) -> None:
    rng = student.rng("gradient")
    for temperature in (1.0, 2.0, 4.0, 10.0):
        z, v = rng.normal(0.0, 3.0, (2, 4))
        got, right = _gradient(student, z, v, temperature), _right_gradient(z, v, temperature)
        if np.allclose(got, right, atol=1e-6):
            continue
        hint = "soften-both"
        if np.allclose(got, -right, atol=1e-6):
            hint = "student-minus-teacher"
        elif any(np.allclose(got, right * temperature**power, atol=1e-6) for power in (-2, -1, 1, 2)):
            hint = "times-the-square"
        words = f"z = {z.round(2)}, v = {v.round(2)}, T = {temperature:g}"
        fail(f"for {words} it is {right.round(4)}", got=got.round(4), hint=hint)


@suite.test("gradient", points=1, name="large logits", reread="Exercise 5, last sentence")
def _gradient_large(student: Any) -> None:
    z, v = np.array([4000.0, 3998.0, 0.0]), np.array([-4000.0, 0.0, 1.0])
    got, right = _gradient(student, z, v, 2.0), _right_gradient(z, v, 2.0)
    expect(
        np.allclose(got, right, atol=1e-6),
        f"for z = {z}, v = {v}, T = 2 it is {right.round(4)}",
        got=got,
        hint="large-logits",
    )


# ---------------------------------------------------------------- 6


def _right_choice(rows: list[dict[str, Any]], most_drop: float, most_kb: float) -> str | None:
    able = [row for row in rows if row["drop"] <= most_drop and row["kB"] <= most_kb]
    return min(able, key=lambda row: row["here"])["name"] if able else None


@suite.test("choose", points=2, name="budgets over made-up tables", reread="All together, and the choice")
def _choose(student: Any) -> None:
    rng = student.rng("choose")
    fixed: list[dict[str, Any]] = [
        {"name": "large", "drop": 0.0, "here": 1.0, "kB": 3600.0},
        {"name": "exact", "drop": 0.5, "here": 0.6, "kB": 900.0},
        {"name": "small", "drop": 2.0, "here": 0.1, "kB": 90.0},
        {"name": "quick", "drop": 1.0, "here": 0.05, "kB": 1200.0},
    ]
    cases = [(fixed, 1.0, 1000.0), (fixed, 0.5, 900.0), (fixed, 2.0, 1200.0), (fixed, 3.0, 100.0), (fixed, -1.0, 1e4)]
    for _ in range(6):
        drops, times, sizes = rng.uniform(0, 3, 6), rng.uniform(0.05, 1, 6), rng.uniform(50, 4000, 6)
        made: list[dict[str, Any]] = [
            {"name": f"network {k}", "drop": float(d), "here": float(t), "kB": float(s)}
            for k, (d, t, s) in enumerate(zip(drops, times, sizes, strict=True))
        ]
        cases.append((made, float(rng.uniform(0.3, 3)), float(rng.uniform(300, 4000))))
    for rows, most_drop, most_kb in cases:
        got = answered(student.choose([dict(row) for row in rows], most_drop, most_kb), "choose")
        right = _right_choice(rows, most_drop, most_kb)
        if isinstance(got, str | None) and got == right:
            continue
        hint = "return-the-name"
        by_name = {row["name"]: row for row in rows}
        if right is None:
            hint = "none-fits"
        elif got is None or (isinstance(got, str) and got in by_name):
            chosen = by_name.get(got) if got else None
            within = chosen is not None and chosen["drop"] <= most_drop and chosen["kB"] <= most_kb
            hint = "fastest-of-these" if within else "both-limits"
        fail(f"at most {most_drop:g} points lost and {most_kb:g} kB: {right!r}", got=got, hint=hint)
