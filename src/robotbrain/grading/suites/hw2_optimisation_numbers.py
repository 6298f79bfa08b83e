"""How `hw2_optimisation` tests reading, quantisation and calibration.

Each ``compare_...`` function puts a question to the student's function, compares with an oracle, and, where the answer
is wrong, looks whether a typical mistake would have given just that answer; then the hint names the mistake.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from robotbrain.grading import expect, expect_close, fail
from robotbrain.grading.suites import hw2_optimisation_probes as probes
from robotbrain.grading.suites import hw2_optimisation_tools as tools
from robotbrain.grading.suites.hw2_optimisation_probes import Array

VERDICTS = {"a": "breaks", "b": "fine", "c": "wastes", "d": "breaks", "e": "fine"}
"""Of the first five of the ten observations about the listing; the others are in the hidden tests.
tests/test_hw2_optimisation.py tries out those that can be tried."""

VERDICT_HINTS = {
    "a": "zeros-can-move",
    "b": "biases-are-few",
    "c": "who-is-optimised",
    "d": "teacher-in-eval",
    "e": "same-slope",
    "f": "classes-on-axis-1",
    "g": "prepare-in-train-mode",
    "h": "nothing-was-observed",
    "i": "zeros-cost-the-same",
    "j": "kernels-of-a-cpu",
}

HINTS = {
    "zeros-can-move": "`prune.remove` makes the zeros ordinary weights again. Who keeps an optimiser's hands off them?",
    "biases-are-few": "A bias is one number for a whole channel. How much would be saved, and how much lost?",
    "who-is-optimised": "Which parameters does the optimiser hold? Gradients that reach others are never used.",
    "same-slope": "Cross entropy with soft targets and KL divergence differ by the teacher's entropy, which does not "
    "depend on the student.",
    "classes-on-axis-1": "Logits are (N, classes, H, W): the classes lie on axis 1.",
    "prepare-in-train-mode": "Which mode does `prepare_qat` ask for? Call it once and read the message.",
    "nothing-was-observed": "A scale comes from values that an observer has seen. Which has it seen between "
    "`prepare_qat` and `convert`?",
    "zeros-cost-the-same": "A dense kernel multiplies by a zero as fast, or as slowly, as by any number.",
    "kernels-of-a-cpu": "fbgemm is a library for x86 CPUs. What does TensorRT on a Jetson read?",
    "levels-not-steps": "2^bits levels have 2^bits - 1 steps between them: 255 for eight bits. Symmetric, "
    "127 steps lie on either side of 0.",
    "range-holds-zero": "Widen the range until it contains 0 first: zero (padding, ReLU) must be exact.",
    "asymmetric-range": "Symmetric was asked for: the zero point is 0 and the scale is max(|low|, |high|) / 127.",
    "symmetric-range": "Asymmetric was asked for: the range goes from low to high, and the zero point says where 0 is.",
    "zero-point-places-zero": "The zero point is the integer that stands for 0.0: `low` is stood for by 0, and 0.0 "
    "lies -low / scale steps above it.",
    "scale-comes-first": "The answer is (scale, zero_point), in this order.",
    "other-widths": "The number of bits is given: four of them have 15 steps, and symmetric 7.",
    "whole-numbers": "Zero point and quantised values are whole numbers, of an integer type.",
    "some-scale": "A tensor of zeros still needs a scale: any finite number above 0 will do (1.0).",
    "nearest-not-below": "Round to the nearest integer (`np.rint`). Casting to int cuts off, and doubles the error.",
    "clip-to-the-range": "What does not fit is clipped to [qmin, qmax].",
    "wrapped-around": "300 in a uint8 is 44: clip first, and only then change the type.",
    "clip-after-the-shift": "Add the zero point before you clip: the limits are those of the stored integer.",
    "zero-point-ignored": "Where is the zero point? 0.0 is stored as zero_point, and zero_point stands for 0.0.",
    "divide-by-the-scale": "An integer counts steps of size `scale`: x / scale on the way in, times scale on the way "
    "out.",
    "subtract-before-scaling": "real = scale * (q - zero_point): subtract first, then scale.",
    "uint8-cannot-be-negative": "In uint8, 3 - 5 is 254: change the type before you subtract.",
    "floats-come-back": "dequantise returns real numbers, float32.",
    "leave-the-input": "`x /= scale` changes the caller's array: make a new one, `x / scale`.",
    "half-a-step": "Rounding to the nearest level is off by half a step at most.",
    "one-scale-each": "Per channel means one scale for each output channel (axis 0), from that channel's own weights.",
    "output-channels": "The output channels lie on axis 0 of a weight: one scale for each of them.",
    "one-scale-for-all": "per_channel=False: one scale for the whole tensor.",
    "largest-magnitude": "The largest MAGNITUDE counts: a channel may be all negative.",
    "dead-channel": "A channel of zeros has a largest magnitude of 0. Its scale must not be: use 1.0 there.",
    "one-byte-each": "Nothing is saved before the weights are stored in eight bits: `.astype(np.int8)`, at the end.",
    "symmetric-int8": "Symmetric int8 weights use -127 to 127: 127 is the largest magnitude, and -128 stays unused.",
    "all-batches": "The range is that of ALL values in ALL batches, not of one batch, nor an average of batches.",
    "min-and-max": "Without a percentile the range is (smallest, largest), each as it is.",
    "once-only": "A generator can be walked through once: collect what you need in one pass.",
    "magnitudes": "The percentile is one of |x|, and the range is symmetric: (-t, t).",
    "percent-not-share": "np.percentile takes percent: 99.9, not 0.999.",
    "calibration-split": "Ranges are parameters, too: take them from the images of `splits['calibration']`.",
    "not-the-test-set": "These are the ranges of the test images. What was tuned on the test set "
    "cannot be tested on it.",
    "calibrate-in-eval": "Calibrate the network that will be deployed: `network.eval()`, so that batch norm uses its "
    "stored statistics.",
    "output-of-the-layer": "The range is of what the layer puts OUT: a forward hook gets (module, inputs, output).",
    "network-input": "The network wants normalised float32 images with the channels first: `scenes.inputs()`.",
    "percentile-too": "`percentile` is given: hand it on to `activation_range`.",
    "take-hooks-off": "Remove the hooks (`handle.remove()`): they would go on to keep every image that ever passes.",
    "leave-as-found": "Leave the network as you found it: its mode, its weights, and its statistics.",
}


# ---------------------------------------------------------------- scale and zero point


def compare_scale(student: Any, low: float, high: float, symmetric: bool, bits: int = 8) -> None:
    """Compare with the closed form; the range as it should be widened must map onto the integers."""
    given = f"low = {low:.4g}, high = {high:.4g}, symmetric={symmetric}, bits={bits}"
    scale, zero = tools.choose_scale(low, high, symmetric, bits)
    answer = student.choose_scale(low, high, symmetric=symmetric, bits=bits)
    try:
        got_scale, got_zero = (float(v) for v in answer)
    except (TypeError, ValueError):
        fail("the answer should be two numbers", got=answer, expected="(scale, zero_point)", given=given)
    if not (math.isfinite(got_scale) and got_scale > 0):
        swapped = math.isclose(got_zero, scale, rel_tol=1e-5) and got_scale == zero
        fail("a scale is a finite number above 0", got=got_scale, given=given,
             hint="scale-comes-first" if swapped else "some-scale")  # fmt: skip
    if low == high == 0:
        expect(got_zero == int(got_zero) and 0 <= got_zero <= 2**bits - 1, "the zero point is not one of the levels",
               got=got_zero, given=given, hint="whole-numbers")  # fmt: skip
        return
    if math.isclose(got_scale, scale, rel_tol=1e-6) and got_zero == zero:
        return
    hint = _scale_mistake((got_scale, got_zero), low, high, symmetric, bits)
    if math.isclose(got_scale, scale, rel_tol=1e-5) and got_zero != round(got_zero):
        hint = "whole-numbers"
    expect_close((got_scale, got_zero), (scale, zero), rtol=1e-5, atol=0.0, given=given, hint=hint,
                 what="(scale, zero_point)")  # fmt: skip


def compare_random_scale(student: Any, rng: np.random.Generator, symmetric: bool, bits: int = 8) -> None:
    """Compare for a range of random ends on both sides of 0."""
    compare_scale(student, -float(rng.uniform(0.1, 4)), float(rng.uniform(0.1, 4)), symmetric, bits)


def _scale_mistake(answer: tuple[float, float], low: float, high: float, symmetric: bool, bits: int) -> str:
    wide_low, wide_high = min(low, 0.0), max(high, 0.0)
    span, top, levels, half = wide_high - wide_low, max(-wide_low, wide_high), 2**bits, 2 ** (bits - 1)
    right = tools.choose_scale(low, high, symmetric, bits)
    other = tools.choose_scale(low, high, not symmetric, bits)
    kind = "asymmetric-range" if symmetric else "symmetric-range"
    mistakes: list[tuple[str, Any]] = [(kind, other), ("scale-comes-first", right[::-1])]
    if bits != 8:
        mistakes.append(("other-widths", tools.choose_scale(low, high, symmetric)))
    if symmetric:
        mistakes += [("levels-not-steps", (top / half, 0)), ("levels-not-steps", (2 * top / (levels - 1), 0)),
                     ("levels-not-steps", (2 * top / levels, 0)), (kind, (span / (levels - 2), 0)),
                     (kind, (span / (levels - 1), 0)), ("largest-magnitude", (abs(high) / (half - 1), 0)),
                     ("largest-magnitude", (abs(low) / (half - 1), 0)), (kind, (right[0], half)),
                     (kind, (right[0], half - 1))]  # fmt: skip
    else:
        for steps in (levels, levels - 2, half):
            mistakes += [("levels-not-steps", (span / steps, zero)) for zero in _near(-wide_low / span * steps)]
        if low > 0 or high < 0:
            narrow = (high - low) / (levels - 1)
            if narrow > 0:
                mistakes += [("range-holds-zero", (narrow, z)) for z in (*_near(-low / narrow), 0, levels - 1)]
        scale = right[0]
        mistakes += [("zero-point-places-zero", (scale, z)) for value in (wide_low / scale, wide_high / scale, 0.0,
                     half, half - 1, -wide_low / scale, -wide_low / scale - half) for z in _near(value)]  # fmt: skip
    return tools.first_match(answer, mistakes, right, rtol=1e-5)


def _near(value: float) -> tuple[float, ...]:
    return value, math.floor(value), math.ceil(value), round(value)


# ---------------------------------------------------------------- quantise, dequantise


def forgive_ties(answer: Array, expected: Array, x: Array, scale: Any) -> Array:
    """Return ``answer``, with ``expected`` where ``x`` lies in the middle of two levels, up to float32's rounding."""
    if answer.shape != expected.shape or answer.dtype.kind not in "iu":
        return answer
    steps = np.asarray(x, dtype=float) / scale
    tie = np.abs(steps - np.floor(steps) - 0.5) < 1e-4
    return np.where(tie & (np.abs(answer.astype(np.int64) - expected) <= 1), expected, answer)


def compare_quantise(student: Any, x: Array, scale: Any, zero_point: int, qmin: int, qmax: int, given: str) -> None:
    """Compare with the nearest level, clipped; in the middle between two levels either will do."""
    expected = tools.quantise(x, scale, zero_point, qmin, qmax)
    held = student.hold(x.copy())
    array = np.asarray(student.quantise(held, scale, zero_point, qmin=qmin, qmax=qmax))
    after = student.fetch(held)
    expect(np.array_equal(after, x), "x was changed", got=after, expected=x, given=given, hint="leave-the-input")
    if array.dtype.kind not in "iu" and array.dtype.kind in "f":
        cut = array.shape == expected.shape and np.array_equal(np.clip(np.rint(array), qmin, qmax), expected)
        fail("quantise should return an array of integers", got=str(array.dtype), expected="an integer type",
             given=given, hint="whole-numbers" if cut or array.shape == expected.shape else "")  # fmt: skip
    array = forgive_ties(array, expected, x, scale)
    if array.dtype.kind in "iu" and np.array_equal(array, expected):
        return
    steps = np.asarray(x, dtype=float) / scale
    near = np.rint(steps)
    shifted = near + zero_point

    def clip(value: Array) -> Array:
        return np.asarray(np.clip(value, qmin, qmax))

    bits = 8
    mistakes: list[tuple[str, Any]] = [
        ("nearest-not-below", clip(np.trunc(steps) + zero_point)),
        ("nearest-not-below", clip(np.trunc(steps + zero_point))),
        ("nearest-not-below", clip(np.floor(steps) + zero_point)),
        ("nearest-not-below", clip(np.ceil(steps) + zero_point)),
        ("nearest-not-below", clip(np.trunc(steps + 0.5) + zero_point)),
        ("zero-point-ignored", clip(near)),
        ("zero-point-ignored", clip(near - zero_point)),
        ("clip-to-the-range", shifted),
        ("clip-to-the-range", np.maximum(shifted, qmin)),
        ("clip-to-the-range", np.minimum(shifted, qmax)),
        ("wrapped-around", np.mod(shifted, 2**bits)),
        ("wrapped-around", np.mod(shifted + 2 ** (bits - 1), 2**bits) - 2 ** (bits - 1)),
        ("wrapped-around", clip(np.mod(shifted, 2**bits))),
        ("clip-after-the-shift", np.clip(near, qmin, qmax) + zero_point),
        ("clip-after-the-shift", np.mod(np.clip(near, qmin, qmax) + zero_point, 2**bits)),
        ("divide-by-the-scale", clip(np.rint(np.asarray(x, dtype=float) * scale) + zero_point)),
    ]
    hint = tools.first_match(array, mistakes, expected, rtol=1e-7)
    expect_close(array, expected, atol=0.0, given=given, hint=hint, what="the quantised array")


def compare_dequantise(student: Any, q: Array, scale: Any, zero_point: int, given: str) -> None:
    """Compare with scale * (q - zero_point)."""
    expected = tools.dequantise(q, scale, zero_point)
    array = np.asarray(student.dequantise(q.copy(), scale, zero_point))
    whole = q.astype(float)
    mistakes: list[tuple[str, Any]] = [
        ("zero-point-ignored", whole * scale),
        ("zero-point-ignored", (whole + zero_point) * scale),
        ("subtract-before-scaling", whole * scale - zero_point),
        ("subtract-before-scaling", whole * scale + zero_point),
        ("uint8-cannot-be-negative", np.mod(whole - zero_point, 256) * scale),
        ("divide-by-the-scale", (whole - zero_point) / scale),
        ("floats-come-back", np.trunc(np.asarray(expected, dtype=float))),
        ("floats-come-back", np.rint(np.asarray(expected, dtype=float))),
    ]
    hint = tools.first_match(array, mistakes, expected)
    if array.dtype.kind in "iu":
        hint = hint or "floats-come-back"
    expect_close(array, expected, rtol=1e-5, atol=1e-7, given=given, hint=hint, what="the dequantised array")


def check_round_trip(student: Any, scale: float, zero_point: int) -> None:
    """All 256 levels survive the way back and forth, and 0.0 is exact."""
    quantise, dequantise = student.quantise, student.dequantise
    levels = np.arange(256, dtype=np.uint8)
    back = np.asarray(quantise(dequantise(levels, scale, zero_point), scale, zero_point, qmin=0, qmax=255))
    hint = "zero-point-ignored"
    if back.shape == levels.shape and back.dtype.kind in "iu":
        apart = back.astype(np.int64) - levels
        hint = "wrapped-around" if not (apart % 256).any() else "nearest-not-below" if abs(apart).max() <= 1 else hint
    expect(np.array_equal(back, levels), "a level does not survive dequantise and quantise",
           given=f"scale = {scale:.4g}, zero_point = {zero_point}, levels 0 to 255", got=back, expected=levels,
           hint=hint)  # fmt: skip
    zero = np.asarray(dequantise(quantise(np.zeros(1), scale, zero_point, qmin=0, qmax=255), scale, zero_point))
    expect(float(zero[0]) == 0.0, "0.0 comes back as another number", got=float(zero[0]), expected=0.0,
           hint="zero-point-ignored")  # fmt: skip


def check_half_a_step(student: Any, rng: np.random.Generator) -> None:
    """Within the range nothing is off by more than half a step; beyond it, the nearest end comes out."""
    quantise, dequantise = student.quantise, student.dequantise
    for _ in range(5):
        low, high = -float(rng.uniform(0.1, 5)), float(rng.uniform(0.1, 5))
        scale, zero = tools.choose_scale(low, high)
        least, most = -zero * scale, (255 - zero) * scale
        x = rng.uniform(1.5 * low, 1.5 * high, 2000).astype(np.float32)
        y = np.asarray(dequantise(quantise(x.copy(), scale, zero, qmin=0, qmax=255), scale, zero), dtype=float)
        worst = float(np.abs(y - np.clip(x, least, most)).max())
        expect(worst <= 0.5001 * scale, "a value in the range is off by more than half a step", hint="half-a-step",
               given=f"2000 values, scale = {scale:.4g}, zero_point = {zero}",
               got=f"{worst / scale:.2f} steps", expected="at most 0.5 steps")  # fmt: skip


# ---------------------------------------------------------------- weights


def compare_weights(student: Any, weight: Array, per_channel: bool, given: str) -> None:
    """Compare scales and integers with symmetric int8."""
    _, scale = tools.quantise_weights(weight, per_channel)
    answer = student.quantise_weights(weight.copy(), per_channel=per_channel)
    if not isinstance(answer, (tuple, list)) or len(answer) != 2:
        fail("the answer should be a pair", got=answer, expected="(q, scale)", given=given)
    got_q, got_scale = np.asarray(answer[0]), np.asarray(answer[1], dtype=float)
    key = "one-scale-each" if per_channel else "one-scale-for-all"
    if not per_channel and got_scale.size == 1:
        got_scale = got_scale.reshape(())
    if got_scale.size != scale.size:
        axis1 = weight.shape[1] if weight.ndim > 1 else 0
        key = "output-channels" if per_channel and got_scale.size == axis1 and got_scale.size > 1 else key
        fail(f"there are {got_scale.size} scales", got=f"shape {got_scale.shape}", expected=f"shape {scale.shape}",
             given=given, hint=key)  # fmt: skip
    if got_scale.shape != scale.shape:
        fail("`q * scale` would not work channel by channel", got=f"shape {got_scale.shape}",
             expected=f"shape {scale.shape}", given=given, hint="output-channels")  # fmt: skip
    if not (np.isfinite(got_scale).all() and (got_scale > 0).all()):
        fail("a scale is a finite number above 0", got=got_scale.ravel(), given=given,
             hint="largest-magnitude" if (got_scale < 0).any() else "dead-channel")  # fmt: skip
    if got_q.dtype.kind not in "iu":
        fail("quantised weights are integers", got=str(got_q.dtype), expected="int8", given=given,
             hint="whole-numbers")  # fmt: skip
    kind = str(got_q.dtype)
    axes = tuple(range(1, weight.ndim)) if per_channel else None
    largest = np.abs(weight).max(axis=axes, keepdims=per_channel)
    alive = largest > 0  # any scale serves a channel of zeros
    shown: list[tuple[str, Any]] = [
        (key, np.broadcast_to(np.abs(weight).max() / 127, scale.shape)),
        ("symmetric-int8", np.broadcast_to(np.abs(weight).max() / 128, scale.shape)),
        ("symmetric-int8", largest / 128),
        ("symmetric-int8", largest / 255),
        ("symmetric-int8", 2 * largest / 255),
        ("largest-magnitude", np.abs(weight.max(axis=axes, keepdims=per_channel)) / 127),
        ("largest-magnitude", np.abs(weight).mean(axis=axes, keepdims=per_channel) / 127),
        ("asymmetric-range", (weight.max(axis=axes, keepdims=per_channel) - weight.min(axis=axes, keepdims=per_channel))
         / 255),
    ]  # fmt: skip
    picked = [(hint, np.asarray(value)[alive]) for hint, value in shown]
    hint = tools.first_match(got_scale[alive], picked, scale[alive])
    expect_close(got_scale[alive], scale[alive], rtol=1e-4, given=given, hint=hint, what="the scale")
    whole = tools.quantise(weight, got_scale, 0, -127, 127)
    near: list[tuple[str, Any]] = [
        ("nearest-not-below", np.trunc(weight / got_scale)),
        ("nearest-not-below", np.floor(weight / got_scale)),
        ("wrapped-around", np.mod(whole, 256)),
    ]
    got_q = forgive_ties(got_q, whole, weight, got_scale)
    expect_close(got_q, whole, atol=0.0, given=given, hint=tools.first_match(got_q, near, whole),
                 what="the quantised weights")  # fmt: skip
    expect(kind == "int8", "quantised weights take one byte each", got=kind, expected="int8", given=given,
           hint="one-byte-each", credit=0.5)  # fmt: skip


def channels_of_all_sizes(rng: np.random.Generator, shape: tuple[int, ...], dead: bool = False) -> Array:
    """Return weights whose channels differ in size by orders of magnitude; the last is all negative."""
    sizes = np.logspace(-2, 0, shape[0]).reshape(-1, *(1,) * (len(shape) - 1))
    weight = (rng.normal(0, 1, shape) * sizes).astype(np.float32)
    weight[-1] = -np.abs(weight[-1])
    if dead:
        weight[1] = 0.0
    return weight


# ---------------------------------------------------------------- calibration


def compare_range(student: Any, batches: Sequence[Array], percentile: float | None, given: str) -> None:
    """Compare with the range of all values; a percentile between two neighbouring values may be either of them."""
    low, high = tools.activation_range(batches, percentile)
    found = student.run(probes.walked, batches, percentile)
    if "again" in found:
        fail(f"no answer: {found['again']}", given=given, expected="(low, high)", hint="once-only")
    answer = found["answer"]
    try:
        got = tuple(float(v) for v in answer)
    except (TypeError, ValueError):
        fail("the answer should be two numbers", got=answer, expected="(low, high)", given=given)
    expect(len(got) == 2, "the answer should be two numbers", got=got, expected="(low, high)", given=given)
    everything = np.concatenate([np.ravel(b) for b in batches])
    if percentile is not None:
        around = [float(np.percentile(np.abs(everything), percentile, method=m)) for m in ("lower", "higher")]
        slack = 1e-6 * around[1]
        if around[0] - slack <= got[1] <= around[1] + slack and math.isclose(got[0], -got[1], rel_tol=1e-6):
            return
    hint = tools.first_match(got, lambda: _range_mistakes(batches, everything, percentile), (low, high))
    expect_close(got, (low, high), rtol=1e-5, given=given, hint=hint, what="(low, high)")


def _range_mistakes(batches: Sequence[Array], every: Array, percentile: float | None) -> list[tuple[str, Any]]:
    ends = [(float(b.min()), float(b.max())) for b in batches]
    mistakes: list[tuple[str, Any]] = []
    if percentile is None:
        top = float(np.abs(every).max())
        mistakes += [("all-batches", ends[0]), ("all-batches", ends[-1]), ("all-batches", np.mean(ends, axis=0)),
                     ("min-and-max", (-top, top)), ("min-and-max", (0.0, float(every.max()))),
                     ("min-and-max", (min(0.0, float(every.min())), max(0.0, float(every.max()))))]  # fmt: skip
        return mistakes
    cut = [float(np.percentile(np.abs(b), percentile)) for b in batches]
    for top in (float(np.mean(cut)), max(cut), float(np.median(cut)), cut[0], cut[-1]):
        mistakes.append(("all-batches", (-top, top)))
    signed, mirrored = np.percentile(every, percentile), np.percentile(every, 100 - percentile)
    for pair in ((-signed, signed), (mirrored, signed), (every.min(), signed), (-abs(mirrored), abs(mirrored))):
        mistakes.append(("magnitudes", pair))
    share = float(np.percentile(np.abs(every), percentile / 100))
    top = float(np.percentile(np.abs(every), percentile))
    mistakes += [("percent-not-share", (-share, share)), ("magnitudes", (0.0, top)),
                 ("magnitudes", (float(every.min()), top))]  # fmt: skip
    return mistakes


def compare_calibration(
    student: Any, rng: np.random.Generator, percentile: float | None = None, training: bool = False
) -> None:
    """Compare with the ranges of the layers' outputs over the calibration images; the network stays as it was."""
    network = tools.small_network(rng)
    layers = ["0", "2", "4"]
    splits = tools.small_splits(rng)
    before = probes.state_of(network)
    values = tools.outputs_of(network, splits["calibration"].inputs(), layers)

    def ranges(scenes: Any, names: Sequence[str] = layers) -> list[tuple[float, float]]:
        found = tools.outputs_of(network, scenes.inputs(), names)
        return [tools.activation_range(found[name], percentile) for name in names]

    def mistakes() -> tools.Mistakes:
        inside = [tools.activation_range([splits["calibration"].inputs()], percentile),
                  *ranges(splits["calibration"], ["1", "3"])]  # fmt: skip
        all_values = [tools.activation_range(values[name]) for name in layers]
        return [
            ("output-of-the-layer", inside),
            *_calibration_mistakes(splits, ranges),
            *_batch_mistakes([np.concatenate(values[name]) for name in layers], percentile),
            *([] if percentile is None else [("percentile-too", all_values)]),
        ]

    expected = [tools.activation_range(values[name], percentile) for name in layers]
    found = student.run(probes.calibrated, before, training, splits, layers, percentile)
    answer = found["answer"]
    given = f"a small network, layers {layers}, {len(splits['calibration'])} images for calibration"
    if not isinstance(answer, Mapping) or set(answer) != set(layers):
        fail("the answer should be a dict with an entry for each layer", got=answer, given=given,
             expected='{"0": (low, high), ...}')  # fmt: skip
    try:
        got = np.array([[float(v) for v in answer[name]] for name in layers])
    except (TypeError, ValueError):
        fail("each entry should be a pair of numbers", got=answer, expected="(low, high)", given=given)
    tools.expect_untouched(before, found["state"], "the network", "calibrate-in-eval")
    if percentile is not None:  # between two neighbouring values, either of them will do
        low, high = (np.abs([tools.activation_range(values[name], percentile, method) for name in layers])
                     for method in ("lower", "higher"))  # fmt: skip
        near = got.shape == low.shape and (np.abs(got) >= low) & (np.abs(got) <= high) & (np.sign(got) == (-1, 1))
        got = np.where(near, expected, got)
    hint = tools.first_match(got, mistakes, expected, rtol=1e-3)
    expect_close(got, expected, rtol=1e-3, atol=1e-5, given=given, hint=hint, what="the table of ranges")
    expect(found["hooks"] == 0, "hooks are still on the network", got=found["hooks"], expected=0,
           hint="take-hooks-off")  # fmt: skip
    tools.expect_mode(found["training"], network, training, given, "leave-as-found")


def _batch_mistakes(values: Sequence[Array], percentile: float | None) -> list[tuple[str, Any]]:
    """Return what comes out where only the first or the last batch counts, or the mean of their ranges."""
    mistakes: list[tuple[str, Any]] = []
    for size in (1, 4, 8, 10, 16, 20, 25, 32, 50, 64):
        each = np.array([[tools.activation_range([v[k : k + size]], percentile) for k in range(0, len(v), size)]
                         for v in values])  # fmt: skip
        mistakes += [("all-batches", each[:, -1]), ("all-batches", each[:, 0]), ("all-batches", each.mean(axis=1))]
    return mistakes


def _calibration_mistakes(splits: Mapping[str, Any], ranges: Callable[..., Any]) -> list[tuple[str, Any]]:
    mistakes = [("not-the-test-set", ranges(splits["test"])), ("calibration-split", ranges(splits["train"])),
                ("calibration-split", ranges(splits["validation"]))]  # fmt: skip
    everything = [np.concatenate([s[k] for s in splits.values()]) for k in (0, 1)]
    for parts in (("train", "calibration"), ("calibration", "test"), ("train", "test")):
        both = [np.concatenate([splits[name][k] for name in parts]) for k in (0, 1)]
        key = "not-the-test-set" if "test" in parts else "calibration-split"
        mistakes.append((key, ranges(probes.SmallScenes(both[0], both[1]))))
    mistakes.append(("not-the-test-set", ranges(probes.SmallScenes(everything[0], everything[1]))))
    scenes = splits["calibration"]

    class Raw:
        def inputs(self) -> Array:
            return np.ascontiguousarray(scenes.images.transpose(0, 3, 1, 2).astype(np.float32))

    class Scaled:
        def inputs(self) -> Array:
            return Raw().inputs() / np.float32(255)

    mistakes += [("network-input", ranges(Raw())), ("network-input", ranges(Scaled()))]
    return mistakes
