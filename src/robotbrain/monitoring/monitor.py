"""A monitor that watches a brain while it runs, in simulated or in wall-clock time, and never gets in its way.

Simulated time::

    monitor = Monitor()
    run = drive(7, attach=[monitor.attach])
    print(monitor.summary())

Wall-clock time, with the kit's rclpy or the genuine one::

    with Monitor() as monitor:
        monitor.attach_node(node)
        rclpy.spin(node)
    print(monitor.summary())

Memory is bounded: percentiles come from sketches (:mod:`robotbrain.monitoring.sketch`); no message is kept. What goes
wrong in the monitor itself is counted and said once; the brain never notices.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from robotbrain.monitoring.chains import ChainTracker
from robotbrain.monitoring.distribution import Distribution
from robotbrain.monitoring.instrument import instrument
from robotbrain.monitoring.monitor_core import TICK_NS, MonitorCore, guarded
from robotbrain.monitoring.sketch import WindowedSketch
from robotbrain.monitoring.snapshots import Glance, Snapshot
from robotbrain.monitoring.summary import ChainSummary, Summary
from robotbrain.monitoring.trace import is_stamped, read_queues, stamp_of
from robotbrain.monitoring.wall import WallListener

if TYPE_CHECKING:
    from robotbrain.ros.context import MessageRecord, SimContext


class Monitor(MonitorCore):
    """Watches callbacks, messages, queues and chains, and keeps figures of them in bounded memory.

    Args:
        deadlines: of callbacks; those of the kit's brain by default.
        window_s: length of the windows that "recent" figures are about, s; > 0.
        chains: from sensor to command; those of the kit's brain by default.
        rules: when alarms are raised.
        on_alarm: called with every :class:`~robotbrain.monitoring.alarms.Alarm`, raised or cleared.
        snapshot_s: a snapshot is taken so often, s; > 0. The last ``keep`` are kept.
        keep: snapshots, >= 1.
        log: file to which snapshots are appended, a JSON object a line.
        resources: a sampler of the machine, whose newest reading goes into each snapshot.
        title: of the summary.
        accuracy: relative, of percentiles.
        roles: what part of the brain each node plays, by its fully qualified name; a simulated brain says so itself.

    Attributes:
        snapshots: the last ones, oldest first.
        alarms: the last ones that were raised or cleared, oldest first.

    Raises:
        InputError: for values out of these ranges.
    """

    def prepare(self) -> None:
        """Set up what the core does not have; its constructor calls this."""
        self._busy: tuple[int, dict[str, int]] = (0, {})
        self._clock = "wall"
        # What the queues of simulations that are over have lost.
        self._lost_before: Counter[tuple[str, str]] = Counter()
        self._removers: list[Callable[[], None]] = []
        self._ticker: threading.Thread | None = None
        self._stop = threading.Event()
        self._wall = WallListener(self)

    # ------------------------------------------------------------ a simulation

    def attach(self, context: SimContext) -> Callable[[], None]:
        """Watch a simulation from now on: ``drive(..., attach=[monitor.attach])``. Returns a function that stops it.

        Simulations that are attached one after the other are one watch: the second begins where the first one ended.
        """
        with self.lock:
            self.drain()
            self._lost_before = self._lost()
            self.offset_ns = self.now_ns - context.now_ns if self.start_ns is not None else 0
            self.context, self._clock = context, "simulated"
            self._busy = (context.now_ns, {})
            # Ids start again with each simulation.
            self.tracker = ChainTracker(self.tracker.chains)
            self.queues.clear()
            self.stamps.clear()
            self.begin(context.now_ns + self.offset_ns)
            removers = [context.add_callback_tap(self.see_callback), context.add_message_tap(self._on_message)]
        return self._removable(removers)

    def _on_message(self, record: MessageRecord, data: bytes) -> None:
        stamped = record.kind == "topic" and is_stamped(record.type_name)
        self.see_message(record, stamp_of(data) if stamped else None)

    # ------------------------------------------------------------ wall-clock time

    def attach_node(self, node: Any) -> Callable[[], None]:
        """Time a node's callbacks and publications in wall-clock time from now on; the kit's rclpy or the genuine one.

        What is known is less than in a simulation: not when a callback became ready, nor what waits in the middleware,
        so deadlines are held against the time from start to end. Chains need messages with a header; where a message
        passes through several nodes on its way, attach them all to one monitor, in one process.

        Starts the monitor's own thread, which notices silence; :meth:`close` or ``with`` ends it. Returns a function
        that puts the node back as it was.
        """
        self.start()
        return self._removable([instrument(node, self._wall)])

    @contextlib.contextmanager
    def span(self, name: str) -> Iterator[None]:
        """Time a block, in wall-clock time: ``with monitor.span("inference"): ...``"""
        began = time.perf_counter_ns()
        try:
            yield
        finally:
            self.record(name, (time.perf_counter_ns() - began) * 1e-6)

    @guarded
    def record(self, name: str, ms: float) -> None:
        """Add a time that somebody measured, ms."""
        sketch = self.spans.get(name)
        if sketch is None:
            sketch = self.spans[name] = WindowedSketch(self.accuracy)
        sketch.add(float(ms))
        if not 0 <= ms < float("inf"):
            self.note(f"span {name}: a value that is no time was left out (got {ms!r})")

    def start(self) -> None:
        """Start the thread that looks at the clock ten times a second, unless it runs; for wall-clock time."""
        with self.lock:
            if self._ticker is not None:
                return
            self.begin(time.perf_counter_ns())
            self._stop.clear()
            self._ticker = threading.Thread(target=self._tick_forever, name="robotbrain-monitor", daemon=True)
            self._ticker.start()

    def _tick_forever(self) -> None:
        while not self._stop.wait(TICK_NS * 1e-9):
            self._tick_wall()

    @guarded
    def _tick_wall(self) -> None:
        self._wall.look()
        self.advance(time.perf_counter_ns())

    def close(self) -> None:
        """Stop watching; the figures stay."""
        self._stop.set()
        ticker, self._ticker = self._ticker, None
        if ticker is not None and ticker is not threading.current_thread():
            ticker.join()
        while self._removers:
            self._removers.pop()()
        with self.lock:
            if self.snapshot_log is not None:
                self.snapshot_log.close()

    def __enter__(self) -> Monitor:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _removable(self, removers: list[Callable[[], None]]) -> Callable[[], None]:
        def remove() -> None:
            while removers:
                with contextlib.suppress(ValueError):  # a tap that somebody else took off already
                    removers.pop()()
            if remove in self._removers:
                self._removers.remove(remove)

        self._removers.append(remove)
        return remove

    # ------------------------------------------------------------ what it says

    def snapshot(self) -> Snapshot:
        """Return how things are now."""
        with self.lock:
            self.drain()
            for stream in self.callbacks.values():
                stream.flush()
            past = self.window_ns if self.window_before else 0
            span = max(1, self.now_ns - self.window_start_ns + past) * 1e-9

            def glance(sketch: WindowedSketch, misses: int = 0) -> Glance:
                recent = sketch.recent()
                return Glance(recent.count / span, recent.quantile(0.5), recent.quantile(0.99), misses)

            chains = {" > ".join(c): glance(a) for c, a in zip(self.tracker.chains, self.ages, strict=True) if a.count}
            return Snapshot(
                time_s=(self.now_ns - (self.start_ns or 0)) * 1e-9,
                callbacks={
                    s.label: glance(s.response if s.response.count else s.latency, s.misses)
                    for s in self.callbacks.values()
                },
                topics={topic: stream.recent_hz(self.now_ns) for topic, stream in self.topics.items()},
                queues=self._depths(),
                chains=chains,
                spans={name: glance(sketch) for name, sketch in self.spans.items()},
                utilisation=self._utilisation(),
                resources=self._readings(),
                alarms=tuple(alarm.text for alarm in self.board.active.values()),
            )

    def _depths(self) -> dict[str, int]:
        if self.context is None:
            return {}
        return {
            f"{subscription.node.get_fully_qualified_name()} {topic.name}": subscription.queue_depth()
            for topic in self.context.topics.values()
            for subscription in topic.subscriptions
        }

    def _utilisation(self) -> dict[str, float]:
        """Return the share of each resource since the last snapshot."""
        device = self.context.resources if self.context is not None else None
        if device is None or self.context is None:
            return {}
        (before_ns, before), now_ns, busy = self._busy, self.context.now_ns, device.busy_ns
        self._busy = (now_ns, busy)
        span = now_ns - before_ns
        if span <= 0:
            return {}
        cores = {name: device.cpu_cores if name == "cpu" else 1 for name in busy}
        return {name: (busy[name] - before.get(name, 0)) / (span * cores[name]) for name in busy}

    def _readings(self) -> dict[str, float]:
        reading = self.sampler.latest if self.sampler is not None else None
        return reading.known() if reading is not None else {}

    def summary(self) -> Summary:
        """Return the figures so far."""
        with self.lock:
            self.drain()
            lost = self._lost()
            for node, topic in lost:
                # A message may be lost on a queue whose callback never ran.
                key = (node, "subscription", topic)
                if key not in self.callbacks:
                    self.new_callback(key)
            span_ns = self.now_ns - (self.start_ns or 0)
            callbacks = [
                stream.summary(lost[node, name] if kind == "subscription" else 0)
                for (node, kind, name), stream in sorted(self.callbacks.items())
            ]
            queues = read_queues(self.context) if self.context is not None else {}
            device = self.context.resources if self.context is not None else None
            return Summary(
                title=self.title,
                clock=self._clock,
                seconds=span_ns * 1e-9,
                callbacks=tuple(callbacks),
                topics=tuple(self.topics[topic].summary() for topic in sorted(self.topics)),
                queues=tuple(
                    queue.summary(span_ns, queues[place].dropped, queues[place].expired)
                    for place, queue in sorted(self.queues.items())
                    if place in queues
                ),
                chains=tuple(
                    ChainSummary(chain, Distribution.from_sketch(ages.total()))
                    for chain, ages in zip(self.tracker.chains, self.ages, strict=True)
                    if ages.count
                ),
                spans={name: Distribution.from_sketch(sketch.total()) for name, sketch in self.spans.items()},
                utilisation=device.utilisation() if device is not None else {},
                end_to_end=Distribution.from_sketch(self.end_to_end.total()),
                alarms=tuple(alarm.text for alarm in self.alarms if alarm.active),
                notes=self._all_notes(),
            )

    def _lost(self) -> Counter[tuple[str, str]]:
        """Return how many messages never met their callback, by (node, topic)."""
        found = Counter(self._lost_before)
        for place, counts in (read_queues(self.context) if self.context is not None else {}).items():
            if counts.dropped + counts.expired:
                found[place] += counts.dropped + counts.expired
        return found

    def _all_notes(self) -> tuple[str, ...]:
        notes = [text + (f" ({count} times)" if count > 1 else "") for text, count in self.notes.items()]
        if self.failures > 1:
            notes.append(f"the monitor itself failed {self.failures} times; some figures are too low")
        notes += [
            f"{stream.label}: {stream.negative_ages} messages bore stamps of the future; two clocks disagree"
            for stream in self.callbacks.values()
            if stream.negative_ages
        ]
        log = self.snapshot_log
        if log is not None and log.lost:
            notes.append(f"{log.lost} snapshots are missing in {log.path.name}, {log.written} are there")
        return tuple(notes)
