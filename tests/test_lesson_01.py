"""The lesson on what a robot brain is: it runs, and its checks know right from wrong."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
import pytest

import robotbrain.ros  # makes rclpy importable
from tests import lessons
from tests.lessons import hints

CLAIMS = """
assert run.success
ranked = sorted(edges(run.trace), key=lambda e: e.mean_size * e.rate_hz, reverse=True)
images = next(e for e in ranked if e.name == "/camera/image")
assert ranked[0].name == "/map" and images.mean_size * images.rate_hz < ranked[0].mean_size * ranked[0].rate_hz
assert (640 * 480) / (64 * 64) == 75
import onnx
from robotbrain.pipeline.brain import default_model
weights = onnx.load(default_model()).graph.initializer
assert round(sum(np.prod(w.dims) for w in weights), -3) == 38000
assert 1000 < len([m for m in run.trace.messages if m.name == "/cmd_vel"]) * 3


def straight_line(start, goal):
    steps = max(1, int(np.ceil(np.hypot(*np.subtract(goal, start)) / 0.1)))
    return np.linspace(start, goal, steps + 1)


straight = drive(8, parts={"planner": StraightPlanner}, time_limit=40)
assert straight.reason == "did not arrive within 40 s" and not straight.collisions
"""


class TestLesson(lessons.LessonTests):
    notebook = "01_ai_robot_brain.ipynb"
    exercises = "1234"
    figures = 2
    claims = CLAIMS


# ---------------------------------------------------------------- the checks


check = partial(lessons.check, "lesson_01")


assert robotbrain.ros.BACKEND == "kit"


def bumper(near: float = 0.5, sides: str = "both", nan: bool = True, low: bool = True, always: bool = True) -> Any:
    from rclpy.node import Node
    from sensor_msgs.msg import LaserScan
    from std_msgs.msg import Bool

    class Bumper(Node):
        def __init__(self) -> None:
            super().__init__("bumper")
            self.publisher = self.create_publisher(Bool, "obstacle_near", 10)
            self.create_subscription(LaserScan, "scan", self.on_scan, 10)

        def on_scan(self, msg: Any) -> None:
            ranges = np.array(msg.ranges)
            angles = msg.angle_min + msg.angle_increment * np.arange(len(ranges))
            limit = 30 if sides == "degrees" else math.radians(30)
            ahead = (angles if sides == "left" else np.abs(angles)) <= limit
            if sides == "left":
                ahead &= angles >= 0
            if not low:
                ahead &= ranges > 0
            seen = ranges[ahead]
            found = bool((seen < near).any()) if nan else bool(seen.min() < near)
            if found or always:
                self.publisher.publish(Bool(data=found))

    return Bumper


def straight_line(start: Any, goal: Any) -> Any:
    steps = max(1, math.ceil(float(np.hypot(*np.subtract(goal, start))) / 0.1))
    return np.linspace(start, goal, steps + 1)


CHOICES = {
    "lidar scans at 10 Hz": "topic",
    "drive to the kitchen, say how far it is, allow to cancel": "action",
    "give me a path from A to B, computed in 20 ms": "service",
    "the speed that the wheels are to turn at": "topic",
    "switch the emergency stop on, and confirm it": "service",
    "dock at the charging station within two minutes": "action",
}


def test_right_answers_pass() -> None:
    assert check("traffic", traffic_kbs=lambda e: e.mean_size * e.rate_hz / 1000).full
    assert check("bumper", Bumper=bumper()).full
    assert check("choices", choices=CHOICES).full
    assert check("straight", straight_line=straight_line).full


@pytest.mark.parametrize(
    ("exercise", "answers", "hint"),
    [
        ("traffic", {"traffic_kbs": lambda e: e.mean_size * e.rate_hz}, "kilobytes"),
        ("traffic", {"traffic_kbs": lambda e: e.mean_size * e.rate_hz / 1024}, "kilobytes"),
        ("traffic", {"traffic_kbs": lambda e: e.mean_size * e.count / 1000}, "rate-not-count"),
        ("traffic", {"traffic_kbs": lambda e: e.rate_hz / e.mean_size}, "size-times-rate"),
        ("bumper", {"Bumper": bumper(near=0.2)}, "nearer-than"),
        ("bumper", {"Bumper": bumper(sides="left")}, "both-sides"),
        ("bumper", {"Bumper": bumper(sides="degrees")}, "angles-are-radians"),
        ("bumper", {"Bumper": bumper(nan=False)}, "nan-is-no-obstacle"),
        ("bumper", {"Bumper": bumper(low=False)}, "minus-inf-is-near"),
        ("bumper", {"Bumper": bumper(always=False)}, "publish-always"),
        ("choices", {"choices": {**CHOICES, "lidar scans at 10 Hz": "service"}}, "streams-are-topics"),
        (
            "choices",
            {"choices": {**CHOICES, "switch the emergency stop on, and confirm it": "topic"}},
            "quick-answers-are-services",
        ),
        (
            "choices",
            {"choices": {**CHOICES, "dock at the charging station within two minutes": "service"}},
            "long-tasks-are-actions",
        ),
        ("straight", {"straight_line": lambda a, b: straight_line(a, b)[:-1]}, "both-ends"),
        ("straight", {"straight_line": lambda a, b: straight_line(a, b)[::2]}, "spacing"),
        ("straight", {"straight_line": lambda a, b: np.linspace(a, b, 10)}, "spacing"),
    ],
)
def test_wrong_answers_get_their_hint(exercise: str, answers: dict[str, Any], hint: str) -> None:
    report = check(exercise, **answers)
    assert not report.full and hint in hints(report), (hints(report), report)


def test_a_line_to_where_one_is_already() -> None:
    def divides(start: Any, goal: Any) -> Any:
        length = float(np.hypot(*np.subtract(goal, start)))
        steps = math.ceil(length / 0.1)
        return np.array([np.add(start, np.subtract(goal, start) * k / steps) for k in range(steps + 1)])

    report = check("straight", straight_line=divides)
    assert report.earned == 2  # only the last test fails, by division by zero


def test_an_answer_of_the_wrong_kind_is_named() -> None:
    report = check("straight", straight_line=lambda a, b: [1, 2, 3])
    assert not report.full and not any("Traceback" in (r.message or "") for r in report.results)
    assert not check("choices", choices=5).full
