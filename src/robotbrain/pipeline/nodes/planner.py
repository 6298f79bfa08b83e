"""Planner node: answers ``nav_msgs/srv/GetPlan`` on the newest map."""

from __future__ import annotations

from nav_msgs.msg import OccupancyGrid
from nav_msgs.srv import GetPlan
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from robotbrain.pipeline.nodes.grids import grid_from_msg
from robotbrain.pipeline.planning import InflationParams, plan_path
from robotbrain.ros import charge_work
from robotbrain.ros.conversions import numpy_to_path


class PlannerNode(Node):
    """Inflated costmap, A*, straightening. An empty path in the response means that there is no route.

    Args:
        params: inflation; defaults suit the kit's robot.
        crop: plan on the known part of the map only (see plan_path).
    """

    def __init__(self, params: InflationParams | None = None, crop: bool = True) -> None:
        super().__init__("planner")
        self._params, self._crop = params, crop
        self._map: OccupancyGrid | None = None
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.create_subscription(OccupancyGrid, "map", self._on_map, latched)
        self.create_service(GetPlan, "plan", self._plan)

    def _on_map(self, msg: OccupancyGrid) -> None:
        self._map = msg

    def _plan(self, request: GetPlan.Request, response: GetPlan.Response) -> GetPlan.Response:
        if self._map is None:
            return response
        occupancy, frame = grid_from_msg(self._map)
        charge_work("map_read", occupancy.size)
        start, goal = request.start.pose.position, request.goal.pose.position
        result = plan_path(
            occupancy,
            frame,
            (start.x, start.y),
            (goal.x, goal.y),
            tolerance=float(request.tolerance),
            params=self._params,
            crop=self._crop,
        )
        charge_work("costmap", result.cells)
        charge_work("astar", result.expanded)
        charge_work("smooth", result.path_cells)
        if result.points is not None:
            response.plan = numpy_to_path(result.points, stamp=self.get_clock().now().to_msg())
        return response
