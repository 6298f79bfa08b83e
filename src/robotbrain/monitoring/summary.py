"""What a monitor or a trace says about a run: typed figures, as tables for a person and as JSON for a program."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from robotbrain.jetson.tables import format_table
from robotbrain.monitoring.deadlines import Jitter
from robotbrain.monitoring.distribution import Distribution, none_if_nan


@dataclass(frozen=True)
class CallbackSummary:
    """One callback of one node, over a run.

    Attributes:
        node, role, kind, name: which; the role may be empty.
        calls: that ended.
        rate_hz: starts per second, from the first to the last; NaN for fewer than two.
        latency: from start to end, ms.
        response: from being ready to the end, ms.
        queueing: from being ready to the start, ms.
        contention: by how much it took longer than on an idle device, ms; without any in wall-clock time.
        demand: what one call wants of each resource (``cpu``, ``gpu``, ...), ms; the GPU's or a DLA's is the inference.
        jitter: of its starts.
        age: of the message's header stamp when the callback starts, ms.
        deadline_ms: for the response; None without one.
        misses: calls over the deadline, and messages dropped or expired before their call.
        failures: calls that raised.
    """

    node: str
    role: str
    kind: str
    name: str
    calls: int
    rate_hz: float
    latency: Distribution
    response: Distribution = field(default_factory=Distribution)
    queueing: Distribution = field(default_factory=Distribution)
    contention: Distribution = field(default_factory=Distribution)
    demand: Mapping[str, Distribution] = field(default_factory=dict)
    jitter: Jitter = field(default_factory=Jitter)
    age: Distribution = field(default_factory=Distribution)
    deadline_ms: float | None = None
    misses: int = 0
    failures: int = 0

    @property
    def label(self) -> str:
        """Node and what sets the callback off, e.g. ``/controller timer _control``."""
        return f"{self.node} {self.kind} {self.name}"

    @property
    def busy_share(self) -> float:
        """Share of one worker's time between its first and last start; NaN if unknown."""
        return self.latency.mean * self.rate_hz * 1e-3


@dataclass(frozen=True)
class TopicSummary:
    """One topic: messages, rate from first to last (NaN for fewer than two), mean size in bytes."""

    topic: str
    messages: int
    rate_hz: float
    mean_bytes: float
    period: Jitter = field(default_factory=Jitter)


@dataclass(frozen=True)
class QueueSummary:
    """One subscription's queue: limit (None: none), most and mean waiting, messages lost."""

    node: str
    topic: str
    limit: int | None
    max_depth: int
    mean_depth: float
    dropped: int
    expired: int = 0


@dataclass(frozen=True)
class ChainSummary:
    """One chain from sensor to command: age of the reading when the command leaves, ms."""

    chain: tuple[str, ...]
    age: Distribution

    @property
    def label(self) -> str:
        """The chain in words."""
        return " > ".join(self.chain)


@dataclass(frozen=True)
class Summary:
    """A run in figures.

    Attributes:
        title: of the run.
        clock: ``simulated`` or ``wall``: what the times are.
        seconds: how long was watched.
        callbacks, topics, queues, chains: see there.
        spans: what ``monitor.span`` and ``monitor.record`` timed, ms, by name.
        utilisation: share of its capacity that each resource was busy, 0 to 1, where known.
        end_to_end: age of the oldest input of each command over all chains, ms.
        alarms: texts of the alarms that were raised, newest last.
        notes: what else a reader must know: clock jumps, errors of the monitor itself.
    """

    title: str
    clock: str
    seconds: float
    callbacks: tuple[CallbackSummary, ...] = ()
    topics: tuple[TopicSummary, ...] = ()
    queues: tuple[QueueSummary, ...] = ()
    chains: tuple[ChainSummary, ...] = ()
    spans: Mapping[str, Distribution] = field(default_factory=dict)
    utilisation: Mapping[str, float] = field(default_factory=dict)
    end_to_end: Distribution = field(default_factory=Distribution)
    alarms: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def callback(self, node: str, kind: str, name: str) -> CallbackSummary:
        """Return one callback's figures; ``node`` may be a role.

        Raises:
            KeyError: if there is none.
        """
        for found in self.callbacks:
            if node in (found.node, found.role) and (kind, name) == (found.kind, found.name):
                return found
        raise KeyError((node, kind, name))

    @property
    def misses(self) -> int:
        """Deadlines missed, all together."""
        return sum(callback.misses for callback in self.callbacks)

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain data for JSON; numbers that do not exist are None."""
        plain = _plain(self)
        assert isinstance(plain, dict)
        return plain

    def to_json(self) -> str:
        """Return everything as JSON."""
        return json.dumps(self.to_dict(), allow_nan=False, indent=1)

    def __str__(self) -> str:
        parts = [f"{self.title or 'run'}: {self.seconds:.1f} s of {self.clock} time"]
        if self.end_to_end.count:
            e2e = self.end_to_end
            parts.append(f"end to end, sensor to command: median {e2e.p50:.1f} ms, 99 % {e2e.p99:.1f} ms")
        parts += [format_table(head, rows, left) for head, rows, left in self.tables().values() if rows]
        if self.utilisation:
            parts.append("busy: " + ", ".join(f"{name} {100 * use:.0f} %" for name, use in self.utilisation.items()))
        parts += [f"alarm: {text}" for text in self.alarms] + [f"note: {text}" for text in self.notes]
        return "\n\n".join(parts)

    def tables(self) -> dict[str, tuple[tuple[str, ...], list[tuple[str, ...]], tuple[int, ...]]]:
        """Return the tables by name: (column titles, rows of text, columns of words)."""
        return {
            "callbacks": (_CALLBACK_HEAD, [_callback_row(c) for c in self.callbacks], (0, 1, 2)),
            "chains": (
                ("from sensor to command (ms)", "commands", "median", "95 %", "99 %", "worst"),
                [(c.label, str(c.age.count), *(_ms(v) for v in _four(c.age))) for c in self.chains],
                (0,),
            ),
            "queues": (
                ("queue", "topic", "limit", "deepest", "mean", "dropped", "expired"),
                [_queue_row(q) for q in self.queues if q.max_depth or q.dropped or q.expired],
                (0, 1),
            ),
            "topics": (
                ("topic", "messages", "Hz", "period (ms)", "deviation, 95 % (ms)", "bytes"),
                [
                    (t.topic, str(t.messages), _ms(t.rate_hz), _ms(t.period.period_ms),
                     _ms(t.period.deviation.p95), "-" if math.isnan(t.mean_bytes) else f"{t.mean_bytes:.0f}")
                    for t in self.topics
                ],
                (0,),
            ),
            "spans": (
                ("span (ms)", "count", "median", "95 %", "99 %", "worst"),
                [(name, str(d.count), *(_ms(v) for v in _four(d))) for name, d in self.spans.items()],
                (0,),
            ),
        }  # fmt: skip


_CALLBACK_HEAD = (
    "node",
    "kind",
    "name",
    "calls",
    "Hz",
    "latency p50",
    "p99",
    "response p50",
    "p99",
    "waited p99",
    "age p50",
    "GPU/DLA",
    "deadline",
    "missed",
)


def _callback_row(c: CallbackSummary) -> tuple[str, ...]:
    inference = sum(d.mean for name, d in c.demand.items() if name != "cpu")
    return (
        c.node,
        c.kind,
        c.name,
        str(c.calls),
        _ms(c.rate_hz),
        _ms(c.latency.p50),
        _ms(c.latency.p99),
        _ms(c.response.p50),
        _ms(c.response.p99),
        _ms(c.queueing.p99),
        _ms(c.age.p50),
        _ms(inference) if inference else "-",
        "-" if c.deadline_ms is None else _ms(c.deadline_ms),
        "-" if c.deadline_ms is None else str(c.misses),
    )


def _queue_row(q: QueueSummary) -> tuple[str, ...]:
    limit = "none" if q.limit is None else str(q.limit)
    return (q.node, q.topic, limit, str(q.max_depth), f"{q.mean_depth:.2f}", str(q.dropped), str(q.expired))


def _four(d: Distribution) -> tuple[float, float, float, float]:
    return d.p50, d.p95, d.p99, d.max


def _ms(value: float) -> str:
    """Return a number with a sensible count of digits, a dash if there is none."""
    if math.isnan(value):
        return "-"
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.1f}" if abs(value) >= 10 else f"{value:.2f}"


def _plain(value: Any) -> Any:
    if isinstance(value, Distribution | Jitter):
        return value.to_dict()
    if hasattr(value, "__dataclass_fields__"):
        return {name: _plain(getattr(value, name)) for name in value.__dataclass_fields__}
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    return none_if_nan(value) if isinstance(value, float) else value
