"""Affine quantisation from first principles: a real number as ``scale * (integer - zero_point)``.

A range [low, high] is spread over the integers of a given width. Two numbers describe the map: the *scale*, the real
distance between neighbouring integers, and the *zero point*, the integer that stands for 0.0. Zero is always exactly
representable, because padding, ReLU and pruned weights produce it all the time and an error there would be systematic.

*Symmetric* quantisation sets the zero point to 0 (signed) so that a product of two quantised numbers needs no
correction terms; TensorRT takes nothing else
(https://docs.nvidia.com/deeplearning/tensorrt/latest/inference-library/work-quantized-types.html). *Asymmetric*
quantisation wastes no integers on a range such as ReLU's [0, high]. *Per channel* means one scale for each index along
an axis, usually the output channels of a weight.

Rounding is to the nearest integer, ties to even, then saturation, as ONNX defines QuantizeLinear
(https://onnx.ai/onnx/operators/onnx__QuantizeLinear.html); see Jacob et al., "Quantization and Training of Neural
Networks for Efficient Integer-Arithmetic-Only Inference", 2018 (https://arxiv.org/abs/1712.05877).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robotbrain.errors import InputError

_SMALLEST_SCALE = float(np.finfo(np.float32).tiny)
"""Below this, float32 loses digits and divisions overflow."""


@dataclass(frozen=True, eq=False)
class QParams:
    """How real numbers become integers and back.

    Attributes:
        scale: float32, > 0: () for a whole tensor, or (C,) per channel. Real distance between two integers.
        zero_point: int32, shape of ``scale``, within [qmin, qmax]: the integer that stands for 0.0.
        qmin, qmax: smallest and largest integer that is used.
        axis: of the channels; None for a whole tensor.

    Raises:
        InputError: for scales that are not positive and finite, zero points out of range, or shapes that disagree.
    """

    scale: NDArray[np.float32]
    zero_point: NDArray[np.int32]
    qmin: int
    qmax: int
    axis: int | None = None

    def __post_init__(self) -> None:
        scale = np.array(self.scale, dtype=np.float32)
        zero_point = np.array(np.broadcast_to(self.zero_point, scale.shape), dtype=np.int32)
        if not (np.isfinite(scale).all() and (scale > 0).all()):
            raise InputError(
                "scale", given=self.scale, expected="finite numbers above 0", fix="Get it from choose_qparams."
            )
        if scale.ndim != (self.axis is not None):
            raise InputError(
                "axis",
                given=f"axis {self.axis} with a scale of shape {scale.shape}",
                expected="None with a single scale, or an axis with one scale per channel",
                fix="Per channel, pass the axis that the ranges were taken along.",
            )
        if self.qmin >= self.qmax or (zero_point < self.qmin).any() or (zero_point > self.qmax).any():
            raise InputError(
                "zero_point",
                given=self.zero_point,
                expected=f"integers from {self.qmin} to {self.qmax}",
                fix="0.0 must have an integer of its own: extend the range so that it contains zero.",
            )
        object.__setattr__(self, "scale", scale)
        object.__setattr__(self, "zero_point", zero_point)

    @property
    def dtype(self) -> np.dtype[np.integer]:
        """Smallest integer type that holds the quantised values."""
        kinds = (np.uint8, np.uint16) if self.qmin >= 0 else (np.int8, np.int16, np.int32)
        return next(
            np.dtype(kind) for kind in kinds if np.iinfo(kind).min <= self.qmin and self.qmax <= np.iinfo(kind).max
        )

    @property
    def low(self) -> NDArray[np.float32]:
        """Smallest real number that is represented; shape of ``scale``."""
        return (self.qmin - self.zero_point).astype(np.float32) * self.scale

    @property
    def high(self) -> NDArray[np.float32]:
        """Largest real number that is represented; shape of ``scale``."""
        return (self.qmax - self.zero_point).astype(np.float32) * self.scale


def integer_range(bits: int = 8, signed: bool = True, narrow: bool = False) -> tuple[int, int]:
    """Return the smallest and largest integer of a width, e.g. (-128, 127); narrow leaves out the smallest.

    Raises:
        InputError: for a width outside 2 to 16 bits.
    """
    if isinstance(bits, bool) or not isinstance(bits, int) or not 2 <= bits <= 16:
        raise InputError("bits", given=bits, expected="a whole number from 2 to 16", fix="INT8 has 8 bits.")
    qmin, qmax = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)
    return qmin + bool(narrow), qmax


def choose_qparams(
    low: ArrayLike,
    high: ArrayLike,
    *,
    bits: int = 8,
    signed: bool = True,
    symmetric: bool = False,
    narrow: bool = False,
    axis: int | None = None,
) -> QParams:
    """Return the scale and zero point that spread a range over the integers.

    The range is first extended to contain zero. A range without extent (all values zero) gets the scale 1. Inside the
    range the rounding error is at most half a scale.

    Args:
        low, high: ends of the range, low <= high: numbers, or (C,) with ``axis``.
        bits: width of the integers, 2 to 16.
        signed: [-2^(bits-1), 2^(bits-1) - 1] instead of [0, 2^bits - 1].
        symmetric: 0.0 sits at the middle integer (0 if signed) and the range is +-max(|low|, |high|), with
            scale = bound / (2^(bits-1) - 1): 127 for INT8, as in TensorRT.
        narrow: leave out the smallest integer: [-127, 127], so that a weight and its negative are both there.
        axis: of the channels, where low and high are arrays.

    Raises:
        InputError: for NaN, infinity, low above high, or arrays without an axis.
    """
    lows, highs = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    if lows.shape != highs.shape or lows.ndim > 1 or lows.ndim != (axis is not None) or lows.size == 0:
        raise InputError(
            "range",
            given=f"shapes {lows.shape} and {highs.shape}, axis {axis}",
            expected="two numbers, or two (C,) arrays together with axis=",
            fix="For one scale per channel: choose_qparams(*per_channel_range(x, axis), axis=axis).",
        )
    if not (np.isfinite(lows).all() and np.isfinite(highs).all()) or (lows > highs).any():
        raise InputError(
            "range",
            given=(low, high),
            expected="finite numbers, low <= high",
            fix="NaN or infinity in calibration means that the network or its preprocessing is broken.",
        )
    qmin, qmax = integer_range(bits, signed, narrow)
    lows, highs = np.minimum(lows, 0.0), np.maximum(highs, 0.0)
    if symmetric:
        steps = 2 ** (bits - 1) - 1
        span = np.maximum(-lows, highs)
    else:
        steps = qmax - qmin
        span = highs - lows
    scale = np.where(span > 0, np.maximum(span / steps, _SMALLEST_SCALE), 1.0).astype(np.float32)
    if symmetric:
        zero_point = np.full(scale.shape, 0 if signed else 2 ** (bits - 1))
    else:
        zero_point = np.clip(np.rint(qmin - lows / scale.astype(np.float64)), qmin, qmax)
    return QParams(scale, zero_point.astype(np.int32), qmin, qmax, axis)


def quantize(x: ArrayLike, q: QParams) -> NDArray[np.integer]:
    """Return the integers nearest to ``x / scale + zero_point``, saturated to [qmin, qmax].

    Args:
        x: real numbers, finite; of any shape that has the axis of ``q``.
        q: scale and zero point.

    Returns:
        The shape of ``x``, in the smallest integer type that holds the range.

    Raises:
        InputError: for NaN or infinity, or a number of channels other than that of ``q``.
    """
    values = finite(x, "x")
    scale, zero_point = _along(q, values.shape)
    with np.errstate(over="ignore"):  # far outside the range the quotient may be infinite: it saturates
        steps = np.rint(values / scale)
    result: NDArray[np.integer] = np.clip(steps + zero_point, q.qmin, q.qmax).astype(q.dtype)
    return result


def dequantize(integers: ArrayLike, q: QParams) -> NDArray[np.float32]:
    """Return ``scale * (integer - zero_point)`` as float32; the zero point gives exactly 0.0.

    Raises:
        InputError: for numbers that are no integers, or lie outside [qmin, qmax].
    """
    given = np.asarray(integers)
    if given.dtype.kind not in "iu" or (given.size and (given.min() < q.qmin or given.max() > q.qmax)):
        raise InputError(
            "integers",
            given=f"{given.dtype}" + (f" from {given.min()} to {given.max()}" if given.size else ""),
            expected=f"integers from {q.qmin} to {q.qmax}",
            fix="Pass what quantize returned, with the same QParams.",
        )
    scale, zero_point = _along(q, given.shape)
    result: NDArray[np.float32] = (given.astype(np.int32) - zero_point).astype(np.float32) * scale
    return result


def fake_quantize(x: ArrayLike, q: QParams) -> NDArray[np.float32]:
    """Return ``dequantize(quantize(x))``: the float32 numbers that an integer network would see."""
    return dequantize(quantize(x, q), q)


def per_tensor_range(x: ArrayLike) -> tuple[float, float]:
    """Return the smallest and largest value.

    Raises:
        InputError: for an empty array, NaN or infinity.
    """
    values = finite(x, "x", some=True)
    return float(values.min()), float(values.max())


def per_channel_range(x: ArrayLike, axis: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the smallest and largest value for each index along an axis, (C,) each.

    Raises:
        InputError: for an empty array, NaN or infinity, or an axis that is not there.
    """
    values = finite(x, "x", some=True)
    if not -values.ndim <= axis < values.ndim:
        raise InputError(
            "axis", given=axis, expected=f"an axis of shape {values.shape}", fix="Output channels of Conv are axis 0."
        )
    rows = np.moveaxis(values, axis, 0).reshape(values.shape[axis], -1)
    return rows.min(axis=1), rows.max(axis=1)


def finite(x: ArrayLike, name: str, *, some: bool = False) -> NDArray[np.float32]:
    """Return ``x`` as float32.

    Raises:
        InputError: for NaN or infinity, what is no array of numbers, or (with ``some``) an empty array.
    """
    try:
        with np.errstate(over="ignore"):  # beyond float32 is infinity, which is refused below
            values = np.asarray(x, dtype=np.float32)
    except (TypeError, ValueError) as error:
        raise InputError(name, given=x, expected="an array of numbers", fix=f"numpy says: {error}") from error
    if not np.isfinite(values).all() or (some and values.size == 0):
        raise InputError(
            name,
            given=f"NaN or infinity in an array of shape {values.shape}" if values.size else "an empty array",
            expected="finite float32 numbers" + (", at least one" if some else ""),
            fix="Look for a division by zero, or a missing normalisation, before this point.",
        )
    return values


def _along(q: QParams, shape: tuple[int, ...]) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return scale and zero point shaped so that they broadcast over an array."""
    if q.axis is None:
        return q.scale, q.zero_point
    if not -len(shape) <= q.axis < len(shape) or shape[q.axis] != q.scale.size:
        raise InputError(
            "channels",
            given=f"shape {shape}, axis {q.axis}",
            expected=f"{q.scale.size} channels along axis {q.axis}",
            fix="Use the axis that the ranges were taken along: 0 for Conv, 1 for ConvTranspose weights.",
        )
    wide = [1] * len(shape)
    wide[q.axis] = -1
    return q.scale.reshape(wide), q.zero_point.reshape(wide)
