"""Latency added up over a run: which callbacks and causes it consists of."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from robotbrain.errors import InputError
from robotbrain.monitoring.critical_path_blame import Place

if TYPE_CHECKING:
    from robotbrain.monitoring.critical_path import Path


@dataclass(frozen=True, slots=True)
class BudgetRow:
    """What one callback and cause contribute.

    Attributes:
        cause, place, resource: as of a span.
        by: whose work was waited for; None if unknown, or if nobody was.
        mean_ms: mean over all paths, ms; the rows of a budget add up to its mean.
        p99_ms: 99th percentile over the paths, ms.
        share: of the mean latency, 0 to 1.
    """

    cause: str
    place: Place
    resource: str
    by: Place | None
    mean_ms: float
    p99_ms: float
    share: float


@dataclass(frozen=True)
class LatencyBudget:
    """End-to-end latency of many paths and what it consists of.

    Attributes:
        count: paths.
        mean_ms, p50_ms, p90_ms, p99_ms: of the latency, ms.
        rows: the largest first.
    """

    count: int
    mean_ms: float
    p50_ms: float
    p90_ms: float
    p99_ms: float
    rows: tuple[BudgetRow, ...]

    def by_cause(self) -> dict[str, float]:
        """Return the mean of each cause, ms, the largest first."""
        found: dict[str, float] = {}
        for row in self.rows:
            found[row.cause] = found.get(row.cause, 0.0) + row.mean_ms
        return dict(sorted(found.items(), key=lambda item: -item[1]))

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {
            "count": self.count,
            "mean_ms": self.mean_ms,
            "p50_ms": self.p50_ms,
            "p90_ms": self.p90_ms,
            "p99_ms": self.p99_ms,
            "rows": [
                {
                    "cause": row.cause,
                    "callback": str(row.place),
                    "resource": row.resource,
                    "by": None if row.by is None else str(row.by),
                    "mean_ms": row.mean_ms,
                    "p99_ms": row.p99_ms,
                    "share": row.share,
                }
                for row in self.rows
            ],
        }


def latency_budget(paths: Iterable[Path]) -> LatencyBudget:
    """Add paths up.

    Raises:
        InputError: for no paths.
    """
    chosen: Sequence[Path] = tuple(paths)
    if not chosen:
        raise InputError(
            "paths",
            given="none",
            expected="at least one path from a sensor to the sink",
            fix="Record for longer, or choose another sink or source.",
        )
    latency = np.array([path.latency_ns for path in chosen]) * 1e-6
    lengths: dict[tuple[str, Place, str, Place | None], list[float]] = {}
    for number, path in enumerate(chosen):
        for span in path.spans:
            column = lengths.setdefault((span.cause, span.place, span.resource, span.by), [0.0] * len(chosen))
            column[number] += span.length_ns * 1e-6
    mean = float(latency.mean())
    rows = [
        BudgetRow(*key, float(np.mean(column)), float(np.percentile(column, 99)), float(np.mean(column)) / mean)
        for key, column in lengths.items()
        if mean
    ]
    rows.sort(key=lambda row: (-row.mean_ms, row.cause, row.place, row.resource, str(row.by)))
    p50, p90, p99 = (float(value) for value in np.percentile(latency, [50, 90, 99]))
    return LatencyBudget(len(chosen), mean, p50, p90, p99, tuple(rows))
