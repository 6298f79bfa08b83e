"""How well the latency model predicts what it was not fitted to."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from robotbrain.jetson.twin.conditions import PRECISIONS
from robotbrain.jetson.twin.data import LatencyRow, load_kernel_lists
from robotbrain.jetson.twin.fit import Fitted, Sample, fit
from robotbrain.jetson.twin.latency import make_work

MIXED_HARNESSES = ("torch2trt", "tf_to_trt")
"""Harnesses whose rows are of networks of several architectures."""

COVERAGE = 0.87
"""Share of left-out rows that the 80 % intervals are made to hold. More than 80 %, since a network of an architecture
that the calibration does not know is harder to predict than one whose siblings stay in the fit."""

Z80 = 1.2815515594600038
"""Half-width of a normal distribution's central 80 % interval, in standard deviations."""


@dataclass(frozen=True)
class LeftOut:
    """A row, and what a model that has not seen its network under these conditions says.

    Attributes:
        row: measured.
        predicted_ms: by the model.
        log_sd: of the prediction, before the intervals' scale.
        baseline_ms: by FLOPs over peak times one efficiency, fitted to what is left of the row's group, else NaN.
    """

    row: LatencyRow
    predicted_ms: float
    log_sd: float
    baseline_ms: float = math.nan

    @property
    def error(self) -> float:
        """Relative error, signed."""
        return self.predicted_ms / self.row.latency_ms - 1

    @property
    def baseline_error(self) -> float:
        """Relative error of the baseline, signed."""
        return self.baseline_ms / self.row.latency_ms - 1

    @property
    def z(self) -> float:
        """Log error in standard deviations."""
        return math.log(self.predicted_ms / self.row.latency_ms) / self.log_sd


def group_of(row: LatencyRow) -> tuple[str, str, str]:
    """Return module, precision and harness."""
    return row.module, row.precision, row.harness


def network_of(row: LatencyRow) -> str:
    """Return the kernel list's name; a network with and without batch norm is the same one once it is fused."""
    return row.kernels.removesuffix("_bn")


def samples(rows: Sequence[LatencyRow]) -> list[Sample]:
    """Return rows as samples; rows that repeat one another share one weight."""
    lists = load_kernel_lists()
    same = Counter((group_of(row), network_of(row), row.where.gpu_ghz) for row in rows)
    return [
        Sample(
            make_work(lists[row.kernels], row.where),
            row.where,
            row.latency_ms,
            1 / same[group_of(row), network_of(row), row.where.gpu_ghz],
        )
        for row in rows
    ]


def predict_left_out(rows: Sequence[LatencyRow], keep: Callable[[LatencyRow], bool], start: Fitted) -> list[LeftOut]:
    """Fit to the rows that ``keep`` accepts; predict the others."""
    kept = [row for row in rows if keep(row)]
    fitted = fit(samples(kept), start)
    out = [row for row in rows if not keep(row)]
    lists = load_kernel_lists()
    works = [make_work(lists[row.kernels], row.where) for row in out]
    predicted = fitted.predict_ms(works, [row.where for row in out])
    return [
        LeftOut(row, float(ms), fitted.log_sd(work, row.where), _baseline(kept, row))
        for row, work, ms in zip(out, works, predicted, strict=True)
    ]


def _baseline(kept: Sequence[LatencyRow], row: LatencyRow) -> float:
    """FLOPs over peak: one efficiency for each group, the median of the other networks' in it."""
    lists = load_kernel_lists()

    def at_peak(r: LatencyRow) -> float:
        return 2e3 * lists[r.kernels].macs / r.where.peak[PRECISIONS.index(r.precision)]

    ratios = [r.latency_ms / at_peak(r) for r in kept if group_of(r) == group_of(row)]
    return float(np.median(ratios)) * at_peak(row) if ratios else math.nan


def leave_one_out(
    rows: Sequence[LatencyRow], start: Fitted, progress: Callable[[int, int], None] | None = None
) -> list[LeftOut]:
    """Leave out each network in turn, with all its rows in its group (module, precision, harness); predict it.

    Args:
        rows: calibration rows.
        start: fit to all of them, from which each smaller fit begins.
        progress: called with (done, of) after each.
    """
    units = sorted({(group_of(row), network_of(row)) for row in rows})
    result: list[LeftOut] = []
    for index, unit in enumerate(units):

        def keep(row: LatencyRow, unit: tuple[tuple[str, str, str], str] = unit) -> bool:
            return (group_of(row), network_of(row)) != unit

        result += predict_left_out(rows, keep, start)
        if progress is not None:
            progress(index + 1, len(units))
    return result


def leave_module_out(rows: Sequence[LatencyRow], module: str, start: Fitted) -> list[LeftOut]:
    """Leave out everything measured on one module; predict it."""
    return predict_left_out(rows, lambda row: row.module != module, start)


def interval_scale(left_out: Iterable[LeftOut], coverage: float = COVERAGE) -> float:
    """Return the factor on ``log_sd`` with which ``coverage`` of the left-out rows lie in their 80 % intervals."""
    return max(0.5, float(np.quantile([abs(item.z) for item in left_out], coverage)) / Z80)


def covered(left_out: Sequence[LeftOut]) -> float:
    """Return the share of rows in their 80 % intervals, each scaled without its own module, precision and harness."""
    hits = 0
    for group in {group_of(item.row) for item in left_out}:
        scale = interval_scale(item for item in left_out if group_of(item.row) != group)
        hits += sum(abs(item.z) <= Z80 * scale for item in left_out if group_of(item.row) == group)
    return hits / len(left_out)


@dataclass(frozen=True)
class Summary:
    """Errors of a set of predictions.

    Attributes:
        rows: how many.
        median, p90: of the absolute relative error.
        within_20: share within 20 %.
        baseline_median: of the baseline, NaN where there is none.
    """

    rows: int
    median: float
    p90: float
    within_20: float
    baseline_median: float


def summarise(left_out: Sequence[LeftOut]) -> Summary:
    """Return the errors of a set of predictions."""
    errors = np.abs([item.error for item in left_out])
    baseline = np.abs([item.baseline_error for item in left_out if not math.isnan(item.baseline_ms)])
    return Summary(
        len(left_out),
        float(np.median(errors)),
        float(np.percentile(errors, 90)),
        float(np.mean(errors <= 0.2)),
        float(np.median(baseline)) if len(baseline) else math.nan,
    )
