"""Figures of the real-time patterns. Each function returns the figure and its alternative text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from robotbrain.errors import InputError
from robotbrain.figures import BLUE, BROWN, GREEN, GREY, INK, MAUVE, QUIET, SKY, VERMILLION, new_figure, tidy, title
from robotbrain.pipeline.patterns.ages import safe_speed
from robotbrain.pipeline.patterns.jitter import JitterResult
from robotbrain.pipeline.patterns.queues import QueueResult
from robotbrain.pipeline.patterns.rates import LoopTimes
from robotbrain.pipeline.patterns.results import PatternResult, age_curve
from robotbrain.pipeline.patterns.stages import NS_PER_MS
from robotbrain.pipeline.patterns.timeline import default_label, plot_timeline

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "plot_ages",
    "plot_comparison",
    "plot_jitter",
    "plot_queues",
    "plot_rates",
    "plot_safe_speed",
    "plot_timeline",
]

LINES = (BLUE, VERMILLION, GREEN, MAUVE, BROWN, SKY, INK)
"""Colours of curves."""

DASHES = ("-", (0, (5, 1.5)), (0, (1.2, 1.2)), (0, (6, 1.5, 1.2, 1.5)), (0, (3, 1)), (0, (8, 2)), (0, (2, 3)))
"""Dashes of curves, so that they can be told apart without colour."""

# ------------------------------------------------------------ ages


def plot_ages(
    results: Sequence[PatternResult],
    start_ms: float | None = None,
    span_ms: float = 600.0,
    *,
    labels: Sequence[str] | None = None,
) -> tuple[Figure, str]:
    """Return the saw-tooth of the age at the actuator, a panel for each run, on the same scales.

    Args:
        results: runs.
        start_ms: left end; the end of the warm-up if None.
        span_ms: width.
        labels: by kind if None.
    """
    names = list(labels) if labels is not None else [default_label(run) for run in results]
    begin = results[0].warmup_ns / NS_PER_MS if start_ms is None else start_ms
    figure = new_figure(11, 1.45 * len(results) + 0.6)
    axes = figure.subplots(len(results), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    top = max(run.peak_age_ms for run in results)
    for axis, run, name, colour in zip(axes, results, names, _cycle(LINES, len(results)), strict=True):
        times, ages = age_curve(run.commands)
        axis.plot(times / NS_PER_MS, ages / NS_PER_MS, color=colour, lw=1.6)
        axis.fill_between(times / NS_PER_MS, ages / NS_PER_MS, color=colour, alpha=0.15, lw=0)
        axis.axhline(run.mean_age_ms, color=INK, lw=1, ls=(0, (4, 2)))
        axis.text(
            begin + span_ms * 1.004,
            run.mean_age_ms,
            f"mean {run.mean_age_ms:.0f} ms\npeak {run.peak_age_ms:.0f} ms",
            va="center",
            fontsize=9,
            color=INK,
        )
        title(axis, name)
        tidy(axis)
        axis.set(xlim=(begin, begin + span_ms), ylim=(0, 1.08 * top))
    axes[-1].set_xlabel("time (ms, simulated)")
    figure.supylabel("age of what the robot acts on (ms)", fontsize=10)
    said = "; ".join(
        f"{name}: mean {run.mean_age_ms:.0f} ms, peak {run.peak_age_ms:.0f} ms"
        for name, run in zip(names, results, strict=True)
    )
    return figure, f"Age of the data behind the newest command over time, a saw-tooth for each brain. {said}."


def plot_comparison(results: Sequence[PatternResult], *, labels: Sequence[str] | None = None) -> tuple[Figure, str]:
    """Return bars of throughput, latency and age at the actuator by brain.

    Args:
        results: runs.
        labels: by kind if None.
    """
    names = list(labels) if labels is not None else [default_label(run) for run in results]
    rows = np.arange(len(results))[::-1]
    figure = new_figure(11, 0.5 * len(results) + 1.3)
    left, middle, right = figure.subplots(1, 3, sharey=True)
    panels: list[tuple[Axes, list[float], str, str]] = [
        (left, [run.throughput_hz for run in results], GREEN, "frames used per second"),
        (middle, [float(run.latency_ms.mean()) for run in results], BLUE, "latency, mean (ms, simulated)"),
        (right, [run.mean_age_ms for run in results], BROWN, "age at the actuator (ms, simulated)"),
    ]
    for axes, values, colour, label in panels:
        axes.barh(rows, values, height=0.62, color=colour)
        peaks = [run.peak_age_ms for run in results] if axes is right else values
        for row, value, peak in zip(rows, values, peaks, strict=True):
            if axes is right:
                axes.plot([value, peak], [row, row], color=INK, lw=1.2)
                axes.plot(peak, row, marker="|", color=INK, ms=9, mew=1.5)
            text = f"{value:.1f}" if axes is left else f"{value:.0f}" + (f", peak {peak:.0f}" if axes is right else "")
            axes.text(peak + 0.02 * max(peaks), row, text, va="center", fontsize=9)
        axes.set_xlim(0, max(peaks) * (1.52 if axes is right else 1.2))
        axes.set_xlabel(label)
        tidy(axes)
        axes.grid(False, axis="y")
        axes.tick_params(axis="y", length=0)
    left.set_yticks(rows, names)
    said = "; ".join(
        f"{name}: {run.throughput_hz:.1f} frames per second, latency {run.latency_ms.mean():.0f} ms, age "
        f"{run.mean_age_ms:.0f} ms on average and {run.peak_age_ms:.0f} ms at most"
        for name, run in zip(names, results, strict=True)
    )
    return figure, f"Throughput, latency and age at the actuator by brain. {said}."


def plot_safe_speed(
    a_max: float,
    distances_m: Sequence[float] = (0.25, 0.5, 1.0, 2.0),
    ages_ms: Mapping[str, float] | None = None,
    *,
    longest_ms: float = 500.0,
) -> tuple[Figure, str]:
    """Return the largest safe speed over the age of the data, a curve for each free distance.

    Args:
        a_max: deceleration, m/s².
        distances_m: free distances, m.
        ages_ms: peak ages to mark, by name, ms.
        longest_ms: right end, ms.
    """
    ages = np.linspace(0, longest_ms, 200)
    figure = new_figure(8, 4.2)
    axes = figure.subplots()
    for distance, colour, dashes in zip(distances_m, _cycle(LINES, len(distances_m)), DASHES, strict=False):
        speeds = safe_speed(ages / 1000, distance, a_max)
        axes.plot(ages, speeds, color=colour, ls=dashes, lw=2)
        axes.text(longest_ms * 1.01, speeds[-1], f"{distance:g} m free", va="center", fontsize=9, color=INK)
    top = float(axes.get_ylim()[1])
    for name, age in (ages_ms or {}).items():
        axes.axvline(age, color=QUIET, lw=1, zorder=1)
        label = axes.text(age, 0.02 * top, f"{name} ", rotation=90, va="bottom", ha="right", fontsize=9, color=QUIET)
        label.set_bbox({"facecolor": "white", "edgecolor": "none", "pad": 0.5, "alpha": 0.85})
    axes.set(xlim=(0, longest_ms), ylim=(0, top), xlabel="age of the data when the brakes bite (ms)")
    axes.set_ylabel("largest safe speed (m/s)")
    tidy(axes)
    said = "; ".join(
        f"with {d:g} m free {float(safe_speed(0, d, a_max)):.2f} m/s on fresh data and "
        f"{float(safe_speed(longest_ms / 1000, d, a_max)):.2f} m/s on data {longest_ms:.0f} ms old"
        for d in distances_m
    )
    return figure, f"Largest speed from which a robot that brakes with {a_max:g} m/s² still stops: {said}."


# ------------------------------------------------------------ queues and rates


def plot_queues(results: Sequence[QueueResult]) -> tuple[Figure, str]:
    """Return how old frames are when they are done, and how many wait, over time, by policy.

    Args:
        results: of the same source and consumer.
    """
    names = [
        f"{run.policy} {run.capacity}" if run.policy in ("keep_last", "drop_newest") else run.policy for run in results
    ]
    names = [name.replace("_", " ") for name in names]
    figure = new_figure(11, 4.4)
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    ends = []
    for run, name, colour, dashes in zip(results, names, _cycle(LINES, len(results)), _cycle(DASHES, 99), strict=False):
        times = np.array([out.released_ns for out in run.outputs]) * 1e-9
        left.plot(times, run.latency_ms, color=colour, ls=dashes, lw=1.8, label=name)
        ends.append(float(run.latency_ms[-5:].mean()))
    left.set_yscale("log")
    left.set(xlabel="time (s, simulated)", ylabel="latency of a frame when it is done (ms)")
    _plain(left)
    left.legend(loc="upper left", frameon=False, fontsize=9, ncols=2)
    rows = np.arange(len(results))[::-1]
    lost = [100 * run.lost / run.frames for run in results]
    used = [100 * len(run.outputs) / run.frames for run in results]
    right.barh(rows, used, height=0.62, color=GREEN, label="worked off")
    right.barh(
        rows, lost, height=0.62, left=used, color=VERMILLION, hatch="////", edgecolor="white", lw=0, label="lost"
    )
    waits = [max(0.0, 100 - a - b) for a, b in zip(used, lost, strict=True)]
    starts = [a + b for a, b in zip(used, lost, strict=True)]
    right.barh(rows, waits, height=0.62, left=starts, facecolor="white", edgecolor=GREY, label="still waiting")
    right.set_yticks(rows, names)
    right.set(xlim=(0, 100), xlabel="frames taken by the camera (%)")
    for row, run in zip(rows, results, strict=True):
        right.text(101, row, f"{run.throughput_hz:.1f}/s", va="center", fontsize=9)
    right.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, frameon=False, fontsize=9)
    right.tick_params(axis="y", length=0)
    for axes in (left, right):
        tidy(axes)
    right.grid(False, axis="y")
    said = "; ".join(
        f"{name}: latency {end:.0f} ms at the end, {share:.0f} % lost, {run.throughput_hz:.1f} frames per second"
        for name, end, share, run in zip(names, ends, lost, results, strict=True)
    )
    return figure, f"Latency over time and fate of the frames by queue policy under overload. {said}."


def plot_rates(loops: Sequence[LoopTimes]) -> tuple[Figure, str]:
    """Return the calls of loops over time, a lane each, with the grid that they should be on.

    Args:
        loops: of the same period, e.g. of loop_times for each method.

    Raises:
        InputError: for loops of different periods.
    """
    from matplotlib.ticker import MultipleLocator

    periods = {loop.period_ns for loop in loops}
    if len(periods) != 1:
        raise InputError("loops", given=sorted(periods), expected="loops of one period", fix="Plot others apart.")
    period = periods.pop() / NS_PER_MS
    figure = new_figure(11, 0.55 * len(loops) + 1.0)
    axes = figure.subplots()
    end = max(float(loop.ends_ns[-1]) for loop in loops) / NS_PER_MS
    for point in np.arange(period, end + period / 2, period):
        axes.axvline(point, color="#C8C8C8", lw=1, zorder=0)
    for row, (loop, colour) in enumerate(zip(loops, _cycle(LINES, len(loops)), strict=True)):
        starts, ends = loop.starts_ns / NS_PER_MS, loop.ends_ns / NS_PER_MS
        axes.barh([row] * len(starts), ends - starts, left=starts, height=0.6, color=colour, edgecolor="white", lw=0.8)
        for number, start in enumerate(starts, start=1):
            axes.text(start + 0.02 * period, row - 0.36, f"{number}", fontsize=7.5, color=QUIET, va="bottom")
    axes.set_yticks(range(len(loops)), [loop.method.replace("_", " ") for loop in loops])
    axes.set_ylim(len(loops) - 0.45, -0.75)
    axes.set(xlim=(0, end * 1.01), xlabel="time (ms); lines: every " + f"{period:g} ms; numbers: calls")
    axes.xaxis.set_major_locator(MultipleLocator(period))
    axes.tick_params(axis="y", length=0)
    axes.spines[["top", "right", "left"]].set_visible(False)
    said = "; ".join(
        f"{loop.method}: call {len(loop.starts_ns)} starts at {loop.starts_ns[-1] / NS_PER_MS:.1f} ms" for loop in loops
    )
    return figure, f"Calls of loops with a period of {period:g} ms over time, and the grid they should be on. {said}."


def plot_jitter(results: Sequence[JitterResult], *, labels: Sequence[str] | None = None) -> tuple[Figure, str]:
    """Return how late calls started on this machine: the share of calls that were later, on logarithmic axes.

    Args:
        results: of measure_jitter.
        labels: by method and priority if None.
    """
    names = list(labels) if labels is not None else [f"{run.method}, {run.priority}" for run in results]
    figure = new_figure(8, 4.2)
    axes = figure.subplots()
    for run, name, colour, dashes in zip(results, names, _cycle(LINES, len(results)), _cycle(DASHES, 99), strict=False):
        late = np.sort(np.maximum(run.wakeup_us, 1.0))
        share = 1 - np.arange(len(late)) / len(late)
        axes.step(late, 100 * share, where="pre", color=colour, ls=dashes, lw=1.8, label=name)
    axes.set(xscale="log", yscale="log", xlabel="started late by more than (μs, measured)", ylabel="share of calls (%)")
    _plain(axes, "x", "y")
    axes.legend(frameon=False, fontsize=9)
    tidy(axes)
    said = "; ".join(
        "{}: median {:.0f} μs, 99 % below {:.0f} μs, at most {:.0f} μs".format(name, *run.percentiles_us(50, 99, 100))
        for name, run in zip(names, results, strict=True)
    )
    return figure, f"How late the calls of a loop start on this machine. {said}."


def _plain(axes: Axes, *names: str) -> None:
    from robotbrain.figures import plain_ticks

    plain_ticks(axes, *(names or ("y",)))


def _cycle(values: Sequence[object], count: int) -> list[object]:
    return [values[k % len(values)] for k in range(count)]
