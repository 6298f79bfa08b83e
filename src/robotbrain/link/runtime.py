"""What runs nodes in wall-clock time: the kit's own graph, or genuine rclpy. Both look alike from here."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

from robotbrain.errors import MissingDependencyError
from robotbrain.link.realtime import RealtimeContext, TimeSource

SLICE_S = 0.02
"""How often a run looks whether it is over, s."""

ROS_INSTALL = "see https://docs.ros.org, or on Linux: pip install ros-kilted-rclpy ros-kilted-rmw-fastrtps-cpp"


class Runtime(Protocol):
    """Makes nodes and runs them."""

    def make(self, factory: Callable[[], Any]) -> Any:
        """Return the node that ``factory`` makes, running."""
        ...

    def destroy(self, node: Any) -> None:
        """Destroy a node."""
        ...

    def run(self, until: Callable[[], bool], timeout_s: float = float("inf")) -> bool:
        """Run until ``until()`` or for ``timeout_s``; tell whether it was the former.

        Raises:
            Exception: what a callback raised.
        """
        ...

    def offered(self) -> Mapping[str, Sequence[str]]:
        """Return the types of the topics that others publish."""
        ...

    def close(self) -> None:
        """Destroy all nodes and end."""
        ...


class KitRuntime:
    """The kit's nodes in this thread.

    Args:
        arguments: ROS arguments, such as remappings.
        clock: paces it.
    """

    def __init__(self, arguments: Sequence[str] = (), clock: TimeSource | None = None) -> None:
        self.context = RealtimeContext(clock)
        self.context.init(list(arguments))
        self.remote: Callable[[], Mapping[str, Sequence[str]]] = dict

    def make(self, factory: Callable[[], Any]) -> Any:
        """Return the node that ``factory`` makes."""
        with self.context.as_default():
            return factory()

    def destroy(self, node: Any) -> None:
        """Destroy a node."""
        node.destroy_node()

    def run(self, until: Callable[[], bool], timeout_s: float = float("inf")) -> bool:
        """Run until ``until()`` or for ``timeout_s`` real seconds; tell whether it was the former."""
        deadline = time.monotonic() + timeout_s
        with self.context.as_default():
            while not until():
                left = deadline - time.monotonic()
                if left <= 0 or not self.context.ok():
                    return until()
                self._slice(min(SLICE_S, left))
        return True

    def _slice(self, seconds: float) -> None:
        # By this computer's clock: one that others set may stand still.
        end = time.monotonic() + seconds
        while self.context.ok() and time.monotonic() < end:
            self.context.step()

    def offered(self) -> Mapping[str, Sequence[str]]:
        """Return the types of the topics on the other side of the link."""
        return self.remote()

    def close(self) -> None:
        """Destroy all nodes and shut the context down."""
        for node in list(self.context.nodes):
            node.destroy_node()
        self.context.try_shutdown()


class RclpyRuntime:
    """Nodes on genuine rclpy, each with a single-threaded executor in a thread of its own.

    Args:
        arguments: ROS arguments, such as remappings.

    Raises:
        MissingDependencyError: genuine rclpy is not installed, or the kit stands in for it.
    """

    def __init__(self, arguments: Sequence[str] = ()) -> None:
        import robotbrain.ros

        if robotbrain.ros.BACKEND != "rclpy":
            raise MissingDependencyError("rclpy (ROS 2)", needed_for="--transport rclpy", install=ROS_INSTALL)
        import rclpy
        from rclpy.signals import SignalHandlerOptions

        # Ctrl-C is for the main thread: it must be able to stop the robot before ROS 2 goes away.
        rclpy.init(args=list(arguments), signal_handler_options=SignalHandlerOptions.NO)
        self._rclpy = rclpy
        self._running: dict[Any, tuple[Any, threading.Thread]] = {}
        self._failures: list[BaseException] = []
        self._failed = threading.Event()

    def make(self, factory: Callable[[], Any]) -> Any:
        """Return the node that ``factory`` makes, spinning in a thread."""
        from rclpy.executors import SingleThreadedExecutor

        node = factory()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        thread = threading.Thread(target=self._spin, args=(executor,), name=node.get_name(), daemon=True)
        self._running[node] = (executor, thread)
        thread.start()
        return node

    def _spin(self, executor: Any) -> None:
        from rclpy.executors import ExternalShutdownException

        try:
            executor.spin()
        except ExternalShutdownException:
            pass
        except BaseException as error:
            self._failures.append(error)
            self._failed.set()

    def destroy(self, node: Any) -> None:
        """Destroy a node and end its thread."""
        executor, thread = self._running.pop(node)
        executor.shutdown(timeout_sec=1.0)
        thread.join(2.0)
        node.destroy_node()

    def run(self, until: Callable[[], bool], timeout_s: float = float("inf")) -> bool:
        """Wait until ``until()`` or for ``timeout_s``; tell whether it was the former."""
        deadline = time.monotonic() + timeout_s
        while not until():
            if time.monotonic() >= deadline:
                return False
            self._failed.wait(SLICE_S)
            if self._failures:
                raise self._failures.pop(0)
        return True

    def offered(self) -> Mapping[str, Sequence[str]]:
        """Return the types of the topics of the ROS 2 graph."""
        for node in self._running:
            return dict(node.get_topic_names_and_types())
        return {}

    def close(self) -> None:
        """Destroy all nodes and shut rclpy down."""
        for node in list(self._running):
            self.destroy(node)
        self._rclpy.try_shutdown()


def use_kit() -> None:
    """Let ``rclpy`` be the kit's even where genuine ROS 2 is installed.

    Raises:
        robotbrain.errors.RobotBrainError: a program of genuine rclpy runs in this process already.
    """
    import robotbrain.ros
    from robotbrain.errors import RobotBrainError
    from robotbrain.ros.shim import genuine_rclpy_available

    if robotbrain.ros.BACKEND == "kit":
        return
    import sys

    if "rclpy" in sys.modules and genuine_rclpy_available():
        raise RobotBrainError("genuine rclpy is loaded in this process; this transport needs the kit's: start anew")
    robotbrain.ros.install(force=True)
