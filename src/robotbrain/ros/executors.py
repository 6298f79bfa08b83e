"""Executors in simulated time (``rclpy.executors``): workers that callbacks occupy for as long as they cost.

A callback that starts at time t and costs c reads the clock t; what it publishes and the responses it
returns are released at t + c; its worker, and its mutually exclusive callback group, are busy until t + c.
Ready callbacks start in the order in which they became ready.

Shared resources (CPU cores of a device, one GPU, DLAs) are not modelled yet. They belong in
:meth:`Executor._start`: the end time computed there becomes the answer of a resource model that is given the
start time and the demands charged, and :meth:`Executor._finish` gives the resources back.
"""

# ruff: noqa: N818 - the names are those of rclpy.executors

from __future__ import annotations

import inspect
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from robotbrain.errors import InputError, RobotBrainError
from robotbrain.ros.callback_groups import CallbackGroup
from robotbrain.ros.context import CallbackRecord, CostModel, Execution, SimContext, get_default_context, set_running
from robotbrain.ros.exceptions import CallbackError, ReentrancyError, SimulationDeadlockError
from robotbrain.ros.task import Future

if TYPE_CHECKING:
    from robotbrain.ros.node import Node


class ExternalShutdownException(RobotBrainError):
    """The context was shut down, or its horizon reached, while spinning."""


class TimeoutException(RobotBrainError):
    """A wait ran out of time."""


class Work:
    """One ready callback: an entity, its payload (CDR bytes, a response, a coroutine) and when it got ready."""

    __slots__ = ("alive", "entity", "payload", "ready_ns", "resumed")

    def __init__(self, entity: Any, payload: Any, ready_ns: int, resumed: bool = False) -> None:
        self.entity, self.payload, self.ready_ns, self.resumed = entity, payload, ready_ns, resumed
        self.alive = True


class Executor:
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
        self._free = num_threads
        self._ready: deque[Work] = deque()
        self._nodes: list[Node] = []

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

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """Detach all nodes."""
        for node in list(self._nodes):
            self.remove_node(node)
        return True

    def wake(self) -> None:
        """Do nothing: a simulated executor never sleeps."""

    # ------------------------------------------------------------ execution

    def enqueue(self, work: Work) -> None:
        """Add a ready callback and start it if a worker and its callback group are free."""
        self._ready.append(work)
        if self._free:
            self._dispatch()

    def _dispatch(self) -> None:
        while self._free:
            work = self._next()
            if work is None:
                return
            self._start(work)

    def _next(self) -> Work | None:
        ready = self._ready
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
        self._free -= 1
        if not work.resumed:
            group.active += 1
        self.executed += 1
        execution = Execution(entity.node)
        set_running(context, execution)
        failure: Exception | None = None
        suspended = False
        try:
            suspended = self._call(work)
        except Exception as error:
            failure = error
        finally:
            set_running(context, None)
            cost = execution.charged_ns
            model = self.cost_model or context.cost_model
            if model is not None and not work.resumed:
                cost += model.cost(entity.node.get_fully_qualified_name(), entity.kind, entity.name)
            end = context.now_ns + cost
            for event, argument in execution.outbox:
                context.schedule(end, event, argument)
            freed = None if suspended else group
            if cost > 0:
                context.schedule(end, self._finish, freed)
            else:
                self._free += 1
                if freed is not None:
                    freed.active -= 1
        if context.callback_taps:
            record = CallbackRecord(
                entity.node.get_fully_qualified_name(),
                entity.kind,
                entity.name,
                work.ready_ns,
                context.now_ns,
                end,
            )
            for tap in list(context.callback_taps):
                tap(record)
        if failure is not None:
            self._fail(work, failure)

    def _finish(self, group: CallbackGroup | None) -> None:
        self._free += 1
        if group is not None:
            group.active -= 1
        self._dispatch()

    def _call(self, work: Work) -> bool:
        """Run a callback, or the next part of a coroutine; tell whether it now waits for a future."""
        entity = work.entity
        if not work.resumed:
            result = entity.execute(work)
            if not inspect.iscoroutine(result):
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
                fix="In a callback await client.call_async(...); asyncio objects need asyncio's own loop.",
            )
        group = entity.callback_group
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
        work = Work(entity, payload, self.context.now_ns, resumed=True)
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

    # ------------------------------------------------------------ spinning

    def spin(self) -> None:
        """Run the simulation until shutdown, until its horizon, or until nothing is left to happen.

        Raises:
            ExternalShutdownException: the horizon was reached (as Ctrl-C in genuine rclpy).
        """
        context = self.context
        context.check_not_in_callback("spin")
        while context.ok():
            upcoming = context.next_event_ns()
            if upcoming is None:
                context.get_logger().info("spin: no event is pending, so nothing can happen any more; shutting down")
                context.try_shutdown()
                return
            if context.horizon_ns is not None and upcoming > context.horizon_ns:
                context.run_until(max(context.now_ns, context.horizon_ns))
                context.try_shutdown()
                raise ExternalShutdownException(f"the context's horizon ({context.horizon_ns} ns) was reached")
            context.step()

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Run the simulation until one callback of this executor has been executed, or the time is over."""
        before = self.executed
        self._spin_while(lambda: self.executed == before, timeout_sec, "spin_once")

    def spin_until_future_complete(self, future: Future, timeout_sec: float | None = None) -> None:
        """Run the simulation until ``future`` is done, or the time is over.

        Raises:
            SimulationDeadlockError: no timeout, and no pending event can complete the future.
        """
        self._spin_while(lambda: not future.done(), timeout_sec, "spin_until_future_complete")

    def spin_once_until_future_complete(self, future: Future, timeout_sec: float | None = None) -> None:
        """Run one callback of this executor, or until ``future`` is done, or the time is over."""
        before = self.executed
        self._spin_while(
            lambda: self.executed == before and not future.done(), timeout_sec, "spin_once_until_future_complete"
        )

    def _spin_while(self, waiting: Callable[[], bool], timeout_sec: float | None, what: str) -> None:
        context = self.context
        context.check_not_in_callback(what)
        deadline = None
        if timeout_sec is not None and timeout_sec >= 0:
            deadline = context.now_ns + round(timeout_sec * 1e9)
        while context.ok() and waiting():
            upcoming = context.next_event_ns()
            limits = [limit for limit in (deadline, context.horizon_ns) if limit is not None]
            if upcoming is not None and not (limits and upcoming > min(limits)):
                context.step()
                continue
            if not limits:
                raise SimulationDeadlockError(
                    f"{what} waits for something that cannot happen: no event is pending "
                    f"at {context.now_ns / 1e9:.9f} s. Is the timer, publisher or service you wait for created?"
                )
            context.run_until(max(context.now_ns, min(limits)))
            if context.horizon_ns is not None and min(limits) == context.horizon_ns and deadline != context.horizon_ns:
                context.try_shutdown()
                raise ExternalShutdownException(f"the context's horizon ({context.horizon_ns} ns) was reached")
            return


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
