"""Brain and robot in two processes, in wall-clock time: drive, emergency stop, kill -9, breakdowns.

What is measured is measured on the robot's own clock, from its log; nothing here asks how fast this machine is.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from robotbrain.pipeline.nodes.safety import RATE_HZ, SafetyLimits
from robotbrain.ros.bag import open_bag

from .processes import Child, Robot, brain

LIMITS = SafetyLimits()


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Robot]:
    child = Robot(tmp_path)
    yield child
    child.kill()


def is_zero(event: dict[str, Any]) -> bool:
    return bool(event["v"] == 0.0 and event["w"] == 0.0)


def largest_gap(events: list[dict[str, Any]]) -> float:
    """Return the longest time between two ticks of the safety node: how late this machine was at worst."""
    times = [event["t"] for event in events]
    return max((b - a for a, b in itertools.pairwise(times)), default=0.0)


def test_emergency_stop_release_and_kill_9(robot: Robot, tmp_path: Path) -> None:
    port = robot.port()
    driver = brain(tmp_path, port, "--bag", "bag")
    try:
        driver.wait_for("driving")
        robot.wait_until(lambda: robot.speed() > 0.1, "moved")
        # The emergency stop, from another process, while the brain goes on commanding.
        stop = Child(tmp_path, "stop", "estop", "--address", f"127.0.0.1:{port}")
        assert stop.finish() == 0, stop.output
        assert "stopped until released" in stop.output
        robot.wait_until(lambda: robot.speed() < 0.01, "stood still")
        count = len(robot.events("cmd_vel"))
        robot.wait_until(lambda: len(robot.events("cmd_vel")) > count + 20, "heard more commands")
        assert any(not is_zero(event) for event in robot.events("cmd_vel")[count:])
        assert all(is_zero(event) for event in robot.events("cmd_vel_safe")[-10:])
        release = Child(tmp_path, "release", "estop", "--release", "--address", f"127.0.0.1:{port}")
        assert release.finish() == 0, release.output
        robot.wait_until(lambda: robot.speed() > 0.2, "moved again")
    finally:
        driver.kill()
    robot.wait_for("a brain has left")
    robot.wait_until(lambda: len(robot.events("truth")) > 0 and robot.speed() < 0.01, "stood still")
    commands, safe = robot.events("cmd_vel"), robot.events("cmd_vel_safe")
    last = commands[-1]["t"]
    after = [event for event in safe if event["t"] > last]
    zero = next(event["t"] for event in after if is_zero(event))
    assert not is_zero(commands[-1]), "it was killed while it wanted to move"
    assert zero <= last + LIMITS.timeout_s + max(1.0 / RATE_HZ, largest_gap(after))
    assert all(is_zero(event) for event in after if event["t"] >= zero)
    # The brain's bag has all but the last second of what it sent, and opens.
    with open_bag(tmp_path / "bag") as bag:
        kept = sum(message.topic == "/cmd_vel" for message in bag)
    assert kept >= sum(event["t"] <= last - 1.0 for event in commands)


def test_a_drive_ends_with_the_robot_at_rest(robot: Robot, tmp_path: Path) -> None:
    driver = brain(tmp_path, robot.port(), "--time-limit", 3, "--decisions", "decisions.jsonl")
    assert driver.finish() == 1, driver.output
    assert "pre-flight check passed" in driver.output
    assert "did not arrive within 3 s" in driver.output
    assert "/scan:" in driver.output
    commands = robot.events("cmd_vel")
    assert sum(not is_zero(event) for event in commands) > 10
    assert is_zero(commands[-1]), "the last thing a brain says is stop"
    robot.wait_until(lambda: robot.speed() < 0.01, "stood still")
    decisions = (tmp_path / "decisions.jsonl").read_text(encoding="utf-8")
    assert '"topic": "cmd_vel"' in decisions and '"topic": "plan"' in decisions
    assert robot.end() == 0, robot.output
    assert "commands refused" in robot.output


def test_the_robot_vanishes(robot: Robot, tmp_path: Path) -> None:
    driver = brain(tmp_path, robot.port(), "--time-limit", 3)
    driver.wait_for("driving")
    robot.kill()
    driver.wait_for("lost the robot")
    assert driver.finish() == 1, driver.output
    assert "Traceback" not in driver.output


def test_port_in_use_and_wrong_token(robot: Robot, tmp_path: Path) -> None:
    port = robot.port()
    second = Child(tmp_path, "second", "robot", "--port", port)
    assert second.finish() == 2
    assert "another --port" in second.output and "Traceback" not in second.output
    stranger = brain(tmp_path, port, "--token", "0" * 32)
    assert stranger.finish() == 2
    assert "token is wrong" in stranger.output and "Traceback" not in stranger.output
    assert robot.process.poll() is None
