"""Observers: what range a tensor's values take, seen batch after batch without keeping them.

Minimum and maximum waste integers on outliers; a percentile cuts a fixed share of the values off; the entropy method
asks where to cut so that the distribution after quantisation tells least apart from the one before. Which is best
depends on the tensor: measure.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robotbrain.errors import InputError
from robotbrain.optimisation.affine import finite

METHODS = ("minmax", "percentile", "entropy")
"""Ways to choose a range."""


class Observer(Protocol):
    """What every observer does."""

    def update(self, array: ArrayLike) -> None:
        """Take in a batch of values, of any shape."""

    def range(self) -> tuple[float, float]:
        """Return (low, high) of what was seen so far."""


class MinMaxObserver:
    """The smallest and the largest value."""

    def __init__(self) -> None:
        self._low, self._high = math.inf, -math.inf

    def update(self, array: ArrayLike) -> None:
        """Take in a batch of values, of any shape.

        Raises:
            InputError: for NaN or infinity.
        """
        values = finite(array, "observed values")
        if values.size:
            self._low, self._high = min(self._low, float(values.min())), max(self._high, float(values.max()))

    def range(self) -> tuple[float, float]:
        """Return the smallest and the largest value.

        Raises:
            InputError: if nothing was seen.
        """
        if self._low > self._high:
            raise _nothing()
        return self._low, self._high


class Histogram:
    """A histogram of signed values whose range grows with them.

    The bins are a power of two wide. When a value does not fit, neighbouring bins are merged in pairs, which is exact.
    So the result does not depend on the order or the size of the batches.

    Args:
        bins: for each sign; a power of two from 256.

    Attributes:
        width: of a bin; 0.0 before the first value other than zero.
        negative, positive: (bins,) counts by magnitude; bin k holds magnitudes from ``k * width`` on.
        zeros: values that are exactly 0.
        low, high: smallest and largest value, exact.
    """

    def __init__(self, bins: int = 2048) -> None:
        if bins < 256 or bins & (bins - 1):
            raise InputError("bins", given=bins, expected="a power of two, 256 or more", fix="2048 is usual.")
        self.bins, self.width, self.zeros = bins, 0.0, 0
        self.negative: NDArray[np.int64] = np.zeros(bins, dtype=np.int64)
        self.positive: NDArray[np.int64] = np.zeros(bins, dtype=np.int64)
        self.low, self.high = math.inf, -math.inf

    @property
    def total(self) -> int:
        """Number of values seen."""
        return int(self.negative.sum() + self.positive.sum()) + self.zeros

    @property
    def magnitudes(self) -> NDArray[np.int64]:
        """Counts of the absolute values, (bins,), without the zeros."""
        return self.negative + self.positive

    def add(self, array: ArrayLike) -> None:
        """Count values of any shape.

        Raises:
            InputError: for NaN or infinity.
        """
        values = finite(array, "observed values").ravel().astype(np.float64)
        if not values.size:
            return
        self.low, self.high = min(self.low, float(values.min())), max(self.high, float(values.max()))
        peak = max(-self.low, self.high)
        if peak > 0:
            # peak / bins = m * 2**e with m < 1, so the peak lies strictly inside bins * 2**e.
            self._widen(math.ldexp(1.0, math.frexp(peak / self.bins)[1]))
        for counts, part in ((self.negative, -values[values < 0]), (self.positive, values[values > 0])):
            if part.size:
                counts += np.bincount((part / self.width).astype(np.int64), minlength=self.bins)
        self.zeros += int((values == 0).sum())

    def _widen(self, width: float) -> None:
        if self.width and width > self.width:
            factor = int(min(width / self.width, self.bins))
            for counts in (self.negative, self.positive):
                merged = counts.reshape(-1, factor).sum(axis=1)
                counts[:] = 0
                counts[: merged.size] = merged
        self.width = max(self.width, width)


class _HistogramObserver:
    """What observers share that look at a histogram of all values."""

    histogram: Histogram

    def update(self, array: ArrayLike) -> None:
        """Take in a batch of values, of any shape; NaN and infinity raise InputError."""
        self.histogram.add(array)

    def _seen(self) -> Histogram:
        if not self.histogram.total:
            raise _nothing()
        return self.histogram


class PercentileObserver(_HistogramObserver):
    """The range that holds the middle ``percentile`` per cent of the values.

    Half of what is cut lies at each end, to the resolution of the histogram and never inside the share that is to be
    kept. 100 gives the smallest and the largest value.

    Args:
        percentile: above 50, at most 100.
        bins: of the histogram, for each sign.
    """

    def __init__(self, percentile: float = 99.99, bins: int = 2048) -> None:
        if not 50 < percentile <= 100:
            raise InputError(
                "percentile", given=percentile, expected="above 50, at most 100", fix="99.9 to 99.999 are usual."
            )
        self.percentile, self.histogram = float(percentile), Histogram(bins)

    def range(self) -> tuple[float, float]:
        """Return (low, high).

        Raises:
            InputError: if nothing was seen.
        """
        seen = self._seen()
        cut = seen.total * (100.0 - self.percentile) / 200.0
        edges = np.arange(seen.bins + 1) * seen.width
        # From the most negative value to the largest: its bins, each with its two ends.
        counts = np.concatenate([seen.negative[::-1], [seen.zeros], seen.positive])
        lower = np.concatenate([-edges[:0:-1], [0.0], edges[:-1]])
        upper = np.concatenate([-edges[-2::-1], [0.0], edges[1:]])
        first = int(np.argmax(np.cumsum(counts) > cut))
        last = counts.size - 1 - int(np.argmax(np.cumsum(counts[::-1]) > cut))
        return max(float(lower[first]), seen.low), min(float(upper[last]), seen.high)


class EntropyObserver(_HistogramObserver):
    """The range whose quantisation loses least information, by the Kullback-Leibler divergence.

    For every threshold T: cut the histogram of magnitudes at T (what lies beyond counts as T), spread the part below T
    over the integers, and compare the two distributions; the T with the smallest divergence wins. The method is
    Migacz, "8-bit Inference with TensorRT", 2017
    (https://on-demand.gputechconf.com/gtc/2017/presentation/s7310-8-bit-inference-with-tensorrt.pdf). Exact zeros are
    left out: they cost nothing, and after a ReLU they would drown everything else.

    Args:
        bins: of the histogram, for each sign.
        levels: integers for the magnitudes: 128 for INT8.
        stride: distance between the thresholds tried, in bins.
    """

    def __init__(self, bins: int = 2048, levels: int = 128, stride: int = 4) -> None:
        if not 2 <= levels <= bins // 2 or stride < 1:
            raise InputError(
                "levels and stride",
                given=(levels, stride),
                expected=f"2 to {bins // 2} levels, a stride of 1 or more",
                fix="128 levels are INT8.",
            )
        self.histogram, self.levels, self.stride = Histogram(bins), levels, stride

    def range(self) -> tuple[float, float]:
        """Return (-T, T), no wider on either side than what was seen.

        Raises:
            InputError: if nothing was seen.
        """
        seen = self._seen()
        counts = seen.magnitudes.astype(np.float64)
        used = int(np.flatnonzero(counts)[-1]) + 1 if counts.any() else 0
        if used <= self.levels:
            return seen.low, seen.high
        candidates = sorted({*range(self.levels, used, self.stride), used})
        divergences = [divergence(counts, cut, self.levels) for cut in candidates]
        threshold = candidates[int(np.argmin(divergences))] * seen.width
        return max(-threshold, seen.low), min(threshold, seen.high)


def divergence(counts: NDArray[np.float64], cut: int, levels: int) -> float:
    """Return the Kullback-Leibler divergence, nats, between a histogram cut at a bin and its quantised self.

    Args:
        counts: (bins,) of the magnitudes.
        cut: bins that are kept, at least ``levels``; the rest is added to the last of them.
        levels: that the kept bins are merged into.
    """
    kept = counts[:cut]
    reference = kept.copy()
    reference[-1] += counts[cut:].sum()
    edges = np.arange(levels + 1) * cut // levels
    occupied = kept > 0
    mass = np.add.reduceat(kept, edges[:-1])
    share = mass / np.maximum(np.add.reduceat(occupied.astype(np.float64), edges[:-1]), 1.0)
    candidate = np.repeat(share, np.diff(edges)) * occupied
    if not candidate.any():
        return math.inf
    p, q = reference / reference.sum(), candidate / candidate.sum()
    some = p > 0
    # Only the last bin can hold something in p and nothing in q; a little mass there keeps the logarithm finite.
    return float(np.sum(p[some] * np.log(p[some] / np.where(q[some] > 0, q[some], 1e-4))))


def make_observer(method: str, percentile: float = 99.99) -> Observer:
    """Return a new observer for one of METHODS.

    Raises:
        InputError: for another method.
    """
    if method == "minmax":
        return MinMaxObserver()
    if method == "percentile":
        return PercentileObserver(percentile)
    if method == "entropy":
        return EntropyObserver()
    raise InputError("method", given=method, expected=", ".join(METHODS), fix="Start with minmax.")


def _nothing() -> InputError:
    return InputError(
        "calibration",
        given="no values",
        expected="at least one batch",
        fix="Call update with the tensor's values first.",
    )
