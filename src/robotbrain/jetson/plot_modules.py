"""Figures of modules: a network's latency against power on several of them, and heat over time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from robotbrain.errors import InputError
from robotbrain.figures import (
    BLUE,
    GREEN,
    GREY,
    INK,
    MAUVE,
    QUIET,
    SKY,
    VERMILLION,
    new_figure,
    plain_ticks,
    tidy,
    title,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from robotbrain.jetson.twin.prediction import Prediction
    from robotbrain.jetson.twin.runtime import ThermalModel, ThermalTrace

FAMILY_STYLE: dict[str, tuple[str, str]] = {
    "maxwell": (VERMILLION, "v"),
    "pascal": (SKY, "^"),
    "volta": (GREEN, "s"),
    "ampere": (BLUE, "o"),
    "blackwell": (MAUVE, "D"),
}
"""Colour and marker by family of GPUs."""


def plot_devices(predictions: Sequence[Prediction]) -> Figure:
    """Return latency against power of one network on several modules, with the 80 % intervals of the latency.

    Power modes of one module are joined by a line. Dotted lines are of equal energy for each inference.

    Raises:
        InputError: for no predictions.
    """
    if not predictions:
        raise InputError("predictions", given=[], expected="at least one", fix="Compare on one module or more.")
    order = sorted(predictions, key=lambda p: (p.latency_ms, p.device, p.mode))
    figure = new_figure(10.0, max(5.2, 0.27 * len({p.device for p in order}) + 1.8))
    axes: Axes = figure.subplots()
    axes.set(xscale="log", yscale="log")
    power = np.array([p.power_w for p in order])
    axes.set_xlim(0.75 * power.min(), 1.3 * power.max())
    low, high = min(p.latency_low_ms for p in order), max(p.latency_high_ms for p in order)
    axes.set_ylim(0.8 * low, 1.25 * high)
    for device in dict.fromkeys(p.device for p in order):
        modes = sorted((p for p in order if p.device == device), key=lambda p: p.power_w)
        colour, _ = FAMILY_STYLE[modes[0].module.family]
        if len(modes) > 1:
            axes.plot([p.power_w for p in modes], [p.latency_ms for p in modes], color=colour, lw=1, alpha=0.6)
    few = len(order) <= 20
    for p in order:
        colour, marker = FAMILY_STYLE[p.module.family]
        bars = [[p.latency_ms - p.latency_low_ms], [p.latency_high_ms - p.latency_ms]]
        axes.errorbar(
            [p.power_w], [p.latency_ms], yerr=bars, fmt=marker, ms=7 if few else 5, color=colour, mec=colour, zorder=3,
            mfc=colour if p.fits else "white", ecolor=(colour, 1.0 if few else 0.3), capsize=2.5 if few else 0, lw=1.1,
        )  # fmt: skip
    _energy_lines(axes)
    _device_labels(axes, order)
    _device_legend(axes, order)
    axes.set_xlabel("power of the module (W)")
    axes.set_ylabel("latency (ms), bars: 80 % interval")
    plain_ticks(axes, "x", "y")
    tidy(axes)
    first, last = order[0], order[-1]
    batch = "" if first.batch == 1 else f", batch {first.batch}"
    title(axes, f"{first.model} in {first.precision}{batch}, timed as by {first.harness}")
    best = min(order, key=lambda p: p.energy_mj)
    failing = ", ".join(dict.fromkeys(p.device for p in order if not p.fits))
    modules = len({p.device for p in order})
    figure.set_label(
        f"Latency against power of {first.model} in {first.precision} on {modules} modules, from "
        f"{first.latency_ms:.3g} ms on {first.device} to {last.latency_ms:.3g} ms on {last.device}; least energy on "
        f"{best.device}, {best.energy_mj:.3g} mJ for each inference."
        + (f" Out of memory: {failing}." if failing else "")
    )
    return figure


def _energy_lines(axes: Axes) -> None:
    """Draw lines of equal power times latency (W x ms = mJ), labelled at the lower edge."""
    (x0, x1), (y0, y1) = axes.get_xlim(), axes.get_ylim()
    for decade in range(math.floor(math.log10(x0 * y0)), math.ceil(math.log10(x1 * y1)) + 1):
        energy = 10.0**decade
        axes.plot([x0, x1], [energy / x0, energy / x1], color=GREY, lw=0.8, ls=":", zorder=1)
        # The label stands where the line leaves: at the lower edge, else at the right one.
        leaves_below = energy / y0 < x1
        at = (energy / y0, y0) if leaves_below else (x1, energy / x1)
        if at[0] > 1.25 * x0 and at[1] < 0.8 * y1:
            axes.annotate(
                f"{energy:g} mJ" if energy < 1000 else f"{energy / 1000:g} J",
                at, xytext=(-8, 4) if leaves_below else (-3, -9), textcoords="offset points", fontsize=7.5, color=QUIET,
                ha="right", bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5},
            )  # fmt: skip
    axes.set_xlim(x0, x1)
    axes.set_ylim(y0, y1)


def _device_labels(axes: Axes, order: Sequence[Prediction]) -> None:
    """Name each module once, in a column at the right that leaves no two names on top of each other."""
    fastest: list[Prediction] = []
    for p in order:
        if p.device not in {other.device for other in fastest}:
            fastest.append(p)
    lower, upper = (math.log10(value) for value in axes.get_ylim())
    wanted = [(math.log10(p.latency_ms) - lower) / (upper - lower) for p in fastest]
    for p, at in zip(fastest, spread(wanted, 1.0 / max(18.0, len(fastest) + 1.0)), strict=True):
        mark = "" if p.fits else "  out of memory"
        axes.annotate(
            f"{p.device}{mark}", (p.power_w, p.latency_ms), xycoords="data", xytext=(1.03, at),
            textcoords="axes fraction", va="center", fontsize=8.5, color=INK, annotation_clip=False,
            arrowprops={"arrowstyle": "-", "color": FAMILY_STYLE[p.module.family][0], "lw": 0.6, "alpha": 0.55,
                        "shrinkB": 4, "shrinkA": 1, "relpos": (0.0, 0.5)},
        )  # fmt: skip


def spread(wanted: Sequence[float], gap: float) -> list[float]:
    """Return places near the wanted ones (ascending), at least ``gap`` apart, moved as little as that allows.

    Neighbours that collide form a block around the mean of what they want; blocks that collide merge. The places stay
    within 0 and 1 if they fit there.
    """
    blocks: list[tuple[float, int]] = []  # (centre, how many)
    for value in wanted:
        blocks.append((value, 1))
        while len(blocks) > 1:
            (left, m), (right, n) = blocks[-2:]
            if right - left >= gap * (m + n) / 2:
                break
            blocks[-2:] = [((m * left + n * right) / (m + n), m + n)]
    places: list[float] = []
    for centre, count in blocks:
        half = gap * (count - 1) / 2
        places += [centre - half + gap * i for i in range(count)]
    for index in range(len(places)):  # up from the lower edge, then down from the upper
        places[index] = max(places[index], gap * (index + 0.5), *([places[index - 1] + gap] if index else []))
    for index in reversed(range(len(places))):
        last = index == len(places) - 1
        places[index] = min(places[index], 1.0 - gap * 0.5 if last else places[index + 1] - gap)
    return places


def _device_legend(axes: Axes, order: Sequence[Prediction]) -> None:
    from matplotlib.lines import Line2D

    families = [family for family in FAMILY_STYLE if any(p.module.family == family for p in order)]
    handles = [
        Line2D([], [], ls="", marker=FAMILY_STYLE[f][1], color=FAMILY_STYLE[f][0], ms=7, label=f.capitalize())
        for f in families
    ]
    handles.append(Line2D([], [], ls=":", color=GREY, label="equal energy"))
    if not all(p.fits for p in order):
        handles.append(Line2D([], [], ls="", marker="o", mfc="white", color=INK, ms=7, label="out of memory"))
    axes.legend(
        handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.11), ncol=len(handles), fontsize=8.5,
        frameon=False, handletextpad=0.4, columnspacing=1.6,
    )  # fmt: skip


def plot_heat(trace: ThermalTrace, model: ThermalModel | None = None, subject: str = "") -> Figure:
    """Return temperature, GPU clock and power over time; shaded where clocks are lowered.

    Args:
        trace: of twin.simulate_heat.
        model: whose trip points to draw.
        subject: for the title.
    """
    figure = new_figure(9.0, 5.6)
    top, middle, bottom = figure.subplots(3, 1, sharex=True, height_ratios=(2.2, 1.0, 1.0))
    unit, scale = ("min", 60.0) if trace.time_s[-1] > 300 else ("s", 1.0)
    t = trace.time_s / scale
    top.plot(t, trace.temperature_c, color=VERMILLION, lw=1.8, label="chip")
    if model is not None:
        trips = (("clocks are lowered", model.throttle_c, "--"), ("shutdown", model.shutdown_c, "-"))
        for name, value, dashes in trips:
            if value < max(trace.temperature_c) + 25:
                top.axhline(value, color=INK, lw=1, ls=dashes, label=f"{name} at {value:g} °C")
        top.axhline(model.ambient_c, color=QUIET, lw=1, ls=":", label=f"air, {model.ambient_c:g} °C")
    middle.step(t, 100 * trace.clock, where="post", color=BLUE, lw=1.5)
    bottom.step(t, trace.power_w, where="post", color=GREEN, lw=1.5)
    top.set_ylabel("temperature (°C)")
    middle.set_ylabel("GPU clock (%)")
    middle.set_ylim(0, 108)
    bottom.set_ylabel("power (W)")
    bottom.set_ylim(0, 1.15 * max(float(np.max(trace.power_w)), 1e-3))
    bottom.set_xlabel(f"time ({unit})")
    bottom.set_xlim(float(t[0]), float(t[-1]))
    for axes in (top, middle, bottom):
        tidy(axes)
        axes.fill_between(
            t, 0, 1, where=trace.clock < 1.0, step="post", transform=axes.get_xaxis_transform(), color=VERMILLION,
            alpha=0.15, lw=0, label="clocks lowered" if axes is top and trace.throttled_s > 0 else None,
        )  # fmt: skip
    top.legend(fontsize=8, loc="lower right", framealpha=0.9, edgecolor="#cccccc")
    title(top, f"Heat{': ' + subject if subject else ''}")
    figure.align_ylabels()
    of, chip = (f" of {subject}" if subject else ""), trace.temperature_c
    figure.set_label(
        f"Temperature{of} over {t[-1]:.3g} {unit}: from {chip[0]:.0f} to {chip[-1]:.0f} degrees Celsius, "
        f"at most {chip.max():.0f}; clocks were lowered for {trace.throttled_s:.0f} s, at the end they stand at "
        f"{100 * trace.clock[-1]:.0f} %." + (" The module shut down." if trace.shut_down else "")
    )
    return figure
