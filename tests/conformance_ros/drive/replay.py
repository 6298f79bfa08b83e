"""What genuine rclpy asked of a planner, asked again on the kit: the answers must be the same."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from robotbrain.ros import SimContext
from robotbrain.ros.cdr import from_cdr, to_cdr
from robotbrain.ros.messages import message_class, service_class
from robotbrain.ros.node import Node
from robotbrain.ros.qos import DurabilityPolicy, QoSProfile
from tests.conformance_ros.drive.planner_process import load


def replay(planner_file: Path, log: Path) -> dict[str, Any]:
    """Play a recorded log to the planner on the kit.

    Returns:
        ``maps`` and ``plans`` played, ``empty`` plans, ``poses`` of all plans together, ``equal`` answers.
    """
    grid: Any = message_class("nav_msgs/msg/OccupancyGrid")
    get_plan: Any = service_class("nav_msgs/srv/GetPlan")
    context = SimContext()
    with context.as_default():
        load(planner_file)()
        user = Node("user", context=context)
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    maps, client = user.create_publisher(grid, "map", latched), user.create_client(get_plan, "plan")
    found = {"maps": 0, "plans": 0, "empty": 0, "poses": 0, "equal": 0}
    for line in log.read_text(encoding="utf-8").splitlines():
        row = json.loads(line)
        if row["event"] == "map":
            maps.publish(from_cdr(bytes.fromhex(row["map"]), grid))
            context.run_for(0.001)
            found["maps"] += 1
            continue
        future = client.call_async(from_cdr(bytes.fromhex(row["request"]), get_plan.Request))
        context.run_for(0.001)
        theirs = from_cdr(bytes.fromhex(row["response"]), get_plan.Response)
        found["plans"] += 1
        found["empty"] += not theirs.plan.poses
        found["poses"] += len(theirs.plan.poses)
        # To the last bit: both planners work on the same float64s.
        found["equal"] += to_cdr(future.result()) == to_cdr(theirs)
    context.shutdown()
    return found
