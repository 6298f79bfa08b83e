"""The simulation: one event heap, the graph of topics and services, and simulated time.

Everything that happens is an event ``(time_ns, sequence)``; ties in time are broken by the order in which
events were scheduled, so a run is a pure function of the program and its seeds.
"""

from __future__ import annotations

import contextlib
import heapq
from collections import deque
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, Literal

from robotbrain.errors import InputError
from robotbrain.ros.arguments import NodeArguments, parse_arguments
from robotbrain.ros.exceptions import CallbackError, NotInitializedException, ReentrancyError
from robotbrain.ros.execution import (
    CallbackRecord,
    CallbackTap,
    CostModel,
    Event,
    Execution,
    Filter,
    MessageRecord,
    MessageTap,
    Tap,
)
from robotbrain.ros.logging import (
    LoggingSeverity,
    LogRecord,
    LogSink,
    RcutilsLogger,
    get_logging_severity_from_string,
    print_sink,
)
from robotbrain.ros.resources import RESOURCES, DeviceResources
from robotbrain.ros.threads import Driver

if TYPE_CHECKING:
    from robotbrain.ros.executors import Executor
    from robotbrain.ros.matching import Topic
    from robotbrain.ros.node import Node
    from robotbrain.ros.services import Service

__all__ = [
    "CallbackRecord",
    "CallbackTap",
    "Context",
    "CostModel",
    "Event",
    "Execution",
    "Filter",
    "MessageRecord",
    "MessageTap",
    "SimContext",
    "Tap",
    "active_context",
    "get_default_context",
    "peek_default_context",
    "set_default_context",
    "set_running",
]


class SimContext:
    """A deterministic ROS graph in simulated time (``rclpy.Context`` of the kit).

    Args:
        latency_ns: transport latency from publisher to subscription (and each way of a service call): ns,
            or a function ``(topic, size_bytes) -> ns``. Messages of one publisher never overtake each other.
        cost_model: what callbacks cost; an object with ``cost(node_name, kind, name) -> ns``, or None for 0.
        start_ns: simulated time at the start.
        resources: of the device that all callbacks run on; None for no limit: each callback then takes the sum of its
            segments, whatever else is running.

    Attributes:
        now_ns: simulated time in ns.
        on_callback_error: called with the :class:`CallbackError` of a failed callback; return True to go on
            (for instance after ``error.node.destroy_node()``, which isolates the node). Unset: it is raised.
        default_executor_factory: makes the executor of a new node. One single-threaded executor per node by
            default, as if every node were a process of its own.
        log_sink: receives every log record; prints by default.
        slowdown: factor by resource (``cpu``, ``gpu``, …) on the cost of every callback that starts from now on, as of
            a device that throttles; 1 where a resource is missing.
        horizon_ns: ``rclpy.spin`` stops there, as if Ctrl-C had been pressed; None for no limit.
    """

    def __init__(
        self,
        *,
        latency_ns: int | Callable[[str, int], int] = 0,
        cost_model: CostModel | None = None,
        start_ns: int = 0,
        resources: DeviceResources | None = None,
    ) -> None:
        from robotbrain.ros.executors import SingleThreadedExecutor

        self.now_ns = start_ns
        self.latency_ns = latency_ns
        self.cost_model = cost_model
        self.resources = resources
        if resources is not None:
            resources.attach(self)
        self.on_callback_error: Callable[[CallbackError], bool] | None = None
        self.default_executor_factory: Callable[[Node], Executor] = lambda node: SingleThreadedExecutor(context=self)
        self.log_sink: LogSink = print_sink
        self.log_level = LoggingSeverity.INFO
        self.log_levels: dict[str, LoggingSeverity] = {}
        self.rosout: dict[str | None, Callable[[LogRecord, Any], None]] = {}
        self.horizon_ns: int | None = None
        self.arguments = NodeArguments()
        self.topics: dict[str, Topic] = {}
        self.services: dict[str, Service] = {}
        self.nodes: list[Node] = []
        self.taps: list[Tap] = []
        self.callback_taps: list[CallbackTap] = []
        self.message_taps: list[MessageTap] = []
        self.filters: list[tuple[str, Filter]] = []
        self.slowdown: dict[str, float] = {}
        self.executor_count = 0
        self.callback_count = 0
        self.message_count = 0
        self.goal_count = 0
        self.running: Execution | None = None
        self.driver = Driver()
        self.holding = False
        self.held: list[Executor] = []
        self._arrivals: list[tuple[Event, Any]] | None = None
        self._heap: list[tuple[int, int, Event, Any]] = []
        self._sequence = 0
        self._failures: deque[CallbackError] = deque()
        self._ok = True
        self._init_called = False
        self._on_shutdown: list[Callable[[], Any]] = []
        self._logger = RcutilsLogger("robotbrain.ros", self)

    # ------------------------------------------------------------ life cycle

    def init(self, args: list[str] | None = None, *, domain_id: int | None = None) -> None:
        """Take ROS arguments; a context of the kit is ready as soon as it exists.

        Raises:
            RuntimeError: called twice.
        """
        if self._init_called:
            raise RuntimeError("Context.init() must only be called once; call rclpy.shutdown() first")
        self._init_called = True
        self.driver.take()
        self.arguments = parse_arguments(args)
        for logger, level in self.arguments.log_levels:
            if logger:
                self.log_levels[logger] = get_logging_severity_from_string(level)
            else:
                self.log_level = get_logging_severity_from_string(level)

    def ok(self) -> bool:
        """Tell whether the context has not been shut down."""
        return self._ok

    def shutdown(self) -> None:
        """End the run: ``ok()`` turns False and a running ``run_until`` or ``spin`` returns."""
        if not self._ok:
            raise RuntimeError("Context has already been shut down")
        self.try_shutdown()

    def try_shutdown(self) -> None:
        """As :meth:`shutdown`, without an error when it already is."""
        if self._ok:
            self._ok = False
            self.driver.ended.set()
            for callback in self._on_shutdown:
                callback()

    def on_shutdown(self, callback: Callable[[], Any]) -> None:
        """Call ``callback()`` at shutdown."""
        self._on_shutdown.append(callback)

    def require_ok(self) -> None:
        """Raise NotInitializedException before ``init`` or after shutdown."""
        if not self.ok():
            raise NotInitializedException("the context has been shut down: call rclpy.init() again")

    @contextlib.contextmanager
    def as_default(self) -> Iterator[SimContext]:
        """Make this the context that ``rclpy.init()`` and nodes without ``context=`` use, inside the block."""
        global _default
        previous, _default = _default, self
        try:
            yield self
        finally:
            _default = previous

    # ------------------------------------------------------------ time and events

    def schedule(self, time_ns: int, event: Event, argument: Any = None) -> None:
        """Run ``event(argument)`` at ``time_ns`` (not before now), after all events scheduled earlier for it."""
        self._sequence += 1
        heapq.heappush(self._heap, (time_ns if time_ns > self.now_ns else self.now_ns, self._sequence, event, argument))

    def release(self, event: Event, argument: Any) -> None:
        """Run ``event`` when the running callback's cost is over, or now when none is running.

        This is how publications and service traffic leave a callback.
        """
        if self.running is not None:
            self.running.outbox.append((event, argument))
        else:
            self.schedule(self.now_ns, event, argument)

    def arrive_together(self, arrivals: list[tuple[Event, Any]], time_ns: int | None = None) -> None:
        """Run these events at ``time_ns`` (now by default), with all that are given for now before the next step.

        Executors start nothing until all of them have run: a queue that they overflow then loses its oldest.
        """
        if time_ns is not None and time_ns > self.now_ns:
            self.schedule(time_ns, self._arrive, arrivals)
        elif self._arrivals is not None:
            self._arrivals += arrivals
        else:
            self._arrivals = arrivals
            self.schedule(self.now_ns, self._arrive, arrivals)

    def _arrive(self, arrivals: list[tuple[Event, Any]]) -> None:
        if arrivals is self._arrivals:
            self._arrivals = None
        self.holding = True
        try:
            for event, argument in arrivals:
                event(argument)
        finally:
            self.holding = False
            held, self.held = self.held, []
            for executor in held:
                executor.dispatch()

    def charge(self, nanoseconds: int, resource: str = "cpu") -> bool:
        """Add to the cost of the running callback; return False (and do nothing) outside callbacks.

        Args:
            nanoseconds: how long ``resource`` is wanted.
            resource: ``cpu``, ``gpu``, ``dla0`` or ``dla1``. What a callback charges runs in that order.

        Raises:
            InputError: negative, or a resource that the device does not have.
        """
        if nanoseconds < 0:
            raise InputError(
                "charge",
                given=nanoseconds,
                expected="nanoseconds >= 0",
                fix="A callback cannot take less than no time.",
            )
        if resource != "cpu":
            self._check_resource(resource)
        if self.running is None:
            return False
        self.running.add(resource, int(nanoseconds))
        return True

    def charge_work(self, kind: str, units: float) -> bool:
        """Add CPU work to the cost of the running callback; return False (and do nothing) outside callbacks.

        The cost model says what it takes (``work_ns(kind, units)``); without such a model it is free.

        Args:
            kind: of work, as the cost model knows it, e.g. ``astar``.
            units: how much, e.g. cells expanded; >= 0.

        Raises:
            InputError: units that are negative or no number; whatever the cost model refuses.
        """
        if not 0 <= units < float("inf"):
            raise InputError(
                f"charge_work of {kind!r}",
                given=units,
                expected="units >= 0",
                fix="Count what was done, do not time it.",
            )
        if self.running is None:
            return False
        work_ns = getattr(self.running.cost_model, "work_ns", None)
        if work_ns is not None:
            self.running.add("cpu", work_ns(kind, units))
        return True

    def _check_resource(self, resource: str) -> None:
        if self.resources is not None:
            self.resources.check(resource)
        elif resource not in RESOURCES:
            raise InputError(
                "resource", given=resource, expected="one of " + ", ".join(RESOURCES), fix="Choose one of these."
            )

    def sleep(self, nanoseconds: int) -> bool:
        """Let time pass: charge it inside a callback, run the simulation for it outside; return ``ok()``."""
        if not self.charge(nanoseconds):
            self.run_until(self.now_ns + nanoseconds)
        return self._ok

    def step(self) -> bool:
        """Process one event; return False when there is none, or after shutdown."""
        self.check_not_in_callback("step")
        with self.driver.lock:
            if not self._heap or not self._ok:
                return False
            self.now_ns, _, event, argument = heapq.heappop(self._heap)
            event(argument)
            if self._failures:
                raise self._failures.popleft()
            return True

    def next_event_ns(self) -> int | None:
        """Return the time of the next event, or None when nothing is pending."""
        return self._heap[0][0] if self._heap else None

    def run_until(self, time_ns: int) -> None:
        """Process every event up to and including ``time_ns`` and set the clock there.

        After a shutdown inside a callback it returns at once, the clock at the time of that callback.

        Raises:
            InputError: ``time_ns`` has passed.
            ReentrancyError: called inside a callback.
            CallbackError: a callback raised; the simulation can go on from there.
        """
        self.check_not_in_callback("run_until")
        if time_ns < self.now_ns:
            raise InputError(
                "run_until",
                given=time_ns,
                expected=f"a time not before now ({self.now_ns} ns)",
                fix="Time runs forward.",
            )
        heap, pop, failures = self._heap, heapq.heappop, self._failures
        with self.driver.lock:
            while heap and heap[0][0] <= time_ns:
                if not self._ok:
                    return
                self.now_ns, _, event, argument = pop(heap)
                event(argument)
                if failures:
                    raise failures.popleft()
            if self._ok:
                self.now_ns = max(time_ns, self.now_ns)

    def run_for(self, seconds: float) -> None:
        """Run for so many simulated seconds; see :meth:`run_until`."""
        self.run_until(self.now_ns + round(seconds * 1e9))

    def fail(self, error: CallbackError) -> None:
        """Give a failed callback to the error hook, or raise it once the current event is complete.

        Not at once: the other receivers of the message that the callback choked on must still get it.
        """
        if self.on_callback_error is None or not self.on_callback_error(error):
            self._failures.append(error)

    def check_not_in_callback(self, what: str) -> None:
        """Raise ReentrancyError inside a callback."""
        running = self.running
        if running is not None and self.in_callback():
            raise ReentrancyError(
                f"{what} was called inside a callback of {running.node.get_fully_qualified_name()}; "
                "a callback must return to let others run: use call_async with add_done_callback, or a timer"
            )

    @property
    def simulated(self) -> bool:
        """Whether this context makes its own time; a subclass that steps otherwise runs in real time."""
        return type(self).step is SimContext.step

    def in_callback(self) -> bool:
        """Tell whether the calling thread is inside a callback."""
        return self.running is not None and (not self.simulated or self.driver.inside())

    def transport_ns(self, name: str, size: int) -> int:
        """Return the transport latency of ``size`` bytes on a topic or service."""
        latency = self.latency_ns
        return latency if isinstance(latency, int) else int(latency(name, size))

    # ------------------------------------------------------------ observation

    def add_tap(self, tap: Tap) -> Callable[[], None]:
        """Call ``tap(release_time_ns, topic, type_name, publisher_node, cdr)`` for every publication, in order.

        Returns:
            A function that removes the tap.
        """
        self.taps.append(tap)
        return lambda: self.taps.remove(tap)

    def add_callback_tap(self, tap: CallbackTap) -> Callable[[], None]:
        """Call ``tap(record)`` for every executed callback; returns a function that removes it."""
        self.callback_taps.append(tap)
        return lambda: self.callback_taps.remove(tap)

    def add_message_tap(self, tap: MessageTap) -> Callable[[], None]:
        """Call ``tap(record, cdr)`` for every message that leaves: publications, requests and responses.

        Returns:
            A function that removes the tap.
        """
        self.message_taps.append(tap)
        return lambda: self.message_taps.remove(tap)

    def add_filter(self, topic: str, filter_: Filter) -> Callable[[], None]:
        """Put a fault between the publishers and the subscriptions of a topic.

        Args:
            topic: absolute name, or ``*`` for every topic.
            filter_: called as ``filter_(record, cdr)`` for each publication; returns the copies to deliver, each as
                (CDR bytes, further delay in ns): none drops the message, ``[(cdr, 0)]`` lets it pass. Several filters
                act one after the other. A message that a filter delays may be overtaken. Taps see what was published.

        Returns:
            A function that removes the filter.
        """
        entry = (topic, filter_)
        self.filters.append(entry)
        return lambda: self.filters.remove(entry)

    def new_message_id(self) -> int:
        """Return the id of a message that is sent now, and note it with the callback that sends it."""
        self.message_count += 1
        if self.running is not None:
            self.running.published.append(self.message_count)
        return self.message_count

    def announce(
        self,
        message_id: int,
        kind: Literal["topic", "request", "response"],
        name: str,
        type_name: str,
        node: Node,
        data: bytes,
    ) -> MessageRecord:
        """Tell the message taps that a message leaves now; return its record."""
        record = MessageRecord(
            message_id, kind, name, type_name, node.get_fully_qualified_name(), self.now_ns, len(data)
        )
        for tap in list(self.message_taps):
            tap(record, data)
        return record

    def filtered(self, record: MessageRecord, data: bytes) -> list[tuple[bytes, int]]:
        """Return what the filters let through of a publication, with the further delay of each copy, ns."""
        copies = [(data, 0)]
        for topic, filter_ in list(self.filters):
            if topic in ("*", record.name):
                copies = [
                    (after, delay + further) for before, delay in copies for after, further in filter_(record, before)
                ]
        return copies

    def get_logger(self) -> RcutilsLogger:
        """Return the logger of the context itself."""
        return self._logger


class Context(SimContext):
    """``rclpy.Context``: not ready before ``rclpy.init(context=...)``."""

    def ok(self) -> bool:
        """Tell whether the context has been initialised and not shut down."""
        return self._ok and self._init_called


_default: SimContext | None = None
_active: SimContext | None = None


def active_context() -> SimContext | None:
    """Return the context whose callback is running now, or None."""
    return _active


def set_running(context: SimContext, execution: Execution | None) -> None:
    """Mark ``execution`` as the callback that is running (None: no longer)."""
    global _active
    context.running = execution
    _active = context if execution is not None else None


def get_default_context() -> SimContext:
    """Return the default context.

    Raises:
        NotInitializedException: ``rclpy.init()`` was not called.
    """
    if _default is None:
        raise NotInitializedException
    return _default


def set_default_context(context: SimContext | None) -> SimContext | None:
    """Make ``context`` the default (None: none); return the former one."""
    global _default
    previous, _default = _default, context
    return previous


def peek_default_context() -> SimContext | None:
    """Return the default context, or None."""
    return _default
