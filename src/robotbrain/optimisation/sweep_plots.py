"""The figure of a sweep: accuracy lost against time taken, on this machine and on a Jetson."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from robotbrain.errors import InputError
from robotbrain.figures import BLUE, GREEN, INK, QUIET, VERMILLION, new_figure, plain_ticks, tidy, title
from robotbrain.optimisation.sweep import NEAR, best_row, complete, front_of, latency_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Row = Mapping[str, Any]

COLOURS = {"fp32": BLUE, "int8": VERMILLION}
"""By the type of the numbers."""

PRECISION_WORDS = {"fp32": "no Q/DQ: FP32 here, FP16 on a Jetson", "int8": "INT8"}
MARKERS = {"as it is": "o", "channels removed": "s", "zeros in the weights": "^", "another width": "D", "teacher": "*"}

_TEXT = 9.5  # points
_DIRECTIONS = 24
_RADII = (9.0, 13.0, 19.0, 27.0, 38.0, 52.0, 70.0, 92.0)  # points

FAR = 12.0
"""Points of mIoU beyond which the axis of losses is compressed."""

Box = tuple[float, float, float, float]
"""x0, y0, x1, y1 in pixels."""


def plot_sweep(rows: Sequence[Row], module: str | None = None) -> Figure:
    """Draw accuracy drop against latency, on this machine (measured) and on a Jetson (predicted by the twin).

    Marker areas grow with what the weights take in the precision they run in. The Pareto front is drawn and labelled;
    so are the teacher and the student that never met it, wherever they are.

    Args:
        rows: of a sweep.
        module: slug of the Jetson; the last of the sweep's if None.

    Raises:
        InputError: for no complete rows, or a module that the sweep has no figures for.
    """
    good = complete(rows)
    if not good:
        raise InputError("rows", given=len(rows), expected="at least one without an error", fix="Run the sweep again.")
    modules = list(good[0]["twin_ms"])
    module = modules[-1] if module is None else module
    if module not in modules:
        raise InputError("module", given=module, expected=" or ".join(modules), fix="Sweep with --modules to add it.")
    from robotbrain.jetson.catalogue import load_module

    figure = new_figure(13.3, 7.0)
    panels = figure.subplots(1, 2, sharey=True)
    name = load_module(module).name
    places = (("host", "This machine, one thread: measured"), (module, f"{name}: predicted by the twin"))
    for axes, (where, words) in zip(panels, places, strict=True):
        _panel(axes, good, where)
        title(axes, words)
    panels[0].set_ylabel("accuracy lost against the teacher (points of mIoU)", fontsize=11)
    figure.suptitle(_headline(good), x=0.01, ha="left", fontsize=14, color=INK)
    _legend(figure, good)
    figure.set_label(_alt_text(good, module, name))
    figure.draw_without_rendering()  # the layout, which the labels then need as it is
    figure.set_layout_engine("none")
    for axes, (where, _) in zip(panels, places, strict=True):
        _label_points(axes, good, where)
    return figure


def short_label(row: Row) -> str:
    """Return a row's label without what goes without saying."""
    words = str(row["label"]).split(", ")
    return ", ".join(words[1:] if len(words) > 1 and words[0] == "student" else words)


def family_of(row: Row) -> str:
    """Return which of MARKERS a row gets: what was done to the network's shape or weights."""
    recipe = row["recipe"]
    if recipe["prune_channels"]:
        return "channels removed"
    if recipe["sparsity"] is not None:
        return "zeros in the weights"
    if isinstance(recipe["student"], int):
        return "another width"
    return "teacher" if recipe["student"] == "teacher" else "as it is"


def marker_area(weights_bytes: float) -> float:
    """Return the area of a marker in points squared: with the square root, for a teacher is 100 times a student."""
    return 0.14 * math.sqrt(max(weights_bytes, 1.0)) + 18.0


def place_labels(
    points: Sequence[tuple[float, float]],
    sizes: Sequence[tuple[float, float]],
    obstacles: Sequence[Box],
    bounds: Box,
    unit: float = 1.0,
) -> list[Box]:
    """Return where labels go so that they cover neither each other nor an obstacle, near their points.

    Each takes the nearest free place around its point; crowded ones choose first.

    Args:
        points: (x, y) of each, pixels.
        sizes: (width, height) of each label, pixels.
        obstacles: boxes to keep clear of: markers.
        bounds: to stay within.
        unit: pixels in a point.

    Returns:
        A box for each label. Where nothing is free, the place that covers least.
    """
    taken = list(obstacles)
    boxes: dict[int, Box] = {}

    def crowding(index: int) -> float:
        x, y = points[index]
        return sum(1.0 / (1.0 + math.hypot(x - a, y - b)) for a, b in points)

    for index in sorted(range(len(points)), key=crowding, reverse=True):
        candidates = _around(points[index], sizes[index], unit)
        costs = [_cost(box, taken, bounds) for box in candidates]
        best = min(range(len(candidates)), key=lambda k: (costs[k], k))
        boxes[index] = candidates[best]
        taken.append(candidates[best])
    return [boxes[index] for index in range(len(points))]


def overlap(one: Box, other: Box) -> float:
    """Return the area that two boxes share."""
    width = min(one[2], other[2]) - max(one[0], other[0])
    height = min(one[3], other[3]) - max(one[1], other[1])
    return max(width, 0.0) * max(height, 0.0)


# ---- pieces ----


def _panel(axes: Axes, rows: Sequence[Row], where: str) -> None:
    able = [row for row in rows if latency_of(row, where) is not None]
    axes.set_xscale("log")
    for row in sorted(able, key=lambda r: -r["weights_bytes"]):
        axes.scatter(
            _ms(row, where),
            row["drop"],
            s=_area(row),
            marker=MARKERS[family_of(row)],
            color=COLOURS[row["precision"]],
            alpha=0.8,
            edgecolors="white",
            linewidths=0.8,
            zorder=3,
        )
    front = front_of(rows, where)
    axes.step(
        [_ms(row, where) for row in front],
        [row["drop"] for row in front],
        where="post",
        color=INK,
        lw=1.2,
        alpha=0.6,
        zorder=2,
        label="Pareto front",
    )
    tidy(axes)
    times = [_ms(row, where) for row in able]
    axes.set_xlim(min(times) / 1.35, max(times) * 1.5)
    low, high = min(row["drop"] for row in rows), max(row["drop"] for row in rows)
    if high > FAR:  # a composition that failed must not flatten all others
        _compress(axes)
    room = high - low
    axes.set_ylim(low - 0.1 - (0.02 if high > FAR else 0.10) * room, high + 0.1 + 0.07 * room)
    plain_ticks(axes, "x")
    axes.tick_params(labelsize=10)
    axes.set_xlabel("time of one inference (ms)", fontsize=11)
    axes.axhspan(axes.get_ylim()[0], NEAR, color=GREEN, alpha=0.07, lw=0, zorder=0)
    place = axes.get_xlim()[1], axes.get_ylim()[0]
    words = f"at most {NEAR:g} point lost "
    axes.annotate(words, place, (0, 5), textcoords="offset points", ha="right", color="#00634A", fontsize=9)


def _compress(axes: Axes) -> None:
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    axes.set_yscale("symlog", linthresh=2.0, linscale=1.0)
    axes.yaxis.set_major_locator(FixedLocator([0.0, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0]))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_locator(NullLocator())


def _ms(row: Row, where: str) -> float:
    value = latency_of(row, where)
    assert value is not None  # rows that cannot run there are not drawn
    return value


def _area(row: Row) -> float:
    return marker_area(row["weights_bytes"]) * (1.9 if family_of(row) == "teacher" else 1.0)  # a star is thin


def _label_points(axes: Axes, rows: Sequence[Row], where: str) -> None:
    labelled = {row["label"]: row for row in front_of(rows, where)}
    labelled |= {row["label"]: row for row in rows if row["label"] in ("teacher", "student (no teacher)", "student")}
    chosen = [row for row in labelled.values() if latency_of(row, where) is not None]
    able = [row for row in rows if latency_of(row, where) is not None]
    figure = axes.figure
    unit = figure.dpi / 72.0

    def pixel(row: Row) -> tuple[float, float]:
        x, y = axes.transData.transform((_ms(row, where), row["drop"]))
        return float(x), float(y)

    def marker_box(row: Row) -> Box:
        (x, y), half = pixel(row), 0.5 * math.sqrt(_area(row)) * unit
        return x - half, y - half, x + half, y + half

    frames = [text.get_window_extent() for text in axes.texts]
    written: list[Box] = [(frame.x0, frame.y0, frame.x1, frame.y1) for frame in frames]
    texts = [axes.text(0.0, 0.0, short_label(row), fontsize=_TEXT, color=INK, zorder=5) for row in chosen]
    extents = [text.get_window_extent() for text in texts]
    sizes = [(extent.width + 4.0 * unit, extent.height + 2.0 * unit) for extent in extents]
    inside = axes.get_window_extent()
    points = [pixel(row) for row in chosen]
    bounds = (inside.x0, inside.y0, inside.x1, inside.y1)
    steps = [pixel(row) for row in front_of(rows, where)]
    lines: list[Box] = []
    for (x0, y0), (x1, y1) in pairwise(steps):  # right, then down: as it is drawn
        lines += [(x0, y0 - unit, x1, y0 + unit), (x1 - unit, y1, x1 + unit, y0)]
    boxes = place_labels(points, sizes, [*written, *lines, *(marker_box(row) for row in able)], bounds, unit)
    back = axes.transData.inverted()
    for text, box, (x, y) in zip(texts, boxes, points, strict=True):
        text.set_position(tuple(back.transform((0.5 * (box[0] + box[2]), 0.5 * (box[1] + box[3])))))
        text.set(horizontalalignment="center", verticalalignment="center")
        near = (min(max(x, box[0]), box[2]), min(max(y, box[1]), box[3]))
        if math.hypot(near[0] - x, near[1] - y) > 7.0 * unit:
            start, end = back.transform((x, y)), back.transform(near)
            axes.plot([start[0], end[0]], [start[1], end[1]], color=QUIET, lw=0.6, zorder=2.5)


def _around(point: tuple[float, float], size: tuple[float, float], unit: float) -> list[Box]:
    """Return boxes around a point, the nearest first; right and above before left and below."""
    x, y = point
    width, height = size
    found = []
    for radius in _RADII:
        for k in range(_DIRECTIONS):
            turn = (k + 1) // 2 * (-1) ** k  # from the right, upwards and downwards in turn
            angle = 2.0 * math.pi * turn / _DIRECTIONS
            # The box lies outside the circle: its nearest side or corner is `radius` away.
            cx = x + math.cos(angle) * (radius * unit + 0.5 * width)
            cy = y + math.sin(angle) * (radius * unit + 0.5 * height)
            found.append((cx - 0.5 * width, cy - 0.5 * height, cx + 0.5 * width, cy + 0.5 * height))
    return found


def _cost(box: Box, taken: Sequence[Box], bounds: Box) -> float:
    area = (box[2] - box[0]) * (box[3] - box[1])
    return sum(overlap(box, other) for other in taken) + 4.0 * (area - overlap(box, bounds))


def _legend(figure: Figure, rows: Sequence[Row]) -> None:
    from matplotlib.lines import Line2D

    def dot(marker: str, colour: str, area: float, label: str) -> Line2D:
        return Line2D([], [], ls="", marker=marker, color=colour, ms=math.sqrt(area), mec="white", label=label)

    families = {family_of(row) for row in rows}
    used = {row["precision"] for row in rows}
    entries = [dot("o", colour, 60.0, PRECISION_WORDS[p]) for p, colour in COLOURS.items() if p in used]
    entries += [dot(m, QUIET, 140.0 if m == "*" else 60.0, name) for name, m in MARKERS.items() if name in families]
    sizes = [row["weights_bytes"] for row in rows]
    shown = [s for s in (10e3, 100e3, 1e6, 4e6) if min(sizes) / 2 <= s <= 2 * max(sizes)]
    entries += [dot("o", "#BBBBBB", marker_area(s), f"{s / 1e3:,.0f} kB of weights") for s in shown]
    entries.append(Line2D([], [], color=INK, lw=1.2, alpha=0.6, label="Pareto front"))
    columns = math.ceil(len(entries) / 2)
    figure.legend(handles=entries, loc="outside lower center", ncols=columns, frameon=False, fontsize=9, labelcolor=INK)


def _headline(rows: Sequence[Row]) -> str:
    best = best_row(rows)
    faster = f"{best['host_speedup']:.1f} times faster than the teacher on this machine"
    lost = f"{best['drop']:.1f} points lost" if best["drop"] > 0.05 else "nothing lost"
    return f"Best of {len(rows)} within {NEAR:g} point: {best['label']}. {faster}, {lost}"


def _alt_text(rows: Sequence[Row], module: str, name: str) -> str:
    host, jetson = front_of(rows, "host"), front_of(rows, module)

    def words(front: Sequence[Row], where: str) -> str:
        return "; ".join(f"{short_label(r)}: {latency_of(r, where):.3g} ms, {r['drop']:+.1f} points" for r in front)

    return (
        f"Two scatter plots of {len(rows)} compositions: points of mIoU lost against the teacher over milliseconds of "
        f"one inference. Pareto front on this machine, fastest first: {words(host, 'host')}. On {name}, as the twin "
        f"predicts: {words(jetson, module)}."
    )
