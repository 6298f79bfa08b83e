"""What is said about many numbers at once: how many, the mean, the extremes and a few percentiles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

if TYPE_CHECKING:
    from robotbrain.monitoring.sketch import LatencySketch


@dataclass(frozen=True)
class Distribution:
    """A summary of numbers, all in one unit (ms unless said otherwise); without any, everything but ``count`` is NaN.

    Attributes:
        count: how many.
        mean, min, p50, p90, p95, p99, max: of them.
    """

    count: int = 0
    mean: float = math.nan
    min: float = math.nan
    p50: float = math.nan
    p90: float = math.nan
    p95: float = math.nan
    p99: float = math.nan
    max: float = math.nan

    @classmethod
    def of(cls, values: ArrayLike | Sequence[float]) -> Distribution:
        """Return the summary of values (exact: percentiles by linear interpolation); NaNs are left out."""
        array = np.asarray(values, dtype=float).ravel()
        array = array[~np.isnan(array)]
        if not len(array):
            return cls()
        p50, p90, p95, p99 = (float(v) for v in np.percentile(array, (50, 90, 95, 99)))
        return cls(len(array), float(array.mean()), float(array.min()), p50, p90, p95, p99, float(array.max()))

    @classmethod
    def from_sketch(cls, sketch: LatencySketch) -> Distribution:
        """Return the summary of what a sketch holds; percentiles are as accurate as the sketch."""
        if not sketch.count:
            return cls()
        p50, p90, p95, p99 = (sketch.quantile(q) for q in (0.5, 0.9, 0.95, 0.99))
        return cls(sketch.count, sketch.mean, sketch.min, p50, p90, p95, p99, sketch.max)

    def to_dict(self) -> dict[str, float | int | None]:
        """Return the summary for JSON; numbers that do not exist are None."""
        return {name: none_if_nan(getattr(self, name)) for name in self.__dataclass_fields__}


def none_if_nan(value: float) -> float | None:
    """Return a number for JSON, which knows no NaN: None in its place."""
    return None if isinstance(value, float) and math.isnan(value) else value
