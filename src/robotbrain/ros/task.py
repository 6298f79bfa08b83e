"""``Future`` and ``Task`` (``rclpy.task``): results that are not there yet, and what an executor does on the side."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Coroutine, Generator
from typing import Any

from robotbrain.ros.callback_groups import CallbackGroup, ReentrantCallbackGroup


class Future:
    """A result that is not there yet.

    Done callbacks run in the order they were added, at the simulated time the result arrives.
    """

    def __init__(self, *, executor: Any = None) -> None:
        self._done = False
        self._cancelled = False
        self._result: Any = None
        self._exception: BaseException | None = None
        self._callbacks: list[Callable[[Any], Any]] = []
        self.completed_in: CallbackGroup | None = None  # callback group in which a client will set the result

    def done(self) -> bool:
        """Tell whether the future has a result or an exception; a cancelled future is not done, as in rclpy."""
        return self._done

    def cancelled(self) -> bool:
        """Tell whether :meth:`cancel` was called before a result came."""
        return self._cancelled

    def _pending(self) -> bool:
        return not (self._done or self._cancelled)

    def cancel(self) -> None:
        """Give up waiting; done callbacks run."""
        if self._pending():
            self._cancelled = True
            self._finish()

    def result(self) -> Any:
        """Return the result, or None while there is none; raise the exception if there is one."""
        if self._exception is not None:
            raise self._exception
        return self._result

    def exception(self) -> BaseException | None:
        """Return the exception, or None."""
        return self._exception

    def set_result(self, result: Any) -> None:
        """Set the result and run the done callbacks."""
        self._result, self._done, self._cancelled = result, True, False
        self._finish()

    def set_exception(self, exception: BaseException) -> None:
        """Set an exception and run the done callbacks."""
        self._exception, self._done, self._cancelled = exception, True, False
        self._finish()

    def add_done_callback(self, callback: Callable[[Any], Any]) -> None:
        """Call ``callback(future)`` when done; at once if it already is."""
        if self._pending():
            self._callbacks.append(callback)
        else:
            callback(self)

    def remove_done_callback(self, callback: Callable[[Any], Any]) -> bool:
        """Remove every registration of ``callback``; tell whether there was one."""
        kept = [known for known in self._callbacks if known != callback]
        removed = len(kept) < len(self._callbacks)
        self._callbacks = kept
        return removed

    def _finish(self) -> None:
        callbacks, self._callbacks = self._callbacks, []
        for callback in callbacks:
            callback(self)

    def __await__(self) -> Generator[Future, None, Any]:
        while self._pending():
            yield self
        return self.result()

    def __repr__(self) -> str:
        state = "cancelled" if self._cancelled else "done" if self._done else "pending"
        return f"<{type(self).__name__} {state}>"


class Task(Future):
    """A function or coroutine that an executor runs once; its future is what it returns.

    Made by ``Executor.create_task``.

    Args:
        handler: a function or ``async def`` function.
        args, kwargs: its arguments.
        entity: what the executor schedules.
    """

    def __init__(
        self,
        handler: Callable[..., Any],
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
        *,
        node: Any = None,
        kind: str = "task",
        name: str = "",
    ) -> None:
        super().__init__()
        self._handler, self._args, self._kwargs = handler, args, kwargs or {}
        self._coroutine: Coroutine[Any, Any, Any] | None = None
        self._running = False
        self.entity = TaskEntity(self, node, kind, name or getattr(handler, "__name__", "") or "task")

    def executing(self) -> bool:
        """Tell whether the task has begun and neither ended nor been cancelled."""
        return self._running and self._pending()

    def cancel(self) -> None:
        """End the task where it waits; nothing of it runs any more."""
        if self._pending():
            self.entity.cancelled = True
            if self._coroutine is not None:
                self._coroutine.close()
        super().cancel()

    def _start(self) -> Any:
        self._running = True
        try:
            result = self._handler(*self._args, **self._kwargs)
        except Exception as error:
            self.set_exception(error)
            raise
        if inspect.iscoroutine(result):
            self._coroutine = result
            return self._watch(result)
        return result

    async def _watch(self, coroutine: Coroutine[Any, Any, Any]) -> Any:
        try:
            return await coroutine
        except Exception as error:
            self.set_exception(error)
            raise


class TaskEntity:
    """A task as executors see it: beside timers and subscriptions, in a callback group of its own.

    Attributes:
        kind: ``task``, or ``action`` when it executes a goal.
        name: of its function, or of the action.
    """

    destroyed = False

    def __init__(self, task: Task, node: Any, kind: str, name: str) -> None:
        self.task, self.node, self.kind, self.name = task, node, kind, name
        self.callback_group = ReentrantCallbackGroup()
        self.cancelled = False

    @property
    def callback_name(self) -> str:
        """Readable name of the function."""
        handler = self.task._handler
        return getattr(handler, "__qualname__", None) or repr(handler)

    def execute(self, work: Any) -> Any:
        """Run the function; may return a coroutine."""
        return self.task._start()

    def complete(self, work: Any, result: Any) -> None:
        """Take what the function returned."""
        if self.task._pending():
            self.task.set_result(result)
