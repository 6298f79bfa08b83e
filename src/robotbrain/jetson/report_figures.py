"""Figures of the calibration's report: predictions of left-out rows against measurements."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from statistics import NormalDist
from typing import TYPE_CHECKING

import numpy as np

from robotbrain.figures import GREY, INK, QUIET, SKY, VERMILLION, new_figure, plain_ticks, tidy, title
from robotbrain.jetson.catalogue import load_module
from robotbrain.jetson.plot_modules import FAMILY_STYLE
from robotbrain.jetson.twin.data import PowerRow
from robotbrain.jetson.twin.validate import LeftOut, group_of, interval_scale

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BAND = SKY


def _families(items: Sequence[LeftOut]) -> list[str]:
    present = {item.row.where.family for item in items}
    return [family for family in FAMILY_STYLE if family in present]


def _identity(axes: Axes, low: float, high: float) -> None:
    ends = np.array([low, high])
    axes.fill_between(ends, 0.8 * ends, 1.2 * ends, color=_BAND, alpha=0.25, lw=0, label="within 20 %")
    axes.plot(ends, ends, color=INK, lw=1)
    axes.set(xscale="log", yscale="log", xlim=(low, high), ylim=(low, high), aspect="equal")
    plain_ticks(axes, "x", "y")
    tidy(axes)


def plot_scatter(items: Sequence[LeftOut]) -> Figure:
    """Return predicted against measured latency of left-out rows."""
    figure = new_figure(6.6, 6.2)
    axes: Axes = figure.subplots()
    values = [value for item in items for value in (item.row.latency_ms, item.predicted_ms)]
    _identity(axes, 0.7 * min(values), 1.4 * max(values))
    for family in _families(items):
        chosen = [item for item in items if item.row.where.family == family]
        colour, marker = FAMILY_STYLE[family]
        axes.scatter(
            [item.row.latency_ms for item in chosen], [item.predicted_ms for item in chosen], s=34, c=colour,
            marker=marker, alpha=0.75, ec="white", lw=0.4, label=f"{family.capitalize()} ({len(chosen)})",
        )  # fmt: skip
    axes.set_xlabel("measured latency (ms)")
    axes.set_ylabel("predicted latency, row left out (ms)")
    axes.legend(fontsize=9, loc="upper left", framealpha=0.9, edgecolor="#cccccc")
    within = sum(abs(item.error) <= 0.2 for item in items)
    figure.set_label(
        f"Predicted against measured latency of {len(items)} left-out rows, both from {min(values):.2g} to "
        f"{max(values):.3g} ms on logarithmic axes. {within} rows lie within 20 %, along the diagonal."
    )
    return figure


def plot_groups(items: Sequence[LeftOut], limit: float = 0.6) -> Figure:
    """Return the signed error of every left-out row, a line for each module, precision and harness.

    Args:
        items: rows.
        limit: errors beyond it are drawn at the edge, with an arrow.
    """
    groups = sorted({group_of(item.row) for item in items}, key=lambda g: (g[2], g[0], g[1]), reverse=True)
    figure = new_figure(9.6, 0.33 * len(groups) + 1.5)
    axes: Axes = figure.subplots()
    axes.axvspan(-20, 20, color=_BAND, alpha=0.25, lw=0)
    axes.axvline(0, color=INK, lw=1)
    for y, group in enumerate(groups):
        chosen = [item for item in items if group_of(item.row) == group]
        colour, marker = FAMILY_STYLE[chosen[0].row.where.family]
        baseline = [item.baseline_error for item in chosen if not math.isnan(item.baseline_error)]
        _errors(axes, baseline, y - 0.22, GREY, "x", 14, limit)
        _errors(axes, [item.error for item in chosen], y + 0.12, colour, marker, 30, limit)
    axes.set_yticks(range(len(groups)), [" ".join((g[2], g[0], g[1])) for g in groups], fontsize=8.5)
    axes.set_ylim(-0.7, len(groups) - 0.3)
    axes.set_xlim(-100 * limit - 4, 100 * limit + 4)
    axes.set_xlabel(f"prediction over measurement, minus one (%); beyond {100 * limit:.0f} % at the edge")
    tidy(axes)
    title(axes, "coloured: the twin; grey crosses: FLOPs over peak, with one efficiency for each line")
    worst = max(items, key=lambda item: abs(item.error))
    figure.set_label(
        f"Signed errors of {len(items)} left-out rows in {len(groups)} groups of harness, module and precision; most "
        f"lie within 20 %. The largest is {100 * worst.error:+.0f} % ({worst.row.network} on {worst.row.module}). The "
        "errors of FLOPs over peak, beside them, spread several times as far."
    )
    return figure


def _errors(axes: Axes, errors: Sequence[float], y: float, colour: str, marker: str, size: float, limit: float) -> None:
    inside = [100 * e for e in errors if abs(e) <= limit]
    axes.scatter(inside, [y] * len(inside), s=size, c=colour, marker=marker, alpha=0.75, lw=0.8, zorder=3)
    for sign, arrow in ((-1, "<"), (1, ">")):
        beyond = [e for e in errors if sign * e > limit]
        if beyond:
            edge = 100 * sign * (limit + 0.015)
            axes.scatter([edge], [y], s=size, c=colour, marker=arrow, zorder=3, clip_on=False)


def coverage(items: Sequence[LeftOut], nominal: Sequence[float]) -> list[float]:
    """Return the share of rows within their interval, for each nominal share.

    As in validate.covered, the intervals of a group (module, precision, harness) are scaled without its own rows.
    """
    scales = {
        group: interval_scale(item for item in items if group_of(item.row) != group)
        for group in {group_of(item.row) for item in items}
    }
    z = np.array([abs(item.z) / scales[group_of(item.row)] for item in items])
    return [float(np.mean(z <= NormalDist().inv_cdf(0.5 + share / 2))) for share in nominal]


def plot_coverage(items: Sequence[LeftOut]) -> Figure:
    """Return the share of left-out rows inside intervals, against the share that the intervals claim."""
    nominal = [round(0.05 * step, 2) for step in range(1, 20)]
    seen = coverage(items, nominal)
    figure = new_figure(5.6, 5.0)
    axes: Axes = figure.subplots()
    axes.plot([0, 100], [0, 100], color=INK, lw=1, label="as claimed")
    axes.axvline(80, color=QUIET, lw=0.9, ls=":")
    axes.fill_between([77, 83], 75, 90, color=_BAND, alpha=0.35, lw=0, label="wanted at 80 %")
    axes.plot(
        [100 * share for share in nominal], [100 * share for share in seen], "o-", color=VERMILLION, ms=5, lw=1.4,
        label="left-out rows",
    )  # fmt: skip
    axes.set(xlim=(0, 100), ylim=(0, 100), aspect="equal")
    axes.set_xlabel("interval claims to hold (% of rows)")
    axes.set_ylabel("interval holds (% of left-out rows)")
    axes.legend(fontsize=9, loc="upper left", framealpha=0.9, edgecolor="#cccccc")
    tidy(axes)
    at_80 = seen[nominal.index(0.8)]
    figure.set_label(
        f"Share of left-out rows inside their interval against what the interval claims: 80 % intervals hold "
        f"{100 * at_80:.0f} % of the rows, 50 % intervals {100 * seen[nominal.index(0.5)]:.0f} %."
    )
    return figure


def plot_power(rows: Sequence[tuple[PowerRow, float]]) -> Figure:
    """Return predicted against measured power at the wall, each network left out in turn."""
    figure = new_figure(6.2, 5.8)
    axes: Axes = figure.subplots()
    family: Callable[[PowerRow], str] = lambda row: load_module(row.module).family  # noqa: E731
    pairs = [(family(row), row.wall_power_w, row.wall_power_w * (1 + error)) for row, error in rows]
    values = [value for _, measured, predicted in pairs for value in (measured, predicted)]
    _identity(axes, 0.8 * min(values), 1.25 * max(values))
    for name, (colour, marker) in FAMILY_STYLE.items():
        chosen = [(measured, predicted) for f, measured, predicted in pairs if f == name]
        if chosen:
            x, y = zip(*chosen, strict=True)
            axes.scatter(
                x, y, s=34, c=colour, marker=marker, alpha=0.75, ec="white", lw=0.4,
                label=f"{name.capitalize()} ({len(chosen)})",
            )  # fmt: skip
    axes.set_xlabel("measured power at the wall (W)")
    axes.set_ylabel("predicted, network left out (W)")
    axes.legend(fontsize=9, loc="upper left", framealpha=0.9, edgecolor="#cccccc")
    median = float(np.median([abs(error) for _, error in rows]))
    figure.set_label(
        f"Predicted against measured wall power of {len(rows)} MLPerf MaxQ rows from {min(values):.0f} to "
        f"{max(values):.0f} W; the median error is {100 * median:.0f} %."
    )
    return figure
