"""Deadlines and leases in simulated time: who was silent for too long."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from robotbrain.ros.context import SimContext


class DeadlineWatch:
    """Counts the periods that went by without a message. It begins with the first message, as in the middleware.

    Args:
        context: the simulation.
        period_ns: longest time between two messages.
        on_miss: called for every missed period when it ends; None only counts, which costs no events.
    """

    def __init__(self, context: SimContext, period_ns: int, on_miss: Callable[[], None] | None) -> None:
        self._context, self._period_ns, self._on_miss = context, period_ns, on_miss
        self._due_ns: int | None = None
        self._missed = 0
        self._scheduled = self._closed = False

    @property
    def missed(self) -> int:
        """Periods without a message so far."""
        return self._missed + self._overdue()

    def _overdue(self) -> int:
        if self._due_ns is None or self._on_miss is not None or self._context.now_ns <= self._due_ns:
            return 0
        # A message that comes exactly when it is due is in time.
        return (self._context.now_ns - self._due_ns - 1) // self._period_ns + 1

    def touch(self) -> None:
        """Note that a message came."""
        self._missed += self._overdue()
        self._due_ns = self._context.now_ns + self._period_ns
        if self._on_miss is not None and not self._scheduled:
            self._scheduled = True
            self._context.schedule(self._due_ns, self._check)

    def _check(self, _: None) -> None:
        self._scheduled = False
        if self._closed or self._due_ns is None or self._on_miss is None:
            return
        if self._context.now_ns >= self._due_ns:
            self._missed += 1
            self._due_ns += self._period_ns
            self._on_miss()
        self._scheduled = True
        self._context.schedule(self._due_ns, self._check)

    def close(self) -> None:
        """Stop counting."""
        self._closed, self._due_ns = True, None


class LeaseWatch:
    """Whether something that must show itself within a lease does so.

    Args:
        context: the simulation.
        lease_ns: longest time without a sign of life.
        on_change: called with True when it comes alive, with False when the lease has run out.

    Attributes:
        alive: whether there was a sign of life within the lease.
        was_alive: whether there ever was one.
    """

    def __init__(self, context: SimContext, lease_ns: int, on_change: Callable[[bool], None]) -> None:
        self._context, self._lease_ns, self._on_change = context, lease_ns, on_change
        self._until_ns = 0
        self._scheduled = False
        self.alive = self.was_alive = False

    def touch(self) -> None:
        """Note a sign of life."""
        self._until_ns = self._context.now_ns + self._lease_ns
        if not self._scheduled:
            self._scheduled = True
            self._context.schedule(self._until_ns, self._check)
        if not self.alive:
            self._on_change(True)
            self.alive = self.was_alive = True

    def _check(self, _: None) -> None:
        self._scheduled = False
        if not self.alive:
            return
        if self._context.now_ns < self._until_ns:
            self._scheduled = True
            self._context.schedule(self._until_ns, self._check)
        else:
            self.alive = False
            self._on_change(False)

    def close(self) -> None:
        """Stop watching."""
        self.alive = False
