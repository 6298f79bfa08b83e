"""Timelines of brains: what each stage did when, and the way of one frame through them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from robotbrain.figures import BLUE, BROWN, GREEN, INK, MAUVE, QUIET, SKY, VERMILLION, new_figure, tidy, title
from robotbrain.pipeline.patterns.results import PatternResult, Span
from robotbrain.pipeline.patterns.stages import NS_PER_MS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FRAME_STYLES = (
    (BLUE, ""),
    (BROWN, "////"),
    (GREEN, ""),
    (MAUVE, "\\\\\\\\"),
    (SKY, ""),
    (VERMILLION, "...."),
)
"""Fill and hatch by frame, in turn (neighbours differ in lightness and hatch, too)."""

OFF_CPU = "#FFFFFF"
"""Core of what does not run on the CPU."""


def plot_timeline(
    results: PatternResult | Sequence[PatternResult],
    start_ms: float | None = None,
    span_ms: float = 400.0,
    *,
    labels: Sequence[str] | None = None,
    follow: int | None = None,
) -> tuple[Figure, str]:
    """Return a Gantt chart: stages as lanes, time to the right, a colour and hatch for each frame.

    What runs on the GPU (or a DLA) has a white core. A line follows one frame from the camera to the command.

    Args:
        results: one run, or several to compare over the same span of time.
        start_ms: left end; the end of the warm-up if None.
        span_ms: width.
        labels: titles; by kind if None.
        follow: number of the frame that the line follows; the first that fits if None, 0 for no line.
    """
    runs = [results] if isinstance(results, PatternResult) else list(results)
    names = list(labels) if labels is not None else [default_label(run) for run in runs]
    begin = runs[0].warmup_ns / NS_PER_MS if start_ms is None else start_ms
    blocks = [_blocks(run) for run in runs]
    lanes = [_lanes(run, found) for run, found in zip(runs, blocks, strict=True)]
    heights = [len(lane) + 1.2 for lane in lanes]
    figure = new_figure(11, 0.31 * sum(heights) + 0.75 * len(runs) + 0.3)
    axes = figure.subplots(len(runs), 1, sharex=True, height_ratios=heights, squeeze=False)[:, 0]
    said = []
    for axis, run, name, found, lane in zip(axes, runs, names, blocks, lanes, strict=True):
        said.append(_timeline(axis, run, name, found, lane, begin, span_ms, follow))
    axes[-1].set_xlabel("time (ms, simulated)")
    axes[0].set_title("white core: on the GPU    line: one frame's way", loc="right", fontsize=9, color=QUIET)
    return figure, "Timeline of stages by frame. " + " ".join(said)


def default_label(run: PatternResult) -> str:
    """Return what a run is called in a figure."""
    return run.kind.capitalize()


class _Block(NamedTuple):
    """A stage's work on a frame, ms; ``inner`` is what of it is not on the CPU."""

    stage: str
    frame: int
    left: float
    right: float
    inner: tuple[tuple[float, float], ...]
    slot: int


def _blocks(run: PatternResult) -> list[_Block]:
    """Put the segments of a stage's work on a frame together; what overlaps in a stage gets slots of its own."""
    ms = 1 / NS_PER_MS
    groups: dict[tuple[str, int, int], list[Span]] = {}
    for span in run.spans:
        # Control at its own rate acts on the same frame several times: each is a block.
        again = span.start_ns if run.kind == "parallel" and span.stage == run.stages[-1].name else 0
        groups.setdefault((span.stage, span.frame, again), []).append(span)
    blocks = []
    free: dict[str, list[float]] = {}
    for (stage, frame, _), spans in sorted(groups.items(), key=lambda item: item[1][0].start_ns):
        left, right = spans[0].start_ns * ms, spans[-1].end_ns * ms
        ends = free.setdefault(stage, [])
        slot = next((k for k, end in enumerate(ends) if end <= left + 1e-9), len(ends))
        ends[slot : slot + 1] = [right]
        inner = tuple((span.start_ns * ms, span.end_ns * ms) for span in spans if span.resource != "cpu")
        blocks.append(_Block(stage, frame, left, right, inner, slot))
    return blocks


def _lanes(run: PatternResult, blocks: Sequence[_Block]) -> dict[tuple[str, int], int]:
    """Return the row of each (stage, slot), from top to bottom."""
    lanes: dict[tuple[str, int], int] = {}
    for stage in run.stages:
        slots = {block.slot for block in blocks if block.stage == stage.name} or {0}
        for slot in sorted(slots):
            lanes[stage.name, slot] = len(lanes)
    return lanes


def _timeline(
    axes: Axes,
    run: PatternResult,
    name: str,
    blocks: Sequence[_Block],
    lanes: Mapping[tuple[str, int], int],
    begin: float,
    span_ms: float,
    follow: int | None,
) -> str:
    end, rows, period = begin + span_ms, len(lanes), run.period_ns / NS_PER_MS
    several = {stage for stage, slot in lanes if slot}
    for frame in range(max(1, int(np.ceil(begin / period))), int(end / period) + 1):
        axes.plot(frame * period, -0.85, marker="v", color=_style(frame)[0], ms=6, clip_on=False)
    for block in blocks:
        if block.right <= begin or block.left >= end:
            continue
        row = lanes[block.stage, block.slot]
        colour, hatch = _style(block.frame)
        width = block.right - block.left
        thin = width < span_ms / 100
        axes.barh(
            row,
            width,
            left=block.left,
            height=0.78,
            color=colour,
            hatch="" if thin else hatch,
            edgecolor=colour if thin else "white",
            lw=0.8,
            zorder=2,
        )
        for left, right in block.inner:
            axes.barh(row, right - left, left=left, height=0.26, color=OFF_CPU, lw=0, zorder=3)
    axes.set_yticks(range(rows), [_lane_name(stage, slot, several) for stage, slot in lanes])
    axes.set_ylim(rows - 0.4, -1.25)
    axes.set_xlim(begin, end)
    axes.tick_params(axis="y", length=0)
    tidy(axes)
    axes.grid(False, axis="y")
    axes.spines["left"].set_visible(False)
    axes.text(begin - 0.008 * span_ms, -0.85, "camera", ha="right", va="center", color=QUIET, fontsize=9)
    title(axes, f"{name}: {run.throughput_hz:.1f} frames/s, latency {run.latency_ms.mean():.0f} ms")
    _follow(axes, run, blocks, lanes, (begin, end), follow)
    dropped = sum(run.drops.values())
    return (
        f"{name}: {run.throughput_hz:.1f} frames per second reach the actuator with a mean latency of "
        f"{run.latency_ms.mean():.0f} ms; {dropped} of {run.frames} frames are dropped."
    )


def _style(frame: int) -> tuple[str, str]:
    return FRAME_STYLES[frame % len(FRAME_STYLES)]


def _lane_name(stage: str, slot: int, several: set[str]) -> str:
    name = stage.replace("_", " ")
    return f"{name} {slot + 1}" if stage in several else name


def _follow(
    axes: Axes,
    run: PatternResult,
    blocks: Sequence[_Block],
    lanes: Mapping[tuple[str, int], int],
    window: tuple[float, float],
    follow: int | None,
) -> None:
    """Draw the way of a frame: down from the camera, along its work, down to the next stage, out as a command."""
    ms, rows = 1 / NS_PER_MS, len(lanes)
    used = {command.state_ns // run.period_ns: command for command in reversed(run.commands)}
    first = window[0] + 0.02 * (window[1] - window[0])
    complete = [
        frame
        for frame, command in sorted(used.items())
        if first <= command.state_ns * ms and command.released_ns * ms <= window[1]
    ]
    frame = follow if follow is not None else next(iter(complete), 0)
    if frame not in used:
        return
    command = used[frame]
    released = command.released_ns * ms
    # Control that runs on its own acts on the state, not on the plan of the same frame, and on each state repeatedly.
    aside = run.stages[-2].name if run.kind == "parallel" else ""
    way = [b for b in blocks if b.frame == frame and b.stage != aside and b.right <= released + 1e-6]
    xs, ys = [command.state_ns * ms], [-0.7]
    for block in sorted(way, key=lambda block: block.left):
        row = float(lanes[block.stage, block.slot])
        xs += [block.left, block.left, block.right]
        ys += [ys[-1], row, row]
    xs += [released, released]
    ys += [ys[-1], rows - 0.5]
    axes.plot(xs, ys, color="white", lw=3.2, zorder=4, solid_joinstyle="miter")
    axes.plot(xs, ys, color=INK, lw=1.5, zorder=5, solid_joinstyle="miter")
    axes.plot(released, rows - 0.5, marker="v", color=INK, ms=6, zorder=6, clip_on=False)
    axes.annotate(
        f"frame {frame}: {(command.released_ns - command.state_ns) * ms:.0f} ms",
        (released, rows - 0.45),
        xytext=(5, 3),
        textcoords="offset points",
        fontsize=9,
        color=INK,
        va="bottom",
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 1.0},
        zorder=6,
    )
