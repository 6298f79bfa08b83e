"""Wrapping the callbacks and publishers of a node, of the kit's rclpy or the genuine one, to time them."""

from __future__ import annotations

import contextlib
import functools
import inspect
import time
from collections.abc import Callable
from typing import Any, Protocol


class Listener(Protocol):
    """What is told of a node's callbacks and messages. Its methods must not raise."""

    def begin(self, node: str, kind: str, name: str, stamp_ns: int | None, clock_ns: int) -> Any:
        """Note that a callback starts; what is returned is handed to :meth:`end`."""
        ...

    def end(self, token: Any, start_ns: int, end_ns: int, failed: bool) -> None:
        """Note that a callback ended; times are monotonic ns."""
        ...

    def sent(self, node: str, topic: str, stamp_ns: int | None, clock_ns: int, size: int | None) -> None:
        """Note that a message is published."""
        ...

    def period(self, node: str, name: str, period_ns: int) -> None:
        """Note the period of a timer."""
        ...


def stamp_ns_of(message: Any) -> int | None:
    """Return the header stamp of a message object, ns; None if it has none, or an empty one."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    if stamp is None:
        return None
    with contextlib.suppress(AttributeError, TypeError, ValueError):
        return (int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)) or None
    return None


def instrument(node: Any, listener: Listener) -> Callable[[], None]:
    """Report a node's subscription, timer and service callbacks and its publications, also of those made later.

    What the node does stays the same: return values, exceptions and the callbacks' signatures, which genuine rclpy
    looks at. Callbacks that are coroutines are timed from their start to their end, with what they wait for.

    Args:
        node: of the kit's rclpy or the genuine one.
        listener: what is told.

    Returns:
        A function that puts everything back.
    """
    return _Instrument(node, listener).undo


class _Instrument:
    def __init__(self, node: Any, listener: Listener) -> None:
        self.node, self.listener = node, listener
        self.name = str(node.get_fully_qualified_name())
        self._undo: list[Callable[[], None]] = []
        self._seen: set[int] = set()
        for publisher in list(node.publishers):
            self.publisher(publisher)
        for subscription in list(node.subscriptions):
            self.callback(subscription, "subscription", _topic_of(subscription))
        for timer in list(node.timers):
            self.callback(timer, "timer", "")
        for service in list(node.services):
            self.callback(service, "service", str(service.service_name))
        self.factory("create_publisher", self.publisher)
        self.factory("create_subscription", lambda made: self.callback(made, "subscription", _topic_of(made)))
        self.factory("create_timer", lambda made: self.callback(made, "timer", ""))
        self.factory("create_service", lambda made: self.callback(made, "service", str(made.service_name)))

    def undo(self) -> None:
        while self._undo:
            self._undo.pop()()

    def now_ns(self) -> int:
        return int(self.node.get_clock().now().nanoseconds)

    def factory(self, method: str, wrap: Callable[[Any], None]) -> None:
        original = getattr(self.node, method)

        @functools.wraps(original)
        def create(*args: Any, **kwargs: Any) -> Any:
            made = original(*args, **kwargs)
            wrap(made)
            return made

        setattr(self.node, method, create)
        self._undo.append(lambda: delattr(self.node, method))

    def publisher(self, publisher: Any) -> None:
        if id(publisher) in self._seen:
            return
        self._seen.add(id(publisher))
        original = publisher.publish
        topic = _topic_of(publisher)

        @functools.wraps(original)
        def publish(message: Any, *args: Any, **kwargs: Any) -> Any:
            size = len(message) if isinstance(message, bytes | bytearray) else None
            self.listener.sent(self.name, topic, stamp_ns_of(message), self.now_ns(), size)
            return original(message, *args, **kwargs)

        publisher.publish = publish
        self._undo.append(lambda: delattr(publisher, "publish"))

    def callback(self, entity: Any, kind: str, name: str) -> None:
        original = entity.callback
        if original is None or id(entity) in self._seen:
            return
        self._seen.add(id(entity))
        if kind == "timer":
            name = getattr(original, "__name__", None) or "timer"
            period = getattr(entity, "timer_period_ns", None)
            if period:
                self.listener.period(self.name, name, int(period))
        entity.callback = self.timed(original, kind, name)
        self._undo.append(lambda: setattr(entity, "callback", original))

    def timed(self, original: Callable[..., Any], kind: str, name: str) -> Callable[..., Any]:
        listener, node = self.listener, self.name

        def start(args: tuple[Any, ...]) -> tuple[Any, int]:
            stamp = stamp_ns_of(args[0]) if kind == "subscription" and args else None
            token = listener.begin(node, kind, name, stamp, self.now_ns())
            return token, time.perf_counter_ns()

        if inspect.iscoroutinefunction(original):

            @functools.wraps(original)
            async def call_async(*args: Any, **kwargs: Any) -> Any:
                token, began = start(args)
                failed = True
                try:
                    result = await original(*args, **kwargs)
                    failed = False
                    return result
                finally:
                    listener.end(token, began, time.perf_counter_ns(), failed)

            return call_async

        @functools.wraps(original)
        def call(*args: Any, **kwargs: Any) -> Any:
            token, began = start(args)
            failed = True
            try:
                result = original(*args, **kwargs)
                failed = False
                return result
            finally:
                listener.end(token, began, time.perf_counter_ns(), failed)

        return call


def _topic_of(end: Any) -> str:
    name = getattr(end, "topic_name", None)
    return str(name if name is not None else end.topic)
