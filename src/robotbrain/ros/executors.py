"""Executors in simulated time (``rclpy.executors``): workers that callbacks occupy for as long as they take.

A callback that starts at time t and ends at time e reads the clock t; what it publishes and the responses it
returns are released at e; its worker, and its mutually exclusive callback group, are busy until e. It ends at
t + c, where c is its cost, if it has the device to itself; where callbacks share a device, the context's
:class:`~robotbrain.ros.resources.DeviceResources` say when. Ready callbacks start in the order in which they
became ready.

Known departure: genuine executors look at entities in turn, the kit at messages. A message that pushes another out of a
full queue waits behind all that came before it, so under overload a subscription of depth 1 may be passed over more
often here than there.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable
from types import CoroutineType
from typing import TYPE_CHECKING, Any

from robotbrain.errors import InputError
from robotbrain.ros.callback_groups import CallbackGroup
from robotbrain.ros.context import CallbackRecord, CostModel, Execution, SimContext, get_default_context, set_running
from robotbrain.ros.exceptions import CallbackError, ReentrancyError
from robotbrain.ros.spinning import (
    ConditionReachedException,
    ExternalShutdownException,
    ShutdownException,
    Spinner,
    TimeoutException,
)
from robotbrain.ros.task import Future, Task

if TYPE_CHECKING:
    from robotbrain.ros.node import Node

__all__ = [
    "ConditionReachedException",
    "Executor",
    "ExternalShutdownException",
    "MultiThreadedExecutor",
    "ShutdownException",
    "SingleThreadedExecutor",
    "TimeoutException",
    "Work",
    "await_or_execute",
    "message_size",
]


async def await_or_execute(callback: Callable[..., Any], *args: Any) -> Any:
    """Call ``callback(*args)``, await it if it is a coroutine function, and return its result."""
    result = callback(*args)
    return await result if isinstance(result, CoroutineType) else result


class Work:
    """One ready callback: an entity, its payload (a message, a response, a coroutine) and when it got ready.

    ``message`` is the id of the message that made it ready, 0 for none.
    """

    __slots__ = ("alive", "entity", "message", "payload", "ready_ns", "resumed")

    def __init__(self, entity: Any, payload: Any, ready_ns: int, message: int = 0, resumed: bool = False) -> None:
        self.entity, self.payload, self.ready_ns = entity, payload, ready_ns
        self.message, self.resumed = message, resumed
        self.alive = True


def message_size(payload: Any) -> int | None:
    """Return the bytes of the CDR message in a piece of work or an event's argument; None when there is none."""
    if isinstance(payload, bytes):
        return len(payload)
    if isinstance(payload, tuple):
        return next((len(part) for part in payload if isinstance(part, bytes)), None)
    return None


class _NoNode:
    """Stands for the node of tasks of an executor that has no nodes."""

    def __init__(self, executor: Executor) -> None:
        self._enqueue = executor.enqueue

    def get_fully_qualified_name(self) -> str:
        return "/"


class Executor(Spinner):
    """Base of the executors.

    Args:
        context: the simulation; the default context when omitted.
        num_threads: workers, >= 1.
        cost_model: overrides the context's cost model for the nodes of this executor.
    """

    def __init__(
        self, *, context: SimContext | None = None, num_threads: int = 1, cost_model: CostModel | None = None
    ) -> None:
        if not isinstance(num_threads, int) or num_threads < 1:
            raise InputError(
                "num_threads", given=num_threads, expected="an integer >= 1", fix="1 is a single-threaded executor."
            )
        self.context = context if context is not None else get_default_context()
        self.num_threads = num_threads
        self.cost_model = cost_model
        self.executed = 0
        self.number = self.context.executor_count
        self.context.executor_count += 1
        self._idle = list(range(num_threads))  # a heap: the lowest worker that is free starts next
        self._priced_by: tuple[Any, Any, Any] = (None, None, None)
        self._ready: deque[Work] = deque()
        self._nodes: list[Node] = []
        self._is_shutdown = False
        self._budget = -1  # callbacks that spin_once may still start; negative: no limit
        self._deferred = False

    # ------------------------------------------------------------ nodes

    def add_node(self, node: Node) -> bool:
        """Run the callbacks of ``node`` here from now on; return False if it already does."""
        if node in self._nodes:
            return False
        if node.executor is not None:
            node.executor.remove_node(node)
        self._nodes.append(node)
        node._set_executor(self)
        return True

    def remove_node(self, node: Node) -> None:
        """Stop running callbacks of ``node``; they wait until it is added to an executor again."""
        if node in self._nodes:
            self._nodes.remove(node)
            mine = [work for work in self._ready if work.entity.node is node]
            self._ready = deque(work for work in self._ready if work.entity.node is not node)
            node._set_executor(None)
            node._parked.extend(mine)

    def get_nodes(self) -> list[Node]:
        """Return the nodes attached."""
        return list(self._nodes)

    def shutdown(self, timeout_sec: float | None = None, *, wait_for_threads: bool = True) -> bool:
        """Detach all nodes and let ``spin`` return; what has begun is finished. Returns True."""
        self._is_shutdown = True
        for node in list(self._nodes):
            self.remove_node(node)
        return True

    def wake(self) -> None:
        """Do nothing: a simulated executor never sleeps."""

    def __enter__(self) -> Executor:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.shutdown()

    # ------------------------------------------------------------ tasks

    def create_task(self, callback: Callable[..., Any], *args: Any, **kwargs: Any) -> Task:
        """Run ``callback(*args, **kwargs)``, plain or ``async def``, on this executor; return its future.

        A task that a callback creates starts when that callback's cost is over, in no callback group. It counts as
        work of the node whose callback created it, or else of the executor's first node.
        """
        running = self.context.running
        owner: Any = running.node if running is not None else None
        if owner not in self._nodes:
            owner = self._nodes[0] if self._nodes else _NoNode(self)
        task = Task(callback, args, kwargs, node=owner)
        self.context.release(self._begin, task)
        return task

    def _begin(self, task: Task) -> None:
        work = Work(task.entity, None, self.context.now_ns)
        if isinstance(task.entity.node, _NoNode):
            self.enqueue(work)
        else:
            task.entity.node._enqueue(work)

    def create_future(self) -> Future:
        """Return a new future."""
        return Future(executor=self)

    # ------------------------------------------------------------ execution

    def enqueue(self, work: Work) -> None:
        """Add a ready callback and start it if a worker and its callback group are free."""
        self._ready.append(work)
        if self._idle:
            if self.context.holding:
                self.context.held.append(self)
            else:
                self.dispatch()

    def _occupied(self) -> bool:
        return self.num_threads == 1 and not self._idle

    def dispatch(self) -> None:
        """Start what is ready, as far as workers and callback groups are free."""
        while self._ready and self._idle:
            if not self._budget:
                if not self._deferred:
                    self._deferred = True
                    self.context.schedule(self.context.now_ns, self._go_on)
                return
            work = self._next()
            if work is None:
                return
            self._budget -= 1
            self._start(work)

    def _go_on(self, _: None) -> None:
        self._deferred = False
        self.dispatch()

    def _next(self) -> Work | None:
        ready = self._ready
        first = ready[0]
        if first.alive and (first.resumed or first.entity.callback_group.can_execute()):
            return ready.popleft()
        while ready and not ready[0].alive:
            ready.popleft()
        for index, work in enumerate(ready):
            if work.alive and (work.resumed or work.entity.callback_group.can_execute()):
                if index == 0:
                    ready.popleft()
                else:
                    del ready[index]
                return work
        return None

    def _start(self, work: Work) -> None:
        context, entity = self.context, work.entity
        group: CallbackGroup = entity.callback_group
        worker = heapq.heappop(self._idle)
        if not work.resumed:
            group.active += 1
        self.executed += 1
        model = self.cost_model or context.cost_model
        context.callback_count += 1
        execution = Execution(entity.node, model, context.callback_count, work.message, worker)
        set_running(context, execution)
        failure: Exception | None = None
        suspended = False
        try:
            suspended = self._call(work)
        except Exception as error:
            failure = error
        finally:
            set_running(context, None)
            if model is not None:
                self._price(model, work, execution)
            if context.slowdown:
                execution.segments = [
                    (resource, max(1, round(length * context.slowdown.get(resource, 1.0))))
                    for resource, length in execution.segments
                ]
            segments, started = execution.segments, context.now_ns
            freed = None if suspended else group
            if not segments:
                if execution.outbox:
                    self._send(execution, started)
                heapq.heappush(self._idle, worker)
                if freed is not None:
                    freed.active -= 1
            elif context.resources is None:
                end = started + sum([length for _, length in segments])
                self._send(execution, end)
                context.schedule(end, self._finish, (freed, worker))
            else:
                context.resources.submit(segments, lambda: self._complete(work, execution, started, freed))
        if context.callback_taps and (not segments or context.resources is None):
            self._record(work, execution, started, started + sum([length for _, length in segments]))
        if failure is not None:
            self._fail(work, failure)

    def _price(self, model: CostModel, work: Work, execution: Execution) -> None:
        """Add what the cost model says to what the callback charged itself."""
        entity, segments = work.entity, execution.segments
        node_name = entity.node.get_fully_qualified_name()
        if model is not self._priced_by[0]:
            self._priced_by = (model, getattr(model, "uncharged_ns", None), getattr(model, "traffic_ns", None))
        _, uncharged_ns, traffic_ns = self._priced_by
        first = 0
        if not work.resumed:
            first = model.cost(node_name, entity.kind, entity.name)
            if not segments and uncharged_ns is not None:
                first += uncharged_ns(node_name, entity.kind, entity.name)
        if traffic_ns is not None:
            received = None if work.resumed else message_size(work.payload)
            if received is not None:
                first += traffic_ns(node_name, received, ())
            if execution.outbox:
                sizes = [message_size(argument) for _, argument in execution.outbox]
                execution.add("cpu", traffic_ns(node_name, None, [size for size in sizes if size is not None]))
        if first:
            # What the model adds comes before the callback's own work: the message is taken off the wire first.
            if segments and segments[0][0] == "cpu":
                segments[0] = ("cpu", segments[0][1] + first)
            else:
                segments.insert(0, ("cpu", first))

    def _send(self, execution: Execution, time_ns: int) -> None:
        for event, argument in execution.outbox:
            self.context.schedule(time_ns, event, argument)

    def _complete(self, work: Work, execution: Execution, started_ns: int, group: CallbackGroup | None) -> None:
        """End a callback whose segments the device has done."""
        now = self.context.now_ns
        self._send(execution, now)
        self.context.schedule(now, self._finish, (group, execution.worker))
        if self.context.callback_taps:
            self._record(work, execution, started_ns, now)

    def _record(self, work: Work, execution: Execution, started_ns: int, end_ns: int) -> None:
        entity, segments = work.entity, execution.segments
        record = CallbackRecord(
            entity.node.get_fully_qualified_name(),
            entity.kind,
            entity.name,
            work.ready_ns,
            started_ns,
            end_ns,
            sum([length for _, length in segments]),
            tuple(segments),
            execution.id,
            execution.message,
            tuple(execution.published),
            self.number,
            execution.worker,
        )
        for tap in list(self.context.callback_taps):
            tap(record)

    def _finish(self, done: tuple[CallbackGroup | None, int]) -> None:
        group, worker = done
        heapq.heappush(self._idle, worker)
        if group is not None:
            group.active -= 1
        self.dispatch()

    def _call(self, work: Work) -> bool:
        """Run a callback, or the next part of a coroutine; tell whether it now waits for a future."""
        entity = work.entity
        if entity.cancelled:
            return False
        if not work.resumed:
            result = entity.execute(work)
            if not isinstance(result, CoroutineType):
                entity.complete(work, result)
                return False
            coroutine = result
        else:
            coroutine = work.payload[1]
        original = work.payload[0] if work.resumed else work
        try:
            awaited = coroutine.send(None)
        except StopIteration as stop:
            entity.complete(original, stop.value)
            return False
        if not isinstance(awaited, Future):
            raise InputError(
                "awaited object",
                given=awaited,
                expected="an rclpy Future",
                fix="In a callback await client.call_async(...) or robotbrain.ros.sleep(node, seconds); "
                "asyncio objects need asyncio's own loop.",
            )
        group: CallbackGroup = entity.callback_group
        if awaited.completed_in is group and not group.can_execute():
            coroutine.throw(
                ReentrancyError(
                    f"{entity.callback_name} awaits a client of its own mutually exclusive callback group, which "
                    "stays busy until the callback returns (genuine rclpy deadlocks): create the client with "
                    "callback_group=ReentrantCallbackGroup()"
                )
            )
        awaited.add_done_callback(lambda _: self._resume(entity, (original, coroutine)))
        return True

    def _resume(self, entity: Any, payload: tuple[Work, Any]) -> None:
        # Through the heap: the future may complete inside another callback of this very executor.
        running = self.context.running
        message = running.message if running is not None else 0
        work = Work(entity, payload, self.context.now_ns, message, resumed=True)
        self.context.release(lambda _: entity.node._enqueue(work), None)

    def _fail(self, work: Work, cause: Exception) -> None:
        entity = work.entity
        error = CallbackError(
            entity.node,
            callback=entity.callback_name,
            kind=entity.kind,
            name=entity.name,
            time_ns=self.context.now_ns,
            cause=cause,
        )
        error.__cause__ = cause
        self.context.fail(error)


class SingleThreadedExecutor(Executor):
    """One callback at a time."""

    def __init__(self, *, context: SimContext | None = None, cost_model: CostModel | None = None) -> None:
        super().__init__(context=context, num_threads=1, cost_model=cost_model)


class MultiThreadedExecutor(Executor):
    """Up to ``num_threads`` callbacks at a time, as callback groups allow.

    Genuine rclpy takes the number of CPU cores of the machine by default; the kit takes 4 everywhere, so that
    a result does not depend on the laptop.
    """

    def __init__(
        self,
        num_threads: int | None = None,
        *,
        context: SimContext | None = None,
        cost_model: CostModel | None = None,
    ) -> None:
        super().__init__(context=context, num_threads=4 if num_threads is None else num_threads, cost_model=cost_model)
