"""``Future`` and the tasks of ``async def`` callbacks (``rclpy.task``)."""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import Any


class Future:
    """A result that is not there yet.

    Done callbacks run in the order they were added, at the simulated time the result arrives.
    """

    def __init__(self, *, executor: Any = None) -> None:
        self._done = False
        self._cancelled = False
        self._result: Any = None
        self._exception: BaseException | None = None
        self._callbacks: list[Callable[[Future], Any]] = []
        self.completed_in: Any = None  # callback group in which a client will set the result

    def done(self) -> bool:
        """Tell whether the future has a result, an exception, or was cancelled."""
        return self._done or self._cancelled

    def cancelled(self) -> bool:
        """Tell whether :meth:`cancel` was called before a result came."""
        return self._cancelled

    def cancel(self) -> None:
        """Give up waiting; done callbacks run."""
        if not self.done():
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
        self._result, self._done = result, True
        self._finish()

    def set_exception(self, exception: BaseException) -> None:
        """Set an exception and run the done callbacks."""
        self._exception, self._done = exception, True
        self._finish()

    def add_done_callback(self, callback: Callable[[Future], Any]) -> None:
        """Call ``callback(future)`` when done; at once if it already is."""
        if self.done():
            callback(self)
        else:
            self._callbacks.append(callback)

    def remove_done_callback(self, callback: Callable[[Future], Any]) -> bool:
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
        while not self.done():
            yield self
        return self.result()

    def __repr__(self) -> str:
        state = "cancelled" if self._cancelled else "done" if self._done else "pending"
        return f"<Future {state}>"
