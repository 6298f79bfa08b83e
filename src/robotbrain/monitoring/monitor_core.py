"""What a monitor does with each callback and each message: figures in bounded memory, alarms, snapshots.

Whoever watches a brain uses :class:`~robotbrain.monitoring.monitor.Monitor`; this is what it stands on, and what a
listener (a simulation's taps, wrapped callbacks, a replay) talks to.
"""

from __future__ import annotations

import functools
import logging
import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Concatenate, ParamSpec, TypeVar

from robotbrain.errors import InputError
from robotbrain.monitoring.alarms import Alarm, AlarmBoard, AlarmRules
from robotbrain.monitoring.chains import KIT_CHAINS, ChainTracker, label_of
from robotbrain.monitoring.deadlines import KIT_DEADLINES, Deadlines
from robotbrain.monitoring.sketch import WindowedSketch
from robotbrain.monitoring.snapshots import Snapshot, SnapshotLog
from robotbrain.monitoring.streams import CallbackStream, QueueStream, TopicStream

if TYPE_CHECKING:
    from robotbrain.monitoring.resources import Sampler
    from robotbrain.ros.context import CallbackRecord, MessageRecord, SimContext

_log = logging.getLogger("robotbrain.monitoring")

TICK_NS = 100_000_000
"""The alarms look at the clock so often, ns."""

_KEPT_ALARMS = 200
_KEPT_NOTES = 50
_KEPT_STAMPS = 5000

CallbackKey = tuple[str, str, str]
"""(node, kind, name) of a callback."""

P = ParamSpec("P")
Core = TypeVar("Core", bound="MonitorCore")


def guarded(method: Callable[Concatenate[Core, P], None]) -> Callable[Concatenate[Core, P], None]:
    """Make a method of a monitor thread-safe, and keep whatever goes wrong in it from the brain."""

    @functools.wraps(method)
    def call(monitor: Core, /, *args: P.args, **kwargs: P.kwargs) -> None:
        with monitor.lock:
            try:
                method(monitor, *args, **kwargs)
            except Exception as error:
                monitor.failed(method.__name__, error)

    return call


class MonitorCore:
    """Keeps figures of callbacks, messages, queues and chains; see :class:`~robotbrain.monitoring.monitor.Monitor`."""

    def __init__(
        self,
        deadlines: Deadlines | None = None,
        window_s: float = 10.0,
        *,
        chains: Iterable[Sequence[str]] = KIT_CHAINS,
        rules: AlarmRules | None = None,
        on_alarm: Callable[[Alarm], object] | None = None,
        snapshot_s: float = 1.0,
        keep: int = 600,
        log: str | Path | None = None,
        resources: Sampler | None = None,
        title: str = "",
        accuracy: float = 0.01,
        roles: Mapping[str, str] | None = None,
    ) -> None:
        for name, value in (("window_s", window_s), ("snapshot_s", snapshot_s), ("keep", keep)):
            if not 0 < value < float("inf"):
                raise InputError(name, given=value, expected="a number > 0", fix="The default is a good start.")
        self.deadlines = KIT_DEADLINES if deadlines is None else deadlines
        self.window_ns, self.snapshot_ns = round(window_s * 1e9), round(snapshot_s * 1e9)
        self.title, self.accuracy, self.roles = title, accuracy, dict(roles or {})
        self.lock = threading.RLock()
        self.tracker = ChainTracker(chains)
        self.snapshots: deque[Snapshot] = deque(maxlen=int(keep))
        self.alarms: deque[Alarm] = deque(maxlen=_KEPT_ALARMS)
        self.board = AlarmBoard(rules or AlarmRules())
        self.alarm_listeners = [on_alarm] if on_alarm is not None else []
        self.snapshot_log = SnapshotLog(log) if log is not None else None
        self.sampler = resources
        self.callbacks: dict[CallbackKey, CallbackStream] = {}
        self.topics: dict[str, TopicStream] = {}
        self.queues: dict[tuple[str, str], QueueStream] = {}
        self.stamps: dict[int, int] = {}
        self.ages = [WindowedSketch(accuracy) for _ in self.tracker.chains]
        self.end_to_end = WindowedSketch(accuracy)
        self.spans: dict[str, WindowedSketch] = {}
        self.notes: dict[str, int] = {}
        self.failures = 0
        self.context: SimContext | None = None
        self.offset_ns = 0
        self.start_ns: int | None = None
        self.now_ns = self._next_tick_ns = self._next_snapshot_ns = self.window_start_ns = 0
        self.window_before = False
        self._seen: list[CallbackRecord | tuple[MessageRecord, int | None]] = []
        self._drain_ns = 0
        self.prepare()

    def prepare(self) -> None:
        """Set up what a subclass adds."""

    # ------------------------------------------------------------ a simulation, or a replay

    def see_callback(self, record: CallbackRecord) -> None:
        """Take a callback that ended; it is looked at within a tenth of a second, with others."""
        self._seen.append(record)
        if record.end_ns >= self._drain_ns:
            self.drain()

    def see_message(self, record: MessageRecord, stamp_ns: int | None) -> None:
        """Take a message that left, with its header stamp."""
        self._seen.append((record, stamp_ns))
        if record.released_ns >= self._drain_ns:
            self.drain()

    def drain(self) -> None:
        """Look at what was taken so far. Doing so for many at once costs the brain half as much."""
        with self.lock:
            seen, self._seen = self._seen, []
            for entry in seen:
                try:
                    if isinstance(entry, tuple):
                        self._message_left(*entry)
                    else:
                        self._callback_ended(entry)
                except Exception as error:
                    self.failed("drain", error)
            self._drain_ns = self.now_ns - self.offset_ns + TICK_NS

    def _callback_ended(self, record: CallbackRecord) -> None:
        key = (record.node, record.kind, record.name)
        stream = self.callbacks.get(key) or self.new_callback(key)
        start, ready, end = record.start_ns, record.ready_ns, record.end_ns
        taken_ms = (end - ready) * 1e-6
        stamp = self.stamps.get(record.message)
        missed = stream.add(
            start + self.offset_ns,
            (end - start) * 1e-6,
            taken_ms,
            (start - ready) * 1e-6,
            (end - start - record.demand_ns) * 1e-6,
            record.segments,
            None if stamp is None else (start - stamp) * 1e-6,
        )
        self.tracker.callback(record)
        if record.kind == "subscription":
            queue = self.queues.get((record.node, record.name))
            if queue is not None:
                queue.taken(ready, start)
        now = end + self.offset_ns
        self.call(stream, missed, taken_ms, now)
        self.advance(now)

    def _message_left(self, record: MessageRecord, stamp_ns: int | None) -> None:
        now = record.released_ns + self.offset_ns
        if stamp_ns is not None:
            self.stamps[record.id] = stamp_ns
            if len(self.stamps) > _KEPT_STAMPS:
                del self.stamps[next(iter(self.stamps))]
        if record.kind == "topic":
            self._arrive(record)
            self.message(record.name, now, record.size)
        self.left(self.tracker.message(record.id, label_of(record), stamp_ns), record.released_ns)
        self.advance(now)

    def _arrive(self, record: MessageRecord) -> None:
        topic = self.context.topics.get(record.name) if self.context is not None else None
        for subscription in topic.subscriptions if topic is not None else ():
            place = (subscription.node.get_fully_qualified_name(), record.name)
            queue = self.queues.get(place)
            if queue is None:
                queue = self.queues[place] = QueueStream(*place, subscription.qos_profile.queue_limit)
            queue.arrive(record.released_ns, subscription.dropped)

    # ------------------------------------------------------------ what both have in common

    def begin(self, now_ns: int) -> None:
        """Let the watch begin at a time, ns; a replay calls this."""
        if self.start_ns is None:
            self.start_ns = self.window_start_ns = now_ns
            self._next_tick_ns, self._next_snapshot_ns = now_ns, now_ns + self.snapshot_ns
        self.now_ns = max(self.now_ns, now_ns)
        self._drain_ns = 0
        self.board.restart(now_ns)

    def new_callback(self, key: CallbackKey, period_ns: int | None = None) -> CallbackStream:
        """Return a new stream for a callback; used by the listeners."""
        node, kind, name = key
        context = self.context
        role = self.roles.get(node, "")
        if context is not None:
            role_of = getattr(context.cost_model, "role", None)
            role = role or (str(role_of(node)) if role_of is not None else "")
            if kind == "timer":
                timers = (t for n in context.nodes if n.get_fully_qualified_name() == node for t in n.timers)
                period_ns = next((timer.timer_period_ns for timer in timers if timer.name == name), period_ns)
        # A node of wall-clock time has no role; by custom it is called like what it does.
        limit = self.deadlines.of(node, role or node.rpartition("/")[2], kind, name)
        stream = self.callbacks[key] = CallbackStream(node, role, kind, name, limit, period_ns, self.accuracy)
        return stream

    def message(self, topic: str, now_ns: int, size: int | None) -> None:
        """Count a message; used by the listeners."""
        stream = self.topics.get(topic)
        if stream is None:
            stream = self.topics[topic] = TopicStream(topic)
        stream.add(now_ns, size)
        self.tell(self.board.message(topic, now_ns))

    def left(self, ends: Mapping[int, int | None], now_ns: int) -> None:
        """Note the ages of a command at the ends of chains; used by the listeners."""
        if not ends:
            return
        ages = {index: (now_ns - origin) * 1e-6 for index, origin in ends.items() if origin is not None}
        for index, age in ages.items():
            self.ages[index].add(age)
        if 0 in ends and len(ages) == len(ends):
            self.end_to_end.add(max(ages.values()))

    def call(self, stream: CallbackStream, missed: bool, taken_ms: float, now_ns: int) -> None:
        """Let the alarms know of a call; used by the listeners."""
        if stream.deadline_ms is not None:
            self.tell(self.board.call(stream.label, missed, taken_ms, stream.deadline_ms, now_ns))

    def advance(self, now_ns: int) -> None:
        """Let time pass: alarms, windows and snapshots; used by the listeners."""
        if now_ns <= self.now_ns:
            return
        self.now_ns = now_ns
        if now_ns < self._next_tick_ns:
            return
        self._next_tick_ns = now_ns + TICK_NS
        self.tell(self.board.tick(now_ns))
        if now_ns >= self._next_snapshot_ns:
            self._next_snapshot_ns += -((self._next_snapshot_ns - now_ns - 1) // self.snapshot_ns) * self.snapshot_ns
            self._keep(self.snapshot())
        if now_ns - self.window_start_ns >= self.window_ns:
            for stream in self.callbacks.values():
                stream.roll()
            for sketch in (*self.ages, self.end_to_end, *self.spans.values()):
                sketch.roll()
            self.window_start_ns, self.window_before = now_ns, True

    def tell(self, changes: Iterable[Alarm]) -> None:
        """Keep alarms and tell who wants to know."""
        for alarm in changes:
            self.alarms.append(alarm)
            for listener in self.alarm_listeners:
                try:
                    listener(alarm)
                except Exception as error:
                    self.failed("on_alarm", error)

    def on_alarm(self, listener: Callable[[Alarm], object]) -> None:
        """Call ``listener(alarm)`` when an alarm is raised or cleared. What it raises does not get out."""
        with self.lock:
            self.alarm_listeners.append(listener)

    def note(self, text: str) -> None:
        """Keep something a reader of the summary must know; the same text is kept once and counted."""
        if text in self.notes or len(self.notes) < _KEPT_NOTES:
            self.notes[text] = self.notes.get(text, 0) + 1

    def failed(self, where: str, error: Exception) -> None:
        """Count an error of the monitor itself, and log the first."""
        self.failures += 1
        if self.failures == 1:
            self.note(f"the monitor itself failed in {where}: {type(error).__name__}: {error}")
            _log.warning("the monitor failed in %s; the brain goes on (said once)", where, exc_info=error)

    def snapshot(self) -> Snapshot:
        """Return how things are now."""
        raise NotImplementedError

    def _keep(self, snapshot: Snapshot) -> None:
        self.snapshots.append(snapshot)
        log = self.snapshot_log
        if log is not None:
            before = log.problem
            if not log.write(snapshot) and log.problem != before:
                self.note(log.problem)
                _log.warning(log.problem)
