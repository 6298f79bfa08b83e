"""The lab's planner out of its notebook is the notebook's, works as a file, and its replay notices differences."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import robotbrain.ros
from robotbrain.ros import SimContext
from robotbrain.ros.cdr import from_cdr, to_cdr
from robotbrain.ros.messages import message_class, service_class
from robotbrain.ros.node import Node
from robotbrain.ros.qos import DurabilityPolicy, QoSProfile
from tests.conformance_ros.drive.extract import EXERCISES, NOTEBOOK, planner_source
from tests.conformance_ros.drive.planner_process import load, recorded
from tests.conformance_ros.drive.replay import replay

pytestmark = pytest.mark.skipif(robotbrain.ros.BACKEND == "rclpy", reason="genuine rclpy is installed here")

OccupancyGrid: Any = message_class("nav_msgs/msg/OccupancyGrid")
GetPlan: Any = service_class("nav_msgs/srv/GetPlan")


def planner_file(folder: Path) -> Path:
    file = folder / "my_planner.py"
    file.write_text(planner_source(), encoding="utf-8")
    return file


def record(folder: Path) -> Path:
    """Ask the planner twice, on the kit, and return the log."""
    log, context = folder / "plans.jsonl", SimContext()
    grid = OccupancyGrid()
    grid.info.width = grid.info.height = 60
    grid.info.resolution = 0.05
    cells = np.zeros((60, 60), np.int8)
    cells[20:40, 30] = 100
    grid.data = cells.ravel().tolist()
    with context.as_default():
        recorded(load(planner_file(folder)), log)()
        user = Node("user")
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    client = user.create_client(GetPlan, "plan")
    request = GetPlan.Request(tolerance=0.3)
    request.start.pose.position.x, request.start.pose.position.y = 0.5, 1.5
    request.goal.pose.position.x, request.goal.pose.position.y = 2.5, 1.5
    for _ in range(2):
        client.call_async(request)
        context.run_for(0.01)
        user.create_publisher(OccupancyGrid, "map", latched).publish(grid)
        context.run_for(0.01)
    return log


def test_every_cell_is_in_the_file_as_it_is() -> None:
    source = planner_source()
    for cell in json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]:
        if cell["metadata"].get("nbgrader", {}).get("grade_id") in EXERCISES:
            assert "".join(cell["source"]) in source


def test_the_file_plans_and_its_replay_agrees(tmp_path: Path) -> None:
    found = replay(planner_file(tmp_path), record(tmp_path))
    assert found["plans"] == found["equal"] == 2
    assert found["empty"] == 1, "before the first map there is no plan"
    assert found["poses"] > 2, "the way leads around the wall"


def test_the_replay_notices_another_answer(tmp_path: Path) -> None:
    log = record(tmp_path)
    rows = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    kind = GetPlan.Response
    answer = from_cdr(bytes.fromhex(rows[-2]["response"]), kind)
    answer.plan.poses[1].pose.position.x += 1e-9
    rows[-2]["response"] = to_cdr(answer).hex()
    log.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
    found = replay(planner_file(tmp_path), log)
    assert (found["plans"], found["equal"]) == (2, 1)
