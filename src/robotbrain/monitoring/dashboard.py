"""A dashboard that follows a running brain: in a notebook as a picture that changes in place, elsewhere as text.

::

    dashboard = Dashboard(monitor)
    dashboard.show()          # in JupyterLab; dashboard.stop() when it is enough
    dashboard.run(30.0)       # in a script: a few lines of text a second, for 30 s

A recorded run is shown in the same way, at any speed::

    Dashboard().replay(run.trace, speed=2.0)
"""

from __future__ import annotations

import bisect
import dataclasses
import html
import math
import re
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

from robotbrain.errors import InputError
from robotbrain.monitoring.chains import main_chains
from robotbrain.monitoring.deadlines import Deadlines
from robotbrain.monitoring.queues import queue_timelines
from robotbrain.monitoring.snapshots import Glance, Snapshot

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from robotbrain.monitoring.monitor import Monitor
    from robotbrain.monitoring.trace import Trace

_SHOWN = 5
_PERCENT = {
    "cpu_percent": "processors",
    "gpu_percent": "GPU",
}


def plot_dashboard(snapshots: Sequence[Snapshot], *, most: int = _SHOWN) -> Figure:
    """Return four panels over time: age of commands, response of the slowest callbacks, rates, and what is busy.

    Args:
        snapshots: oldest first.
        most: lines in a panel.
    """
    from robotbrain.figures import INK, new_figure

    alarms = snapshots[-1].alarms if snapshots else ()
    figure = new_figure(13.5, 5.8 + 0.22 * min(3, len(alarms)))
    panels = figure.subplots(2, 2)
    words = [
        _glances(panels[0, 0], snapshots, "chains", "sensor to command (ms)", 2),
        _glances(panels[0, 1], snapshots, "callbacks", "slowest callbacks (ms)", most),
        _rates(panels[1, 0], snapshots, most),
        _use(panels[1, 1], snapshots),
    ]
    for axes in panels[1]:
        axes.set_xlabel("time (s)")
    if alarms:
        more = f"  (and {len(alarms) - 3} more)" if len(alarms) > 3 else ""
        figure.suptitle(
            "⚠ " + "\n⚠ ".join(alarms[:3]) + more, color=INK, fontweight="bold", fontsize=10, ha="left", x=0.01
        )
    span = f"{snapshots[0].time_s:.0f} to {snapshots[-1].time_s:.0f} s. " if snapshots else "Nothing to show yet. "
    said = "; ".join(word for word in words if word)
    figure.set_label(f"Dashboard, {span}{said}. " + ("Alarms: " + "; ".join(alarms) if alarms else "No alarm."))
    return figure


def _style(index: int) -> tuple[str, Any]:
    from robotbrain.figures import LINES, PALETTE

    return PALETTE[index % len(PALETTE)], LINES[index % len(LINES)]


def _finish(axes: Axes, heading: str, legend: bool = True) -> None:
    from robotbrain.figures import tidy, title

    tidy(axes)
    title(axes, heading)
    axes.set_ylim(0, None)
    if legend and axes.get_legend_handles_labels()[0]:
        # Beside the lines: above them it would hide what matters most, the high values.
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.02), fontsize=8, frameon=False, handlelength=2.4)


def _glances(axes: Axes, snapshots: Sequence[Snapshot], field: str, heading: str, most: int) -> str:
    """Draw medians as lines and the way up to the 99th percentiles as bands."""
    newest: dict[str, Glance] = dict(getattr(snapshots[-1], field)) if snapshots else {}
    known = {name: glance for name, glance in newest.items() if not math.isnan(glance.p99_ms)}
    chosen = sorted(known, key=lambda name: -known[name].p99_ms)[:most]
    for index, name in enumerate(chosen):
        colour, line = _style(index)
        found = [(s.time_s, getattr(s, field)[name]) for s in snapshots if name in getattr(s, field)]
        times = [t for t, _ in found]
        axes.plot(times, [g.p50_ms for _, g in found], ls=line, color=colour, lw=1.6, label=_short(name))
        axes.fill_between(times, [g.p50_ms for _, g in found], [g.p99_ms for _, g in found], color=colour, alpha=0.15)
    _finish(axes, f"{heading}: median, band up to 99 %")
    return "; ".join(f"{name}: median {known[name].p50_ms:.1f} ms, 99 % {known[name].p99_ms:.1f} ms" for name in chosen)


def _short(name: str) -> str:
    """Return a name in lines that are short enough for a legend."""
    if " > " in name:
        return name.replace(" > ", "\n → ")
    return re.sub(" (timer|subscription|service|client) ", "\n ← ", name)


def _rates(axes: Axes, snapshots: Sequence[Snapshot], most: int) -> str:
    newest = dict(snapshots[-1].topics) if snapshots else {}
    # What reaches the wheels comes first, then what comes least often: sensors at full rate are seldom the trouble.
    chosen = sorted(newest, key=lambda topic: (topic != "/cmd_vel", newest[topic] == 0, newest[topic]))[:most]
    for index, topic in enumerate(chosen):
        colour, line = _style(index)
        points = [(s.time_s, s.topics[topic]) for s in snapshots if topic in s.topics]
        axes.plot(*zip(*points, strict=True), ls=line, color=colour, lw=1.6, label=topic)
    _finish(axes, "messages a second (Hz)")
    return ", ".join(f"{topic} {newest[topic]:.1f} Hz" for topic in chosen)


def _use(axes: Axes, snapshots: Sequence[Snapshot]) -> str:
    from robotbrain.figures import QUIET

    series: dict[str, list[tuple[float, float]]] = {}
    for snapshot in snapshots:
        for name, share in snapshot.utilisation.items():
            series.setdefault(f"{name.upper()} (simulated)", []).append((snapshot.time_s, 100 * share))
        for name, label in _PERCENT.items():
            if name in snapshot.resources:
                series.setdefault(label, []).append((snapshot.time_s, snapshot.resources[name]))
    for index, (name, points) in enumerate(series.items()):
        colour, line = _style(index)
        axes.plot(*zip(*points, strict=True), ls=line, color=colour, lw=1.6, label=name)
    extra = []
    if snapshots:
        resources = snapshots[-1].resources
        units = {"temperature_c": "°C", "power_w": "W", "process_rss_mb": "MB"}
        extra = [f"{resources[name]:.0f} {unit}" for name, unit in units.items() if name in resources]
    _finish(axes, "busy (%)" + (", now " + ", ".join(extra) if extra else ""))
    axes.set_ylim(0, 105)
    if not series:
        axes.text(0.5, 0.5, "no source of resources", transform=axes.transAxes, ha="center", color=QUIET)
    return ", ".join(f"{name} {points[-1][1]:.0f} %" for name, points in series.items())


def snapshot_text(snapshot: Snapshot, most: int = _SHOWN) -> str:
    """Return a snapshot as a few lines for a terminal."""

    lines = [f"t = {snapshot.time_s:.1f} s"]
    for name, glance in snapshot.chains.items():
        lines.append(f"  {name}: median {glance.p50_ms:.0f} ms, 99 % {glance.p99_ms:.0f} ms")
    known = [(name, glance) for name, glance in snapshot.callbacks.items() if not math.isnan(glance.p99_ms)]
    for name, glance in sorted(known, key=lambda item: -item[1].p99_ms)[:most]:
        missed = f", {glance.misses} deadlines missed" if glance.misses else ""
        lines.append(f"  {name}: {glance.rate_hz:.1f} Hz, 99 % {glance.p99_ms:.1f} ms{missed}")
    shares = [f"{name} {100 * share:.0f} %" for name, share in snapshot.utilisation.items()]
    shares += [f"{label} {snapshot.resources[n]:.0f} %" for n, label in _PERCENT.items() if n in snapshot.resources]
    if shares:
        lines.append("  busy: " + ", ".join(shares))
    lines += [f"  ALARM {text}" for text in snapshot.alarms]
    return "\n".join(lines)


def snapshots_of(
    trace: Trace, every_s: float = 0.5, window_s: float = 2.0, deadlines: Deadlines | None = None
) -> list[Snapshot]:
    """Return what a monitor would have seen of a recorded run.

    Args:
        trace: of the run.
        every_s: between snapshots, > 0.
        window_s: length of the windows of recent figures, > 0.
        deadlines: of its callbacks; those of the kit's brain by default.

    Raises:
        InputError: for values out of these ranges.
    """
    from robotbrain.monitoring.monitor import Monitor

    monitor = Monitor(
        deadlines,
        window_s,
        chains=main_chains(trace),
        snapshot_s=every_s,
        keep=max(1, math.ceil(trace.seconds / every_s) + 1) if every_s > 0 else 1,
        roles=trace.roles,
    )
    monitor.begin(trace.start_ns)
    # A callback counts when it ends, before what it sent leaves; the ids keep the order within one instant.
    order: list[tuple[int, int, int, Callable[[], None]]] = []
    for callback in trace.callbacks:
        order.append((callback.end_ns, callback.id, 0, lambda record=callback: monitor.see_callback(record)))  # type: ignore[misc]
    for message in trace.messages:
        sender = trace.sender.get(message.id)
        stamp = trace.stamps.get(message.id)
        order.append(
            (
                message.released_ns,
                0 if sender is None else sender.id,
                1,
                lambda record=message, stamp=stamp: monitor.see_message(record, stamp),  # type: ignore[misc]
            )
        )
    for _, _, _, happen in sorted(order, key=lambda entry: entry[:3]):
        happen()
    return _with_device(trace, list(monitor.snapshots), every_s)


def _with_device(trace: Trace, snapshots: list[Snapshot], every_s: float) -> list[Snapshot]:
    """Add depths of queues and use of the device, which a monitor reads off the simulation."""
    from robotbrain.monitoring.plots import busy_over_time

    queues = queue_timelines(trace)
    shares = busy_over_time(trace, every_s)[1] if trace.capacity else {}
    found = []
    for snapshot in snapshots:
        now = trace.start_ns + snapshot.time_s * 1e9
        depths = {f"{q.node} {q.topic}": int(q.depth[max(0, bisect.bisect(q.time_ns, now) - 1)]) for q in queues}
        place = max(0, math.ceil(snapshot.time_s / every_s - 0.5) - 1)
        use = {name: float(share[min(place, len(share) - 1)]) for name, share in shares.items()}
        found.append(dataclasses.replace(snapshot, queues=depths, utilisation=use))
    return found


class Dashboard:
    """Follows a monitor, or replays a trace.

    Args:
        monitor: that watches a brain.
        period_s: between pictures, > 0.
        span_s: of the past that is shown, > 0.

    Raises:
        InputError: for values out of these ranges.
    """

    def __init__(self, monitor: Monitor | None = None, *, period_s: float = 1.0, span_s: float = 60.0) -> None:
        for name, value in (("period_s", period_s), ("span_s", span_s)):
            if not 0 < value < math.inf:
                raise InputError(name, given=value, expected="seconds > 0", fix="Leave it out for a usual value.")
        self.monitor = monitor
        self.period_s, self.span_s = period_s, span_s
        self.problem = ""
        self._widget: Any = None
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()

    # ------------------------------------------------------------ what is shown

    def snapshots(self) -> list[Snapshot]:
        """Return the monitor's snapshots within the span, oldest first, and how things are now as the last."""
        if self.monitor is None:
            return []
        with self.monitor.lock:
            found = [*self.monitor.snapshots, self.monitor.snapshot()]
        return [snapshot for snapshot in found if snapshot.time_s >= found[-1].time_s - self.span_s]

    def figure(self) -> Figure:
        """Return the picture of now."""
        return plot_dashboard(self.snapshots())

    def markup(self, snapshots: Sequence[Snapshot]) -> str:
        """Return the picture as HTML, with its alternative text."""
        from robotbrain.figures import to_html

        head = f"<b>t = {snapshots[-1].time_s:.1f} s</b>" if snapshots else "<b>waiting for the first snapshot</b>"
        trouble = f" <strong>{html.escape(self.problem)}</span>" if self.problem else ""
        return f"<div>{head}{trouble}<br>{to_html(plot_dashboard(snapshots), dpi=100)}</div>"

    # ------------------------------------------------------------ live

    def show(self) -> Any:
        """Show the dashboard below the cell, and keep it up to date until :meth:`stop`; returns the widget.

        Outside a notebook it says how things are, once, as text.
        """
        if not in_notebook():
            print(self.text())
            return None
        self._start(self._live())
        return self._widget

    def text(self) -> str:
        """Return how things are now as text."""
        snapshots = self.snapshots()
        return snapshot_text(snapshots[-1]) if snapshots else "nothing is watched: Dashboard(monitor)"

    def run(self, seconds: float, write: Callable[[str], object] = print) -> None:
        """Write how things are, every period, for so long; for scripts. Ctrl-C ends it."""
        ends = time.monotonic() + seconds
        while True:
            write(self.text())
            left = ends - time.monotonic()
            if left <= 0:
                return
            time.sleep(min(self.period_s, left))

    def replay(self, trace: Trace, speed: float = 1.0, write: Callable[[str], object] = print) -> Any:
        """Show a recorded run as if it happened now, ``speed`` times as fast; returns the widget.

        Outside a notebook the snapshots are written as text at that pace.

        Raises:
            InputError: for a speed that is not positive.
        """
        if not 0 < speed < math.inf:
            raise InputError("speed", given=speed, expected="a number > 0", fix="2 is twice as fast as it happened.")
        found = snapshots_of(trace, every_s=max(0.1, min(0.5 * speed, trace.seconds / 10)))
        if in_notebook():
            self._start(self._paced(found, speed))
            return self._widget
        for shown in self._paced(found, speed):
            write(snapshot_text(shown[-1]))
        return None

    def _live(self) -> Iterator[list[Snapshot]]:
        began, place = time.monotonic(), 0
        while not self._stop.is_set():
            yield self.snapshots()
            place = max(place + 1, math.ceil((time.monotonic() - began) / self.period_s))
            self._stop.wait(max(0.0, began + place * self.period_s - time.monotonic()))

    def _paced(self, snapshots: Sequence[Snapshot], speed: float) -> Iterator[list[Snapshot]]:
        began = time.monotonic()
        for index, newest in enumerate(snapshots):
            late = time.monotonic() - began - newest.time_s / speed
            last = index == len(snapshots) - 1
            if late > 0.5 and not last:
                continue  # drawing takes longer than that: leave one out rather than fall behind
            if self._stop.wait(max(0.0, -late)):
                return
            yield [s for s in snapshots[: index + 1] if s.time_s >= newest.time_s - self.span_s]

    def _start(self, frames: Iterator[list[Snapshot]]) -> None:
        from IPython.display import display
        from ipywidgets import HTML

        self.stop()
        self._stop.clear()
        self.problem = ""
        self._widget = HTML(self.markup([]))
        display(self._widget)
        self._thread = threading.Thread(target=self._draw, args=(frames,), name="robotbrain-dashboard", daemon=True)
        self._thread.start()

    def _draw(self, frames: Iterator[list[Snapshot]]) -> None:
        for snapshots in frames:
            try:
                self._widget.value = self.markup(snapshots)
            except Exception as error:  # a picture that fails must not end the dashboard, let alone the brain
                self.problem = f"a picture failed: {type(error).__name__}: {error}"

    def stop(self) -> None:
        """Stop updating; the last picture stays."""
        self._stop.set()
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join(5.0)

    def __enter__(self) -> Dashboard:
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()


def in_notebook() -> bool:
    """Tell whether this runs in a Jupyter kernel, where widgets can be shown."""
    try:
        from IPython import get_ipython
    except ImportError:
        return False
    shell = get_ipython()
    return shell is not None and getattr(shell, "kernel", None) is not None
