"""Deadlines of callbacks, and how regular their starts are."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from robotbrain.errors import InputError
from robotbrain.monitoring.distribution import Distribution, none_if_nan

KINDS = ("timer", "subscription", "service", "client")

DeadlineKey = tuple[str, str, str]
"""(node or role, kind, name): name is a topic, a service or a timer's callback; ``*`` stands for any."""


class Deadlines(Mapping[DeadlineKey, float]):
    """How long callbacks may take from being ready to their end.

    Args:
        table: ms by (node or role, kind, name). A node is written with its slash (``/controller``), a role without.
            ``*`` for the node or the name stands for any. The most specific entry counts: a node before a role before
            ``*``, then a name before ``*``.

    Raises:
        InputError: for an entry of another form, or a deadline that is not positive.
    """

    def __init__(self, table: Mapping[DeadlineKey, float] | None = None) -> None:
        self._table = dict(table or {})
        for key, limit in self._table.items():
            well_formed = isinstance(key, tuple) and len(key) == 3 and all(isinstance(part, str) for part in key)
            if not well_formed or key[1] not in KINDS:
                raise InputError(
                    "deadline",
                    given=key,
                    expected="(node or role, kind, name) with one of the kinds " + ", ".join(KINDS),
                    fix="For instance ('controller', 'timer', '_control'): 50.0.",
                )
            if isinstance(limit, bool) or not isinstance(limit, int | float) or not 0 < limit < math.inf:
                raise InputError(
                    f"deadline of {key}", given=limit, expected="milliseconds > 0", fix="One period is a usual choice."
                )

    def of(self, node: str, role: str, kind: str, name: str) -> float | None:
        """Return the deadline of a callback, ms; None without one."""
        for who in (node, role, "*"):
            if who:
                for what in (name, "*"):
                    limit = self._table.get((who, kind, what))
                    if limit is not None:
                        return float(limit)
        return None

    def __getitem__(self, key: DeadlineKey) -> float:
        return self._table[key]

    def __iter__(self) -> Iterator[DeadlineKey]:
        return iter(self._table)

    def __len__(self) -> int:
        return len(self._table)

    def __repr__(self) -> str:
        return f"Deadlines({self._table!r})"


KIT_DEADLINES = Deadlines(
    {
        ("controller", "timer", "_control"): 50.0,
        ("perception", "subscription", "/camera/image"): 100.0,
        ("estimator", "subscription", "/scan"): 100.0,
        ("estimator", "subscription", "/joint_states"): 20.0,
    }
)
"""Deadlines of the kit's brain: one period of the timer or the sensor."""


@dataclass(frozen=True)
class Jitter:
    """How regularly something starts.

    Attributes:
        period_ms: of the grid; declared, or else the median of the intervals. NaN for fewer than three starts.
        declared: whether somebody said what the period is.
        offset: how much later than the earliest start, relative to the grid, ms (peak to peak jitter is its ``max``).
            The grid's own drift does not count.
        deviation: of ``|interval - period|``, ms.
        drift_ppm: by how much the mean period differs from the declared one, parts per million; NaN if not declared.
        missed: places of the grid between the first and last start at which nothing started.
    """

    period_ms: float = math.nan
    declared: bool = False
    offset: Distribution = field(default_factory=Distribution)
    deviation: Distribution = field(default_factory=Distribution)
    drift_ppm: float = math.nan
    missed: int = 0

    def to_dict(self) -> dict[str, object]:
        """Return the figures for JSON; numbers that do not exist are None."""
        return {
            "period_ms": none_if_nan(self.period_ms),
            "declared": self.declared,
            "offset_ms": self.offset.to_dict(),
            "deviation_ms": self.deviation.to_dict(),
            "drift_ppm": none_if_nan(self.drift_ppm),
            "missed": self.missed,
        }


def jitter_of(start_ns: ArrayLike, period_ns: float | None = None) -> Jitter:
    """Return how regular some starts are.

    Args:
        start_ns: (N,) int, in order.
        period_ns: of the grid, if somebody declared it.

    Each start belongs to a place of a grid: the one before it, plus the interval in whole periods. A straight line
    through (place, time), by least squares, takes the drift out; what is left is the jitter.
    """
    times = np.asarray(start_ns, dtype=np.int64)
    if len(times) < 3:
        return Jitter(math.nan if period_ns is None else period_ns * 1e-6, period_ns is not None)
    intervals = np.diff(times)
    period = float(period_ns) if period_ns is not None else float(np.median(intervals))
    if period <= 0:
        return Jitter(0.0)
    places = np.concatenate([[0], np.cumsum(np.maximum(0, np.round(intervals / period)))])
    if places[-1] < 1:
        return Jitter(period * 1e-6, period_ns is not None)
    elapsed = (times - times[0]).astype(float)
    slope, intercept = np.polyfit(places, elapsed, 1)
    offset = elapsed - (slope * places + intercept)
    return Jitter(
        period_ms=period * 1e-6,
        declared=period_ns is not None,
        offset=Distribution.of((offset - offset.min()) * 1e-6),
        deviation=Distribution.of(np.abs(intervals - period) * 1e-6),
        drift_ppm=math.nan if period_ns is None else float(slope / period - 1) * 1e6,
        missed=int(places[-1]) + 1 - len(np.unique(places)),
    )


SHORT_NAMES: Mapping[DeadlineKey, str] = MappingProxyType(
    {
        ("controller", "timer", "_control"): "controller",
        ("perception", "subscription", "/camera/image"): "perception",
        ("estimator", "subscription", "/scan"): "estimator_scan",
        ("estimator", "subscription", "/joint_states"): "estimator_wheels",
    }
)
"""What ``RunResult.deadline_misses`` calls the callbacks of KIT_DEADLINES."""
