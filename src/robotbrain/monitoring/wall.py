"""What a monitor makes of a node's callbacks and messages in wall-clock time."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from robotbrain.monitoring.clockwatch import ClockWatch

if TYPE_CHECKING:
    from robotbrain.monitoring.chains import Inputs
    from robotbrain.monitoring.monitor import Monitor

_REMEMBERED = 5000


@dataclass(slots=True)
class _Call:
    """A callback that is running."""

    node: str
    kind: str
    name: str
    stamp_ns: int | None
    clock_ns: int
    number: int
    message: int
    inputs: Inputs = field(default_factory=dict)


class WallListener:
    """Hands what :func:`~robotbrain.monitoring.instrument.instrument` sees to a monitor; it never raises.

    Rates and durations are of a clock that cannot jump. Ages compare header stamps with the node's own clock, which
    may: a jump is noted, and ages across it are left out.
    """

    def __init__(self, monitor: Monitor) -> None:
        self._monitor = monitor
        self._running = threading.local()
        self._calls = 0
        self._messages = 0
        self._ids: dict[tuple[str, int], int] = {}
        self._published: set[str] = set()
        self._counted_by: dict[str, str] = {}
        self._periods: dict[tuple[str, str], int] = {}
        self._system_clock = ClockWatch("the system clock")
        self._clocks: dict[str, ClockWatch] = {}
        self._valid_from_ns = 0

    def look(self) -> None:
        """Look whether the system clock jumped."""
        said = self._system_clock.look(time.time_ns(), time.perf_counter_ns())
        if said is not None:
            self._monitor.note(said)
            self._valid_from_ns = time.time_ns()

    def period(self, node: str, name: str, period_ns: int) -> None:
        """Note the period of a timer."""
        self._periods[node, name] = period_ns

    def begin(self, node: str, kind: str, name: str, stamp_ns: int | None, clock_ns: int) -> _Call | None:
        """Note that a callback starts."""
        monitor = self._monitor
        with monitor.lock:
            try:
                self._look_at(node, clock_ns)
                self._calls += 1
                message = 0
                if kind == "subscription":
                    message = self._taken(node, name, stamp_ns)
                call = _Call(node, kind, name, stamp_ns, clock_ns, self._calls, message)
                call.inputs = monitor.tracker.inputs(node, time.perf_counter_ns(), call.number, message)
                self._stack().append(call)
                return call
            except Exception as error:
                monitor.failed("begin", error)
                return None

    def end(self, token: Any, start_ns: int, end_ns: int, failed: bool) -> None:
        """Note that a callback ended."""
        if token is None:
            return
        monitor = self._monitor
        with monitor.lock:
            try:
                call: _Call = token
                stack = self._stack()
                if call in stack:
                    stack.remove(call)
                key = (call.node, call.kind, call.name)
                stream = monitor.callbacks.get(key)
                if stream is None:
                    stream = monitor.new_callback(key, self._periods.get((call.node, call.name)))
                taken_ms = (end_ns - start_ns) * 1e-6
                missed = stream.add(start_ns, taken_ms, age_ms=self._age_ms(call.stamp_ns, call.clock_ns))
                stream.failures += failed
                monitor.tracker.ended(call.node, end_ns, call.number, call.message)
                monitor.call(stream, missed, taken_ms, end_ns)
                monitor.advance(end_ns)
            except Exception as error:
                monitor.failed("end", error)

    def sent(self, node: str, topic: str, stamp_ns: int | None, clock_ns: int, size: int | None) -> None:
        """Note that a message is published."""
        monitor = self._monitor
        with monitor.lock:
            try:
                self._look_at(node, clock_ns)
                now = time.perf_counter_ns()
                self._published.add(topic)
                call = next((call for call in reversed(self._stack()) if call.node == node), None)
                number = self._new_id(topic, stamp_ns)
                if call is not None:
                    monitor.tracker.sends(number, call.inputs)
                ends = monitor.tracker.message(number, topic, stamp_ns)
                fresh = {i: None if o is not None and o < self._valid_from_ns else o for i, o in ends.items()}
                monitor.left(fresh, clock_ns)
                monitor.message(topic, now, size)
                monitor.advance(now)
            except Exception as error:
                monitor.failed("sent", error)

    def _taken(self, node: str, topic: str, stamp_ns: int | None) -> int:
        """Return the id of a message that a subscription took; count it if nobody who is watched publishes it."""
        if topic not in self._published and self._counted_by.setdefault(topic, node) == node:
            self._monitor.message(topic, time.perf_counter_ns(), None)
        if stamp_ns is None:
            return 0
        number = self._ids.get((topic, stamp_ns))
        if number is None:
            number = self._new_id(topic, stamp_ns)
            self._monitor.tracker.message(number, topic, stamp_ns)
        return number

    def _new_id(self, topic: str, stamp_ns: int | None) -> int:
        self._messages += 1
        if stamp_ns is not None:
            self._ids[topic, stamp_ns] = self._messages
            if len(self._ids) > _REMEMBERED:
                del self._ids[next(iter(self._ids))]
        return self._messages

    def _age_ms(self, stamp_ns: int | None, clock_ns: int) -> float | None:
        if stamp_ns is None or stamp_ns < self._valid_from_ns:
            return None
        return (clock_ns - stamp_ns) * 1e-6

    def _look_at(self, node: str, clock_ns: int) -> None:
        """Look whether the system clock or a node's clock jumped."""
        monotonic = time.perf_counter_ns()
        said = self._system_clock.look(time.time_ns(), monotonic)
        if said is not None:
            self._monitor.note(said)
            self._valid_from_ns = clock_ns
        watch = self._clocks.get(node)
        if watch is None:
            watch = self._clocks[node] = ClockWatch(f"the clock of {node}", steady=False)
        said = watch.look(clock_ns, monotonic)
        if said is not None:
            self._monitor.note(said)
            self._valid_from_ns = 0

    def _stack(self) -> list[_Call]:
        stack: list[_Call] | None = getattr(self._running, "stack", None)
        if stack is None:
            stack = self._running.stack = []
        return stack
