"""Module-level functions of ``rclpy``: init, shutdown, ok, create_node and spinning."""

from __future__ import annotations

from typing import Any

from robotbrain.ros import context as _context
from robotbrain.ros.context import SimContext, get_default_context, peek_default_context, set_default_context
from robotbrain.ros.executors import Executor, SingleThreadedExecutor
from robotbrain.ros.logging import RcutilsLogger, get_logger
from robotbrain.ros.node import Node
from robotbrain.ros.task import Future

__all__ = [
    "Future",
    "RcutilsLogger",
    "charge",
    "charge_work",
    "create_node",
    "get_default_context",
    "get_global_executor",
    "get_logger",
    "init",
    "ok",
    "shutdown",
    "spin",
    "spin_once",
    "spin_until_future_complete",
    "try_shutdown",
]


class InitContextManager:
    """What ``init`` returns: leaving a ``with rclpy.init():`` block shuts the context down."""

    def __init__(self, context: SimContext) -> None:
        self.context = context

    def __enter__(self) -> InitContextManager:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.context.try_shutdown()


def init(
    *,
    args: list[str] | None = None,
    context: SimContext | None = None,
    domain_id: int | None = None,
    signal_handler_options: Any = None,
) -> InitContextManager:
    """Start using ROS.

    Without ``context`` the default context is initialised: the one a harness made default
    (``SimContext.as_default``), or else a new one at simulated time 0.

    Raises:
        RuntimeError: already initialised.
    """
    if context is None:
        context = peek_default_context()
        if context is None or not context.ok():
            context = SimContext()
            set_default_context(context)
    context.init(args, domain_id=domain_id)
    return InitContextManager(context)


def shutdown(*, context: SimContext | None = None, uninstall_handlers: bool | None = None) -> None:
    """Shut the context down.

    Raises:
        RuntimeError: it already is.
    """
    (context or get_default_context()).shutdown()


def try_shutdown(*, context: SimContext | None = None, uninstall_handlers: bool | None = None) -> None:
    """Shut the context down unless it already is."""
    chosen = context or peek_default_context()
    if chosen is not None:
        chosen.try_shutdown()


def ok(*, context: SimContext | None = None) -> bool:
    """Tell whether the context is initialised and not shut down."""
    chosen = context or peek_default_context()
    return chosen is not None and chosen.ok()


def create_node(node_name: str, **kwargs: Any) -> Node:
    """Create a :class:`Node`; keyword arguments as its constructor's."""
    return Node(node_name, **kwargs)


def get_global_executor() -> Executor:
    """Return an executor for spinning the default context; nodes keep their own executors."""
    return SingleThreadedExecutor()


def _spinner(node: Node, executor: Executor | None) -> Executor:
    if executor is not None:
        executor.add_node(node)
        return executor
    if node.executor is None:
        node.context.default_executor_factory(node).add_node(node)
    assert node.executor is not None
    return node.executor


def spin(node: Node, executor: Executor | None = None) -> None:
    """Run the simulation until shutdown, its horizon, or until nothing is left to happen.

    The whole context runs: all its nodes, not only ``node``.
    """
    _spinner(node, executor).spin()


def spin_once(node: Node, *, executor: Executor | None = None, timeout_sec: float | None = None) -> None:
    """Run the simulation until one callback of the node's executor has been executed, or the time is over."""
    _spinner(node, executor).spin_once(timeout_sec)


def spin_until_future_complete(
    node: Node, future: Future, executor: Executor | None = None, timeout_sec: float | None = None
) -> None:
    """Run the simulation until the future is done, or the time is over."""
    _spinner(node, executor).spin_until_future_complete(future, timeout_sec)


def charge(nanoseconds: int, resource: str = "cpu") -> bool:
    """Add ``nanoseconds`` of simulated time to the cost of the callback that is running now.

    This is how a timed inference engine adds its latency: ``charge(engine.latency_ns, engine.resource)``. Outside
    callbacks, and without a kit context, it does nothing.

    Args:
        nanoseconds: >= 0.
        resource: where the time is spent: ``cpu``, ``gpu``, ``dla0`` or ``dla1``.

    Returns:
        Whether it was charged.
    """
    active = _context.active_context()
    return active.charge(nanoseconds, resource) if active is not None else False


def charge_work(kind: str, units: float) -> bool:
    """Add CPU work to the cost of the callback that is running now, e.g. ``charge_work("astar", expanded)``.

    The simulation's cost model turns units of work into time on its device. Outside callbacks, without a kit context
    and without such a model it does nothing.

    Returns:
        Whether there was a callback to charge.
    """
    active = _context.active_context()
    return active.charge_work(kind, units) if active is not None else False
