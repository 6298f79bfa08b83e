"""The closed form: what a change should gain by Amdahl's law on the critical path, to explain what a replay says."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from robotbrain.monitoring.whatif_changes import (
    Change,
    Device,
    Faster,
    MoveTo,
    OwnExecutor,
    QueueDepth,
    SmallerMessages,
    Threads,
    Together,
    Without,
)

if TYPE_CHECKING:
    from robotbrain.monitoring.critical_path import Path, Span


def estimate_ms(paths: Sequence[Path], change: Change) -> float:
    """Return the gain in mean latency that the recorded paths promise, ms: Amdahl's law on the critical path.

    Every span that the change acts on shrinks by its factor: execution, and waiting for somebody else's execution.
    Nothing else moves: what waits for a timer is assumed to wait as long as before, queues to drain as before. A timer
    between a change and the sink passes a gain on in the mean, not in each case.
    """
    if not paths:
        return 0.0
    total = sum(span.length_ns * (1 - _left(span, change)) for path in paths for span in path.spans)
    return total / len(paths) * 1e-6


def _left(span: Span, change: Change) -> float:
    """Return the share of a span that a change leaves."""
    if isinstance(change, Together):
        left = 1.0
        for part in change.changes:
            left *= _left(span, part)
        return left
    worker = span.by or (span.place if span.cause == "execution" else None)
    if isinstance(change, Faster) and worker is not None and span.cause in ("execution", "contention", "queueing"):
        here = change.resource is None or span.cause == "queueing" or span.resource == change.resource
        return 1 / change.times if here and change.touches(worker) else 1.0
    if isinstance(change, OwnExecutor) and span.cause == "queueing" and span.by is not None:
        apart = not change.nodes or {span.by.node, span.place.node} & set(change.nodes)
        return 0.0 if span.by.node != span.place.node and apart else 1.0
    if isinstance(change, Threads) and span.cause == "queueing" and span.by is not None:
        return 0.0 if span.by.node != span.place.node and change.threads > 1 else 1.0
    if isinstance(change, QueueDepth) and span.cause == "queueing" and span.place == span.by:
        # At most the rest of the one that runs is waited for; the older messages are gone.
        return 0.0 if (span.place.node, span.place.name) == (change.node, change.topic) else 1.0
    if isinstance(change, MoveTo) and span.place.node == change.node and span.resource == change.source:
        return 0.0 if span.cause == "contention" else change.slower
    if isinstance(change, Device) and span.cause in ("execution", "contention"):
        factor = {"cpu": change.cpu, "gpu": change.gpu}.get(span.resource, change.dla)
        return 1 / factor
    if isinstance(change, Without) and span.by is not None:
        return 0.0 if span.by.node == change.node else 1.0
    if isinstance(change, SmallerMessages):
        if span.cause == "transport" and span.resource == change.topic:
            return change.left
        if span.cause == "execution" and span.place.kind == "subscription" and span.place.name == change.topic:
            return change.left if change.work is None else 1 - change.work + change.work * change.left
    return 1.0
