"""The report of a run: one HTML file with everything in it, for whoever was not there."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotbrain.errors import InputError
from robotbrain.files import write_text
from robotbrain.monitoring import plots
from robotbrain.monitoring.deadlines import Deadlines
from robotbrain.monitoring.metrics import measure
from robotbrain.monitoring.report_page import WORDS, cards, figure, page, table
from robotbrain.monitoring.summary import Summary
from robotbrain.monitoring.trace import Trace

if TYPE_CHECKING:
    from robotbrain.monitoring.snapshots import Snapshot


def write_report(
    source: Trace | Summary,
    path: str | Path,
    *,
    window_s: tuple[float, float] | None = None,
    deadlines: Deadlines | None = None,
    snapshots: Sequence[Snapshot] = (),
    title: str = "",
) -> Path:
    """Write the report of a run, whole or not at all, and return its path.

    Args:
        source: a trace, or the summary of a monitor that watched (which knows less).
        path: of the HTML file.
        window_s: from and to, seconds since the beginning, that the timeline shows; around the worst command by
            default.
        deadlines: of a trace's callbacks; those of the kit's brain by default.
        snapshots: that a monitor took.
        title: of the page; that of the run by default.

    Raises:
        InputError: for a window outside the run, or a place that cannot be written to.
    """
    text = report_html(source, window_s=window_s, deadlines=deadlines, snapshots=snapshots, title=title)
    try:
        return write_text(path, text)
    except OSError as error:
        raise InputError(
            "report", given=str(path), expected="a place that can be written to", fix=str(error)
        ) from error


def report_html(
    source: Trace | Summary,
    *,
    window_s: tuple[float, float] | None = None,
    deadlines: Deadlines | None = None,
    snapshots: Sequence[Snapshot] = (),
    title: str = "",
) -> str:
    """Return the report of a run as one HTML page; see :func:`write_report`."""
    trace = source if isinstance(source, Trace) else None
    summary = measure(source, deadlines) if isinstance(source, Trace) else source
    sections: list[tuple[str, str]] = []
    if trace is not None:
        found = _diagnosis(trace)
        if found:
            sections.append(("Diagnosis", found))
        sections.append(("What happened when", WORDS["timeline"] + figure(_timeline(trace, window_s, deadlines))))
    if summary.chains:
        drawn = figure(plots.plot_end_to_end(trace)) if trace is not None else ""
        sections.append(("Sensor to command", WORDS["end to end"] + drawn + _table(summary, "chains", "Age by chain")))
    sections.append(
        (
            "How long callbacks take",
            WORDS["latency"]
            + figure(plots.plot_latencies(summary))
            + _table(summary, "callbacks", "All callbacks; times in ms"),
        )
    )
    if summary.spans:
        sections.append(("Spans", _table(summary, "spans", "What the program timed itself")))
    sections.append(
        (
            "Rates and jitter",
            WORDS["rhythm"] + figure(plots.plot_rhythm(summary)) + _table(summary, "topics", "Topics"),
        )
    )
    if trace is not None:
        sections.append(
            ("Queues", WORDS["queues"] + figure(plots.plot_queues(trace)) + _table(summary, "queues", "Queues"))
        )
        if trace.capacity:
            sections.append(("The device", WORDS["device"] + figure(plots.plot_resources(trace))))
    elif summary.queues:
        sections.append(("Queues", WORDS["queues"] + _table(summary, "queues", "Queues")))
    if snapshots:
        from robotbrain.monitoring.dashboard import plot_dashboard

        sections.append(("Over time", WORDS["history"] + figure(plot_dashboard(snapshots))))
    if summary.alarms or summary.notes:
        sections.append(("Alarms and notes", _notes(summary)))
    return page(title or summary.title or "A run of a robot brain", _lead(summary), sections)


def _timeline(trace: Trace, window_s: tuple[float, float] | None, deadlines: Deadlines | None) -> Any:
    if window_s is None:
        return plots.plot_timeline(trace, deadlines=deadlines)
    begin, end = window_s
    if not 0 <= begin < end <= trace.seconds + 1e-9:
        raise InputError(
            "window_s",
            given=window_s,
            expected=f"two times from 0 to {trace.seconds:g} s, in order",
            fix="For instance (2.0, 2.5).",
        )
    return plots.plot_timeline(
        trace, trace.start_ns + round(begin * 1e9), trace.start_ns + round(end * 1e9), deadlines=deadlines
    )


def _lead(summary: Summary) -> str:
    clock = "simulated time" if summary.clock == "simulated" else "wall-clock time"
    text = f"{summary.seconds:.1f} s of {clock}, {sum(c.calls for c in summary.callbacks):,} callbacks, "
    text += f"{sum(t.messages for t in summary.topics):,} messages."
    return f'<p class="quiet">{html.escape(text)}</p>' + cards(_cards(summary))


def _cards(summary: Summary) -> list[tuple[str, str, bool]]:
    entries: list[tuple[str, str, bool]] = []
    if summary.end_to_end.count:
        entries.append((f"{summary.end_to_end.p50:.0f} ms", "sensor to command, median", False))
        entries.append((f"{summary.end_to_end.p99:.0f} ms", "sensor to command, 99th percentile", False))
    sink = next((t for t in summary.topics if summary.chains and t.topic == summary.chains[0].chain[-1]), None)
    if sink is not None and not math.isnan(sink.rate_hz):
        entries.append((f"{sink.rate_hz:.1f} Hz", f"commands on {sink.topic}", False))
    limited = [c for c in summary.callbacks if c.deadline_ms is not None]
    if limited:
        # A message that was dropped never became a call: it counts as due all the same.
        lost = {(q.node, q.topic): q.dropped + q.expired for q in summary.queues}
        due = sum(c.calls + (lost.get((c.node, c.name), 0) if c.kind == "subscription" else 0) for c in limited)
        share = f" of {due:,} due" if due else ""
        entries.append((f"{summary.misses:,}", f"deadlines missed{share}", summary.misses > 0))
    dropped = sum(q.dropped + q.expired for q in summary.queues)
    entries.append((f"{dropped:,}", "messages lost in queues", dropped > 0))
    if summary.utilisation:
        name, use = max(summary.utilisation.items(), key=lambda item: item[1])
        entries.append((f"{100 * use:.0f} %", f"use of the busiest resource, {name.upper()}", use > 0.9))
    return entries


def _table(summary: Summary, name: str, caption: str) -> str:
    head, rows, words = summary.tables()[name]
    return table(head, rows, caption, words) if rows else ""


def _notes(summary: Summary) -> str:
    parts = []
    for heading, texts in (("Alarms that were raised", summary.alarms), ("To be known", summary.notes)):
        if texts:
            items = "".join(f"<li>{html.escape(text)}</li>" for text in texts)
            parts.append(f'<h3>{heading}</h3><ul class="notes">{items}</ul>')
    return "".join(parts)


def _diagnosis(trace: Trace) -> str:
    """Return what the bottleneck report says; nothing where it is not installed or has nothing to say."""
    try:
        from robotbrain.monitoring.diagnosis import diagnose
    except ImportError:
        return ""
    try:
        found = diagnose(trace)
    except InputError as error:  # a run too short or too strange to be diagnosed
        return f"<p>No diagnosis: {html.escape(str(error))}</p>"
    markup = getattr(found, "_repr_html_", None)
    text = markup() if callable(markup) else None
    return text if isinstance(text, str) else f"<pre>{html.escape(str(found))}</pre>"
