"""Percentiles of a stream in bounded memory: DDSketch, from the ``ddsketch`` package.

A sketch counts values in bins whose width grows with the value, so that every quantile it returns is within a relative
error of the true one, whatever the distribution; merging two sketches loses nothing.

Source: Masson, Rim and Lee, "DDSketch: a fast and fully-mergeable quantile sketch with relative-error guarantees",
PVLDB 12(12), 2019. T-digests give no such bound; KLL sketches bound the rank, which says little about a long tail.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from robotbrain.errors import InputError

QUANTILES = (0.5, 0.9, 0.95, 0.99)
"""Quantiles that summaries show."""

_BINS = 2048  # at 1 % these span 17 decades: a nanosecond and a year fit side by side

_BUFFER = 256  # values that wait to be handed to the sketch together

_SMALLEST = 1e-9
"""Values below this count as 0 (in ms: a picosecond)."""


class LatencySketch:
    """Quantiles of non-negative values, such as latencies in ms, each within a relative error.

    A value that cannot be a latency is left out but counted: NaN and infinities as ``invalid``, negative numbers as
    ``negative`` (two clocks that disagree, as a rule).

    Args:
        relative_accuracy: bound of ``|estimate - true| / true`` for every quantile, between 0 and 1 (both excluded).

    Raises:
        InputError: for an accuracy outside that range.
    """

    __slots__ = (
        "_buffer",
        "_count",
        "_invalid",
        "_log_gamma",
        "_max",
        "_min",
        "_negative",
        "_sketch",
        "_sum",
        "relative_accuracy",
    )

    def __init__(self, relative_accuracy: float = 0.01) -> None:
        if not 0 < relative_accuracy < 1:
            raise InputError(
                "relative_accuracy",
                given=relative_accuracy,
                expected="a number between 0 and 1",
                fix="0.01 keeps every percentile within 1 %.",
            )
        from ddsketch import LogCollapsingLowestDenseDDSketch

        self.relative_accuracy = float(relative_accuracy)
        self._sketch: Any = LogCollapsingLowestDenseDDSketch(relative_accuracy, _BINS)
        self._log_gamma = math.log((1 + relative_accuracy) / (1 - relative_accuracy))
        self._buffer: list[float] = []
        self._sum, self._min, self._max = 0.0, math.inf, -math.inf
        self._count = self._invalid = self._negative = 0

    def add(self, value: float) -> None:
        """Add a value, or count it as invalid or negative."""
        # This runs for every callback of a brain: the work is done later, for many values at once.
        buffer = self._buffer
        buffer.append(value)
        if len(buffer) >= _BUFFER:
            self._flush()

    def _flush(self) -> None:
        """Hand the values that wait to the sketch, all of one bin at once."""
        if not self._buffer:
            return
        values = np.array(self._buffer, dtype=float)
        self._buffer.clear()
        fit = (values >= 0) & (values < math.inf)
        if not fit.all():
            negative = int(np.count_nonzero((values < 0) & (values > -math.inf)))
            self._negative += negative
            self._invalid += int(np.count_nonzero(~fit)) - negative
            values = values[fit]
            if not len(values):
                return
        self._count += len(values)
        self._sum += float(values.sum())
        self._min, self._max = min(self._min, float(values.min())), max(self._max, float(values.max()))
        positive = values[values > _SMALLEST]
        if len(positive) < len(values):
            self._sketch.add(0.0, len(values) - len(positive))
        bins = np.ceil(np.log(positive) / self._log_gamma)
        _, first, counts = np.unique(bins, return_index=True, return_counts=True)
        for index, count in zip(first.tolist(), counts.tolist(), strict=True):
            self._sketch.add(float(positive[index]), count)

    @property
    def count(self) -> int:
        """Values that were added."""
        self._flush()
        return self._count

    @property
    def invalid(self) -> int:
        """Values that were NaN or infinite."""
        self._flush()
        return self._invalid

    @property
    def negative(self) -> int:
        """Values below 0."""
        self._flush()
        return self._negative

    def extend(self, values: Iterable[float]) -> None:
        """Add several values."""
        self._buffer.extend(values)
        if len(self._buffer) >= _BUFFER:
            self._flush()

    def quantile(self, q: float) -> float:
        """Return the value of rank ``floor(q (count - 1))`` within the relative accuracy; NaN of an empty sketch.

        Args:
            q: 0 (the smallest) to 1 (the largest); both ends are exact.

        Raises:
            InputError: for another q.
        """
        if not 0 <= q <= 1:
            raise InputError("quantile", given=q, expected="0 to 1", fix="The 99th percentile is 0.99.")
        self._flush()
        if not self._count:
            return math.nan
        if q in (0, 1):
            return self._min if q == 0 else self._max
        # The true value lies between the two, so moving the estimate there only brings it nearer.
        return min(max(float(self._sketch.get_quantile_value(q)), self._min), self._max)

    @property
    def min(self) -> float:
        """The smallest value (exact); NaN of an empty sketch."""
        self._flush()
        return self._min if self._count else math.nan

    @property
    def max(self) -> float:
        """The largest value (exact); NaN of an empty sketch."""
        self._flush()
        return self._max if self._count else math.nan

    @property
    def mean(self) -> float:
        """The mean (exact but for rounding); NaN of an empty sketch."""
        self._flush()
        return self._sum / self._count if self._count else math.nan

    @property
    def total(self) -> float:
        """The sum of the values."""
        self._flush()
        return self._sum

    def merge(self, other: LatencySketch) -> None:
        """Add everything that another sketch holds; the other stays as it is.

        Raises:
            InputError: for a sketch of another accuracy.
        """
        if other.relative_accuracy != self.relative_accuracy:
            raise InputError(
                "merge",
                given=f"sketches of accuracy {self.relative_accuracy} and {other.relative_accuracy}",
                expected="one accuracy",
                fix="Make both with the same relative_accuracy.",
            )
        other._flush()
        self._invalid += other._invalid
        self._negative += other._negative
        if not other._count:
            return
        self._sketch.merge(other._sketch)
        self._count += other._count
        self._sum += other._sum
        self._min, self._max = min(self._min, other._min), max(self._max, other._max)

    def copy(self) -> LatencySketch:
        """Return a sketch that holds the same."""
        twin = LatencySketch(self.relative_accuracy)
        twin.merge(self)
        return twin

    def to_dict(self) -> dict[str, float | int | None]:
        """Return counts, extremes, mean and the QUANTILES for JSON; numbers that do not exist are None."""
        shown: dict[str, float | int | None] = {
            "count": self.count,
            "invalid": self.invalid,
            "negative": self.negative,
            "relative_accuracy": self.relative_accuracy,
        }
        numbers = {"min": self.min, "mean": self.mean, "max": self.max}
        numbers.update({f"p{100 * q:g}": self.quantile(q) for q in QUANTILES})
        shown.update({name: None if math.isnan(value) else value for name, value in numbers.items()})
        return shown

    def __repr__(self) -> str:
        if not self.count:
            return "LatencySketch(empty)"
        return f"LatencySketch(count={self.count}, p50={self.quantile(0.5):.4g}, p99={self.quantile(0.99):.4g})"


class WindowedSketch:
    """A sketch of everything, and one of the recent past.

    Time is cut into windows; :meth:`recent` covers the window that is running and the one before it.
    """

    __slots__ = ("_closed", "_current", "_last", "add", "extend")

    def __init__(self, relative_accuracy: float = 0.01) -> None:
        self._closed = LatencySketch(relative_accuracy)
        self._last: LatencySketch | None = None
        self._current = LatencySketch(relative_accuracy)
        self.add, self.extend = self._current.add, self._current.extend
        """Add a value, or several, to the window that is running; see :class:`LatencySketch`."""

    def roll(self) -> None:
        """Close the window that is running and begin the next."""
        if self._last is not None:
            self._closed.merge(self._last)
        self._last = self._current
        self._current = LatencySketch(self._current.relative_accuracy)
        self.add, self.extend = self._current.add, self._current.extend

    def total(self) -> LatencySketch:
        """Return a sketch of everything."""
        found = self._closed.copy()
        if self._last is not None:
            found.merge(self._last)
        found.merge(self._current)
        return found

    def recent(self) -> LatencySketch:
        """Return a sketch of the window that is running and the one before it."""
        found = self._current.copy()
        if self._last is not None:
            found.merge(self._last)
        return found

    @property
    def count(self) -> int:
        """Values so far."""
        return self._closed.count + (self._last.count if self._last is not None else 0) + self._current.count
