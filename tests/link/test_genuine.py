"""The same nodes on genuine ROS 2, and the kit beside it over DDS. Skipped where these are not installed.

Run them with the Python of an environment that has genuine rclpy, the kit's dependencies and cyclonedds:
``ROBOTBRAIN_GENUINE_PYTHON=…/bin/python pytest tests/link/test_genuine.py``.
"""

from __future__ import annotations

import importlib.util
import itertools
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from ..conftest import need
from .processes import Child, Robot

PYTHON = os.environ.get("ROBOTBRAIN_GENUINE_PYTHON", sys.executable)
GENUINE_ONLY = "rpyutils"
"""A module that genuine rclpy needs and the kit does not stand in for."""

LOCAL = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": "77"}
GENUINE = {**LOCAL, "ROBOTBRAIN_ROS_BACKEND": ""}


def has(module: str) -> bool:
    """Tell whether the other Python can import a module."""
    if sys.executable == PYTHON:
        return importlib.util.find_spec(module) is not None
    test = f"import importlib.util, sys; sys.exit(importlib.util.find_spec({module!r}) is None)"
    return subprocess.run([PYTHON, "-c", test], check=False).returncode == 0


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Robot]:
    need(has(GENUINE_ONLY), "genuine rclpy is not installed (Linux: ros-kilted-rclpy from PyPI)")
    child = Robot(tmp_path, "--transport", "rclpy", python=PYTHON, **GENUINE)
    child.wait_for("on the ROS 2 graph")
    yield child
    child.kill()


def check_drive(robot: Robot, driver: Child) -> None:
    driver.wait_for("driving")
    robot.wait_until(lambda: robot.speed() > 0.1, "moved")
    driver.kill()
    robot.wait_until(lambda: robot.speed() < 0.01, "stood still")
    last = robot.events("cmd_vel")[-1]["t"]
    after = [event for event in robot.events("cmd_vel_safe") if event["t"] > last]
    gap = max(b["t"] - a["t"] for a, b in itertools.pairwise(after))
    zero = next(event["t"] for event in after if event["v"] == 0.0 and event["w"] == 0.0)
    assert zero <= last + 0.5 + max(0.02, gap)


def test_brain_and_robot_on_genuine_rclpy(robot: Robot, tmp_path: Path) -> None:
    arguments = ("drive", "--robot", "ros", "--transport", "rclpy")
    check_drive(robot, Child(tmp_path, "brain", *arguments, python=PYTHON, **GENUINE))


def test_the_kit_s_brain_drives_a_robot_on_genuine_rclpy_over_dds(robot: Robot, tmp_path: Path) -> None:
    need(has("cyclonedds"), "cyclonedds is not installed (the extra `dds`)")
    arguments = ("drive", "--robot", "ros", "--transport", "dds", "--domain", 77)
    check_drive(robot, Child(tmp_path, "brain", *arguments, python=PYTHON, **LOCAL))


def test_a_genuine_brain_drives_the_kit_s_robot_over_dds(tmp_path: Path) -> None:
    need(has(GENUINE_ONLY), "genuine rclpy is not installed (Linux: ros-kilted-rclpy from PyPI)")
    need(has("cyclonedds"), "cyclonedds is not installed (the extra `dds`)")
    robot = Robot(tmp_path, "--transport", "dds", "--domain", 77, python=PYTHON, **LOCAL)
    try:
        robot.wait_for("DDS domain 77")
        arguments = ("drive", "--robot", "ros", "--transport", "rclpy")
        check_drive(robot, Child(tmp_path, "brain", *arguments, python=PYTHON, **GENUINE))
    finally:
        robot.kill()


def test_what_is_missing_is_said_so(tmp_path: Path) -> None:
    if not has(GENUINE_ONLY):
        child = Child(tmp_path, "brain", "drive", "--robot", "ros", "--transport", "rclpy", ROBOTBRAIN_ROS_BACKEND="")
        assert child.finish() == 2 and "ros-kilted-rclpy" in child.output
    if not has("cyclonedds"):
        child = Child(tmp_path, "robot", "robot", "--transport", "dds")
        assert child.finish() == 2 and "robotbrain[dds]" in child.output
