"""What the programs of this suite share: a decision log, and waiting for a condition instead of for a while.

Plain Python and rclpy; the same file serves the kit and genuine rclpy. The one place that knows that there are two
is :class:`SimulatedTime`: genuine ROS 2 takes simulated time from ``/clock``, in the kit time *is* simulated.
"""

from __future__ import annotations

import array
import builtins
import contextlib
import enum
import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node

QUIET_SEC = 0.04
"""Genuine executors count as idle when nothing happens for so long (loopback delivery takes well under 1 ms)."""


# ------------------------------------------------------------ decision log


def plain(value: Any) -> Any:
    """Return ``value`` as JSON can hold it; floats keep every digit, enumerations show their name."""
    if isinstance(value, enum.Enum) or hasattr(type(value), "__members__"):
        return value.name
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, (int, float)):
        return value if value == value and abs(value) != float("inf") else str(value)
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, (bytes, bytearray)):
        return value.hex()
    if isinstance(value, (array.array, np.ndarray, list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, (set, frozenset)):
        return sorted(plain(item) for item in value)
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, type):
        return value.__name__
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    return str(value)


def log(event: str, **fields: Any) -> None:
    """Append one line to the decision log: a canonical JSON object without wall-clock times."""
    line = json.dumps({"event": event, **{key: plain(value) for key, value in fields.items()}}, sort_keys=True)
    target = os.environ.get("CONFORMANCE_LOG")
    if target:
        with Path(target).open("a", encoding="utf-8", newline="\n") as file:
            file.write(line + "\n")
    else:
        print(line, file=sys.stdout)


_OF_RCLPY = {
    "ExternalShutdownException", "InvalidHandle", "InvalidNamespaceException", "InvalidNodeNameException",
    "InvalidParameterException", "InvalidParameterTypeException", "InvalidParameterValueException",
    "InvalidQoSProfileException", "InvalidServiceNameException", "InvalidTopicNameException",
    "NameValidationException", "NotInitializedException", "ParameterAlreadyDeclaredException", "ParameterException",
    "ParameterImmutableException", "ParameterNotDeclaredException", "ParameterUninitializedException",
    "ROSInterruptException", "TimeoutException", "TimerCancelledError",
}  # fmt: skip


def catchable(error: BaseException) -> list[str]:
    """Return the classes, narrowest first, by which an ordinary program can catch ``error``."""
    names = [kind.__name__ for kind in type(error).__mro__]
    return [name for name in names if name in _OF_RCLPY or hasattr(builtins, name)]


def attempt(event: str, function: Callable[[], Any], **fields: Any) -> Any:
    """Call ``function`` and log what came of it: its result, or as what its exception can be caught."""
    try:
        result = function()
    except Exception as error:
        log(event, raised=[name for name in catchable(error) if name not in ("object", "BaseException")], **fields)
        return None
    log(event, result=result, **fields)
    return result


# ------------------------------------------------------------ waiting


@contextlib.contextmanager
def ros(args: Sequence[str] | None = None) -> Iterator[None]:
    """``rclpy.init`` and ``rclpy.shutdown`` around a block."""
    rclpy.init(args=list(args) if args is not None else [])
    try:
        yield
    finally:
        rclpy.try_shutdown()


def steady() -> Clock:
    """Return a clock that runs although nobody publishes ``/clock``."""
    return Clock(clock_type=ClockType.STEADY_TIME)


def executor_of(*nodes: Node) -> SingleThreadedExecutor:
    """Return a single-threaded executor with these nodes, in order."""
    executor = SingleThreadedExecutor()
    for node in nodes:
        executor.add_node(node)
    return executor


def spin_until(executor: Executor, condition: Callable[[], Any], timeout_sec: float = 10.0) -> bool:
    """Spin until the condition holds; tell whether it did before the time was over."""
    clock = steady()
    end = clock.now() + Duration(seconds=timeout_sec)
    while not condition():
        if clock.now() >= end:
            return False
        executor.spin_once(timeout_sec=0.02)
    return True


def spin_for(executor: Executor, seconds: float) -> None:
    """Spin for so long."""
    spin_until(executor, lambda: False, seconds)


def await_match(executor: Executor, *ends: tuple[Any, int]) -> None:
    """Spin until each publisher reaches so many subscriptions.

    Args:
        ends: (publisher, number of subscriptions).
    """
    if not spin_until(executor, lambda: all(pub.get_subscription_count() == count for pub, count in ends)):
        raise TimeoutError(f"discovery: {[(pub.topic_name, pub.get_subscription_count(), n) for pub, n in ends]}")


def is_kit() -> bool:
    """Tell whether time is simulated by the context itself. Only this module may ask."""
    return hasattr(rclpy.get_default_context(), "run_until")


def settle(seconds: float = 0.2) -> None:
    """Let the middleware finish in the background, without spinning: nothing to wait for in the kit."""
    if not is_kit():
        time.sleep(seconds)


class SimulatedTime:
    """Moves the clock of nodes that were created with ``use_sim_time``, in steps, each followed until all is quiet.

    Args:
        executor: runs every node.
        nodes: whose clocks follow.
        start_sec: first time shown; later than 0, which genuine ROS 2 takes for "not set yet".
    """

    def __init__(self, executor: Executor, *nodes: Node) -> None:
        self.executor, self.nodes = executor, nodes
        self.now_ns = 0
        self._publisher: Any = None
        if not is_kit():
            from rosgraph_msgs.msg import Clock as ClockMessage

            self._message = ClockMessage
            self._driver = Node("clock_driver")
            self._publisher = self._driver.create_publisher(ClockMessage, "/clock", 10)
            executor.add_node(self._driver)
            await_match(executor, (self._publisher, len(nodes)))
        self.jump(1.0)

    def jump(self, seconds: float) -> None:
        """Move time by so much in one step, and wait until all is quiet."""
        self.now_ns += round(seconds * 1e9)
        if self._publisher is None:
            rclpy.get_default_context().run_until(self.now_ns)
            return
        message = self._message()
        message.clock.sec, message.clock.nanosec = divmod(self.now_ns, 10**9)
        self._publisher.publish(message)
        target = self.now_ns
        if not spin_until(
            self.executor, lambda: all(node.get_clock().now().nanoseconds == target for node in self.nodes)
        ):
            raise TimeoutError(f"clocks did not follow to {target} ns")
        self.quiet()

    def quiet(self) -> None:
        """Spin until nothing has happened for a while."""
        while True:
            start = time.monotonic()
            self.executor.spin_once(timeout_sec=QUIET_SEC)
            if time.monotonic() - start >= QUIET_SEC * 0.9:
                return

    def advance(self, seconds: float, step: float = 0.01) -> None:
        """Move time by so much in equal steps."""
        for _ in range(round(seconds / step)):
            self.jump(step)


def sim_node(name: str, **kwargs: Any) -> Node:
    """Return a node on simulated time."""
    override = rclpy.parameter.Parameter("use_sim_time", rclpy.parameter.Parameter.Type.BOOL, True)
    return Node(name, parameter_overrides=[override], **kwargs)
