"""Checks of the lesson `01_ai_robot_brain`. Nothing here is graded: an answer that is still open is no mistake."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from robotbrain.grading import Suite, expect, fail
from robotbrain.grading.suites.lesson_tools import answered

suite = Suite("lesson_01")

suite.exercise("traffic", title="1 What fills the wire?", points=2, provides=("traffic_kbs",))
suite.exercise("bumper", title="2 Your first node", points=5, provides=("Bumper",))
suite.exercise("choices", title="3 Topic, service or action?", points=1, provides=("choices",))
suite.exercise("straight", title="4 The simplest planner", points=3, provides=("straight_line",))

_HINTS = {
    "size-times-rate": "Traffic is the size of a message times how many there are in a second.",
    "kilobytes": "A kilobyte is 1000 bytes: divide by 1000.",
    "rate-not-count": "edge.count is the number in the whole drive; per second it is edge.rate_hz.",
    "publish-always": "Publish for every scan, `Bool(data=False)` as well: whoever listens must be able to tell "
    "'nothing there' from 'the node is dead'.",
    "both-sides": "30° to either side: compare the absolute value of the angle with np.radians(30).",
    "angles-are-radians": "Angles in messages are radians: np.radians(30) is 0.52.",
    "nan-is-no-obstacle": "NaN is no reading. Comparisons with NaN are False, but np.min of NaN and others is NaN.",
    "minus-inf-is-near": "-inf means that something is too near to measure: it is smaller than 0.5, so it counts.",
    "nearer-than": "Nearer than 0.5 m: compare each range with 0.5.",
    "streams-are-topics": "A stream of values, of which the newest matters, is a topic.",
    "quick-answers-are-services": "One question, one answer, done soon, and somebody waits for it: a service.",
    "long-tasks-are-actions": "It takes long, somebody wants to follow it and may cancel it: an action.",
    "both-ends": "The first point is the start and the last one the goal.",
    "spacing": "Divide the length by 0.1 and round UP to get the number of steps; there is one point more than steps.",
    "same-place": "A start that is the goal has length 0: there is still at least one step.",
}
for _key, _text in _HINTS.items():
    suite.hint(_key, _text)


# ---------------------------------------------------------------- 1


@suite.test("traffic", points=2, name="edges worked out by hand", reread="Exercise 1")
def _traffic(student: Any) -> None:
    for size, rate, count in ((500.0, 10.0, 300), (193_704.0, 2.0, 40), (52.0, 19.95, 435)):
        got = answered(student.traffic_kbs(SimpleNamespace(mean_size=size, rate_hz=rate, count=count)), "traffic_kbs")
        right = size * rate / 1000
        if isinstance(got, int | float) and math.isclose(got, right, rel_tol=1e-6):
            continue
        hint = "size-times-rate"
        if isinstance(got, int | float):
            if math.isclose(got, right * 1000, rel_tol=1e-6) or math.isclose(got, right / 1.024, rel_tol=1e-3):
                hint = "kilobytes"
            elif math.isclose(got, size * count / 1000, rel_tol=1e-6):
                hint = "rate-not-count"
        fail(f"{rate:g} messages of {size:g} bytes a second are {right:g} kB/s", got=got, hint=hint)


# ---------------------------------------------------------------- 2

_FAR = 3.0
Case = tuple[dict[float, float], bool, str]
"""A scan, as {angle in degrees: range in m}, the right answer, and a hint."""


def _warnings(student: Any, scans: Sequence[dict[float, float]]) -> list[bool]:
    """Let the student's node see scans, given as {angle in degrees: range in m}; return what it published."""
    import rclpy
    from sensor_msgs.msg import LaserScan
    from std_msgs.msg import Bool

    from robotbrain.ros import SimContext

    heard: list[bool] = []
    with SimContext().as_default() as context:
        node = student.Bumper()
        other = rclpy.create_node("robot")
        publisher = other.create_publisher(LaserScan, "scan", 10)
        other.create_subscription(Bool, "obstacle_near", lambda msg: heard.append(bool(msg.data)), 10)
        for scan in scans:
            msg = LaserScan()
            msg.angle_min, msg.angle_increment = -math.pi, math.radians(10)
            ranges = np.full(36, _FAR, dtype=np.float32)
            for degrees, distance in scan.items():
                ranges[round((degrees + 180) / 10)] = distance
            msg.ranges = ranges.tolist()
            publisher.publish(msg)
            context.run_for(0.1)
        node.destroy_node()
    return heard


def _expect_warnings(student: Any, cases: Sequence[Case]) -> None:
    heard = _warnings(student, [scan for scan, _, _ in cases])
    if not heard:
        raise NotImplementedError("Bumper.on_scan publishes nothing")
    expect(
        len(heard) == len(cases),
        f"after {len(cases)} scans it has published {len(heard)} messages",
        hint="publish-always",
    )
    for (scan, right, hint), got in zip(cases, heard, strict=True):
        words = ", ".join(f"{distance:g} m at {degrees:g}°" for degrees, distance in scan.items())
        expect(
            got is right,
            f"with {words}, and {_FAR:g} m everywhere else, it said {got}; expected {right}",
            hint=hint,
        )


@suite.test("bumper", points=1, name="straight ahead, near and far", reread="Exercise 2")
def _bumper_ahead(student: Any) -> None:
    _expect_warnings(student, [({0: 0.3}, True, "nearer-than"), ({0: 0.8}, False, "nearer-than"), ({0: 0.3}, True, "")])


@suite.test("bumper", points=2, name="to the sides and behind", reread="Exercise 2")
def _bumper_sides(student: Any) -> None:
    cases: list[Case] = [
        ({20: 0.3}, True, "both-sides"),
        ({-20: 0.3}, True, "both-sides"),
        ({50: 0.3}, False, "angles-are-radians"),
        ({-60: 0.3, 170: 0.2}, False, "both-sides"),
    ]
    _expect_warnings(student, cases)


@suite.test("bumper", points=2, name="inf, -inf and NaN", reread="Exercise 2, REP 117")
def _bumper_special(student: Any) -> None:
    cases: list[Case] = [
        ({0: math.inf, 10: math.inf}, False, "nearer-than"),
        ({0: math.nan}, False, "nan-is-no-obstacle"),
        ({0: math.nan, 10: 0.3}, True, "nan-is-no-obstacle"),
        ({10: -math.inf}, True, "minus-inf-is-near"),
    ]
    _expect_warnings(student, cases)


# ---------------------------------------------------------------- 3

_RIGHT = {
    "lidar scans at 10 Hz": "topic",
    "drive to the kitchen, say how far it is, allow to cancel": "action",
    "give me a path from A to B, computed in 20 ms": "service",
    "the speed that the wheels are to turn at": "topic",
    "switch the emergency stop on, and confirm it": "service",
    "dock at the charging station within two minutes": "action",
}
_WHY = {
    "topic": "streams-are-topics",
    "service": "quick-answers-are-services",
    "action": "long-tasks-are-actions",
}


@suite.test("choices", points=1, name="the six lines", reread="Nodes, topics, services, actions")
def _choices(student: Any) -> None:
    answers = student["choices"]
    expect(isinstance(answers, dict), "`choices` should still be the dictionary of the cell", got=answers)
    if all(answers.get(line) is ... for line in _RIGHT):
        raise NotImplementedError("choices")
    for line, right in _RIGHT.items():
        got = answers.get(line)
        got = got.strip().lower() if isinstance(got, str) else got
        expect(got in _WHY, f'for "{line}" choose "topic", "service" or "action"', got=got)
        expect(got == right, f'"{line}" is better no {got}', hint=_WHY[right])


# ---------------------------------------------------------------- 4


def _line(student: Any, start: tuple[float, float], goal: tuple[float, float]) -> np.ndarray[Any, Any]:
    points = np.asarray(answered(student.straight_line(start, goal), "straight_line"), dtype=float)
    if points.ndim != 2 or points.shape[1] != 2:
        fail("straight_line should return an array of shape (N, 2)", got=points.shape, hint="spacing")
    return points


@suite.test("straight", points=2, name="along an axis and aslant", reread="Exercise 4")
def _straight_lines(student: Any) -> None:
    rng = student.rng("straight")
    cases = [((0.0, 0.0), (1.0, 0.0)), ((0.0, 0.0), (0.0, -0.55))]
    cases += [(tuple(rng.uniform(-5, 5, 2)), tuple(rng.uniform(-5, 5, 2))) for _ in range(5)]
    for start, goal in cases:
        points = _line(student, start, goal)
        expect(
            np.allclose(points[0], start) and np.allclose(points[-1], goal),
            f"the line from {np.round(start, 2)} to {np.round(goal, 2)} goes from {np.round(points[0], 2)} to "
            f"{np.round(points[-1], 2)}",
            hint="both-ends",
        )
        steps = np.diff(points, axis=0)
        lengths = np.hypot(*steps.T)
        expect(
            lengths.max() <= 0.1 + 1e-9,
            f"two neighbours are {lengths.max():.3f} m apart",
            hint="spacing",
        )
        expect(np.allclose(steps, steps[0], atol=1e-9), "the points are not evenly spaced", hint="spacing")
        length = float(np.hypot(*np.subtract(goal, start)))
        expect(len(points) <= 20 * length + 3, f"{len(points)} points for {length:.2f} m are a lot", hint="spacing")


@suite.test("straight", points=1, name="already there", reread="Exercise 4")
def _straight_point(student: Any) -> None:
    points = _line(student, (1.5, -2.0), (1.5, -2.0))
    expect(
        len(points) >= 1 and np.allclose(points, (1.5, -2.0)),
        "from a place to itself the line is that place",
        got=points,
        hint="same-place",
    )
