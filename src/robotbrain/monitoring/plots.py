"""Figures of a run: what happened when, how long things took, what waited, what was busy.

Each returns a matplotlib figure whose label says in words what it shows
(:func:`robotbrain.figures.alt_text`). Lines and marks differ besides their colours.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robotbrain.figures import (
    BLUE,
    GREEN,
    GREY,
    INK,
    LINES,
    MAUVE,
    PALETTE,
    QUIET,
    SKY,
    VERMILLION,
    new_figure,
    plain_ticks,
    text_on,
    tidy,
    title,
)
from robotbrain.monitoring.chains import ChainAges, chain_ages, main_chains, outside_nodes
from robotbrain.monitoring.critical_path_device import lay_out
from robotbrain.monitoring.deadlines import KIT_DEADLINES, Deadlines
from robotbrain.monitoring.distribution import Distribution
from robotbrain.monitoring.queues import QueueTimeline, queue_timelines

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from robotbrain.monitoring.summary import CallbackSummary, Summary
    from robotbrain.monitoring.trace import Trace

Array = NDArray[np.float64]

_CLIP = 100.0  # deviation, % of the period, from which nobody would call it periodic
_ROLE_ORDER = ("perception", "estimator", "mapper", "planner", "mission", "controller")
_RESOURCES = {"cpu": (BLUE, "-"), "gpu": (VERMILLION, "--"), "dla0": (GREEN, ":"), "dla1": (MAUVE, "-.")}


def node_order(trace: Trace) -> list[str]:
    """Return the nodes of a run, the robot first, then the brain along its pipeline."""
    seen = dict.fromkeys(callback.node for callback in trace.callbacks)
    outside = outside_nodes(trace)

    def rank(node: str) -> tuple[bool, int]:
        role = trace.roles.get(node, "")
        return node not in outside, _ROLE_ORDER.index(role) if role in _ROLE_ORDER else len(_ROLE_ORDER)

    return sorted(seen, key=rank)


def node_colours(trace: Trace) -> dict[str, str]:
    """Return a colour for each node; the robot's are grey."""
    outside = outside_nodes(trace)
    inside = [node for node in node_order(trace) if node not in outside]
    colours = {node: PALETTE[index % len(PALETTE)] for index, node in enumerate(inside)}
    return {node: colours.get(node, GREY) for node in node_order(trace)}


def worst_window(trace: Trace, longest_s: float = 1.0) -> tuple[int, int]:
    """Return a window (ns) around the making of the command whose input was the oldest; at most so long.

    Without commands it is the beginning of the run.
    """
    worst: tuple[float, int] | None = None
    for ages in chain_ages(trace, main_chains(trace)):
        if len(ages.known_ms):
            index = int(np.nanargmax(ages.age_ms))
            found = (float(ages.age_ms[index]), int(ages.time_ns[index]))
            worst = found if worst is None else max(worst, found)
    length = round(longest_s * 1e9)
    if worst is None:
        return trace.start_ns, min(trace.end_ns, trace.start_ns + length)
    age_ns, left = round(worst[0] * 1e6), worst[1]
    margin = max(10_000_000, age_ns // 8)
    begin, end = max(trace.start_ns, left - age_ns - margin), min(trace.end_ns, left + margin)
    return max(begin, end - length), end


def plot_timeline(
    trace: Trace, begin_ns: int | None = None, end_ns: int | None = None, *, deadlines: Deadlines | None = None
) -> Figure:
    """Return a Gantt chart of a window: a row for each node, and one for each resource of the device.

    Args:
        trace: of a run.
        begin_ns, end_ns: of the window; around the worst command by default.
        deadlines: of the callbacks; those of the kit's brain by default.
    """
    usual = worst_window(trace)
    begin = usual[0] if begin_ns is None else begin_ns
    end = usual[1] if end_ns is None else end_ns
    limits = KIT_DEADLINES if deadlines is None else deadlines
    shown = [c for c in trace.callbacks if c.end_ns >= begin and c.ready_ns <= end]
    nodes = [node for node in node_order(trace) if any(c.node == node for c in shown)]
    colours = node_colours(trace)
    resources = list(trace.capacity)
    figure = new_figure(11, 0.9 + 0.42 * (len(nodes) + len(resources)))
    axes = figure.subplots()
    rows = {node: len(nodes) + len(resources) - 1 - index for index, node in enumerate(nodes)}
    late = 0
    for callback in shown:
        y, colour = rows[callback.node], colours[callback.node]
        start, stop, ready = (_ms(t, begin) for t in (callback.start_ns, callback.end_ns, callback.ready_ns))
        if start - ready > 0:
            axes.plot([max(ready, 0), start], [y - 0.33] * 2, color=colour, lw=1.6, alpha=0.55, solid_capstyle="butt")
        axes.broken_barh([(start, stop - start)], (y - 0.24, 0.5), facecolor=colour, edgecolor=colour, lw=0.7)
        if stop - start > 0.085 * (end - begin) * 1e-6 and start >= 0 and stop <= (end - begin) * 1e-6:
            axes.text((start + stop) / 2, y, callback.name.lstrip("_"), ha="center", va="center", fontsize=8,
                      color=text_on(colour), clip_on=True)  # fmt: skip
        limit = limits.of(callback.node, trace.roles.get(callback.node, ""), callback.kind, callback.name)
        if limit is not None and (callback.end_ns - callback.ready_ns) * 1e-6 > limit:
            late += 1
            axes.plot(stop, y + 0.38, marker="v", ms=6, color=VERMILLION, mec="white", mew=0.4, clip_on=True, zorder=5)
    labels = [f"{node} ({trace.roles[node]})" if trace.roles.get(node, "") not in ("", node[1:]) else node
              for node in nodes]  # fmt: skip
    _resource_rows(axes, trace, resources, begin, end)
    axes.axhline(len(resources) - 0.5, color="#BBBBBB", lw=0.8)
    names = labels[::-1]
    axes.set_yticks(
        range(len(nodes) + len(resources)), [_resource_name(name, trace) for name in resources[::-1]] + names
    )
    axes.set_xlim(0, (end - begin) * 1e-6)
    axes.set_ylim(-0.6, len(nodes) + len(resources) - 0.4)
    axes.set_xlabel(f"time since {(begin - trace.start_ns) * 1e-9:.3f} s (ms)")
    tidy(axes)
    axes.grid(axis="y", visible=False)
    axes.tick_params(axis="y", length=0)
    mark = "; a triangle: deadline missed" if late else ""
    title(axes, f"Bars are callbacks; the thin line below is how long one waited{mark}")
    busiest = max(nodes, key=lambda n: sum(c.end_ns - c.start_ns for c in shown if c.node == n), default="nothing")
    figure.set_label(
        f"Timeline of {len(shown)} callbacks of {len(nodes)} nodes over {(end - begin) * 1e-6:.0f} ms, from "
        f"{(begin - trace.start_ns) * 1e-9:.3f} s on. {busiest} is busy the longest; {late} deadlines are missed."
    )
    return figure


def _resource_rows(axes: Axes, trace: Trace, resources: Sequence[str], begin: int, end: int) -> None:
    if not resources:
        return
    bounds = {name: len(resources) - 1 - index for index, name in enumerate(resources)}
    by_id = {callback.id: callback for callback in trace.callbacks}
    colours = node_colours(trace)
    for number, pieces in lay_out(trace).items():
        for piece in pieces:
            if piece.end_ns < begin or piece.served_from_ns > end:
                continue
            y, colour = bounds[piece.resource], colours[by_id[number].node]
            shared = trace.capacity[piece.resource] > 1
            span = (_ms(piece.served_from_ns, begin), (piece.end_ns - piece.served_from_ns) * 1e-6)
            # Several cores lie on top of each other: the darker, the more of them work.
            axes.broken_barh([span], (y - 0.3, 0.6), facecolor=colour, alpha=0.5 if shared else 1, lw=0)


def _resource_name(name: str, trace: Trace) -> str:
    count = trace.capacity[name]
    return f"{name.upper()} ({count} cores)" if name == "cpu" else name.upper()


def _ms(time_ns: int, begin_ns: int) -> float:
    return (time_ns - begin_ns) * 1e-6


def plot_end_to_end(trace: Trace, chains: Iterable[Sequence[str]] | None = None) -> Figure:
    """Return the age of the reading behind each command over time, a line for each chain."""
    ages = chain_ages(trace, main_chains(trace) if chains is None else chains)
    figure = new_figure(11, 3.0)
    axes = figure.subplots()
    words = []
    for index, found in enumerate(ages):
        if not len(found.known_ms):
            continue
        known = ~np.isnan(found.age_ms)
        times = (found.time_ns[known] - trace.start_ns) * 1e-9
        _age_line(
            axes,
            np.asarray(times, dtype=np.float64),
            found.known_ms,
            PALETTE[index % len(PALETTE)],
            LINES[index % len(LINES)],
            _chain_name(found),
        )
        words.append(
            f"{_chain_name(found)}: median {np.median(found.known_ms):.0f} ms, at most {found.known_ms.max():.0f} ms"
        )
    axes.set(xlabel="time (s)", ylabel="age of the input (ms)", ylim=(0, None))
    axes.set_xlim(0, max(trace.seconds, 1e-9))
    tidy(axes)
    if words:
        figure.legend(loc="outside upper left", ncols=len(words), frameon=False, fontsize=9)
    figure.set_label("Age of the sensor reading behind each command over time. " + ("; ".join(words) or "No command."))
    return figure


def _age_line(axes: Axes, times: Array, ages: Array, colour: str, line: Any, label: str) -> None:
    """Draw ages one by one, or, where they are many, their mean and range in short stretches of time."""
    bins = 60
    if len(times) <= 3 * bins:
        axes.plot(times, ages, ls=line, color=colour, lw=1.2, label=label)
        return
    edges = np.linspace(times[0], times[-1], bins + 1)
    groups = np.clip(np.searchsorted(edges, times, side="right") - 1, 0, bins - 1)
    stretches = [ages[groups == k] for k in range(bins)]
    middle = (edges[:-1] + edges[1:]) / 2
    rows = [(t, v.mean(), v.min(), v.max()) for t, v in zip(middle, stretches, strict=True) if len(v)]
    when, mean, low, high = np.array(rows).T
    axes.fill_between(when, low, high, color=colour, alpha=0.22, lw=0)
    axes.plot(when, mean, ls=line, color=colour, lw=1.6, label=f"{label} (mean and range)")


def _chain_name(ages: ChainAges) -> str:
    return " → ".join(ages.chain)


def plot_latencies(summary: Summary, most: int = 16) -> Figure:
    """Return how long callbacks took, from being ready to their end: median, 99th percentile, worst, deadline.

    In wall-clock time, where nobody knows when a callback became ready, from start to end.
    """
    rows = sorted((c for c in summary.callbacks if c.calls and _taken(c).max > 0), key=lambda c: -_taken(c).p99)[:most]
    rows.reverse()
    figure = new_figure(11, 1.1 + 0.32 * max(1, len(rows)))
    axes = figure.subplots()
    for y, callback in enumerate(rows):
        taken = _taken(callback)
        low = max(taken.p50, 1e-3)
        axes.plot([low, max(taken.p99, low)], [y, y], color=SKY, lw=7, solid_capstyle="butt", zorder=2)
        axes.plot(low, y, "o", color=BLUE, ms=6, zorder=4)
        axes.plot(max(taken.max, 1e-3), y, "|", color=INK, ms=10, zorder=3)
        if callback.deadline_ms is not None:
            missed = callback.misses > 0
            axes.plot(
                callback.deadline_ms, y, "X" if missed else "D", color=VERMILLION if missed else GREEN, ms=7,
                mec="white", mew=0.5, zorder=5,
            )  # fmt: skip
    axes.set_yticks(range(len(rows)), [callback.label for callback in rows], fontsize=9)
    axes.set_xscale("log")
    axes.set_ylim(-0.7, len(rows) - 0.3)
    if rows:
        plain_ticks(axes, "x")
    response = any(c.response.count for c in summary.callbacks)
    axes.set_xlabel("from ready to end (ms)" if response else "from start to end (ms)")
    tidy(axes)
    axes.tick_params(axis="y", length=0)
    _legend(figure, [("median", BLUE, "o"), ("99th percentile (end of bar)", SKY, "s"), ("worst", INK, "|"),
                     ("deadline kept", GREEN, "D"), ("deadline missed", VERMILLION, "X")])  # fmt: skip
    slowest = ", ".join(f"{c.label} {_taken(c).p99:.1f} ms" for c in rows[::-1][:3])
    figure.set_label(f"How long {len(rows)} callbacks took. The slowest by the 99th percentile: {slowest or 'none'}.")
    return figure


def _taken(callback: CallbackSummary) -> Distribution:
    return callback.response if callback.response.count else callback.latency


def _legend(figure: Figure, entries: Sequence[tuple[str, str, str]]) -> None:
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], color=colour, marker=mark, ls="", label=text) for text, colour, mark in entries]
    figure.legend(handles=handles, loc="outside upper left", ncols=len(entries), frameon=False, fontsize=9)


def plot_rhythm(summary: Summary, most: int = 14) -> Figure:
    """Return how regular topics and timers are: deviation of their intervals from the period, in percent of it."""
    found = [(f"{t.topic}", t.period, t.rate_hz) for t in summary.topics if t.messages > 4]
    found += [
        (f"{c.node} {c.name}", c.jitter, c.rate_hz) for c in summary.callbacks if c.kind == "timer" and c.calls > 4
    ]
    rows = [(n, j, r) for n, j, r in found if j.period_ms > 0 and j.deviation.count]
    rows = sorted(rows, key=lambda row: -row[1].deviation.p95 / row[1].period_ms)[:most][::-1]
    figure = new_figure(11, 1.1 + 0.3 * max(1, len(rows)))
    axes = figure.subplots()
    for y, (_, jitter, rate) in enumerate(rows):
        p50, p95 = (100 * value / jitter.period_ms for value in (jitter.deviation.p50, jitter.deviation.p95))
        axes.barh(y, min(p95, _CLIP), height=0.6, color=SKY)
        axes.barh(y, min(p50, _CLIP), height=0.28, color=BLUE)
        beyond = f"  not periodic: {p95:.0f} %," if p95 > _CLIP else " "
        axes.text(min(p95, _CLIP), y, f"{beyond} {rate:.1f} Hz", va="center", fontsize=8.5, color=QUIET)
    axes.set_yticks(range(len(rows)), [name for name, _, _ in rows], fontsize=9)
    axes.set_xlabel("deviation of an interval from the period (% of the period)")
    longest = max((100 * j.deviation.p95 / j.period_ms for _, j, _ in rows), default=0.0)
    axes.set_xlim(0, _CLIP * 1.28 if longest > _CLIP else max(1.0, 1.15 * longest))
    tidy(axes)
    axes.tick_params(axis="y", length=0)
    _legend(figure, [("median", BLUE, "s"), ("95th percentile", SKY, "s")])
    worst = rows[-1] if rows else None
    said = "" if worst is None else f" The least regular is {worst[0]} at {worst[2]:.1f} Hz."
    figure.set_label(f"How regular {len(rows)} topics and timers are.{said}")
    return figure


def plot_queues(trace: Trace, most: int = 6) -> Figure:
    """Return how many messages waited over time, in the queues in which most did."""
    found = [q for q in queue_timelines(trace) if q.max_depth > 1 or q.mean_depth > 0.05 or q.dropped]
    queues = sorted(found, key=lambda q: (-q.mean_depth, -q.dropped))[:most]
    if not queues:
        figure = new_figure(11, 0.6)
        figure.text(0.01, 0.5, "Messages hardly waited: no queue held more than one at a time.", color=INK, va="center")
        figure.set_label("Messages hardly waited: no queue held more than one at a time.")
        return figure
    figure = new_figure(11, 0.7 + 0.85 * len(queues))
    panels = np.atleast_1d(figure.subplots(len(queues), 1, sharex=True))
    for axes, queue in zip(panels, queues, strict=False):
        _queue_panel(axes, queue, trace)
    panels[-1].set_xlabel("time (s)")
    panels[-1].set_xlim(0, max(trace.seconds, 1e-9))
    words = "; ".join(
        f"{q.topic} of {q.node}: mean {q.mean_depth:.1f}, most {q.max_depth}, {q.dropped} dropped" for q in queues
    )
    figure.set_label(f"Messages that waited over time. {words}.")
    return figure


def _queue_panel(axes: Axes, queue: QueueTimeline, trace: Trace) -> None:
    times = np.append(queue.time_ns, queue.end_ns)
    seconds = (times - trace.start_ns) * 1e-9
    axes.fill_between(seconds, np.append(queue.depth, queue.depth[-1]), step="post", color=SKY, lw=0)
    if queue.limit is not None and queue.max_depth >= queue.limit:
        axes.axhline(queue.limit, color=VERMILLION, lw=1, ls="--")
    if len(queue.drop_ns):
        drops = (queue.drop_ns - trace.start_ns) * 1e-9
        axes.plot(drops, np.full(len(drops), max(1, queue.max_depth)), "|", color=VERMILLION, ms=7, mew=1)
    axes.set_ylim(0, 1.18 * max(1, queue.max_depth))
    axes.set_yticks([0, max(1, queue.max_depth)])
    tidy(axes)
    limit = "no limit" if queue.limit is None else f"limit {queue.limit}"
    lost = f", {queue.dropped} dropped (red marks)" if queue.dropped else ""
    axes.set_title(f"{queue.topic} at {queue.node}: {limit}{lost}", loc="left", fontsize=9, color=INK, pad=2)


def busy_over_time(trace: Trace, bin_s: float) -> tuple[Array, dict[str, Array]]:
    """Return the share of each resource that was busy in each bin.

    Args:
        trace: of a run on a device.
        bin_s: > 0.

    Returns:
        centres of the bins (B,), s, and shares (B,), 0 to 1, by resource.
    """
    width = bin_s * 1e9
    count = max(1, math.ceil((trace.end_ns - trace.start_ns) / width))
    edges = trace.start_ns + width * np.arange(count + 1)
    lengths = np.diff(np.minimum(edges, max(trace.end_ns, trace.start_ns + 1)))
    shares = {}
    pieces = [piece for found in lay_out(trace).values() for piece in found]
    for name, capacity in trace.capacity.items():
        mine = [piece for piece in pieces if piece.resource == name]
        begin = np.array([piece.served_from_ns for piece in mine], dtype=float)
        end = np.array([piece.end_ns for piece in mine], dtype=float)
        weight = np.array([piece.demand_ns for piece in mine], dtype=float) / np.maximum(end - begin, 1)
        # Work done up to each edge, of pieces that run at an even pace.
        done = [float((np.clip(edge - begin, 0, end - begin) * weight).sum()) for edge in edges]
        shares[name] = np.diff(done) / (lengths * capacity)
    return (edges[:-1] + lengths / 2 - trace.start_ns) * 1e-9, shares


def plot_resources(trace: Trace, bin_s: float | None = None) -> Figure:
    """Return how busy each resource of the device was over time."""
    width = max(0.05, trace.seconds / 200) if bin_s is None else bin_s
    figure = new_figure(11, 2.6)
    axes = figure.subplots()
    words = []
    if trace.capacity:
        times, shares = busy_over_time(trace, width)
        for name, share in shares.items():
            colour, line = _RESOURCES.get(name, (INK, "-"))
            label = f"{_resource_name(name, trace)}, mean {100 * share.mean():.0f} %"
            axes.step(times, 100 * share, line, where="mid", color=colour, lw=1.3, label=label)
            words.append(f"{name} {100 * share.mean():.0f} % on average, at most {100 * share.max():.0f} %")
        figure.legend(loc="outside upper left", ncols=len(shares), frameon=False, fontsize=9)
    axes.set(xlabel="time (s)", ylabel="busy (%)", ylim=(0, 105))
    axes.set_xlim(0, max(trace.seconds, 1e-9))
    tidy(axes)
    figure.set_label("How busy the device was over time. " + ("; ".join(words) or "The run had no device") + ".")
    return figure
