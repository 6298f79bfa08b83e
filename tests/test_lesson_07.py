"""The lesson on perception and control in real time: it runs, and its checks know right from wrong."""

from __future__ import annotations

import math
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from robotbrain.grading import Verdict
from robotbrain.pipeline.patterns.ages import StaleGuard, safe_speed
from robotbrain.pipeline.patterns.budgets import Task
from robotbrain.pipeline.patterns.chains import reaction_bound_ns
from robotbrain.pipeline.patterns.forms import closed_form
from robotbrain.pipeline.patterns.queues import QUEUE_POLICIES
from robotbrain.pipeline.patterns.rates import next_due
from robotbrain.pipeline.patterns.stages import Stage
from tests import lessons
from tests.lessons import hints

CLAIMS = """
from robotbrain.pipeline.patterns.ages import safe_speed
from robotbrain.pipeline.patterns.queues import queue_form
from robotbrain.sim.robot import RobotParams

# the same brain, twice
one, many = drives["one thread"], drives["a process for each node"]
assert one.reason == "did not arrive within 30 s" and round(one.goal_distance) == 3 and many.success
assert round(one.control_hz) == 4 and round(many.control_hz) == 20
brain_nodes = sorted({c.node for c in one.trace.callbacks} - {"/robot"})
assert len(brain_nodes) == 6


def calls(run, node, name):
    found = [c for c in run.trace.callbacks if (c.node, c.name) == (node, name)]
    return np.array([(c.end_ns - c.start_ns, c.start_ns - c.ready_ns) for c in found]) / 1e9


brain_calls = sorted((c.start_ns, c.end_ns) for c in one.trace.callbacks if c.node != "/robot")
assert all(end <= start for (_, end), (start, _) in zip(brain_calls, brain_calls[1:]))
perceiving = [np.median(calls(run, "/perception", "/camera/image")[:, 0]) for run in (one, many)]
assert abs(perceiving[0] - 0.2) < 0.01 and abs(perceiving[0] / perceiving[1] - 1) < 0.01
computing, waiting = np.median(calls(one, "/controller", "_control"), axis=0)
assert computing < 0.001 and 0.2 < waiting < 0.3
assert max(calls(many, "/controller", "_control")[:, 1]) < 0.025

# the loop and its steps
assert round(len(robot.commands) / 10, 1) == 12.2 and abs(sequential.throughput_hz - 1000 / total) < 0.01
perception = stages[0]
assert 0.2 < perception.on("gpu") / perception.ns < 0.3
assert all(stage.ms < 33 for stage in split.stages) and not sum(split.drops.values())
assert abs(split.latency_ms.mean() - total) < 0.01 and split.throughput_hz > 29.9
assert pipelined.latency_ms.mean() >= sequential.latency_ms.mean() and pipelined.throughput_hz > 21
faster = [stage.scaled(0.5) if stage.name == "planning" else stage for stage in stages]
again = run_brain("pipelined", faster, "orin-nano-8gb:15W", **settings)
assert abs(again.throughput_hz - pipelined.throughput_hz) < 0.01
assert abs(parallel.command_hz - 50) < 0.1
for run in (sequential, pipelined, split):
    step_ms = 1000 / run.throughput_hz
    assert abs(run.mean_age_ms - run.latency_ms.mean() - step_ms / 2) < 0.7
    assert abs(run.peak_age_ms - run.latency_ms.max() - step_ms) < 1.5

# rates
rates = {round(1e9 / ns) for ns in one.trace.periods_ns.values()}
assert {50, 10, 20, 2} <= rates
assert len(measured["timer"].times.starts_ns) == 300

# old data
assert approach(ways["no guard"])[-1] == 0 and approach(ways["with a guard"])[-1] > 1
assert off_cm["the newest pose"] > 10 and off_cm["the pose at the stamp"] < 0.1
lines = {line.name: line for line in budget.check(pipelined)}
assert lines["perception"].slack_ms < 0 and all(lines[name].slack_ms > 0 for name in lines if name not in
                                                ("perception", "sampling"))
assert pipelined.peak_age_ms < 180 and round(perception.ms) == 46 and lines["perception"].spent_ms > 70
assert split.peak_age_ms < pipelined.peak_age_ms - 40
timers, events = ([run_chain(links, trigger, seconds=3, offsets_ns=start).reaction_ms for start in starts]
                  for trigger in ("timers", "events"))
assert max(timers) - min(timers) > 100 and max(events) - min(events) < 1 and max(timers) < 407.5

# queues
by_name = {(run.policy, run.capacity): run for run in overload}
assert by_name["keep_all", 1].latency_ms[-1] > 2500 and by_name["keep_all", 1].lost == 0
T, work_ns = round(1e9 / 30), 45 * MS
ten, single = queue_form("keep_last", T, work_ns, 10), queue_form("keep_last", T, work_ns, 1)
assert ten.lost_share == single.lost_share and round(ten.latency_ms / single.latency_ms) == 6
assert list(by_name["throttle", 1].latency_ms) == list(by_name["skip", 1].latency_ms)
assert all(run.latency_ms.min() == run.latency_ms.max() for run in overload if run.policy in ("skip", "throttle"))

# metres
assert RobotParams().motor_lag_s * 1000 == ACTUATOR_MS and RobotParams().max_acceleration == 1.0
speeds = {name: float(safe_speed(age / 1000, 0.1, 1.0)) for name, age in ages.items()}
assert max(speeds, key=speeds.get) == "split" and speeds["Nano, one thread"] < speeds["split"] / 3
assert safe_speed(ages["Nano, one thread"] / 1000, 1.0, 1.0) > safe_speed(ages["split"] / 1000, 1.0, 1.0) / 2
"""


class TestLesson(lessons.LessonTests):
    notebook = "07_perception_control.ipynb"
    exercises = "123456"
    figures = 11
    tables = 7
    claims = CLAIMS


# ---------------------------------------------------------------- right answers


check = partial(lessons.check, "lesson_07")


def pace(steps: Any, camera: float, pipelined: bool) -> tuple[float, float]:
    return 1000 / max(camera, max(steps) if pipelined else sum(steps)), sum(steps)


def next_wakeup(due: int, now: int, period: int) -> int:
    return due + max(1, -(-(now - due) // period)) * period


def speed_scale(
    msg: Any, now_ns: int, fresh_s: float = 0.2, max_s: float = 0.5, future: float = 0.005, scale: float = 1e-9
) -> float:
    if msg is None:
        return 0
    age = (now_ns - msg.header.stamp.sec * 10**9 - msg.header.stamp.nanosec) * scale
    if age < -future:
        return 0
    return min(1, max(0, (max_s - age) / (max_s - fresh_s)))


def worst_age_ms(links: Any) -> float:
    return sum(period + response for period, response in links)


POLICY = {
    "avoid obstacles": "keep_last",
    "avoid obstacles faster": "credit",
    "inspect a weld": "keep_all",
    "track a ball": "skip",
}


def largest_speed(age: float, distance: float, a_max: float = 1.0) -> float:
    if distance == 0:
        return 0
    return 2 * distance / (age + math.sqrt(age * age + 2 * distance / a_max))


RIGHT = {
    "pace": {"pace": pace},
    "wakeup": {"next_wakeup": next_wakeup},
    "stale": {"speed_scale": speed_scale},
    "worst": {"worst_age_ms": worst_age_ms},
    "queue": {"policy": POLICY},
    "speed": {"largest_speed": largest_speed},
}


@pytest.mark.parametrize("exercise", RIGHT)
def test_right_answers_pass(exercise: str) -> None:
    report = check(exercise, **RIGHT[exercise])
    assert report.full, report


def test_right_answers_in_other_words_pass() -> None:
    assert check("pace", pace=lambda s, c, p: [min(1000 / c, 1000 / (max(s) if p else sum(s))), np.sum(s)]).full

    def step_by_step(due: int, now: int, period: int) -> int:
        due += period
        while due < now:
            due += period
        return due

    assert check("wakeup", next_wakeup=step_by_step).full
    assert check("stale", speed_scale=lambda m, n, f, x: np.float64(speed_scale(m, n, f, x))).full
    assert check("queue", policy={**POLICY, "track a ball": " Throttle"}).full
    naive = lambda t, d, a: -a * t + math.sqrt((a * t) ** 2 + 2 * a * d)  # noqa: E731
    assert check("speed", largest_speed=naive).full


def test_what_the_checks_call_right_is_what_the_library_does() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        due, late, period = (int(n) for n in rng.integers((0, 0, 1), (1000, 500, 60)))
        assert next_wakeup(due, due + late, period) == next_due("timer", due, due + late, 0, period)
        age, distance, a_max = rng.uniform((0, 0.01, 0.1), (2, 5, 5))
        assert largest_speed(age, distance, a_max) == pytest.approx(float(safe_speed(age, distance, a_max)))
        guard = StaleGuard(0.5, fresh_age=0.2, policy="slow")
        stamp, now = 10**9, 10**9 + int(rng.integers(-20_000_000, 700_000_000))
        header = SimpleNamespace(stamp=SimpleNamespace(sec=stamp // 10**9, nanosec=stamp % 10**9))
        assert speed_scale(SimpleNamespace(header=header), now) == pytest.approx(guard.judge(stamp, now).speed_scale)
        times = [(float(p), float(rng.uniform(0.1, 1) * p)) for p in rng.uniform(10, 100, 3)]
        links = [Task.of(f"link{k}", *pair) for k, pair in enumerate(times)]
        assert worst_age_ms(times) == pytest.approx(reaction_bound_ns(links) / 1e6, rel=1e-6)
        steps = [Stage.of(f"step{k}", float(ms)) for k, ms in enumerate(rng.integers(1, 50, 4))]
        for kind in ("sequential", "pipelined"):
            form = closed_form(kind, steps, 8, 100_000_000 if kind == "pipelined" else 300_000_000)
            camera_ms = 100.0 if kind == "pipelined" else 300.0
            expected = pace([s.ms for s in steps], camera_ms, kind == "pipelined")
            assert (form.throughput_hz, form.latency_ns / 1e6) == pytest.approx(expected)


# ---------------------------------------------------------------- wrong answers


def seconds_only(msg: Any, now_ns: int, fresh_s: float, max_s: float) -> float:
    if msg is None:
        return 0
    age = now_ns * 1e-9 - msg.header.stamp.sec
    return min(1, max(0, (max_s - age) / (max_s - fresh_s)))


def unclipped(msg: Any, now_ns: int, fresh_s: float, max_s: float) -> float:
    if msg is None:
        return 0
    age = (now_ns - msg.header.stamp.sec * 10**9 - msg.header.stamp.nanosec) * 1e-9
    return 0 if age < -0.005 else (max_s - age) / (max_s - fresh_s)


@pytest.mark.parametrize(
    ("exercise", "answer", "hint"),
    [
        ("pace", lambda s, c, p: (1000 / (max(s) if p else sum(s)), sum(s)), "camera-is-the-limit"),
        ("pace", lambda s, c, p: pace(s, c, False), "slowest-step"),
        ("pace", lambda s, c, p: pace(s, c, True), "sum-of-steps"),
        ("pace", lambda s, c, p: (pace(s, c, p)[0] / 1000, sum(s)), "per-second"),
        ("pace", lambda s, c, p: pace(s, c, p)[::-1], "order-of-the-pair"),
        ("pace", lambda s, c, p: pace(s, c, p)[0], "order-of-the-pair"),
        ("pace", lambda s, c, p: (pace(s, c, p)[0], max(s) if p else sum(s)), "latency-is-the-sum"),
        ("pace", lambda s, c, p: (pace(s, c, p)[0], sum(s) / len(s) if p else sum(s)), "latency-is-the-sum"),
        ("pace", lambda s, c, p: (pace(s, c, p)[0], max(c, sum(s))), "no-wait"),
        ("wakeup", lambda d, n, p: n + p, "grid-not-now"),
        ("wakeup", lambda d, n, p: d + p, "skip-missed"),
        ("wakeup", lambda d, n, p: (n // p + 1) * p, "grid-through-due"),
        ("wakeup", lambda d, n, p: d + ((n - d) // p + 1) * p, "not-too-far"),
        ("wakeup", lambda d, n, p: d + -(-(n - d) // p) * p, "after-due"),
        ("wakeup", lambda d, n, p: float(next_wakeup(d, n, p)), "whole-nanoseconds"),
        ("wakeup", lambda d, n, p: int(float(next_wakeup(d, n, p))), "whole-nanoseconds"),
        ("stale", seconds_only, "both-parts"),
        ("stale", unclipped, "between-0-and-1"),
        ("stale", lambda m, n, f, x: speed_scale(m, n, f, x, scale=1), "seconds-and-nanoseconds"),
        ("stale", lambda m, n, f, x: speed_scale(m, n, f, x, scale=1e-6), "seconds-and-nanoseconds"),
        ("stale", lambda m, n, f, x: float(speed_scale(m, n, f, x) > 0), "straight-line"),
        ("stale", lambda m, n, f, x: 1 - speed_scale(m, n, f, x), "straight-line"),
        ("stale", lambda m, n, f, x: speed_scale(m, n, f, x) if m else 1, "nothing-yet"),
        ("stale", lambda m, n, f, x: speed_scale(m, n, f, x) if m else m.header, "nothing-yet"),
        ("stale", lambda m, n, f, x: speed_scale(m, n, f, x, future=9), "future"),
        ("stale", lambda m, n, f, x: speed_scale(m, n, f, x, future=0), "clock-tolerance"),
        ("worst", lambda links: links[0][0] + sum(r for _, r in links), "every-link-samples"),
        ("worst", lambda links: sum(p / 2 + r for p, r in links), "worst-not-mean"),
        ("worst", lambda links: sum(p for p, _ in links), "responses-count"),
        ("worst", lambda links: sum(r for _, r in links), "periods-count"),
        ("queue", {**POLICY, "avoid obstacles": "drop_newest"}, "read-the-table"),
        ("queue", {**POLICY, "avoid obstacles": "skip"}, "read-the-table"),
        ("queue", {**POLICY, "avoid obstacles": "credit"}, "needs-a-trigger"),
        ("queue", {**POLICY, "avoid obstacles faster": "keep_last"}, "read-the-table"),
        ("queue", {**POLICY, "inspect a weld": "keep_last"}, "nothing-may-be-lost"),
        ("queue", {**POLICY, "track a ball": "keep_last"}, "latency-that-varies"),
        ("speed", lambda t, d, a: math.sqrt(2 * a * d), "latency-counts"),
        ("speed", lambda t, d, a: d / t if t else math.sqrt(2 * a * d), "brakes-count"),
        ("speed", lambda t, d, a: largest_speed(t, 2 * d, a), ""),
        ("speed", lambda t, d, a: largest_speed(t, d, a / 2), "half-v-squared"),
        ("speed", lambda t, d, a: -a * t - math.sqrt((a * t) ** 2 + 2 * a * d), "positive-root"),
        ("speed", lambda t, d, a: largest_speed(t / 1000, d, a), "seconds"),
        ("speed", lambda t, d, a: 2 * d / (t + math.sqrt(t * t + 2 * d / a)), "no-way-no-speed"),
    ],
)
def test_wrong_answers_get_their_hint(exercise: str, answer: Any, hint: str) -> None:
    (name,) = RIGHT[exercise]
    report = check(exercise, **{name: answer})
    assert not report.full and (not hint or hint in hints(report)), (hints(report), report)


@pytest.mark.parametrize("exercise", RIGHT)
@pytest.mark.parametrize("answer", [None, "fast", (1, 2, 3), math.nan])
def test_an_answer_of_the_wrong_kind_is_named(exercise: str, answer: Any) -> None:
    (name,) = RIGHT[exercise]
    report = check(exercise, **{name: answer if exercise == "queue" else lambda *_: answer})
    assert not report.full
    for result in report.results:
        assert result.verdict is Verdict.FAILED and "Traceback" not in (result.message or ""), result


@pytest.mark.parametrize("policy", QUEUE_POLICIES)
def test_each_task_has_the_policies_that_its_numbers_leave(policy: str) -> None:
    fits = {task for task in POLICY if check("queue", policy={**POLICY, task: policy}).full}
    expected = {task for task, right in POLICY.items() if right == policy}
    assert fits == expected | ({"track a ball"} if policy in ("skip", "throttle") else set())
