"""Figures of one network on one module: roofline and timeline."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robotbrain.figures import BLUE, GREY, INK, MAUVE, QUIET, SKY, new_figure, plain_ticks, tidy, title
from robotbrain.jetson.kernels import PRECISIONS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

    from robotbrain.jetson.twin.prediction import KernelTime, Prediction

BOUNDS: dict[str, tuple[str, str]] = {
    "compute": (BLUE, "o"),
    "memory": (SKY, "s"),
    "launch": (MAUVE, "^"),
}
"""Colour and marker by what bounds a kernel."""

LANES: dict[str, str] = {
    "conv": "convolution",
    "dw": "depthwise\nconvolution",
    "mm": "matrix\nproduct",
    "pw": "pointwise",
    "mem": "data\nmovement",
}
"""Rows of the timeline, by class of kernel."""

_NUMBERED = 5


def _subject(prediction: Prediction) -> str:
    batch = "" if prediction.batch == 1 else f", batch {prediction.batch}"
    return f"{prediction.model} in {prediction.precision}{batch} on {prediction.device}, mode {prediction.mode}"


def _share(prediction: Prediction, bound: str) -> str:
    times = [time.total_ms for time in prediction.kernels if time.bound == bound]
    whole = sum(time.total_ms for time in prediction.kernels)
    return f"{bound} ({len(times)} kernel{'s' * (len(times) != 1)}, {100 * sum(times) / whole:.0f} % of their time)"


def plot_prediction(prediction: Prediction) -> Figure:
    """Return roofline and timeline of a prediction in one figure."""
    figure = new_figure(10.0, 9.6)
    halves = figure.subfigures(2, 1, height_ratios=(1.5, 1.0), squeeze=False)[:, 0]
    words = [_draw_roofline(halves[0], prediction), _draw_timeline(halves[1], prediction)]
    figure.set_label(" ".join(words))
    return figure


# ---- roofline ----


def plot_roofline(prediction: Prediction) -> Figure:
    """Return the roofline of a module's power mode with each kernel on it.

    A dot is a kernel at its arithmetic intensity (FLOP per byte moved) and the rate it reaches; its area goes with its
    time. Kernels without arithmetic have no place on these axes: they stand in a strip beside it, at the bandwidth they
    reach. After Williams, Waterman and Patterson, Roofline, CACM 52(4), 2009.
    """
    figure = new_figure(10.0, 5.8)
    figure.set_label(_draw_roofline(figure, prediction))
    return figure


def _draw_roofline(figure: Figure | SubFigure, prediction: Prediction) -> str:
    where = prediction.where
    computing = [time for time in prediction.kernels if time.flops > 0]
    moving = [time for time in prediction.kernels if time.flops <= 0]
    ratios = (4.6, 1.0) if moving else (1.0,)
    axes = figure.subplots(1, len(ratios), width_ratios=ratios, squeeze=False)[0]
    main: Axes = axes[0]
    longest = max(time.total_ms for time in prediction.kernels)
    intensity = np.array([time.flops / max(1.0, time.bytes_moved) for time in computing])
    rate = np.array([_rate(time.flops, time.total_ms) for time in computing])
    used = sorted({PRECISIONS.index(time.precision) for time in prediction.kernels})
    roofs = {PRECISIONS[index]: where.peak[index] / 1e9 for index in used}
    gbs = where.bandwidth / 1e9
    ridges = {name: peak / gbs for name, peak in roofs.items()}
    low = min([0.3 * min(ridges.values()), *(0.5 * intensity)])
    high = max([4.0 * max(ridges.values()), *(2.0 * intensity)])
    _draw_roofs(main, roofs, gbs, low, high)
    cuda = {PRECISIONS[i]: where.cuda_peak[i] / 1e9 for i in used}
    top_peak = max(roofs.values())
    if any(time.kernel.op == "dw" for time in computing) and max(cuda.values()) < 0.99 * top_peak:
        level = max(cuda.values())
        main.plot([level / gbs, high], [level, level], color=QUIET, lw=1.2, ls=(0, (4, 3)))
        main.annotate(
            f"CUDA cores (depthwise) {_flops(level)}",
            (level / gbs, level), xytext=(-6, 1), textcoords="offset points", ha="right", fontsize=8.5, color=QUIET,
        )  # fmt: skip
    if computing:
        _scatter(main, computing, intensity, rate, longest)
    else:
        main.text(0.5, 0.4, "no kernel does arithmetic", transform=main.transAxes, ha="center", color=QUIET)
    main.set(xscale="log", yscale="log", xlim=(low, high))
    floor = min([0.5 * low * gbs, *(0.4 * rate)])
    main.set_ylim(max(floor, 1e-6 * top_peak), 2.2 * top_peak)
    plain_ticks(main, "x", "y")
    main.set_xlabel("arithmetic intensity (FLOP/byte)")
    main.set_ylabel("rate reached (GFLOP/s)")
    tidy(main)
    _legend(main, prediction, longest)
    title(main, f"Roofline: {_subject(prediction)}")
    if moving:
        _draw_moving(axes[1], moving, longest, gbs)
    bounds = "; ".join(_share(prediction, bound) for bound in BOUNDS)
    roof_words = ", ".join(f"{_flops(peak, name)} in {name}" for name, peak in roofs.items())
    best = f"The fastest kernel reaches {100 * max(rate / top_peak):.0f} % of the peak. " if len(rate) else ""
    return (
        f"Roofline of {_subject(prediction)}. Roofs: {roof_words} and {gbs:.3g} GB/s, ridge at "
        f"{max(ridges.values()):.3g} FLOP/byte. {len(computing)} kernels with arithmetic, {len(moving)} that only move "
        f"data. Bound by {bounds}. {best}".strip()
    )


def _rate(amount: float, ms: float) -> float:
    """Return giga-units per second."""
    return amount / 1e6 / ms


def _flops(giga: float, precision: str = "") -> str:
    unit = "OP/s" if precision == "int8" else "FLOP/s"
    return f"{giga:.3g} G{unit}" if giga < 1000 else f"{giga / 1000:.3g} T{unit}"


def _draw_roofs(axes: Axes, roofs: dict[str, float], gbs: float, low: float, high: float) -> None:
    top = max(roofs.values())
    axes.plot([low, top / gbs], [low * gbs, top], color=INK, lw=1.6)
    for name, peak in roofs.items():
        ridge = peak / gbs
        axes.plot([ridge, high], [peak, peak], color=INK, lw=1.6)
        axes.plot([ridge], [peak], marker="D", ms=6, color="white", mec=INK, zorder=4)
        axes.annotate(
            f"{name} peak {_flops(peak, name)}",
            (high, peak), xytext=(0, 4), textcoords="offset points", ha="right", fontsize=8.5, color=INK,
        )  # fmt: skip
        axes.annotate(
            f"ridge {ridge:.3g} FLOP/byte",
            (ridge, peak), xytext=(-6, 5), textcoords="offset points", ha="right", fontsize=8.5, color=INK,
        )  # fmt: skip
    at = low * (top / gbs / low) ** 0.35
    axes.annotate(
        f"memory {gbs:.3g} GB/s",
        (at, at * gbs), xytext=(-6, 3), textcoords="offset points", ha="right", fontsize=8.5, color=INK,
    )  # fmt: skip


def _areas(times: Sequence[KernelTime], longest: float) -> NDArray[np.float64]:
    return np.array([10.0 + 240.0 * time.total_ms / longest for time in times])


def _scatter(
    axes: Axes, times: Sequence[KernelTime], x: NDArray[np.float64], y: NDArray[np.float64], longest: float
) -> None:
    areas = _areas(times, longest)
    for bound, (colour, marker) in BOUNDS.items():
        chosen = np.array([time.bound == bound for time in times], dtype=bool)
        if chosen.any():
            axes.scatter(
                x[chosen], y[chosen], s=areas[chosen], c=colour, marker=marker, alpha=0.65, ec="white",
                lw=0.6 if len(times) < 100 else 0.2,
                zorder=3,
            )  # fmt: skip


def _legend(axes: Axes, prediction: Prediction, longest: float) -> None:
    from matplotlib.lines import Line2D

    handles: list[Any] = [
        Line2D([], [], ls="", marker=marker, color=colour, ms=7, label=_share(prediction, bound))
        for bound, (colour, marker) in BOUNDS.items()
    ]
    legend = axes.legend(
        handles=handles, loc="lower right", fontsize=8, title=f"bound by (area: time, largest {longest:.3g} ms)",
        title_fontsize=8, framealpha=0.9, edgecolor="#cccccc",
    )  # fmt: skip
    legend.get_title().set_color(INK)


def _draw_moving(axes: Axes, moving: Sequence[KernelTime], longest: float, gbs: float) -> None:
    # Spread over the strip in the order in which they run: there is no quantity along x.
    x = (np.arange(len(moving)) + 0.5) / len(moving)
    y = np.array([_rate(time.bytes_moved, time.total_ms) for time in moving])
    _scatter(axes, moving, x, np.maximum(y, 1e-9), longest)
    axes.axhline(gbs, color=INK, lw=1.6)
    axes.annotate(
        f"{gbs:.3g} GB/s", (1, gbs), xycoords=("axes fraction", "data"), xytext=(0, 4), textcoords="offset points",
        ha="right", fontsize=8.5, color=INK,
    )  # fmt: skip
    axes.set(yscale="log", xlim=(-0.08, 1.08), xticks=[])
    axes.set_ylim(min([0.5 * gbs, *(0.4 * y[y > 0])]), 2.2 * gbs)
    plain_ticks(axes, "y")
    axes.set_xlabel("in order")
    axes.set_ylabel("bandwidth reached (GB/s)")
    tidy(axes)
    title(axes, "only move data")


# ---- timeline ----


def plot_timeline(prediction: Prediction) -> Figure:
    """Return when each kernel runs: a lane for each class of kernel, launches on a lane of their own."""
    figure = new_figure(10.0, 4.2)
    figure.set_label(_draw_timeline(figure, prediction))
    return figure


def _draw_timeline(figure: Figure | SubFigure, prediction: Prediction) -> str:
    axes: Axes = figure.subplots()
    times = prediction.kernels
    total = np.array([time.total_ms for time in times])
    launch = np.array([time.launch_ms for time in times])
    begin = prediction.fixed_ms + np.concatenate([[0.0], np.cumsum(total)[:-1]])
    end = float(begin[-1] + total[-1])
    kinds = [time.kernel.op.partition(":")[0] for time in times]
    lanes = [kind for kind in LANES if kind in kinds]
    height = 0.72
    axes.broken_barh(
        list(zip(begin.tolist(), launch.tolist(), strict=True)), (-height / 2, height), facecolors=GREY, lw=0,
        label=f"launches ({launch.sum():.3g} ms)",
    )  # fmt: skip
    axes.broken_barh([(0.0, prediction.fixed_ms)], (-height / 2, height), facecolors="#555555", lw=0)
    # A kernel shorter than a pixel or so would vanish: a thin line of its own colour keeps it visible.
    edge = 0.3 if len(times) > 120 else 0.6
    for bound, (colour, _) in BOUNDS.items():
        for lane, kind in enumerate(lanes, start=1):
            chosen = [i for i, time in enumerate(times) if time.bound == bound and kinds[i] == kind]
            spans = [(float(begin[i] + launch[i]), float(max(total[i] - launch[i], 0.0))) for i in chosen]
            if spans:
                axes.broken_barh(spans, (lane - height / 2, height), facecolors=colour, edgecolors=colour, lw=edge)
    _number_slowest(axes, prediction, begin, [lanes.index(kind) + 1 for kind in kinds], height, end)
    axes.set_yticks(range(len(lanes) + 1), ["start and\nlaunches", *(LANES[lane] for lane in lanes)], fontsize=8.5)
    axes.set_xlim(0, end)
    axes.set_ylim(-0.6, len(lanes) + 0.85)
    axes.set_xlabel("time (ms); the numbers name the slowest kernels")
    tidy(axes)
    axes.grid(False, axis="y")
    count = "1 kernel" if len(times) == 1 else f"{len(times)} kernels"
    title(axes, f"Timeline: {_subject(prediction)}, {count} in {end:.3g} ms (predicted)")
    _timeline_legend(axes, prediction, float(launch.sum()))
    slow = max(range(len(times)), key=lambda i: times[i].total_ms)
    return (
        f"Timeline of {_subject(prediction)}: {count} in {end:.3g} ms, of which the launches take "
        f"{launch.sum():.3g} ms and the start {prediction.fixed_ms:.3g} ms. The slowest kernel is number {slow} "
        f"({times[slow].kernel.name or times[slow].kernel.op}) with {times[slow].total_ms:.3g} ms."
    )


def _number_slowest(
    axes: Axes, prediction: Prediction, begin: NDArray[np.float64], lane: Sequence[int], height: float, end: float
) -> None:
    """Number the slowest kernels above their bars, where there is room between the numbers."""
    times = prediction.kernels
    order = sorted(range(len(times)), key=lambda i: (-times[i].total_ms, i))
    placed: list[tuple[int, float]] = []
    for index in order:
        middle = float(begin[index]) + (times[index].launch_ms + times[index].total_ms) / 2
        if len(placed) == _NUMBERED:
            break
        if any(lane[index] == other and abs(middle - x) < 0.025 * end for other, x in placed):
            continue
        placed.append((lane[index], middle))
        axes.annotate(
            str(index), (middle, lane[index] + height / 2), xytext=(0, 1.5), textcoords="offset points", ha="center",
            fontsize=8, color=INK,
        )  # fmt: skip


def _timeline_legend(axes: Axes, prediction: Prediction, launch_ms: float) -> None:
    from matplotlib.patches import Patch

    handles = [Patch(color=colour, label=f"bound by {bound}") for bound, (colour, _) in BOUNDS.items()]
    handles += [
        Patch(color=GREY, label=f"launches, {launch_ms:.3g} ms"),
        Patch(color="#555555", label=f"start of an inference, {prediction.fixed_ms:.3g} ms"),
    ]
    axes.legend(
        handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.2), ncol=5, fontsize=8, frameon=False,
        handlelength=1.2, columnspacing=1.4,
    )  # fmt: skip
