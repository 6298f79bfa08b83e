"""Results of a robustness test: intervals, paired comparison, table and figure."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from robotbrain.errors import InputError
from robotbrain.monitoring.accuracy import wilson_interval

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NOTHING = "none"
"""Name of the runs without a fault."""


@dataclass(frozen=True)
class Row:
    """How one world went under one fault.

    Attributes:
        fault, severity, seed: which.
        success, reason, seconds: as of the run.
        e2e_p50_ms, e2e_p99_ms: end-to-end latency, ms; NaN for a run without commands.
    """

    fault: str
    severity: str
    seed: int
    success: bool
    reason: str
    seconds: float
    e2e_p50_ms: float
    e2e_p99_ms: float


@dataclass(frozen=True)
class Summary:
    """How a brain drove under one fault.

    Attributes:
        fault, severity: which.
        successes, runs: worlds solved, of how many.
        low, high: 95 % interval of the success rate (Wilson).
        e2e_p50_ms, e2e_p99_ms: median over the worlds of a run's median and 99th percentile, ms.
        seconds: median time of the solved ones, s.
        lost, won: worlds that are solved only without the fault, and only with it.
        p_value: of "the fault makes no difference to success" (exact McNemar test on the same worlds).
        reasons: why worlds were not solved, with how often, the most frequent first.
    """

    fault: str
    severity: str
    successes: int
    runs: int
    low: float
    high: float
    e2e_p50_ms: float
    e2e_p99_ms: float
    seconds: float
    lost: int
    won: int
    p_value: float
    reasons: tuple[tuple[str, int], ...] = field(repr=False)

    @property
    def rate(self) -> float:
        """Share of the worlds solved."""
        return self.successes / self.runs


def wilson(successes: int, runs: int) -> tuple[float, float]:
    """Return the 95 % score interval of a rate; see :func:`~robotbrain.monitoring.accuracy.wilson_interval`.

    Raises:
        InputError: unless 0 <= successes <= runs and runs > 0.
    """
    if not 0 <= successes <= runs or runs == 0:
        raise InputError(
            "successes and runs", given=(successes, runs), expected="0 <= successes <= runs, runs > 0", fix="Count."
        )
    found = wilson_interval(successes, runs)
    return found.low, found.high


def mcnemar(lost: int, won: int) -> float:
    """Return the two-sided p-value that ``lost`` and ``won`` changes of a pair are equally likely (exact binomial)."""
    count = lost + won
    if not count:
        return 1.0
    tail = float(sum(math.comb(count, k) for k in range(min(lost, won) + 1)) / 2**count)
    return min(1.0, 2 * tail)


@dataclass(frozen=True)
class Robustness:
    """Results of a robustness test: ``print(result)`` shows the table.

    Attributes:
        rows: of every run.
    """

    rows: tuple[Row, ...] = field(repr=False)

    @functools.cached_property
    def summaries(self) -> tuple[Summary, ...]:
        """One for each fault and severity, in the order tried; the first is without a fault."""
        groups: dict[tuple[str, str], list[Row]] = {}
        for row in self.rows:
            groups.setdefault((row.fault, row.severity), []).append(row)
        without = {row.seed: row.success for row in groups.get((NOTHING, ""), [])}
        return tuple(_summary(rows, without) for rows in groups.values())

    def __str__(self) -> str:
        head = ("fault", "severity", "solved", "95 % interval", "e2e p50 ms", "p99 ms", "s", "lost", "won", "p", "why")
        body = [
            (
                s.fault,
                s.severity,
                f"{s.successes}/{s.runs}",
                f"{s.low:.0%} to {s.high:.0%}",
                f"{s.e2e_p50_ms:.0f}",
                f"{s.e2e_p99_ms:.0f}",
                f"{s.seconds:.1f}",
                str(s.lost),
                str(s.won),
                f"{s.p_value:.2g}",
                f"{s.reasons[0][1]} x {s.reasons[0][0]}"[:60] if s.reasons else "",
            )
            for s in self.summaries
        ]
        widths = [max(len(line[i]) for line in [head, *body]) for i in range(len(head))]
        left = (0, 1, 10)
        lines = [
            "  ".join(
                c.ljust(w) if i in left else c.rjust(w) for i, (c, w) in enumerate(zip(line, widths, strict=True))
            )
            for line in [head, *body]
        ]
        return "\n".join(line.rstrip() for line in lines)

    def plot(self) -> tuple[Figure, str]:
        """Return a figure of success rate and latency by fault, and its alternative text."""
        from robotbrain.figures import BLUE, INK, SKY, new_figure, tidy, title

        found = self.summaries
        names = [s.fault if s.fault == NOTHING else f"{s.fault}, {s.severity}" for s in found]
        figure = new_figure(11, 0.36 * len(found) + 1.3)
        left, right = figure.subplots(1, 2, sharey=True, width_ratios=(3, 2))
        for row, s in enumerate(found):
            left.plot([100 * s.low, 100 * s.high], [row, row], color=SKY, lw=4, solid_capstyle="butt")
            left.plot(100 * s.rate, row, "o", color=BLUE)
            left.text(103, row, f"{s.successes} of {s.runs}", va="center", color=INK)
            if math.isfinite(s.e2e_p99_ms):
                right.barh(row, s.e2e_p99_ms, color=BLUE, height=0.6)
                right.barh(row, s.e2e_p50_ms, color=SKY, height=0.3)
        left.set_yticks(range(len(found)), names)
        left.invert_yaxis()
        left.set_xlim(-3, 118)
        left.set_xticks(range(0, 101, 25))
        left.set_xlabel("worlds solved (%), 95 % interval")
        right.set_xlabel("end-to-end latency (ms): bar: p99; narrow bar in it: median")
        title(left, "What faults do to driving")
        tidy(left)
        tidy(right)
        alt = "Worlds solved and end-to-end latency by fault. " + "; ".join(
            f"{name}: {s.successes} of {s.runs} solved, median {s.e2e_p50_ms:.0f} ms, 99th percentile "
            f"{s.e2e_p99_ms:.0f} ms"
            for name, s in zip(names, found, strict=True)
        )
        figure.set_label(alt)
        return figure, alt

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON; what is not a number is None."""
        return {
            "rows": [plain(asdict(row)) for row in self.rows],
            "summaries": [plain(asdict(s)) for s in self.summaries],
        }


def plain(values: dict[str, Any]) -> dict[str, Any]:
    """Return values for JSON: None for what is not a number."""
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in values.items()}


def _summary(rows: Sequence[Row], without: Mapping[int, bool]) -> Summary:
    solved = [row for row in rows if row.success]
    low, high = wilson(len(solved), len(rows))
    pairs = [(without[row.seed], row.success) for row in rows if row.seed in without]
    lost, won = pairs.count((True, False)), pairs.count((False, True))
    reasons: dict[str, int] = {}
    for row in rows:
        if not row.success:
            reasons[row.reason] = reasons.get(row.reason, 0) + 1
    return Summary(
        rows[0].fault,
        rows[0].severity,
        len(solved),
        len(rows),
        low,
        high,
        _median([row.e2e_p50_ms for row in rows]),
        _median([row.e2e_p99_ms for row in rows]),
        _median([row.seconds for row in solved]),
        lost,
        won,
        mcnemar(lost, won),
        tuple(sorted(reasons.items(), key=lambda item: (-item[1], item[0]))),
    )


def _median(values: Iterable[float]) -> float:
    known = [value for value in values if math.isfinite(value)]
    return float(np.median(known)) if known else math.nan
