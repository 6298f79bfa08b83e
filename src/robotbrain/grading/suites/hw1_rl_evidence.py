"""How `hw1_rl` tests a reading of the outline's listing, and what numbers of successes prove."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import beta, norm

from robotbrain.grading import expect_close, fail

VERDICTS = {"a": "breaks", "b": "wastes", "c": "wastes", "d": "breaks", "e": "breaks"}
"""Of the first five of the ten observations about the outline's listing; the others are in the hidden tests.
tests/test_hw1_rl.py tries out those that can be tried."""

VERDICT_HINTS = {
    "a": "done-means-ended",
    "b": "who-is-optimised",
    "c": "who-is-optimised",
    "d": "nothing-new",
    "e": "time-is-up",
    "f": "never-called",
    "g": "as-in-the-paper",
    "h": "two-and-five",
    "i": "as-in-the-paper",
    "j": "one-row",
}

HINTS = {
    "one-sided": "One-sided: all 5 % of doubt lie below the bound, so the quantile is 0.05, not 0.025.",
    "exact-not-normal": "p - 1.645 sqrt(p (1 - p) / n) is far off near 100 %, where policies are. The exact bound is "
    "`beta.ppf(0.05, k, n - k + 1)`.",
    "zero-of-n": "Of no success at all nothing follows: the bound is 0.0.",
    "bound-from-below": "The LOWER bound is wanted: the rate that is exceeded with 95 % confidence.",
    "sim-minus-real": "The gap is what is lost on the way: rate in simulation minus rate on the robot.",
    "both-uncertain": "Both rates are uncertain. Their distances to their own Wilson limits are combined as a root of "
    "a sum of squares.",
    "crossed-limits": "The gap is smallest where simulation is at its LOWER limit and reality at its UPPER one, and "
    "the other way round.",
    "rate-not-count": "Rates lie between 0 and 1: divide by the number of trials, each list by its own.",
}

Z = 1.96


def exact_bound(successes: int, n: int, doubt: float = 0.05) -> float:
    """Return the lower end of the one-sided Clopper-Pearson interval (1934) of a success rate."""
    return float(beta.ppf(doubt, successes, n - successes + 1)) if successes > 0 else 0.0


def wilson(successes: int, n: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval (1927) of a rate."""
    p = successes / n
    centre = p + Z**2 / (2 * n)
    half = Z * math.sqrt(p * (1 - p) / n + Z**2 / (4 * n**2))
    return (centre - half) / (1 + Z**2 / n), (centre + half) / (1 + Z**2 / n)


def newcombe(sim: Sequence[bool], real: Sequence[bool]) -> tuple[float, float, float]:
    """Return the difference of two success rates with its 95 % interval (Newcombe, 1998, method 10)."""
    p, q = sum(sim) / len(sim), sum(real) / len(real)
    (p_low, p_high), (q_low, q_high) = wilson(sum(sim), len(sim)), wilson(sum(real), len(real))
    low = p - q - math.hypot(p - p_low, q_high - q)
    high = p - q + math.hypot(p_high - p, q - q_low)
    return p - q, low, high


def as_number(answer: Any) -> float:
    """Return a number as float, anything else as NaN."""
    try:
        return float(answer)
    except (TypeError, ValueError):
        return math.nan


def compare_bound(student: Any, cases: Sequence[tuple[int, int]]) -> None:
    """Compare with the exact bound."""
    for k, n in cases:
        expected = exact_bound(k, n)
        answer = student(k, n)
        given = as_number(answer)
        if abs(given - expected) <= 1e-4:
            continue
        p = k / n
        mistakes = [
            ("one-sided", exact_bound(k, n, 0.025)),
            ("one-sided", wilson(k, n)[0]),
            ("exact-not-normal", p - norm.ppf(0.95) * math.sqrt(p * (1 - p) / n)),
            ("exact-not-normal", p - Z * math.sqrt(p * (1 - p) / n)),
            ("exact-not-normal", p),
            ("exact-not-normal", float(beta.ppf(0.05, k, n - k)) if 0 < k < n else math.nan),
            ("exact-not-normal", float(beta.ppf(0.05, k + 1, n - k))),
            ("exact-not-normal", float(beta.ppf(0.05, k + 1, n - k + 1))),
            ("bound-from-below", float(beta.ppf(0.95, k + 1, n - k)) if k < n else 1.0),
            ("bound-from-below", 1 - expected),
        ]
        hint = "zero-of-n" if k == 0 else next((h for h, w in mistakes if math.isclose(given, w, rel_tol=1e-4)), "")
        expect_close(answer, expected, atol=1e-4, given=f"{k} successes in {n} trials", hint=hint, what="the bound")


def compare_gap(student: Any, sim: Sequence[bool], real: Sequence[bool]) -> None:
    """Compare with Newcombe's interval."""
    expected = newcombe(sim, real)
    answer = student(np.array(sim), np.array(real))
    given = f"{sum(sim)} of {len(sim)} in simulation, {sum(real)} of {len(real)} on the surrogate"
    try:
        values = tuple(map(as_number, answer))
    except TypeError:
        values = ()
    if len(values) != 3:
        fail("the answer should be three numbers", got=answer, expected="(difference, low, high)", given=given)
    if np.allclose(values, expected, rtol=0, atol=1e-4):
        return
    p, q = sum(sim) / len(sim), sum(real) / len(real)
    (p_low, p_high), (q_low, q_high) = wilson(sum(sim), len(sim)), wilson(sum(real), len(real))
    wald = Z * math.sqrt(p * (1 - p) / len(sim) + q * (1 - q) / len(real))
    flipped = newcombe(real, sim)
    mistakes = [
        ("sim-minus-real", flipped),
        ("exact-not-normal", (p - q, p - q - wald, p - q + wald)),
        ("both-uncertain", (p - q, p_low - q_high, p_high - q_low)),
        ("both-uncertain", (p - q, p_low - q, p_high - q)),
        ("both-uncertain", (p - q, p - q_high, p - q_low)),
        ("both-uncertain", (p - q, p_low - q_low, p_high - q_high)),
        ("rate-not-count", (float(sum(sim) - sum(real)), *expected[1:])),
    ]
    sides = ((p - p_low, p_high - p), (q - q_low, q_high - q))
    arms = [math.hypot(a, b) for a in sides[0] for b in sides[1]]
    mistakes += [("crossed-limits", (p - q, p - q - a, p - q + b)) for a in arms for b in arms]
    hint = next((h for h, w in mistakes if not np.allclose(w, expected) and np.allclose(values, w, rtol=1e-4)), "")
    expect_close(values, expected, atol=1e-4, given=given, hint=hint, what="(difference, low, high)")
