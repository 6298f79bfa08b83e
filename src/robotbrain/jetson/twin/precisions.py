"""How well the twin predicts what a lower precision brings: ratios of published latencies, and of its own."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass

from robotbrain.jetson.twin.conditions import PRECISIONS
from robotbrain.jetson.twin.data import LatencyRow, load_kernel_lists
from robotbrain.jetson.twin.fit import Fitted
from robotbrain.jetson.twin.latency import make_work
from robotbrain.jetson.twin.validate import LeftOut, network_of, predict_left_out

PROMISE = 0.25
"""Largest relative error of a ratio that the twin promises for networks and modules of which something is published."""

LEFT_OUT: dict[str, Callable[[LatencyRow], Hashable]] = {
    "network on the module": lambda row: (row.module, row.harness, network_of(row)),
    "network everywhere": network_of,
    "architecture on the module": lambda row: (row.module, row.harness, architecture_of(row)),
    "module": lambda row: row.module,
    "architecture everywhere": lambda row: architecture_of(row),
}
"""What may be left out of the fit, in all precisions at once, before it is predicted: rows with the same value leave
together. The first two keep siblings (YOLO11m beside YOLO11x), the last keeps nothing alike on any module."""


@dataclass(frozen=True)
class PrecisionPair:
    """One network in two precisions, all else equal: module, mode, clock, harness and source.

    Attributes:
        lower, higher: rows with predictions, of the lower and the higher precision.
    """

    lower: LeftOut
    higher: LeftOut

    @property
    def kind(self) -> str:
        """Which ratio, e.g. ``"int8/fp16"``."""
        return f"{self.lower.row.precision}/{self.higher.row.precision}"

    @property
    def published(self) -> float:
        """Published latency in the lower precision over that in the higher one."""
        return self.lower.row.latency_ms / self.higher.row.latency_ms

    @property
    def predicted(self) -> float:
        """The same of the predictions."""
        return self.lower.predicted_ms / self.higher.predicted_ms

    @property
    def peaks(self) -> float:
        """What the data sheet's dense peaks would give."""
        lower, higher = self.lower.row, self.higher.row
        at = PRECISIONS.index
        return higher.where.peak[at(higher.precision)] / lower.where.peak[at(lower.precision)]

    @property
    def error(self) -> float:
        """Relative error of the predicted ratio, signed."""
        return self.predicted / self.published - 1


def architecture_of(row: LatencyRow) -> str:
    """Return the architecture family of a row's network: its kernel list's name up to the first number or size."""
    return re.split(r"\d|_", row.kernels)[0]


def _setting(row: LatencyRow) -> tuple[Hashable, ...]:
    return row.module, row.mode, row.kernels, row.harness, row.source, row.where.gpu_ghz, row.where.bandwidth


def precision_pairs(items: Sequence[LeftOut]) -> list[PrecisionPair]:
    """Return all pairs that differ in nothing but their precision, in the order of the items."""
    groups: dict[tuple[Hashable, ...], list[LeftOut]] = {}
    for item in items:
        groups.setdefault(_setting(item.row), []).append(item)
    pairs = []
    for group in groups.values():
        ordered = sorted(group, key=lambda item: PRECISIONS.index(item.row.precision), reverse=True)
        for lower, higher in itertools.combinations(ordered, 2):
            if lower.row.precision != higher.row.precision:
                pairs.append(PrecisionPair(lower, higher))
    return pairs


def predict_rows(rows: Sequence[LatencyRow], fitted: Fitted) -> list[LeftOut]:
    """Predict rows with a fit as it is, also those that it was made from."""
    lists = load_kernel_lists()
    works = [make_work(lists[row.kernels], row.where) for row in rows]
    predicted = fitted.predict_ms(works, [row.where for row in rows])
    return [
        LeftOut(row, float(ms), fitted.log_sd(work, row.where))
        for row, work, ms in zip(rows, works, predicted, strict=True)
    ]


def pairs_left_out(
    rows: Sequence[LatencyRow], key: Callable[[LatencyRow], Hashable], start: Fitted
) -> list[PrecisionPair]:
    """Predict each pair with a fit that has seen neither of its rows, nor any other with the same key.

    Args:
        rows: calibration rows.
        key: what leaves the fit together; one of LEFT_OUT, or another that no pair has two values of.
        start: fit to all of them, from which each smaller fit begins.
    """
    in_pairs = {
        id(item.row)
        for pair in precision_pairs([LeftOut(row, row.latency_ms, 1.0) for row in rows])
        for item in (pair.lower, pair.higher)
    }
    pairs = []
    for unit in dict.fromkeys(key(row) for row in rows if id(row) in in_pairs):
        pairs += precision_pairs(predict_left_out(rows, lambda row, unit=unit: key(row) != unit, start))  # type: ignore[misc]
    return pairs
