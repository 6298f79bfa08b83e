"""Names the slip behind a wrong number: units, sign, order, off by one. For tests that name none themselves."""

from __future__ import annotations

import math
from typing import Any

_LARGEST = 100_000  # numbers
_FACTORS = {
    1000.0: "it is 1000 times as large: are both in the same unit (ms and s, mm and m)?",
    0.001: "it is a thousandth: are both in the same unit (ms and s, mm and m)?",
    100.0: "it is 100 times as large: a percentage where a fraction is meant?",
    0.01: "it is a hundredth: a fraction where a percentage is meant?",
    180.0 / math.pi: "it is in degrees where radians are meant",
    math.pi / 180.0: "it is in radians where degrees are meant",
    2.0: "it is twice as large: is something counted twice?",
    0.5: "it is half as large: is something left out, or halved twice?",
    -1.0: "it has the opposite sign",
}


def likely_slip(got: Any, expected: Any) -> str:
    """The slip that turns ``expected`` into ``got``, as a sentence, or ``""`` if none of the usual ones does.

    Args:
        got: a wrong answer, as an array of real numbers.
        expected: the right one.
    """
    import numpy as np

    if got.size > _LARGEST or got.dtype.kind not in "iuf" or expected.dtype.kind not in "biuf":
        return ""
    if got.shape != expected.shape:
        return "rows and columns are exchanged" if got.ndim > 1 and got.shape == expected.shape[::-1] else ""
    if not np.isfinite(got).all() or not np.isfinite(expected).all() or not expected.any():
        return ""
    scale = float(np.abs(expected).max())
    for factor, text in _FACTORS.items():
        if np.allclose(got, factor * expected, rtol=1e-6, atol=1e-9 * scale * abs(factor)):
            return text
    if got.size > 1:
        for changed, text in ((got.T, "rows and columns are exchanged"), (got[::-1], "the order is reversed")):
            if changed.shape == expected.shape and np.allclose(changed, expected, rtol=1e-6, atol=1e-9 * scale):
                return text
    for step, text in ((1.0, "it is one too many"), (-1.0, "it is one too few")):
        if expected.dtype.kind in "iu" and np.array_equal(got, expected + step):
            return text
    return ""
