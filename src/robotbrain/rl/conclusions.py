"""What may be concluded from few episodes and few trainings: intervals, and whether A beats B."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robotbrain.errors import InputError
from robotbrain.monitoring.accuracy import Estimate

Floats = NDArray[np.float64]


def clopper_pearson(
    successes: int, trials: int, level: float = 0.95, side: Literal["both", "lower", "upper"] = "both"
) -> Estimate:
    """Return a share with its exact interval: it holds the true share with at least the stated confidence.

    Args:
        successes: 0 to ``trials``.
        trials: independent ones, >= 1.
        level: confidence, between 0 and 1.
        side: ``"lower"`` bounds the share from below only (the upper end is 1): 'at least so much', as a threshold
            asks; ``"upper"`` from above only.

    Source: Clopper & Pearson, "The use of confidence or fiducial limits illustrated in the case of the binomial",
    Biometrika 26, 1934.

    Raises:
        InputError: for numbers out of these ranges.
    """
    from scipy.special import betaincinv

    if not 0 <= successes <= trials or trials < 1 or not 0 < level < 1:
        raise InputError(
            "successes, trials, level",
            given=(successes, trials, level),
            expected="0 to trials, 1 or more, between 0 and 1",
            fix="95 % is 0.95.",
        )
    if side not in ("both", "lower", "upper"):
        raise InputError("side", given=side, expected="'both', 'lower' or 'upper'", fix="A threshold asks for 'lower'.")
    outside = (1 - level) / (2 if side == "both" else 1)
    low = 0.0 if side == "upper" or successes == 0 else betaincinv(successes, trials - successes + 1, outside)
    high = 1.0 if side == "lower" or successes == trials else betaincinv(successes + 1, trials - successes, 1 - outside)
    return Estimate(successes / trials, float(low), float(high), level)


def bootstrap(
    values: ArrayLike | Sequence[ArrayLike],
    *,
    of: Callable[[Floats], float] = lambda values: float(np.mean(values)),
    level: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> Estimate:
    """Return a figure of values with its bootstrap interval (percentiles).

    Args:
        values: independent ones, (n,); or one array for each seed of a training: then seeds are drawn with
            replacement, and values within each, since two episodes of one training are more alike than two trainings.
        of: the figure of (n,) values; the mean by default.
        level: confidence, between 0 and 1.
        resamples: >= 1.
        seed: of the drawing.

    Source: Efron, "Bootstrap methods: another look at the jackknife", Annals of Statistics 7, 1979; for several seeds
    Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice", NeurIPS 2021.

    Raises:
        InputError: without values, or for a level or number of resamples out of range.
    """
    groups = _groups(values)
    if not 0 < level < 1 or resamples < 1:
        raise InputError(
            "level, resamples", given=(level, resamples), expected="between 0 and 1; 1 or more", fix="95 % is 0.95."
        )
    rng = np.random.default_rng(seed)

    def again(group: Floats) -> Floats:
        return group[rng.integers(0, len(group), len(group))]

    drawn = np.empty(resamples)
    for index in range(resamples):
        chosen = groups if len(groups) == 1 else [groups[i] for i in rng.integers(0, len(groups), len(groups))]
        drawn[index] = of(np.concatenate([again(group) for group in chosen]))
    low, high = np.percentile(drawn, [50 * (1 - level), 50 * (1 + level)])
    return Estimate(of(np.concatenate(groups)), float(low), float(high), level)


@dataclass(frozen=True)
class Comparison:
    """Whether A beats B.

    Attributes:
        difference: of the means, A - B, with a confidence interval (both sides; Welch's).
        p_value: probability of a difference at least so favourable if A were no better than B.
        smallest_p: what so few values could show at best; a test at a lower level cannot succeed.
        test: its name.
    """

    difference: Estimate
    p_value: float
    smallest_p: float
    test: str

    def __str__(self) -> str:
        note = "" if self.smallest_p < 0.01 else f"; so few values cannot show less than p = {self.smallest_p:.2g}"
        return f"difference {self.difference}, p = {self.p_value:.2g} ({self.test}{note})"


def compare(
    a: ArrayLike,
    b: ArrayLike,
    *,
    test: Literal["permutation", "welch"] = "permutation",
    paired: bool = False,
    level: float = 0.95,
    resamples: int = 9999,
    seed: int = 0,
) -> Comparison:
    """Test whether A's mean is larger than B's (one-sided).

    The values have to be independent: one for each training (its mean over episodes) to conclude about a method, one
    for each episode to conclude about two given policies.

    Args:
        a, b: values, (n,) and (m,), at least 2 each, larger is better.
        test: ``"permutation"`` assumes only that labels could be swapped if there were no difference, and is exact
            for few values; ``"welch"`` assumes normally distributed means, not equal variances.
        paired: row i of both was obtained under the same conditions (one seed); n must equal m.
        level: of the difference's interval.
        resamples: permutations, where there are too many to try all.
        seed: of their drawing.

    Raises:
        InputError: for fewer than 2 values, unequal numbers of pairs, or values that are not numbers.
    """
    from scipy import stats

    first, second = (_values(x, name) for x, name in ((a, "a"), (b, "b")))
    if paired and len(first) != len(second):
        raise InputError("pairs", given=(len(first), len(second)), expected="equal numbers", fix="Or paired=False.")
    if test not in ("permutation", "welch"):
        raise InputError("test", given=test, expected="'permutation' or 'welch'", fix="Permutation suits few values.")
    difference = float(first.mean() - second.mean())
    if paired:
        welch = stats.ttest_rel(first, second, alternative="greater")
        both = stats.ttest_rel(first, second)
        count = 2 ** len(first)
    else:
        welch = stats.ttest_ind(first, second, equal_var=False, alternative="greater")
        both = stats.ttest_ind(first, second, equal_var=False)
        count = math.comb(len(first) + len(second), len(first))
    interval = both.confidence_interval(level)
    estimate = Estimate(difference, float(interval.low), float(interval.high), level)
    if test == "welch":
        return Comparison(estimate, float(welch.pvalue), 0.0, "paired t" if paired else "Welch's t")
    swapped = _swapped(first, second, paired, count, resamples, np.random.default_rng(seed))
    # Sums of the same numbers in another order differ by rounding: what is equal must count as equal.
    as_good = int((swapped >= difference - 1e-12 * max(1.0, abs(difference))).sum())
    exact = count <= resamples
    p_value = as_good / count if exact else (as_good + 1) / (resamples + 1)
    smallest = 1 / count if exact else 1 / (resamples + 1)
    return Comparison(estimate, p_value, smallest, "paired permutation" if paired else "permutation")


def _swapped(a: Floats, b: Floats, paired: bool, count: int, resamples: int, rng: np.random.Generator) -> Floats:
    """Return the difference of the means for all ``count`` ways to swap labels, or for some drawn ones."""
    n, m = len(a), len(b)
    if paired:
        if count <= resamples:
            signs = 1.0 - 2.0 * ((np.arange(count)[:, None] >> np.arange(n)) & 1)
        else:
            signs = rng.choice([-1.0, 1.0], (resamples, n))
        swapped: Floats = signs @ (a - b) / n
        return swapped
    together = np.concatenate([a, b])
    if count <= resamples:
        chosen = np.array(list(itertools.combinations(range(n + m), n)))
    else:
        chosen = np.argsort(rng.random((resamples, n + m)), axis=1)[:, :n]
    total = together[chosen].sum(axis=1)
    result: Floats = total / n - (together.sum() - total) / m
    return result


def _groups(values: Any) -> list[Floats]:
    nested = len(values) > 0 and np.ndim(values[0]) > 0
    groups = [np.asarray(group, dtype=np.float64).ravel() for group in (values if nested else [values])]
    if not groups or any(not len(group) or not np.isfinite(group).all() for group in groups):
        raise InputError(
            "values",
            given=[len(group) for group in groups],
            expected="at least one value in each group, all finite",
            fix="Leave out what is missing.",
        )
    return groups


def _values(x: ArrayLike, name: str) -> Floats:
    values = np.asarray(x, dtype=np.float64).ravel()
    if len(values) < 2 or not np.isfinite(values).all():
        raise InputError(name, given=values, expected="at least 2 numbers", fix="Run more seeds.")
    return values
