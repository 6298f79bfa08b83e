"""The calibration's report: one HTML page with everything in it, to be judged by a reader who doubts it."""

from __future__ import annotations

import html
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from robotbrain.errors import InputError
from robotbrain.figures import to_html
from robotbrain.files import write_text
from robotbrain.jetson import report_figures as figures
from robotbrain.jetson.catalogue import list_modules, load_module
from robotbrain.jetson.report_words import LIMITS, NOTES, PAGE
from robotbrain.jetson.twin.calibrate import CalibrationRun, group_summaries
from robotbrain.jetson.twin.conditions import PRECISIONS
from robotbrain.jetson.twin.data import LatencyRow, load_kernel_lists, load_latency_rows, load_power_rows
from robotbrain.jetson.twin.latency import make_work
from robotbrain.jetson.twin.power import SUPPLY_EFFICIENCY, TYPICAL_USE
from robotbrain.jetson.twin.runtime import runtime_figures
from robotbrain.jetson.twin.validate import MIXED_HARNESSES, Z80, LeftOut, Summary, covered, group_of, summarise

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SIBLING_TARGET, FAR_TARGET = 0.08, 0.25
"""Median errors that are wanted with a module left out whole: with a sibling measured, and without one."""


def write_report(run: CalibrationRun, path: str | Path) -> Path:
    """Write the report of a calibration, figures included, and return its path.

    Raises:
        InputError: for a place that cannot be written to.
    """
    try:
        return write_text(path, report_html(run))
    except OSError as error:
        raise InputError(
            "report", given=str(path), expected="a place that can be written to", fix=str(error)
        ) from error


def report_html(run: CalibrationRun) -> str:
    """Return the report of a calibration as one HTML page that needs nothing else."""
    sections = [
        ("What is asked of it, and what it does", _targets(run)),
        ("Predicted against measured", _scatter(run)),
        ("Errors by kind", _by_kind(run)),
        ("How sure it says it is", _intervals(run)),
        ("Modules that it never saw", _transfer(run)),
        ("Power at the wall", _power(run)),
        ("A look from outside", _check_rows(run)),
        ("Rows that are not used, and why", _left_out_rows()),
        ("Where the numbers come from", _origins()),
        ("What it cannot say", "<ul>" + "".join(f"<li>{text}</li>" for text in LIMITS) + "</ul>"),
    ]
    contents = "".join(f'<li><a href="#s{i}">{html.escape(name)}</a></li>' for i, (name, _) in enumerate(sections, 1))
    body = [f"<nav aria-label='Contents'><ol>{contents}</ol></nav>"]
    body += [f'<section id="s{i}"><h2>{html.escape(n)}</h2>{text}</section>' for i, (n, text) in enumerate(sections, 1)]
    return PAGE.replace("@DIGEST@", run.calibration.digest[:12]).replace("@BODY@", "\n".join(body))


# ---- pieces ----


def _table(head: Sequence[str], rows: Iterable[Sequence[object]], caption: str, left: Sequence[int] = (0,)) -> str:
    """Return a table; the first cell of a row is its heading; columns in ``left`` hold words."""

    def cell(index: int, value: object) -> str:
        kind = ' class="words"' if index in left else ""
        text = html.escape(str(value))
        return f'<th scope="row"{kind}>{text}</th>' if index == 0 else f"<td{kind}>{text}</td>"

    top = "".join(
        f'<th scope="col"{" class=words" if i in left else ""}>{html.escape(name)}</th>' for i, name in enumerate(head)
    )
    lines = "".join(f"<tr>{''.join(cell(i, value) for i, value in enumerate(row))}</tr>" for row in rows)
    return (
        f'<div class="wide"><table><caption>{html.escape(caption)}</caption>'
        f"<thead><tr>{top}</tr></thead><tbody>{lines}</tbody></table></div>"
    )


def _figure(figure: Figure, caption: str) -> str:
    return f"<figure>{to_html(figure)}<figcaption>{html.escape(caption)}</figcaption></figure>"


def _percent(share: float, digits: int = 1) -> str:
    return "-" if math.isnan(share) else f"{100 * share:.{digits}f} %"


_ERROR_HEAD = ("rows", "median error", "90th percentile", "within 20 %", "FLOPs/peak, median error")


def _errors(summary: Summary, baseline: float | None = None) -> tuple[str, ...]:
    return (
        str(summary.rows),
        _percent(summary.median),
        _percent(summary.p90),
        _percent(summary.within_20, 0),
        _percent(summary.baseline_median if baseline is None else baseline, 0),
    )


def architecture(kernels: str) -> str:
    """Return the architecture that a kernel list's name belongs to, e.g. ``resnet`` for ``resnet50_299``."""
    found = re.match(r"inception_resnet|yolov?\d+|[a-z]+", kernels)
    return found[0] if found else kernels


# ---- sections ----


def _mixed(run: CalibrationRun) -> list[LeftOut]:
    return [item for item in run.left_out if item.row.harness in MIXED_HARNESSES]


def _like_for_like(items: Sequence[LeftOut], rows: Sequence[LatencyRow]) -> list[LeftOut]:
    """Leave out rows of harnesses that nobody ran on another module of the family: they test no carrying over."""
    known = {(r.module, r.where.family, r.harness) for r in rows}
    return [
        item
        for item in items
        if any(m != item.row.module and (f, h) == (item.row.where.family, item.row.harness) for m, f, h in known)
    ]


def _targets(run: CalibrationRun) -> str:
    mixed, rows = _mixed(run), [item.row for item in run.left_out]
    both, pooled = summarise(run.left_out), summarise(mixed)
    inside = covered(run.left_out)
    wall = float(np.median([abs(error) for _, error in run.power]))
    gain = pooled.baseline_median / pooled.median
    lines: list[tuple[str, str, str, bool]] = [
        (f"median error, mixed architectures ({pooled.rows} rows)", "at most 7 %", _percent(pooled.median),
         pooled.median <= 0.07),
        ("share of them within 20 %", "at least 90 %", _percent(pooled.within_20), pooled.within_20 >= 0.9),
        ("median error of FLOPs over peak on the same rows, over the twin's", "at least 4", f"{gain:.1f}", gain >= 4),
        (f"left-out rows in their 80 % intervals ({both.rows} rows)", "75 to 90 %", _percent(inside),
         0.75 <= inside <= 0.9),
    ]  # fmt: skip
    for slug, items in run.transfer.items():
        same = _like_for_like(items, rows)
        far = slug.startswith("agx")
        goal = FAR_TARGET if far else SIBLING_TARGET
        value = summarise(same or items)
        lines.append(
            (f"median error on {slug}, none of its rows seen ({value.rows} rows)", f"at most {100 * goal:.0f} %",
             _percent(value.median), value.median <= goal)
        )  # fmt: skip
    lines.append((f"median error of wall power ({len(run.power)} rows)", "at most 15 %", _percent(wall), wall <= 0.15))
    rows_shown = [(what, goal, value, "yes" if ok else "NO") for what, goal, value, ok in lines]
    return NOTES["targets"] + _table(
        ("measured on rows that the model did not see", "wanted", "reached", "met"), rows_shown, "Targets", (0, 3)
    )


def _scatter(run: CalibrationRun) -> str:
    worst = sorted(run.left_out, key=lambda item: -abs(item.error))[:8]
    rows = [
        (f"{i.row.network}", i.row.module, i.row.precision, i.row.harness, f"{i.row.latency_ms:.3g}",
         f"{i.predicted_ms:.3g}", f"{100 * i.error:+.0f} %", f"{100 * i.baseline_error:+.0f} %")
        for i in worst
    ]  # fmt: skip
    head = ("network", "module", "precision", "harness", "measured (ms)", "predicted (ms)", "error", "FLOPs/peak")
    return (
        NOTES["left out"]
        + _figure(figures.plot_scatter(run.left_out), "Each dot is one published latency.")
        + _figure(figures.plot_groups(run.left_out), "Each dot is one published latency.")
        + _table(head, rows, "The eight largest errors", (0, 1, 2, 3))
    )


def _by_kind(run: CalibrationRun) -> str:
    keys: dict[str, Callable[[LeftOut], str]] = {
        "family": lambda item: item.row.where.family,
        "module": lambda item: item.row.module,
        "harness": lambda item: item.row.harness,
        "precision": lambda item: item.row.precision,
        "architecture": lambda item: architecture(item.row.kernels),
        "module, precision and harness": lambda item: " ".join(group_of(item.row)),
    }
    parts = [
        _table(
            (name, *_ERROR_HEAD),
            [(group, *_errors(summary)) for group, summary in group_summaries(run.left_out, key).items()],
            f"By {name}",
        )
        for name, key in keys.items()
    ]
    return NOTES["kinds"] + '<div class="tables">' + "".join(parts) + "</div>"


def _intervals(run: CalibrationRun) -> str:
    scale = f"<p>Factor on the model's own spread: {run.calibration.scale:.2f}.</p>"
    return NOTES["intervals"] + scale + _figure(figures.plot_coverage(run.left_out), "On the line is as claimed.")


def transfer_baseline(items: Sequence[LeftOut], rows: Sequence[LatencyRow]) -> float:
    """Return the median error of FLOPs over peak on a module without rows: the efficiency is that of other modules.

    Args:
        items: rows of the module that was left out.
        rows: all rows; those of other modules with the same family, precision and harness set the efficiency.
    """
    lists = load_kernel_lists()

    def at_peak(row: LatencyRow) -> float:
        return 2e3 * lists[row.kernels].macs / row.where.peak[PRECISIONS.index(row.precision)]

    errors = []
    for item in items:
        want = (item.row.where.family, item.row.precision, item.row.harness)
        like = [r for r in rows if r.module != item.row.module and (r.where.family, r.precision, r.harness) == want]
        if like:
            efficiency = float(np.median([r.latency_ms / at_peak(r) for r in like]))
            errors.append(abs(efficiency * at_peak(item.row) / item.row.latency_ms - 1))
    return float(np.median(errors)) if errors else math.nan


def _transfer(run: CalibrationRun) -> str:
    rows = [item.row for item in run.left_out]
    lines = []
    for slug, items in run.transfer.items():
        same = _like_for_like(items, rows)
        other = [item for item in items if item not in same]
        for name, chosen in (("run on others of its family", same), ("run on no other", other)):
            if chosen:
                lines.append((slug, name, *_errors(summarise(chosen), transfer_baseline(chosen, rows))))
    return NOTES["transfer"] + _table(
        ("module left out whole", "harnesses", *_ERROR_HEAD), lines, "Carried over from other modules", (0, 1)
    )


def _power(run: CalibrationRun) -> str:
    modules = sorted({row.module for row, _ in run.power})
    lines = []
    for slug in modules:
        errors = [abs(error) for row, error in run.power if row.module == slug]
        watts = [row.wall_power_w for row, _ in run.power if row.module == slug]
        share = float(np.mean(np.array(errors) <= 0.2))
        lines.append(
            (slug, len(errors), f"{min(watts):.0f} to {max(watts):.0f}", _percent(float(np.median(errors))),
             _percent(max(errors)), _percent(share, 0))
        )  # fmt: skip
    head = ("module", "rows", "measured (W)", "median error", "largest", "within 20 %")
    note = NOTES["power"].replace("@SUPPLY@", f"{100 * SUPPLY_EFFICIENCY:.0f} %")
    note = note.replace("@USE@", f"{100 * TYPICAL_USE:.0f} %")
    return (
        note
        + _figure(figures.plot_power(run.power), "Each dot is one MLPerf MaxQ result.")
        + _table(head, lines, "Wall power by module")
    )


def _check_rows(run: CalibrationRun) -> str:
    fitted, lists = run.calibration.latency, load_kernel_lists()
    rows = load_latency_rows(uses=("check",))
    lines = []
    hits = 0
    for row in rows:
        work = make_work(lists[row.kernels], row.where)
        ms = float(fitted.predict_ms([work], [row.where])[0])
        spread = math.exp(Z80 * run.calibration.scale * fitted.log_sd(work, row.where))
        hits += ms / spread <= row.latency_ms <= ms * spread
        lines.append(
            (row.network, row.module, row.precision, row.harness, f"{row.latency_ms:.3g}", f"{ms:.3g}",
             f"{ms / spread:.3g} to {ms * spread:.3g}", f"{100 * (ms / row.latency_ms - 1):+.0f} %")
        )  # fmt: skip
    head = (
        "network",
        "module",
        "precision",
        "taken as",
        "measured (ms)",
        "predicted (ms)",
        "80 % interval (ms)",
        "error",
    )
    share = f"<p>{hits} of {len(rows)} lie in their 80 % intervals.</p>" if rows else "<p>There are none.</p>"
    return NOTES["check"] + share + (_table(head, lines, "Rows for checking", (0, 1, 2, 3)) if rows else "")


def _left_out_rows() -> str:
    parts = []
    reasons = (
        ("latency", Counter(row.note for row in load_latency_rows(uses=("out",))), len(load_latency_rows())),
        ("wall power", Counter(row.note for row in load_power_rows(uses=("out",))), len(load_power_rows())),
    )
    for name, counts, used in reasons:
        lines = [(note, count) for note, count in counts.most_common()]
        caption = f"Published rows of {name} that are not used: {counts.total()}; used: {used}"
        parts.append(_table(("reason", "rows"), lines, caption))
    checks = Counter(row.note for row in load_latency_rows(uses=("check",)))
    caption = f"Rows of latency that only check: {checks.total()}"
    parts.append(_table(("reason", "rows"), checks.most_common(), caption))
    modules = {row.module for row in load_latency_rows()}
    without = ", ".join(slug for slug in list_modules() if slug not in modules)
    return NOTES["not used"] + "".join(parts) + f"<p>Modules without any row in the fit: {html.escape(without)}.</p>"


def _repository(source: str) -> str:
    """Return the part of a source that names the project or site."""
    found = re.match(r"github:[^:]+|https?://[^/]+(?:/[^/]+){0,2}|[^:]+:.*", source)
    return found[0] if found else source


def _origins() -> str:
    latency = Counter(_repository(row.source) for row in load_latency_rows())
    power = Counter(_repository(row.source) for row in load_power_rows())
    sources = [(s, latency.get(s, 0), power.get(s, 0)) for s in sorted({*latency, *power})]
    runtime = [
        (name, f"{figure.value:g}", figure.unit, figure.provenance, figure.source, figure.note)
        for name, figure in runtime_figures().items()
    ]
    modules = Counter(figure.provenance for slug in list_modules() for figure in load_module(slug).figures.values())
    counted = ", ".join(f"{count} {name}" for name, count in modules.most_common())
    return (
        NOTES["origins"]
        + _table(("source", "latency rows", "power rows"), sources, "Published measurements in the fit")
        + f"<p>Figures of the modules themselves, in the catalogue: {counted}. "
        "<code>robotbrain jetson show MODULE</code> lists each with its source.</p>"
        + _table(
            ("figure", "value", "unit", "provenance", "source", "note"),
            runtime,
            "Memory and heat: figures of runtime.toml, not fitted to anything",
            (0, 2, 3, 4, 5),
        )
    )
