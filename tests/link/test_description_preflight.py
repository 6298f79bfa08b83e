"""Descriptions of robots, and what the pre-flight check finds."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from robotbrain.errors import InputError
from robotbrain.link.description import SENSORS, RobotDescription, description_from, example, load_description
from robotbrain.link.parts import load_part
from robotbrain.link.preflight import JOINTS, Preflight, Sight, problems
from robotbrain.pipeline.remote import RemoteOptions, make_nodes
from robotbrain.ros import SimContext
from robotbrain.sim import RobotSim, generate_world
from robotbrain.sim.camera import CameraExtrinsics


def test_the_default_is_the_kit_s_robot() -> None:
    description, camera = RobotDescription(), CameraExtrinsics()
    sim = RobotSim(generate_world(0, 0.0))
    assert (description.wheel_radius, description.track) == (sim.robot.wheel_radius, sim.robot.track)
    assert description.camera == (camera.x, camera.y, camera.z, camera.pitch)


def test_the_example_is_read_in_full(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(example(), encoding="utf-8")
    robot = load_description(path)
    assert (robot.name, robot.wheel_radius, robot.track) == ("my robot", 0.033, 0.287)
    scan = next(sensor for sensor in robot.sensors if sensor.topic == "scan")
    assert (scan.frame, scan.least_hz) == ("base_scan", 4.0)
    assert robot.ros_arguments() == ["--ros-args", "-r", "camera/image:=/oak/rgb/image_raw"]
    assert robot.safety == {"max_speed": 0.22}


@pytest.mark.parametrize(
    "content",
    [
        {"wheels": 2},
        {"base": {"radius": 0.03}},
        {"base": {"track": "wide"}},
        {"base": {"track": 0.0}},
        {"base": {"track": float("nan")}},
        {"base": 3},
        {"frames": {"lidar": "x"}},
        {"remap": {"scan": 3}},
        {"name": 3},
    ],
)
def test_impossible_descriptions(content: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        description_from(content)


@pytest.mark.parametrize("text", ["a = ", "\xff"])
def test_files_that_are_no_toml(tmp_path: Path, text: str) -> None:
    path = tmp_path / "robot.toml"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match="robot description"):
        load_description(path)
    with pytest.raises(InputError, match="robot description"):
        load_description(tmp_path / "none.toml")


def good_sights() -> dict[str, Sight]:
    return {
        sensor.topic: Sight(
            messages=101,
            first_ns=0,
            last_ns=round(100 / (2 * sensor.least_hz) * 1e9),
            frame=sensor.frame,
            youngest_s=0.01,
            joints=JOINTS,
        )
        for sensor in SENSORS
    }


def test_a_good_robot_has_no_problems() -> None:
    assert problems(SENSORS, good_sights(), commands_heard=True) == []


@pytest.mark.parametrize(
    ("topic", "change", "text"),
    [
        ("scan", {"last_ns": 100_000_000_000}, "1.0 times a second"),
        ("camera/image", {"frame": "camera_link"}, "'camera_link'"),
        ("imu", {"youngest_s": 3600.0}, "clocks"),
        ("imu", {"youngest_s": -5.0}, "clocks"),
        ("joint_states", {"joints": ("wheel_left_joint", "wheel_right_joint")}, "wheel_left_joint"),
    ],
)
def test_each_fault_is_found_and_named(topic: str, change: dict[str, Any], text: str) -> None:
    sights = good_sights()
    for name, value in change.items():
        setattr(sights[topic], name, value)
    (problem,) = problems(SENSORS, sights, commands_heard=True)
    assert topic in problem and text in problem


def test_a_deaf_robot_is_a_problem() -> None:
    (problem,) = problems(SENSORS, good_sights(), commands_heard=False)
    assert "cmd_vel" in problem


def test_preflight_on_the_simulated_robot() -> None:
    context = SimContext()
    with context.as_default():
        from robotbrain.pipeline.nodes.robot import RobotNode

        check = Preflight(SENSORS)
        waiting = check.waiting_for({"/scan": ["sensor_msgs/msg/PointCloud2"], "/imu": ["sensor_msgs/msg/Imu"]})
        assert "/scan as sensor_msgs/msg/LaserScan (the robot has it as sensor_msgs/msg/PointCloud2)" in waiting
        assert "/imu (announced, but silent)" in waiting
        assert "/camera/depth (sensor_msgs/msg/Image)" in waiting
        RobotNode(RobotSim(generate_world(0, 0.0)))
        context.run_for(2.0)
        assert check.missing() == []
        assert check.problems() == []
        rates = {topic: round(sight.hz) for topic, sight in check.sights.items()}
        assert (rates["scan"], rates["imu"]) == (10, 50)
        RobotNode(RobotSim(generate_world(0, 0.0)))
        assert any("second robot" in problem for problem in check.problems())


def test_parts_from_files(tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_text("class MyPlanner:\n    pass\n", encoding="utf-8")
    role, factory = load_part(f"planner={path}:MyPlanner")
    assert role == "planner" and factory.__name__ == "MyPlanner"
    assert make_nodes(RobotDescription(), parts={role: factory})["planner"] is factory
    for spec in (f"pilot={path}:MyPlanner", f"planner={path}:Other", "planner=none.py:X", "planner"):
        with pytest.raises(InputError, match="part"):
            load_part(spec)
    with pytest.raises(InputError, match="part"):
        make_nodes(RobotDescription(), parts={"pilot": factory})


def test_parts_from_notebooks_without_running_their_cells(tmp_path: Path) -> None:
    cells = [
        "import math\nSIDE = 4\nraise_if_run = 1 / 0",
        "%matplotlib inline",
        "def area():\n    return math.prod([SIDE, SIDE])",
        "class Mine:\n    size = area()\n\nprint(1 / 0)",
    ]
    notebook = {"cells": [{"cell_type": "code", "source": cell.splitlines(keepends=True)} for cell in cells]}
    path = tmp_path / "lab.ipynb"
    path.write_text(json.dumps(notebook), encoding="utf-8")
    _, made = load_part(f"planner={path}:Mine")
    assert vars(made)["size"] == 16
    path.write_text("{}", encoding="utf-8")
    with pytest.raises(InputError, match="part"):
        load_part(f"planner={path}:Mine")


def test_a_recorder_asks_for_what_all_publishers_offer() -> None:
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data

    from robotbrain.link.recording import accepting
    from robotbrain.ros.qos import incompatibility

    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    kinds = (QoSProfile(depth=10), qos_profile_sensor_data, latched)
    for first in kinds:
        for second in kinds:
            asked = accepting([first, second])
            assert not incompatibility(first, asked) and not incompatibility(second, asked)
    assert accepting([latched]).durability == DurabilityPolicy.TRANSIENT_LOCAL
    assert accepting([latched]).reliability == ReliabilityPolicy.RELIABLE


def test_options_have_defaults_that_suit_the_robot_command() -> None:
    from robotbrain.link.robot import RobotOptions

    assert (RemoteOptions().host, RemoteOptions().port) == (RobotOptions().host, RobotOptions().port)


def test_a_part_whose_file_fails_is_named_with_the_line(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("import math\n\nradius = math.pi * x\n")
    with pytest.raises(InputError, match=r"line 3: NameError: name 'x' is not defined"):
        load_part(f"planner={tmp_path / 'mine.py'}:MyPlanner")
