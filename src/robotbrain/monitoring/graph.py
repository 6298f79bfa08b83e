"""The computation graph as it was in a run: who sent what to whom, and how often."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from robotbrain.errors import InputError
from robotbrain.figures import BLUE, VERMILLION, new_figure
from robotbrain.monitoring.trace import Trace

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Edge:
    """Messages from one node to another.

    Attributes:
        source, target: fully qualified node names.
        name: of the topic or service.
        kind: ``topic`` or ``service`` (its requests and answers together; the source is the client).
        type_name: ROS type.
        count: messages taken, or calls.
        rate_hz: the same per second of the trace.
        mean_size: of a message (of a service: of a request), bytes.
    """

    source: str
    target: str
    name: str
    kind: str
    type_name: str
    count: int
    rate_hz: float
    mean_size: float


def edges(trace: Trace) -> list[Edge]:
    """Return the edges of a run's graph, by source, target and name. Messages that nobody took make none."""
    found: dict[tuple[str, str, str, str, str], list[int]] = {}
    for callback in trace.callbacks:
        message = trace.message_by_id.get(callback.message)
        if message is None or message.kind == "response":
            continue
        kind = "topic" if message.kind == "topic" else "service"
        found.setdefault((message.node, callback.node, message.name, kind, message.type_name), []).append(message.size)
    seconds = trace.seconds
    return [
        Edge(
            *key,
            count=len(sizes),
            rate_hz=len(sizes) / seconds if seconds else math.nan,
            mean_size=sum(sizes) / len(sizes),
        )
        for key, sizes in sorted(found.items())
    ]


def plot_graph(trace: Trace, nodes: Sequence[str] | None = None) -> Figure:
    """Draw who talks to whom: a row for each node, a column for each topic and service. Its label is its alt text.

    A dot sends and a triangle receives; the two ends of a service are joined by a broken line. However many
    connections there are, none crosses another.

    Args:
        trace: of the run.
        nodes: names of the rows from top to bottom; by default those that exchange messages, sorted.

    Raises:
        InputError: for a run without messages, or ``nodes`` that leave one out or name one that is not there.
    """

    shown = edges(trace)
    present = sorted({edge.source for edge in shown} | {edge.target for edge in shown})
    rows = present if nodes is None else list(nodes)
    if sorted(rows) != present or not present:
        raise InputError(
            "nodes of a graph",
            given=rows,
            expected="those that exchange messages: " + (", ".join(present) or "there are none in this trace"),
            fix="Name each of them once.",
        )
    height = {node: len(rows) - 1 - index for index, node in enumerate(rows)}
    # In the order in which a message travels: by the sender's row.
    links = sorted({(edge.kind, edge.name) for edge in shown}, key=lambda link: _order(link, shown, rows))
    figure = new_figure(max(6.0, 0.62 * len(links) + 2.2), 0.46 * len(rows) + 1.9)
    axes = figure.subplots()
    for x, link in enumerate(links):
        _column(axes, x, [edge for edge in shown if (edge.kind, edge.name) == link], height)
    axes.set(xlim=(-0.6, len(links) - 0.4), ylim=(-0.6, len(rows) - 0.4), xticks=range(len(links)))
    axes.set_yticks([height[node] for node in rows], [node.strip("/") for node in rows], fontsize=11)
    labels = [_label([edge for edge in shown if (edge.kind, edge.name) == link]) for link in links]
    axes.xaxis.tick_top()
    axes.set_xticklabels(labels, rotation=38, ha="left", rotation_mode="anchor", fontsize=9)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    for y in height.values():
        axes.axhline(y, color="#E3E3E3", linewidth=9, zorder=0)
    words = "; ".join(f"{e.source.strip('/')} to {e.target.strip('/')} by {e.kind} {e.name}, {_rate(e)}" for e in shown)
    figure.set_label(f"Graph of nodes with their topics and services. {words}.")
    return figure


_TOPIC, _SERVICE = BLUE, VERMILLION


def _order(link: tuple[str, str], shown: Sequence[Edge], rows: Sequence[str]) -> tuple[int, int, str]:
    mine = [edge for edge in shown if (edge.kind, edge.name) == link]
    return min(rows.index(e.source) for e in mine), min(rows.index(e.target) for e in mine), link[1]


def _rate(edge: Edge) -> str:
    if edge.rate_hz >= 0.95:
        return f"{edge.rate_hz:.0f} Hz"
    return f"{edge.count} {'time' if edge.count == 1 else 'times'}"


def _label(between: Sequence[Edge]) -> str:
    busiest = max(between, key=lambda edge: edge.count)
    kind = " (service)" if busiest.kind == "service" else ""
    return f"{busiest.name.strip('/')}{kind}, {_rate(busiest)}"


def _column(axes: Axes, x: int, between: Sequence[Edge], height: dict[str, int]) -> None:
    service = between[0].kind == "service"
    colour = _SERVICE if service else _TOPIC
    senders = sorted({height[edge.source] for edge in between})
    takers = sorted({height[edge.target] for edge in between})
    ends = (min(senders + takers), max(senders + takers))
    axes.plot((x, x), ends, color=colour, linewidth=1.6, linestyle="--" if service else "-", zorder=1)
    axes.plot([x] * len(senders), senders, "o", color=colour, markersize=9, zorder=2)
    for y in takers:
        # The triangle points the way the message comes.
        marker = "v" if y < max(senders) else "^"
        axes.plot(x, y, marker, color=colour, markerfacecolor="white", markeredgewidth=1.8, markersize=10, zorder=2)
