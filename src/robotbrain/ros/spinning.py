"""Spinning: letting simulated time run until something has happened (the blocking half of ``rclpy.executors``)."""

# ruff: noqa: N818 - the names are those of rclpy.executors

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from robotbrain.errors import RobotBrainError
from robotbrain.ros.exceptions import SimulationDeadlockError
from robotbrain.ros.task import Future

if TYPE_CHECKING:
    from robotbrain.ros.context import SimContext


class ExternalShutdownException(RobotBrainError):
    """The context was shut down, or its horizon reached, while spinning."""


class ShutdownException(RobotBrainError):
    """The executor was shut down."""


class TimeoutException(RobotBrainError):
    """A wait ran out of time."""


class ConditionReachedException(RobotBrainError):
    """What was waited for has come."""


class Spinner:
    """What an executor's ``spin`` functions do. The whole context runs, not only the executor's own nodes.

    Attributes:
        context: the simulation.
        executed: callbacks of this executor that have been started.
    """

    context: SimContext
    executed: int
    _is_shutdown: bool
    _budget: int

    def spin(self) -> None:
        """Run the simulation until shutdown, until its horizon, or until nothing is left to happen.

        In a second thread it leaves the running to the first one (see :mod:`robotbrain.ros.threads`).

        Raises:
            ExternalShutdownException: the horizon was reached (as Ctrl-C in genuine rclpy).
        """
        context = self.context
        context.check_not_in_callback("spin")
        second = context.simulated and not context.driver.is_mine()
        while context.ok() and not self._is_shutdown:
            if second and not context.driver.give_way(context):
                return
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
        self._spin_one(None, timeout_sec, "spin_once")

    def spin_until_future_complete(self, future: Future, timeout_sec: float | None = None) -> None:
        """Run the simulation until ``future`` is done or cancelled, or the time is over.

        Raises:
            SimulationDeadlockError: no timeout, and no pending event can complete the future.
        """
        self._spin_while(future._pending, timeout_sec, "spin_until_future_complete")

    def spin_once_until_future_complete(self, future: Future, timeout_sec: float | None = None) -> None:
        """Run one callback of this executor, or until ``future`` is done, or the time is over."""
        self._spin_one(future, timeout_sec, "spin_once_until_future_complete")

    def _spin_one(self, future: Future | None, timeout_sec: float | None, what: str) -> None:
        before = self.executed
        # Of several callbacks that are ready at one time only one is started.
        self._budget = 1
        try:
            self._spin_while(
                lambda: self.executed == before and (future is None or future._pending()), timeout_sec, what
            )
        finally:
            self._budget = -1

    def _spin_while(self, waiting: Callable[[], bool], timeout_sec: float | None, what: str) -> None:
        if self._is_shutdown:
            return
        context = self.context
        spin_while(context, waiting, timeout_sec, what)
        # A thread that spins returns when the callback it runs does, not in its midst.
        while self._occupied() and context.ok() and (upcoming := context.next_event_ns()) is not None:
            if context.horizon_ns is not None and upcoming > context.horizon_ns:
                break
            context.step()

    def _occupied(self) -> bool:
        """Tell whether the spinning thread itself is busy with a callback."""
        raise NotImplementedError


def spin_while(context: SimContext, waiting: Callable[[], bool], timeout_sec: float | None, what: str) -> None:
    """Run the simulation while ``waiting()``, at most for ``timeout_sec`` (None or negative: without limit).

    Args:
        context: the simulation.
        waiting: asked before each event.
        timeout_sec: in simulated time.
        what: is waiting, for messages.

    Raises:
        ReentrancyError: called inside a callback.
        SimulationDeadlockError: no limit, and no event is pending.
        ExternalShutdownException: the horizon was reached.
    """
    context.check_not_in_callback(what)
    deadline = None
    if timeout_sec is not None and 0 <= timeout_sec < float("inf"):
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
