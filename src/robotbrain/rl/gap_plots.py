"""Figures of a gap study: colours that the colour-blind can tell apart, and each figure also in words."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from robotbrain.figures import BLUE, BROWN, GREEN, MAUVE, QUIET, SKY, VERMILLION, new_figure, tidy, title
from robotbrain.rl.gap_report import PLACES, GapReport

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PLACE_STYLES = {"simulation": (BLUE, "o"), "surrogate": (VERMILLION, "s")}
"""Colour and marker by place."""
VARIANT_COLOURS = (VERMILLION, BLUE, GREEN, MAUVE, SKY, BROWN)
VARIANT_LINES = ("-", "--", "-.", ":")
TOLERANCE_MM = 20.0
_UNITS = {
    "payload": "kg",
    "payload_offset": "m",
    "com_shift": "m",
    "motor_lag_s": "s",
    "command_delay_s": "s",
    "measurement_delay_s": "s",
    "play": "rad",
    "encoder_bias": "rad",
    "encoder_noise": "rad",
    "velocity_noise": "rad/s",
}


def plot_gap(report: GapReport) -> Figure:
    """Return success in both places per training (left) and the surrogates' errors (right); its label is in words."""
    figure = new_figure(10.0, 0.45 * len(report.rows) + 3.0)
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    _plot_success(left, report)
    _plot_errors(right, report)
    figure.set_label(describe(report))
    return figure


def _plot_success(axes: Axes, report: GapReport) -> None:
    for k, variant in enumerate(report.rows):
        for place in PLACES:
            colour, marker = PLACE_STYLES[place]
            shares = 100 * report.values(variant, place)
            height = k + (0.13 if place == "surrogate" else -0.13)
            rows = np.full(len(shares), height)
            axes.plot(shares, rows, ls="", marker=marker, color=colour, alpha=0.45, ms=5, mec="none")
            name = {"simulation": "in simulation", "surrogate": "on surrogates"}[place] if k == 0 else None
            axes.plot(
                [shares.mean()], [height], ls="", marker=marker, color=colour, ms=11, mfc="none", mew=2, label=name
            )
    axes.set_yticks(range(len(report.rows)), list(report.rows))
    axes.set_ylim(len(report.rows) - 0.5, -0.5)
    axes.set_xlim(-3, 103)
    axes.set_xlabel("targets reached (%); filled: one training, ring: mean")
    title(axes, "From simulation to surrogates")
    tidy(axes)
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, -0.02), ncols=2, frameon=True, framealpha=0.9)


def _plot_errors(axes: Axes, report: GapReport) -> None:
    for k, variant in enumerate(report.rows):
        error = np.sort(1e3 * report.error_by_robot(variant))
        share = 100 * np.arange(1, len(error) + 1) / len(error)
        colour, line = VARIANT_COLOURS[k % len(VARIANT_COLOURS)], VARIANT_LINES[k % len(VARIANT_LINES)]
        axes.step(error, share, where="post", color=colour, ls=line, lw=2, label=variant)
    axes.axvline(TOLERANCE_MM, color=QUIET, lw=0.8)
    axes.set_xscale("log")
    axes.set_xlabel("final error (mm); grey: tolerance")
    axes.set_ylabel("surrogates with at most this error (%)")
    title(axes, "Error, surrogate by surrogate")
    tidy(axes)
    axes.legend(loc="lower right", frameon=True, framealpha=0.9)


def plot_sensitivity(report: GapReport, columns: int = 5) -> Figure:
    """Return the final error against each of the surrogates' parameters, a panel each, strongest first."""
    order = list(report.sensitivity(next(iter(report.rows))))
    values = report.surrogate_parameters()
    rows = math.ceil(len(order) / columns)
    figure = new_figure(2.3 * columns, 2.1 * rows + 0.5)
    panels = figure.subplots(rows, columns, sharey=True, squeeze=False)
    words = []
    for axes, name in zip(panels.flat, order, strict=False):
        for k, variant in enumerate(report.rows):
            found, marker = 1e3 * report.error_by_robot(variant), ("s", "o", "^", "D")[k % 4]
            rho = report.sensitivity(variant)[name]
            words.append(f"{variant} and {name}: {rho:+.2f}")
            colour = VARIANT_COLOURS[k % len(VARIANT_COLOURS)]
            label = variant if axes is panels.flat[0] else None
            axes.plot(values[name], found, ls="", marker=marker, ms=3, color=colour, mec="none", label=label)
        axes.set_yscale("log")
        axes.axhline(TOLERANCE_MM, color=QUIET, lw=0.8)
        axes.set_xlabel(
            f"{name.removesuffix('_s').replace('_', ' ')}" + (f" ({_UNITS[name]})" if name in _UNITS else "")
        )
        tidy(axes)
    for axes in list(panels.flat)[len(order) :]:
        axes.set_visible(False)
    for row in panels:
        row[0].set_ylabel("final error (mm)")
    figure.legend(loc="outside upper center", ncols=4, frameon=False)
    figure.set_label("Final error against each surrogate parameter; rank correlations: " + ", ".join(words) + ".")
    return figure


def plot_dissection(report: GapReport) -> Figure:
    """Return what share of targets each variant reaches on robots that differ from the nominal one in one way only."""
    names = list(report.dissection)
    kinds = sorted(report.dissected(names[0]), key=report.dissected(names[0]).__getitem__)
    figure = new_figure(8.0, 0.42 * len(kinds) + 1.6)
    axes = figure.subplots()
    words = []
    for k, variant in enumerate(names):
        shares = report.dissected(variant)
        height = np.arange(len(kinds)) + 0.8 * ((k + 0.5) / len(names) - 0.5)
        colour, hatch = VARIANT_COLOURS[k % len(VARIANT_COLOURS)], ("", "//", "..", "xx")[k % 4]
        values = [100 * shares[kind] for kind in kinds]
        axes.barh(height, values, 0.8 / len(names), color=colour, hatch=hatch, edgecolor="white", label=variant)
        words.append(f"{variant}: " + ", ".join(f"{kind} {shares[kind]:.0%}" for kind in kinds))
    axes.set_yticks(range(len(kinds)), kinds)
    axes.invert_yaxis()
    axes.set_xlim(0, 100)
    axes.set_xlabel("targets reached (%)")
    title(axes, "Robots that differ from the simulated one in one way only")
    tidy(axes)
    figure.legend(loc="outside lower center", ncols=4, frameon=False)
    figure.set_label("Targets reached on robots that differ in one way only. " + "; ".join(words) + ".")
    return figure


def describe(report: GapReport) -> str:
    """Return what :func:`plot_gap` shows, in words."""
    parts = []
    for variant in report.rows:
        sim, real = (100 * report.values(variant, place).mean() for place in PLACES)
        parts.append(f"{variant}: {sim:.0f} % of targets reached in simulation, {real:.0f} % on surrogates")
    return "Success in simulation and on surrogates by training. " + "; ".join(parts) + "."
