"""Learning curves with the spread over seeds, and estimates with their intervals, as figures.

One seed says little about a method: a curve is the median over trainings, with what lies around it. Colours, marks and
words are those of the kit's other figures; each figure's label says in words what it shows
(:func:`robotbrain.figures.alt_text`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from robotbrain.errors import InputError
from robotbrain.figures import PALETTE, QUIET, alt_text, new_figure, save, tidy, title, to_html
from robotbrain.monitoring.accuracy import Estimate
from robotbrain.rl.logs import Run, Series, read_run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Spread", "alt_text", "plot_curves", "plot_estimates", "save", "series_from_records", "spread", "to_html"]

Floats = NDArray[np.float64]
Training = Run | Series | str | Path
"""A training: its run, its run's folder, or one figure of it."""
Axis = Literal["steps", "minutes"]

_LINES = ("-", "--", "-.", ":")
_MARKS = ("o", "s", "^", "D", "v", "P", "X")
_AXES: dict[Axis, str] = {"steps": "environment steps", "minutes": "wall-clock time of training, min"}


@dataclass(frozen=True)
class Spread:
    """A figure over several trainings, on common places.

    Attributes:
        x: environment steps, or minutes.
        median, low, high: over the trainings, at each x.
        trainings: how many.
    """

    x: Floats
    median: Floats
    low: Floats
    high: Floats
    trainings: int


def spread(series: Sequence[Series], *, x: Axis = "steps", band: float = 1.0, points: int = 200) -> Spread:
    """Return the median over trainings and the band that holds this share of them.

    Between its points each training is interpolated linearly; the result ends where the shortest one does.

    Args:
        series: one for each training; points that are not numbers are left out.
        x: over what.
        band: 1 from the lowest to the highest training, 0.5 between the quartiles.
        points: places.

    Raises:
        InputError: without a training, for one without numbers, or for trainings that do not overlap.
    """
    if not series or not 0 <= band <= 1 or points < 2:
        raise InputError(
            "series, band, points",
            given=(len(series), band, points),
            expected="one training or more, 0 to 1, 2 or more",
            fix="Did the runs log this figure?",
        )
    lines = []
    for one in series:
        valid = np.isfinite(one.value)
        place = one.step.astype(np.float64) if x == "steps" else one.elapsed_s / 60
        if not valid.any():
            raise InputError("series", given=one.value, expected="at least one number", fix="Train for longer.")
        lines.append((place[valid], one.value[valid]))
    begin, end = max(place[0] for place, _ in lines), min(place[-1] for place, _ in lines)
    if begin > end:
        raise InputError(
            "trainings",
            given=[(float(place[0]), float(place[-1])) for place, _ in lines],
            expected="a part that all of them cover",
            fix="Compare trainings of similar length.",
        )
    # The places of the trainings themselves where they agree: nothing is smoothed then.
    common = lines[0][0]
    same = all(np.array_equal(place[: len(common)], common[: len(place)]) for place, _ in lines)
    where = np.unique(common[common <= end]) if same and len(common) <= points else np.linspace(begin, end, points)
    values = np.stack([np.interp(where, place, value) for place, value in lines])
    low, high = np.quantile(values, [(1 - band) / 2, (1 + band) / 2], axis=0)
    return Spread(where, np.median(values, axis=0), low, high, len(lines))


def plot_curves(
    trainings: Mapping[str, Sequence[Training]],
    name: str = "train/return",
    *,
    x: Axis = "steps",
    ylabel: str = "",
    heading: str = "",
    percent: bool = False,
    band: float = 1.0,
    threshold: float | None = None,
) -> Figure:
    """Return a figure of learning curves: the median over each method's trainings, and their spread.

    Args:
        trainings: for each method its trainings, one for each seed.
        name: of the figure, as it was logged.
        x: over environment steps or wall-clock time.
        ylabel: of the vertical axis, with its unit; the name by default.
        heading: of the figure.
        percent: the values are shares; the axis goes from 0 to 100 %.
        band: share of the trainings in the band, see :func:`spread`.
        threshold: what is to be reached, drawn as a line.

    Raises:
        InputError: as :func:`spread`, and for an unknown name.
    """
    if not trainings:
        raise InputError("trainings", given=0, expected="at least one method", fix='{"PPO": [run_dir, ...]}')
    figure = new_figure(7.4, 4.2)
    axes = figure.subplots()
    factor = 100.0 if percent else 1.0
    label = ylabel or (f"{name}, %" if percent else name)
    words = []
    for index, (method, group) in enumerate(trainings.items()):
        found = spread([_series(one, name) for one in group], x=x, band=band)
        colour = PALETTE[index % len(PALETTE)]
        seeds = f"{found.trainings} seed{'s' * (found.trainings > 1)}"
        axes.fill_between(found.x, factor * found.low, factor * found.high, color=colour, alpha=0.2, lw=0)
        axes.plot(
            found.x,
            factor * found.median,
            color=colour,
            ls=_LINES[index % len(_LINES)],
            marker=_MARKS[index % len(_MARKS)],
            markevery=max(1, len(found.x) // 8),
            ms=5,
            lw=1.8,
            label=f"{method} ({seeds})",
        )
        last = f"{factor * found.median[-1]:.3g} ({factor * found.low[-1]:.3g} to {factor * found.high[-1]:.3g})"
        start = f"{factor * found.median[0]:.3g}"
        extent = f"{found.x[-1]:,.0f} steps" if x == "steps" else f"{found.x[-1]:.3g} min"
        words.append(f"{method}, {seeds}: from {start} to {last} after {extent}")
    if threshold is not None:
        axes.axhline(factor * threshold, color=QUIET, lw=1.2, ls=(0, (6, 3)))
        axes.annotate(
            f"to reach: {factor * threshold:g}",
            (0.995, factor * threshold),
            xycoords=("axes fraction", "data"),
            ha="right",
            va="bottom",
            fontsize=9,
            color=QUIET,
        )
    axes.set_xlabel(_AXES[x])
    axes.set_ylabel(label)
    if x == "steps":
        axes.xaxis.set_major_formatter(_thousands)
    if percent:
        axes.set_ylim(-2, 102)
    axes.set_xlim(left=0)
    tidy(axes)
    axes.legend(frameon=False, fontsize=9)
    share = "from the lowest to the highest seed" if band == 1 else f"with {100 * band:g} % of the seeds"
    title(axes, heading or f"{label}: median and band {share}")
    figure.set_label(f"Learning curves of {label} over {_AXES[x]}, median and band {share}. " + "; ".join(words) + ".")
    return figure


def plot_estimates(
    estimates: Mapping[str, Estimate], *, xlabel: str, heading: str = "", percent: bool = False
) -> Figure:
    """Return a figure of estimates, one row for each, with their intervals.

    Args:
        estimates: by what they are of.
        xlabel: what they estimate, with its unit.
        heading: of the figure.
        percent: the values are shares, shown in %.

    Raises:
        InputError: without any.
    """
    if not estimates:
        raise InputError("estimates", given=0, expected="at least one", fix="Evaluate something first.")
    figure = new_figure(7.4, 1.1 + 0.42 * len(estimates))
    axes = figure.subplots()
    factor = 100.0 if percent else 1.0
    for row, (_, estimate) in enumerate(estimates.items()):
        colour = PALETTE[row % len(PALETTE)]
        axes.plot([factor * estimate.low, factor * estimate.high], [row, row], color=colour, lw=2.4)
        axes.plot(factor * estimate.value, row, _MARKS[row % len(_MARKS)], color=colour, ms=7)
    axes.set_yticks(range(len(estimates)), list(estimates))
    axes.invert_yaxis()
    axes.set_xlabel(xlabel)
    tidy(axes)
    level = next(iter(estimates.values())).level
    title(axes, heading or f"{xlabel}, with {100 * level:g} % intervals")
    words = [
        f"{n}: {factor * e.value:.3g} ({factor * e.low:.3g} to {factor * e.high:.3g})" for n, e in estimates.items()
    ]
    figure.set_label(f"Estimates of {xlabel} with {100 * level:g} % intervals. " + "; ".join(words) + ".")
    return figure


def series_from_records(records: Sequence[Mapping[str, float]], name: str) -> Series:
    """Return one figure of a learning curve that is a list of records with ``step`` and, if known, ``seconds``.

    Raises:
        InputError: when no record has it.
    """
    rows = [record for record in records if name in record]
    if not rows:
        known = sorted({key for record in records for key in record} - {"step", "seconds"})
        raise InputError("name of a figure", given=name, expected=", ".join(known) or "records", fix="See the names.")
    return Series(
        np.array([row["step"] for row in rows], np.int64),
        np.array([row.get("seconds", np.nan) for row in rows], np.float64),
        np.array([row[name] for row in rows], np.float64),
    )


def _series(training: Training, name: str) -> Series:
    if isinstance(training, Series):
        return training
    return (training if isinstance(training, Run) else read_run(training))[name]


def _thousands(value: float, _: Any) -> str:
    if abs(value) >= 1e6:
        return f"{value / 1e6:g} M"
    return f"{value / 1e3:g} k" if abs(value) >= 1e3 else f"{value:g}"
