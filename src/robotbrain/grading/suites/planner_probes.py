"""What labs run in the student's process to try a planner node out: inputs only, no answers."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from robotbrain.grading import Student

Array = NDArray[np.float64]
Point = tuple[float, float]


class CountedWork:
    """A cost model in which work is free, but counted."""

    def __init__(self) -> None:
        self.units: dict[str, float] = {}

    def cost(self, node_name: str, kind: str, name: str) -> int:
        """Nothing costs anything."""
        return 0

    def work_ns(self, kind: str, units: float) -> int:
        """Count work of a callback."""
        self.units[kind] = self.units.get(kind, 0.0) + units
        return 0


class PlannerHost:
    """A planner node beside a client, in simulated time of its own.

    Args:
        make: makes the node.
    """

    def __init__(self, make: Callable[[], Any]) -> None:
        from robotbrain.ros import SimContext  # first: it makes the imports below resolve

        from nav_msgs.msg import OccupancyGrid  # isort: skip
        from nav_msgs.srv import GetPlan  # isort: skip
        from rclpy.node import Node  # isort: skip
        from rclpy.qos import DurabilityPolicy, QoSProfile  # isort: skip

        self._work = CountedWork()
        self._context = SimContext(cost_model=self._work)
        self._request: Callable[[], Any] = GetPlan.Request
        with self._context.as_default():
            make()
            client = Node("tester")
            latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            self._maps = client.create_publisher(OccupancyGrid, "map", latched)
            self._client = client.create_client(GetPlan, "plan")

    def ready(self) -> bool:
        """Tell whether the node offers the service ``plan``."""
        return bool(self._client.service_is_ready())

    def show(self, cells: NDArray[np.int8], resolution: float, origin: Point) -> dict[str, float]:
        """Publish a map; return what the node charged for it, by kind of work."""
        from robotbrain.ros.conversions import numpy_to_grid

        self._maps.publish(numpy_to_grid(cells, resolution, origin))
        return self._run(0.1)

    def ask(self, start: Point, goal: Point, tolerance: float) -> tuple[Array | None, dict[str, float]]:
        """Return the answered path, (N, 2) m (None: no answer), and what the node charged for it."""
        from robotbrain.ros.conversions import path_to_numpy

        request = self._request()
        request.start.pose.position.x, request.start.pose.position.y = start
        request.goal.pose.position.x, request.goal.pose.position.y = goal
        request.tolerance = tolerance
        future = self._client.call_async(request)
        charged = self._run(1.0)
        return (path_to_numpy(future.result().plan) if future.done() else None), charged

    def _run(self, seconds: float) -> dict[str, float]:
        from robotbrain.ros import CallbackError

        self._work.units = {}
        try:
            self._context.run_for(seconds)
        except CallbackError as error:
            raise error.cause from None
        return self._work.units


def host(student: Student, name: str) -> PlannerHost:
    """Probe: make the student's node of this class, ready to be asked."""
    return PlannerHost(student[name])
