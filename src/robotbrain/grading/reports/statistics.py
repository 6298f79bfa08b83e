"""Classical test theory: what the answers of a class say about the tests.

Definitions as in Crocker and Algina, *Introduction to Classical and Modern Test Theory* (1986), chapters 7 and 14. A
matrix of scores has a row for each student and a column for each item; every function takes partial credit.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Scores = NDArray[np.float64]
KELLEY = 0.27
"""Share of the class in the upper and in the lower group (Kelley 1939, J. Educational Psychology 30:17-24)."""


def difficulty(item: Scores, most: float) -> float:
    """Mean share of the points, in [0, 1]: 1 is an item that everybody solves. For 0/1 items the proportion p."""
    return float(np.mean(item)) / most


def correlation(a: Scores, b: Scores) -> float:
    """Pearson's r, or NaN where one of the two does not vary. With a 0/1 variable it is the point-biserial."""
    da, db = a - np.mean(a), b - np.mean(b)
    scale = math.sqrt(float(da @ da) * float(db @ db))
    # A mean that rounds leaves a dust of differences: no variation in the data is none in the result.
    if scale == 0 or np.ptp(a) < 1e-9 or np.ptp(b) < 1e-9:
        return math.nan
    return float(np.clip(da @ db / scale, -1.0, 1.0))


def discrimination(scores: Scores, column: int) -> float:
    """Corrected point-biserial: the item's correlation with the total of the *other* items (Henrysson 1963)."""
    return correlation(scores[:, column], np.delete(scores, column, axis=1).sum(axis=1))


def upper_lower(item: Scores, totals: Scores, most: float, share: float = KELLEY) -> float:
    """Difficulty in the best ``share`` of the class less that in the worst, in [-1, 1] (the index D).

    Students who tie at a group's border share its places, so that the result does not depend on their order.
    """
    upper, lower = _group(totals, share), _group(-totals, share)
    return float(upper @ item - lower @ item) / most


def _group(totals: Scores, share: float) -> Scores:
    """Weights (sum 1) of the students in the group with the highest ``totals``."""
    size = max(1.0, share * len(totals))
    weights = np.zeros(len(totals))
    left = size
    for value in np.unique(totals)[::-1]:
        tied = totals == value
        count = int(tied.sum())
        weights[tied] = min(1.0, left / count)
        left -= count
        if left <= 0:
            break
    return np.asarray(weights / size)


def cronbach_alpha(scores: Scores) -> float:
    """Cronbach's alpha (1951, Psychometrika 16:297-334); for 0/1 items it is KR-20 (Kuder and Richardson 1937).

    NaN with fewer than two items or two students, or where all totals are equal. It is a lower bound of the reliability
    if errors are independent, and no measure of there being one dimension.
    """
    students, items = scores.shape
    if students < 2 or items < 2:
        return math.nan
    total = float(np.var(scores.sum(axis=1), ddof=1))
    if total < 1e-12:
        return math.nan
    return float(items / (items - 1) * (1 - np.var(scores, axis=0, ddof=1).sum() / total))


def is_dichotomous(scores: Scores, most: Scores) -> bool:
    """Whether every score is nothing or all of the item's points (then alpha is KR-20)."""
    return bool(np.all((np.abs(scores) < 1e-9) | (np.abs(scores - most) < 1e-9)))


def least_notable(students: int) -> float:
    """The smallest correlation that 95 % confidence tells from 0 (Fisher's z); 1 for fewer than five students."""
    return 1.0 if students < 5 else math.tanh(1.96 / math.sqrt(students - 3))
