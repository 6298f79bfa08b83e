"""How the tests of `hw3_performance` judge a student's ``validate``: made-up runs, and the verdict on them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from robotbrain.grading import expect, fail
from robotbrain.grading.suites import judging
from robotbrain.grading.suites.hw3_performance_tools import Array

if TYPE_CHECKING:
    from robotbrain.grading import Student


def made_up_run(seed: int, success: bool, e2e_ms: Sequence[float] | Array) -> Any:
    """Return something with the fields of a run."""
    return SimpleNamespace(
        seed=seed,
        success=success,
        reason="reached the goal" if success else "did not arrive within 40 s",
        seconds=14.0 if success else 40.0,
        e2e_ms=np.array(e2e_ms, dtype=float),
    )


def random_runs(rng: np.random.Generator, scales: Sequence[float], wins: Sequence[bool], first: int = 0) -> list[Any]:
    """Return runs in worlds ``first``, … whose latencies scatter around ``scales`` ms (inf: it never acted)."""
    return [
        made_up_run(first + k, won, scale * rng.gamma(8.0, 1 / 8.0, rng.integers(40, 90)) if scale < math.inf else [])
        for k, (scale, won) in enumerate(zip(scales, wins, strict=True))
    ]


def wilson(successes: int, runs: int, z: float = 1.96) -> tuple[float, float]:
    """Return Wilson's score interval."""
    rate = successes / runs
    centre, half = rate + z**2 / (2 * runs), z * math.sqrt(rate * (1 - rate) / runs + z**2 / (4 * runs**2))
    return (centre - half) / (1 + z**2 / runs), (centre + half) / (1 + z**2 / runs)


def p95(run: Any) -> float:
    """Return the 95th percentile of a run's end-to-end latency, ms; inf if it has none."""
    return float(np.percentile(run.e2e_ms, 95)) if len(run.e2e_ms) else math.inf


def _ratio(before: float, after: float) -> float:
    return 1.0 if before == after == math.inf else math.inf if before == math.inf else before / after


def verdict(before: Sequence[Any], after: Sequence[Any]) -> dict[str, Any]:
    """Return the whole answer of ``validate``."""
    late = {run.seed: run for run in after}
    ratios = sorted(_ratio(p95(run), p95(late[run.seed])) for run in before)
    n = len(ratios)
    # Most extreme ranks that a median lies outside of in at most 2.5 % of samples, by summing binomials.
    tail, rank = 0.0, 0
    while rank < n // 2 and (tail := tail + math.comb(n, rank) / 2**n) <= 0.025:
        rank += 1
    rank = max(rank, 1)
    low, high = ratios[rank - 1], ratios[n - rank]
    rates = [sum(bool(run.success) for run in runs) for runs in (before, after)]
    parts = [(k / n, *wilson(k, n)) for k in rates]
    middle = float(np.median(ratios)) if ratios[n // 2] < math.inf else _median(ratios)
    return {
        "speedup": middle,
        "interval": (low, high),
        "before": parts[0],
        "after": parts[1],
        "accept": low > 1 and parts[1][1] >= parts[0][0] - 0.1,
    }


def _median(ordered: Sequence[float]) -> float:
    n = len(ordered)
    return ordered[n // 2] if n % 2 else (ordered[n // 2 - 1] + ordered[n // 2]) / 2


def _speedup_mistakes(before: Sequence[Any], after: Sequence[Any]) -> list[tuple[str, float]]:
    late = {run.seed: run for run in after}
    pairs = [(run, late[run.seed]) for run in before]
    ratios = [_ratio(p95(a), p95(b)) for a, b in pairs]
    alive = [_ratio(p95(a), p95(b)) for a, b in pairs if a.success and b.success]
    survivors = [_ratio(p95(a), p95(b)) for a, b in pairs if a.success]
    arrived = [_ratio(p95(a), p95(b)) for a, b in pairs if b.success]
    finite = [r for r in ratios if r < math.inf]
    order = [_ratio(p95(a), p95(b)) for a, b in zip(before, after, strict=True)]
    means = [float(np.mean([p95(run) for run in runs])) for runs in (before, after)]
    pools = [np.concatenate([run.e2e_ms for run in runs]) for runs in (before, after)]
    found = [
        ("before-over-after", _median(sorted(1 / r if r else math.inf for r in ratios))),
        ("before-over-after", 1 / _median(sorted(ratios)) if _median(sorted(ratios)) else math.inf),
        ("pair-by-world", _median(sorted(order))),
        ("ratio-of-pairs", _ratio(means[0], means[1])),
        ("ratio-of-pairs", float(np.mean(ratios))),
    ]
    for rows in (alive, survivors, arrived, finite):
        if rows and len(rows) < len(ratios):
            found += [("survivorship", _median(sorted(rows))), ("survivorship", float(np.mean(rows)))]
    if all(len(pool) for pool in pools):
        found.append(("ratio-of-pairs", float(np.percentile(pools[0], 95) / np.percentile(pools[1], 95))))
    return found


def compare_validation(
    student: Student,
    before: Sequence[Any],
    after: Sequence[Any],
    keys: Sequence[str] = ("speedup", "interval", "before", "after", "accept"),
) -> None:
    """Compare the given keys of the student's verdict with the oracle's."""
    expected = verdict(before, after)
    answer = student.validate(list(before), list(after))
    if not isinstance(answer, Mapping) or not set(expected) <= set(answer):
        fail("the answer is not the dict asked for", got=answer, expected="keys " + ", ".join(expected))
    lost = sum(not run.success for run in before)
    given = f"{len(before)} worlds, {lost} runs failed before and {sum(not run.success for run in after)} after"
    if "speedup" in keys:
        numb = isinstance(answer["speedup"], float) and math.isnan(answer["speedup"])
        judging.compare(
            answer["speedup"],
            expected["speedup"],
            lambda: _speedup_mistakes(before, after),
            hint="no-run-is-inf" if numb else "",
            given=given,
            what="speedup",
        )
    if "interval" in keys:
        judging.compare(
            answer["interval"], expected["interval"], hint="ranks-of-the-median", given=given, what="interval"
        )
    for key, runs in (("before", before), ("after", after)):
        if key in keys:
            rate, n = expected[key][0], len(runs)
            half = 1.96 * math.sqrt(rate * (1 - rate) / n)
            wald = [
                ("wilson-not-wald", (rate, rate - half, rate + half)),
                ("wilson-not-wald", (rate, max(0.0, rate - half), min(1.0, rate + half))),
            ]
            judging.compare(
                answer[key],
                expected[key],
                wald,
                atol=5e-4,
                match_atol=1e-3,
                given=given,
                what=key,
            )
    if "accept" in keys:
        got = answer["accept"]
        expect(isinstance(got, (bool, np.bool_)), "accept should be True or False", got=got)
        low, rate = expected["interval"][0], expected["after"]
        reason = "interval-decides" if low <= 1 < expected["speedup"] else "not-worse"
        expect(
            bool(got) == expected["accept"],
            "this change should " + ("be accepted" if expected["accept"] else "not be accepted (yet)"),
            got=bool(got),
            expected=expected["accept"],
            given=f"{given}; speed-up at least {low:.2f}, success {expected['before'][0]:.0%} before, at least "
            f"{rate[1]:.0%} after",
            hint=reason,
        )
