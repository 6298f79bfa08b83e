"""How `capstone` judges the supervisor and the whole brain: against a state machine, and by driving.

The brain drives in the tests' own process. The student's planner, glue and supervisor run where the student's code
lives and are asked over the pipe; network and policy are files, which the hardened loaders have checked before.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from robotbrain.errors import InputError
from robotbrain.grading import expect, fail
from robotbrain.grading.suites import capstone_parts as parts_of
from robotbrain.grading.suites import hw2_optimisation_network as network_file
from robotbrain.grading.suites.hw3_performance_drives import relay
from robotbrain.grading.suites.hw3_performance_verdict import wilson
from robotbrain.grading.suites.planner_probes import host
from robotbrain.pipeline.brain import default_model
from robotbrain.pipeline.capstone import BRIEF, BrainParts, BrainRun, Launch, drive_brain

if TYPE_CHECKING:
    from robotbrain.grading import Student
    from robotbrain.pipeline.nodes.supervised_controller import Health

OLD_S, BLIND_S, PAUSE_S, BEYOND = 0.5, 2.0, 1.0, 2.0
"""Ages from which a sensor is old and the camera blind, how long the policy must pause, how far inputs may go."""
PRACTICE_WORLD = 5000
STAGES = ("network", "perception", "planning", "end_to_end")
"""Lines of the latency budget, ms."""
PADDING = 2.0
"""A line of the budget may be at most so many times what is measured."""

HINTS = {
    "old-inputs-stop": "A robot that knows neither where it is nor what is around it must not move: stop as soon as "
    "scan or pose is older than 0.5 s.",
    "blind-stops": "Low boxes are seen by the camera only. Late images are worth a slower robot, but after 2 s without "
    "any it must stop.",
    "nan-is-no-number": "Every comparison with NaN is False. Write `not (age <= limit)` instead of `age > limit`, so "
    "that what is not known counts as bad.",
    "late-image-falls-back": "An image older than 0.5 s is late: fall back to pursuit.",
    "inputs-can-break": "A single NaN or infinity among the 43 inputs makes the answer worthless: look at all of them.",
    "outside-of-training": "Inputs beyond 2 in size are nothing that the policy has met in training, whatever their "
    "sign: it extrapolates. Fall back.",
    "action-can-break": "A network that diverged answers NaN, and no motor takes that: look at both numbers.",
    "come-back-slowly": "One good moment is no recovery: the policy comes back once 1 s has passed since the last bad "
    "one.",
    "come-back-at-all": "After 1 s without anything bad the policy takes over again. Remember the time of the last bad "
    "moment, not the first.",
    "too-anxious": "Everything was well here. Limits are inclusive: an age of exactly 0.5 s is not old yet.",
    "one-of-three-words": 'Return "policy", "pursuit" or "stop".',
    "a-memory-of-its-own": "Each Supervisor begins anew: keep its memory in `self`, not in the class or the notebook.",
    "a-launch": "LAUNCH is a Launch(...), as in the example: every role in exactly one group.",
    "build-it-in-int8": 'A Q/DQ file runs in INT8 only if the engine is built so: precision="int8".',
    "newest-image-only": "An image that waited is an old image: camera_queue=1.",
    "paths-grow-old": "The map grows while the robot drives: replan_after is at most 2 s.",
    "who-shares-a-thread": "Callbacks in one group wait for each other. The wheels come every 20 ms, one image takes "
    "some 50: who can share a thread with whom?",
    "measure-the-budget": "Drive, look at the 95th percentiles, and write down what you can promise: no less than what "
    "you measure, and not more than twice as much (planning: up to 500 ms).",
    "four-lines": 'BUDGET is a dict with "network", "perception", "planning" and "end_to_end", in ms.',
    "look-at-the-replay": "Drive in other worlds (any seed), and look at a failed one with `run.replay().show()`: what "
    "did the robot not see, and who was in command?",
    "try-with-faults": "Drive with `policy_fails_at=6` and with a Blackout of /camera/image, and look at `.modes`.",
}


# ---------------------------------------------------------------- the supervisor


class Watchdog:
    """Decides who drives; the stand-in for a student's ``Supervisor``.

    Attributes:
        why: key of the hint for those who decide otherwise.
    """

    def __init__(self) -> None:
        self.why = ""
        self._bad_s = -math.inf

    def decide(self, health: Health) -> str:
        """Return ``policy``, ``pursuit`` or ``stop``."""
        ages = (health.scan_age_s, health.pose_age_s, health.image_age_s)
        shown, answered = np.asarray(health.inputs), np.asarray(health.action)
        known = not any(math.isnan(age) for age in ages)
        if not (ages[0] <= OLD_S and ages[1] <= OLD_S and ages[2] <= BLIND_S):
            self.why = (
                "nan-is-no-number" if not known else "old-inputs-stop" if max(ages[:2]) > OLD_S else "blind-stops"
            )
            self._bad_s = health.now_s
            return "stop"
        bad = {
            "late-image-falls-back": ages[2] > OLD_S,
            "inputs-can-break": not np.isfinite(shown).all(),
            "action-can-break": not np.isfinite(answered).all(),
            "outside-of-training": bool((np.abs(shown) > BEYOND).any()),
        }
        self.why = next((hint for hint, holds in bad.items() if holds), "")
        if self.why:
            self._bad_s = health.now_s
            return "pursuit"
        if health.now_s - self._bad_s < PAUSE_S:
            self.why = "come-back-slowly"
            return "pursuit"
        self.why = "too-anxious" if self._bad_s == -math.inf else "come-back-at-all"
        return "policy"


def moment(now_s: float, **changes: Any) -> Health:
    """Return the health of a brain that is well, but for ``changes``."""
    from robotbrain.pipeline.nodes.supervised_controller import Health

    well = {
        "scan_age_s": 0.1,
        "pose_age_s": 0.02,
        "image_age_s": 0.15,
        "inputs": tuple(0.3 * math.sin(k) for k in range(43)),
        "action": (0.4, -0.2),
    }
    return Health(now_s=now_s, **{**well, **changes})


def with_input(place: int, value: float) -> dict[str, Any]:
    """Return the change for one input of the policy."""
    inputs = list(moment(0.0).inputs)
    inputs[place] = value
    return {"inputs": tuple(inputs)}


def compare_decisions(student: Student, story: Sequence[tuple[float, Mapping[str, Any]]]) -> None:
    """Let a new supervisor decide at each moment of a story (time s, what is not well), and compare."""
    mine, theirs = Watchdog(), student.Supervisor()
    for number, (now_s, changes) in enumerate(story):
        health = moment(now_s, **changes)
        expected, answer = mine.decide(health), theirs.decide(health)
        if isinstance(answer, str) and answer == expected:
            continue
        known = isinstance(answer, str) and answer in ("policy", "pursuit", "stop")
        hint = mine.why if known else "one-of-three-words"
        if number == 0 and expected == "policy" and known:
            hint = "a-memory-of-its-own" if answer == "pursuit" else "too-anxious"
        said = ", ".join(f"{k} = {_short(v)}" for k, v in changes.items()) or "nothing wrong"
        fail("the supervisor decides otherwise", got=answer, expected=expected,
             given=f"moment {number + 1} of {len(story)}, at {now_s:g} s: {said}", hint=hint)  # fmt: skip


def _short(value: Any) -> str:
    if isinstance(value, tuple) and len(value) > 3:
        odd = [(k, v) for k, v in enumerate(value) if not abs(v) <= 1]
        return "one with " + ", ".join(f"[{k}] = {v:g}" for k, v in odd) if odd else "usual ones"
    return str(value)


def random_story(rng: np.random.Generator, steps: int = 60) -> list[tuple[float, dict[str, Any]]]:
    """Return moments 0.1 to 0.4 s apart in which now and then something is wrong."""
    now, story = 0.0, []
    for _ in range(steps):
        now += float(rng.uniform(0.1, 0.4))
        kind = int(rng.integers(0, 22))
        place, sign = int(rng.integers(0, 43)), float(rng.choice([-1, 1]))
        odd: dict[int, dict[str, Any]] = {
            0: {"scan_age_s": float(rng.uniform(0.55, 3))},
            1: {"pose_age_s": float(rng.uniform(0.55, 3))},
            2: {"image_age_s": float(rng.uniform(0.55, 1.9))},
            3: {"image_age_s": float(rng.uniform(2.1, 9))},
            4: with_input(place, float(rng.choice([np.nan, np.inf, -np.inf]))),
            5: with_input(place, sign * float(rng.uniform(2.1, 40))),
            6: {"action": (0.1, float("nan"))},
            7: {"action": (float("inf"), 0.2)},
            8: with_input(place, sign * float(rng.uniform(1.2, 1.9))),
            9: {"image_age_s": float(rng.uniform(0.3, 0.49))},
        }
        story.append((now, odd.get(kind, {})))
    return story


# ---------------------------------------------------------------- the launch and the budget


def launch_of(student: Student) -> Launch:
    """Return the student's launch configuration, or fail."""
    launch = student.LAUNCH
    if not isinstance(launch, Launch):
        fail("LAUNCH should be a Launch(...)", got=launch, expected="a Launch", hint="a-launch")
    return launch  # type: ignore[no-any-return]


def check_launch(student: Student) -> None:
    """Fail where a launch wastes what the parts can do, whatever it drives like in one world."""
    launch = launch_of(student)
    expect(launch.precision == "int8", "the engine is not built in INT8", got=launch.precision, expected="int8",
           hint="build-it-in-int8")  # fmt: skip
    expect(launch.camera_queue == 1, "images wait", got=launch.camera_queue, expected=1, hint="newest-image-only")
    expect(launch.replan_after <= BRIEF.replan_s, "paths grow too old", got=f"{launch.replan_after:g} s",
           expected=f"at most {BRIEF.replan_s:g} s", hint="paths-grow-old")  # fmt: skip


def p95(values: Any) -> float:
    """Return the 95th percentile; inf of nothing."""
    return float(np.percentile(values, 95)) if len(values) else math.inf


def check_deadlines(found: BrainRun, given: str) -> None:
    """Fail unless a run kept its deadlines."""
    worst = max(found.run.deadline_misses, key=lambda name: found.run.deadline_misses[name])
    expect(found.missed <= BRIEF.missed, "deadlines are missed", got=f"{found.missed:.1%}, most of them by {worst}",
           expected=f"at most {BRIEF.missed:.0%}", given=given, hint="who-shares-a-thread")  # fmt: skip


def check_real_time(found: BrainRun, given: str) -> None:
    """Fail unless a run kept its deadlines and acted on what was young enough."""
    check_deadlines(found, given)
    age = p95(found.run.e2e_ms)
    expect(age <= BRIEF.end_to_end_ms, "commands are built on what is too old", got=f"95th percentile {age:.0f} ms",
           expected=f"at most {BRIEF.end_to_end_ms:g} ms", given=given, hint="who-shares-a-thread")  # fmt: skip


def measured(student: Student, run: BrainRun) -> dict[str, float]:
    """Return what the lines of the budget are compared with, ms."""
    path, precision = network_of(student) or default_model(), launch_of(student).precision
    return {
        "network": float(parts_of.predict(path, precision).latency_ms),
        "perception": p95(run.run.perception_ms),
        "planning": p95(run.run.planning_ms),
        "end_to_end": p95(run.run.e2e_ms),
    }


def check_budget(student: Student, run: BrainRun) -> None:
    """Fail unless the written budget promises what was measured, and not much more."""
    budget = student.BUDGET
    if not isinstance(budget, Mapping) or set(budget) != set(STAGES):
        fail("BUDGET is not the dict asked for", got=budget, expected="keys " + ", ".join(STAGES), hint="four-lines")
    # Planning varies from world to world: its line may be generous.
    for name, is_now in measured(student, run).items():
        promised = budget[name]
        number = isinstance(promised, (int, float)) and not isinstance(promised, bool)
        expect(number, f"BUDGET[{name!r}] is no number", got=promised, expected="ms", hint="four-lines")
        most = 500.0 if name == "planning" else PADDING * is_now
        expect(is_now <= promised <= most, f"the budget's line {name!r} does not hold", got=f"{promised:g} ms",
               expected=f"{math.ceil(is_now * 10) / 10:g} to {most:.0f} ms", given=f"world {PRACTICE_WORLD}",
               hint="measure-the-budget")  # fmt: skip
    most = BRIEF.end_to_end_ms
    expect(budget["end_to_end"] <= most, "the budget promises less than the brief asks for",
           got=f"{budget['end_to_end']:g} ms", expected=f"at most {most:g} ms", hint="measure-the-budget")  # fmt: skip
    expect(budget["network"] <= BRIEF.network_ms, "the budget promises less than the brief asks for",
           got=f"network {budget['network']:g} ms", expected=f"at most {BRIEF.network_ms:g} ms",
           hint="measure-the-budget")  # fmt: skip


# ---------------------------------------------------------------- drives


def network_of(student: Student) -> Any:
    """Return the path of the student's network once it is checked; None where the kit's stands in."""
    if student.uses_reference("NETWORK"):
        return None
    return network_file.load(parts_of.handed_in(student)).path


def brain_of(student: Student) -> BrainParts:
    """Return the student's parts, the kit's where one is not right yet."""
    for name in ("MyPlanner", "observe", "Supervisor"):
        student[name]  # what is missing is reported before anything drives
    return BrainParts(
        network=network_of(student),
        policy=None if student.uses_reference("POLICY") else parts_of.load_policy(student).path,
        planner=lambda: relay(student.run(host, "MyPlanner")),
        observe=student["observe"],
        supervisor=student["Supervisor"],
    )


def drive(student: Student, world: int, **how: Any) -> BrainRun:
    """Let the student's brain drive in a world."""
    from robotbrain.ros import CallbackError

    launch, parts = launch_of(student), brain_of(student)
    try:
        return drive_brain(world, parts, launch, **how)
    except CallbackError as error:
        cause = error.cause
        kind = getattr(cause, "type_name", type(cause).__name__)
        fail(f"on the way, a part raised {kind}: {cause}", hint="look-at-the-replay")
    except InputError as error:
        fail(f"this brain cannot drive: {error.what}", got=error.given, expected=error.expected)
    raise AssertionError  # for the type checker: fail always raises


_PRACTISED: dict[int, BrainRun] = {}


def practise(student: Student, *, again: bool) -> BrainRun:
    """Return the run in the practice world; the one before, unless it is to be driven again."""
    if again or id(student) not in _PRACTISED:
        _PRACTISED.clear()
        _PRACTISED[id(student)] = drive(student, PRACTICE_WORLD)
    return _PRACTISED[id(student)]


def judge_practice(student: Student) -> None:
    """Fail unless the brain arrives in the practice world, in real time."""
    found = practise(student, again=True)
    given = f"world {PRACTICE_WORLD} on {BRIEF.module}"
    expect(found.run.success, f"this did not go well: {found.run.reason}", given=given, hint="look-at-the-replay")
    check_real_time(found, given)


def judge_worlds(student: Student, worlds: Sequence[int], first: int) -> None:
    """Fail unless the brain arrives in worlds that nobody has seen; half of the points for two thirds of them.

    If it arrives in each of the ``first`` ones, without missing its deadlines, no others are needed.
    """
    runs: list[BrainRun] = []
    for world in worlds:
        runs.append(drive(student, world))
        lost = sum(not found.run.success for found in runs)
        if (len(runs) >= first and lost == 0) or lost > len(worlds) / 3:
            break
    won, n = sum(found.run.success for found in runs), len(runs)
    low, high = wilson(won, n)
    touched = sum(bool(found.run.collisions) for found in runs)
    reasons = "; ".join(found.run.reason for found in runs if not found.run.success)
    expect(won >= n - (n >= len(worlds)), "the brain does not arrive often enough", given=f"{n} worlds unknown to it",
           got=f"{won} of {n} reached (95 % interval {low:.0%} to {high:.0%}), {touched} with a touch: {reasons}",
           expected=f"{first} of {first}, or {len(worlds) - 1} of {len(worlds)}", hint="look-at-the-replay",
           credit=0.5 if won >= 2 * len(worlds) / 3 else 0.0)  # fmt: skip
    for found in runs:
        check_real_time(found, "a world unknown to you")


def judge_faults(student: Student, world: int, blackout: tuple[float, float], policy_fails_at: float) -> None:
    """Fail unless the brain arrives although the camera fails for a while and the policy for good."""
    from robotbrain.monitoring.faults import Blackout

    fault = Blackout("/camera/image", during=blackout)
    found = drive(student, world, attach=[fault.install], policy_fails_at=policy_fails_at)
    given = "an unknown world; the camera fails for a while, and later the policy for good"
    expect(found.run.success, f"this did not go well: {found.run.reason}", given=given, hint="try-with-faults")
    check_deadlines(found, given)


def warm() -> None:
    """Import and cache what driving needs."""
    from robotbrain.pipeline.nodes import supervised_controller  # noqa: F401

    parts = BrainParts(None, None, parts_of.stand_in_planner, parts_of.observe, Watchdog)
    roles = (("perception",), ("estimator",), ("mapper", "planner", "mission"), ("controller",))
    drive_brain(PRACTICE_WORLD, parts, Launch(roles), brief=replace(BRIEF, seconds=1.0))
