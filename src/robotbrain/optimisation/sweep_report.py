"""The report of a sweep: one HTML page with everything in it."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from robotbrain.errors import InputError
from robotbrain.files import write_text
from robotbrain.jetson.tables import short
from robotbrain.monitoring.report_page import cards, figure, page, table
from robotbrain.optimisation.semi_structured import SOURCES
from robotbrain.optimisation.sweep import NEAR, best_row, clock_note, complete, front_of, latency_of
from robotbrain.optimisation.sweep_plots import plot_sweep

Row = Mapping[str, Any]

_NOTES = (
    "Accuracy is the mean intersection over union on the validation split. Choices were made on these images, so the "
    "figure to quote is that of the chosen network on the test split.",
    "INT8 files are judged with ONNX Runtime's optimisations off: the Q/DQ arithmetic is then done in floating point, "
    "as exactly as it is written. Fused integer kernels saturate on processors without VNNI.",
    "Time on this machine: ONNX Runtime, one thread, median of turns alternating with the teacher, processor time "
    "where others disturbed them. A quantised network is timed as its sibling with unsigned activations, which ONNX "
    "Runtime has fast kernels for; a network trained for quantisation is timed as it is.",
    "Time and energy on a Jetson are predictions of the twin, no measurements. The interval is of the absolute time; "
    "compositions of one network share most of that error, so that their order is surer than their times. Networks "
    "this small hardly differ there: launching kernels takes longer than computing them. A network without Q/DQ nodes "
    "is built in FP32 and in FP16 and counts with the faster; one with them in INT8. TensorRT refuses Q/DQ nodes on "
    "modules without INT8: there is no figure then.",
    "Weights: bytes in the precision they run in. The file that TensorRT takes holds quantised weights as floats, so "
    "it does not shrink; the engine built from it does.",
    "Zeros in the weights change neither time nor size: dense kernels multiply by zero as slowly as by anything else. "
    "Only the compressed file is smaller. For 2:4 patterns on Ampere the twin promises nothing, because nobody has "
    "published a gain for networks this narrow: " + "; ".join(SOURCES) + ".",
)


def write_sweep_report(rows: Sequence[Row], path: str | Path, module: str | None = None) -> Path:
    """Write the report of a sweep and return its path.

    Args:
        rows: of the sweep.
        path: of the HTML file.
        module: that the figure shows; the last of the sweep's if None.

    Raises:
        InputError: for no complete rows, an unknown module, or a place that cannot be written to.
    """
    content = sweep_report(rows, module)
    try:
        return write_text(path, content)
    except OSError as error:
        raise InputError(
            "report", given=str(path), expected="a place that can be written to", fix=str(error)
        ) from error


def sweep_report(rows: Sequence[Row], module: str | None = None) -> str:
    """Return the report of a sweep as one HTML page that needs nothing else."""
    good = complete(rows)
    drawn = figure(plot_sweep(rows, module))
    modules = list(good[0]["twin_ms"])
    sections = [
        ("Accuracy against time", drawn),
        ("What nothing beats", "".join(_front_table(good, where) for where in ("host", *modules))),
        ("Every composition", _all(good, modules)),
    ]
    failed = [row for row in rows if "error" in row]
    if failed:
        lines = [(row["label"], row["error"]) for row in failed]
        sections.append(("What could not be made", table(("composition", "why"), lines, "Errors", words=(0, 1))))
    notes = "".join(f"<li>{html.escape(text)}</li>" for text in _NOTES)
    sections.append(("How it was measured", f'<ul class="notes">{notes}</ul>'))
    return page("Compositions of optimisations", _lead(good), sections)


def table_rows(rows: Sequence[Row], modules: Sequence[str]) -> tuple[list[str], list[list[str]]]:
    """Return titles and cells of a table of rows, for a page as for a terminal."""
    head = ["composition", "mIoU", "lost (points)", "here (ms)", "times faster"]
    head += [f"{m} (ms)" for m in modules] + ["weights (kB)", "file, gz (kB)", "zeros"]
    body = []
    for row in rows:
        cells = [row["label"], f"{row['mean_iou']:.4f}", f"{row['drop']:+.2f}", short(row["host_ms"])]
        cells.append(f"{row['host_speedup']:.1f}")
        for module in modules:
            value = latency_of(row, module)
            cells.append("none" if value is None else f"{short(value)} {row['twin_precision'][module]}")
        cells += [short(row["weights_bytes"] / 1e3), short(row["gzip_bytes"] / 1e3), f"{row['sparsity']:.0%}"]
        body.append(cells)
    return head, body


def _lead(rows: Sequence[Row]) -> str:
    best, teacher = best_row(rows), rows[0]
    entries = [
        (f"{best['host_speedup']:.1f} times", f"faster than the teacher on this machine: {best['label']}", False),
        (f"{best['drop']:+.2f} points", "of mIoU lost by it", False),
        (f"{teacher['weights_bytes'] / best['weights_bytes']:.0f} times", "smaller are its weights", False),
        (f"{teacher['mean_iou']:.3f}", "mIoU of the teacher", False),
    ]
    words = (
        f"{len(rows)} ways to make a segmentation network small and fast, each measured alike. The figures at a glance "
        f"are of the fastest that loses at most {NEAR:g} point of mIoU."
    )
    warning = clock_note(rows)
    said = f"<p><strong>{html.escape(warning)}</strong></p>" if warning else ""
    return f'<p class="quiet">{words}</p>{said}{cards(entries)}'


def _front_table(rows: Sequence[Row], where: str) -> str:
    from robotbrain.jetson.catalogue import load_module

    place = "This machine, measured" if where == "host" else f"{load_module(where).name}, predicted by the twin"
    head, lines = ["composition", "lost (points of mIoU)", "time (ms)"], []
    if where != "host":
        head += ["80 % interval (ms)", "precision", "energy (mJ)"]
    for row in front_of(rows, where):
        cells = [row["label"], f"{row['drop']:+.2f}", short(latency_of(row, where) or 0.0)]
        if where != "host":
            precision = row["twin_precision"][where]
            figures = row["twin"][where][precision]
            interval = f"{short(figures['latency_low_ms'])} to {short(figures['latency_high_ms'])}"
            cells += [interval, precision.upper(), short(row["energy_mj"][where])]
        lines.append(cells)
    return table(head, lines, place)


def _all(rows: Sequence[Row], modules: Sequence[str]) -> str:
    head, body = table_rows(sorted(rows, key=lambda row: row["drop"]), modules)
    return table(head, body, "In the order of what they lose")
