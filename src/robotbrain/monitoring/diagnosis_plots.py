"""A diagnosis as a figure: where the latency goes, and how busy everything is."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from robotbrain.figures import BLUE, INK, QUIET, SKY, VERMILLION, new_figure, tidy, title

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from robotbrain.monitoring.diagnosis import Diagnosis

WORK: dict[str, Any] = {"color": BLUE}
WAIT: dict[str, Any] = {"color": SKY}
LIMIT: dict[str, Any] = {"facecolor": VERMILLION, "edgecolor": "white", "hatch": "////"}
"""How bars of work done, of waiting and of the bottleneck look."""

WORKING = ("slow node", "slow inference", "slow service", "oversized input")


def plot_diagnosis(diagnosis: Diagnosis, most: int = 8) -> tuple[Figure, str]:
    """Return a waterfall of the latency budget beside bars of what is busy, and the alternative text.

    Args:
        diagnosis: what was found.
        most: rows of each side at most.
    """
    causes = [cause for cause in diagnosis.causes if cause.share >= 0.01][:most]
    busy = _busy(diagnosis)[:most]
    rows = max(len(causes) + 1, len(busy))
    figure = new_figure(12, 0.42 * rows + 1.5)
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    _waterfall(left, diagnosis, len(causes))
    _bars(right, busy)
    alt = _alt(diagnosis, len(causes), busy)
    figure.set_label(alt)
    return figure, alt


def _waterfall(axes: Axes, diagnosis: Diagnosis, count: int) -> None:
    begin, labels = 0.0, []
    total = diagnosis.before.mean_ms
    for row, cause in enumerate(diagnosis.causes[:count]):
        style = LIMIT if row == 0 else WORK if cause.kind in WORKING else WAIT
        axes.barh(row, cause.mean_ms, left=begin, height=0.7, **style)
        axes.text(begin + cause.mean_ms + 0.01 * total, row, f"{cause.mean_ms:.1f} ms", va="center", color=INK)
        begin += cause.mean_ms
        labels.append(cause.name)
    rest = total - begin
    axes.barh(count, rest, left=begin, color=QUIET, height=0.7)
    labels.append("everything else")
    axes.set_yticks(range(count + 1), labels)
    axes.invert_yaxis()
    axes.set_xlim(0, 1.15 * total)
    axes.set_xlabel(f"mean time from {diagnosis.before.source} to {diagnosis.before.sink} (ms, simulated)")
    title(axes, "Where the latency goes (hatched: the bottleneck; dark: work; light: waiting)")
    tidy(axes)


def _busy(diagnosis: Diagnosis) -> list[tuple[str, float]]:
    load = diagnosis.load
    found = [(name.upper(), use) for name, use in load.resources.items()]
    for executor in load.threads:
        names = load.nodes[executor]
        label = names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"
        found.append((f"thread of {label}", load.executor_use(executor)))
    return sorted(found, key=lambda item: -item[1])


def _bars(axes: Axes, busy: list[tuple[str, float]]) -> None:
    for row, (_, use) in enumerate(busy):
        axes.barh(row, 100 * use, height=0.7, **(LIMIT if use > 0.9 else WORK))
        axes.text(100 * use + 1.5, row, f"{use:.0%}", va="center", color=INK)
    axes.set_yticks(range(len(busy)), [name for name, _ in busy])
    axes.invert_yaxis()
    axes.set_xlim(0, 115)
    axes.set_xlabel("share of the time in use (%)")
    title(axes, "What is busy (hatched: above 90 %)")
    tidy(axes)


def _alt(diagnosis: Diagnosis, count: int, busy: list[tuple[str, float]]) -> str:
    before = diagnosis.before
    parts = "; ".join(f"{c.name} {c.mean_ms:.1f} ms ({c.share:.0%})" for c in diagnosis.causes[:count])
    use = "; ".join(f"{name} {share:.0%}" for name, share in busy)
    return (
        f"Two charts. Mean latency from {before.source} to {before.sink}, {before.mean_ms:.1f} ms, by cause: {parts}. "
        f"Share of the time in use: {use}."
    )
