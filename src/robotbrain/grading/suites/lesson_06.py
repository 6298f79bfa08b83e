"""Checks of the lesson `06_sim_to_real`. Nothing here is graded: an answer that is still open is no mistake."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.stats import t  # not within a test: an import that its time limit interrupts stays broken

from robotbrain.grading import Suite, expect, fail
from robotbrain.grading.suites.lesson_tools import answered

suite = Suite("lesson_06")

suite.exercise("with_play", title="1 A joint with play", points=3, provides=("with_play",))
suite.exercise("interval", title="2 Is it really better?", points=3, provides=("interval",))
suite.exercise("remedies", title="3 What would you randomise?", points=1, provides=("remedies",))
suite.exercise("in_policy_order", title="4 Joints by name", points=3, provides=("in_policy_order",))

_HINTS = {
    "moves-only-when-pushed": "Inside the play nothing happens: the arm stays where it is until the motor pushes it.",
    "half-on-each-side": "The gap is half the play on either side: the arm is within motor -/+ play/2.",
    "remembers": "Start from where the arm was after the last step, not from the motor: play is a memory.",
    "one-per-motor-angle": "Return as many angles as there are motor angles, the arm's after each.",
    "remedy-latency": "What comes late is a matter of latency: let commands arrive late in training too.",
    "remedy-load": "A weight in the hand pulls with a force that nobody told the controller of.",
    "remedy-friction": "Stiff bearings are joint friction.",
    "remedy-noise": "Angles that jitter are noise on the observation.",
    "remedy-motor": "A motor that gives less than its data sheet: motor strength.",
    "between-trainings": "The unit is a training (a seed): n is len(values), and t has n - 1 degrees of freedom.",
    "divide-by-n-minus-one": "The standard deviation of a sample divides by n - 1: np.std(values, ddof=1).",
    "root-n": "The mean of n values varies less than one: divide the standard deviation by the square root of n.",
    "student-not-normal": "Five values do not show their spread well: take Student's t with n - 1 degrees of freedom "
    "(2.776 for five), not 1.96.",
    "both-ends-of-the-interval": "Return the lower and the upper end, a pair.",
    "by-name": "Look up each name of joint_names in names: names.index(name), or a dictionary.",
    "other-joints-too": "The message may hold joints that the policy does not know, as a gripper's: leave them out.",
    "refuse-what-is-missing": "A joint that the policy needs and the message lacks must not be made up: KeyError.",
}
for _key, _text in _HINTS.items():
    suite.hint(_key, _text)


# ---------------------------------------------------------------- 1


def _play(motor: Any, play: float, start: float) -> np.ndarray[Any, Any]:
    arm, found = start, []
    for angle in motor:
        arm = min(max(arm, angle - play / 2), angle + play / 2)
        found.append(arm)
    return np.array(found)


def _arm(student: Any, motor: Any, play: float, start: float) -> np.ndarray[Any, Any]:
    got = answered(student.with_play(list(motor), play, start), "with_play")
    try:
        angles = np.asarray(got, dtype=float)
    except (TypeError, ValueError):
        fail("with_play should return numbers", got=got, hint="one-per-motor-angle")
    expect(
        angles.shape == (len(motor),),
        f"{len(motor)} motor angles have {len(motor)} arm angles",
        got=angles.shape,
        hint="one-per-motor-angle",
    )
    return angles


@suite.test("with_play", points=2, name="there and back", reread="Exercise 1")
def _there_and_back(student: Any) -> None:
    for motor, play, start in (
        ([0.0, 0.5, 1.0, 0.8, 0.2, 0.0], 0.2, 0.0),
        ([0.3, -0.3, 0.3, -0.3], 0.1, 0.0),
    ):
        got, right = _arm(student, motor, play, start), _play(motor, play, start)
        if np.allclose(got, right, atol=1e-9):
            continue
        hint = "moves-only-when-pushed"
        if np.allclose(got, _play(motor, 2 * play, start), atol=1e-9):
            hint = "half-on-each-side"
        elif np.allclose(got, motor, atol=play):
            hint = "remembers"
        fail(f"motor {motor}, play {play}: arm {np.round(right, 3).tolist()}", got=got.tolist(), hint=hint)


@suite.test("with_play", points=1, name="small moves inside the gap", reread="Exercise 1")
def _inside(student: Any) -> None:
    got = _arm(student, [0.02, -0.03, 0.04], 0.1, 0.0)
    expect(
        np.allclose(got, 0.0, atol=1e-12), "moves of 0.04 within a play of 0.1 do not reach the arm", got=got.tolist(),
        hint="moves-only-when-pushed",
    )  # fmt: skip


# ---------------------------------------------------------------- 2

_REMEDIES = {
    "the field bus delivers each command 10 to 20 ms late": ("latency", "remedy-latency"),
    "the hand carries a camera that is in no model, 0.6 kg": ("load", "remedy-load"),
    "it is February, and the grease is stiff": ("friction", "remedy-friction"),
    "the angles that are read jitter by a fraction of a degree": ("noise", "remedy-noise"),
    "the motors are warm and give 80 % of what they should": ("motor", "remedy-motor"),
}


@suite.test("remedies", points=1, name="the five troubles", reread="Make the simulation unsure of itself")
def _remedies(student: Any) -> None:
    answers = student["remedies"]
    expect(isinstance(answers, dict), "`remedies` should still be the dictionary of the cell", got=answers)
    if all(answers.get(line) is ... for line in _REMEDIES):
        raise NotImplementedError("remedies")
    known = sorted({name for name, _ in _REMEDIES.values()})
    for line, (right, hint) in _REMEDIES.items():
        got = answers.get(line)
        got = got.strip().lower() if isinstance(got, str) else got
        expect(got in known, f'for "{line}" choose one of {", ".join(known)}', got=got)
        expect(got == right, f'for "{line}" there is something nearer than {got}', hint=hint)


# ---------------------------------------------------------------- 3


def _student_interval(values: Any, quantile: float, ddof: int = 1, root: bool = True) -> tuple[float, float]:
    values = np.asarray(values, float)
    half = quantile * values.std(ddof=ddof) / (math.sqrt(len(values)) if root else 1.0)
    return float(values.mean() - half), float(values.mean() + half)


@suite.test("interval", points=3, name="against scipy's", reread="Exercise 2")
def _interval(student: Any) -> None:
    rng = student.rng("interval")
    for n in (5, 3, 8):
        values = rng.uniform(0.4, 1.0, n)
        got = answered(student.interval(values.tolist()), "interval")
        try:
            low, high = (float(x) for x in got)
        except (TypeError, ValueError):
            fail("interval should return two numbers", got=got, hint="both-ends-of-the-interval")
        q = float(t.ppf(0.975, n - 1))
        right = _student_interval(values, q)
        if np.allclose((low, high), right, atol=2e-4):
            continue
        hint = "both-ends-of-the-interval"
        for wrong, why in (
            (_student_interval(values, 1.96), "student-not-normal"),
            (_student_interval(values, q, ddof=0), "divide-by-n-minus-one"),
            (_student_interval(values, q, root=False), "root-n"),
            (_student_interval(values, 2.776), "between-trainings"),
        ):
            if np.allclose((low, high), wrong, atol=2e-4):
                hint = why
                break
        fail(
            f"the mean of {np.round(values, 3).tolist()} lies in {right[0]:.4f} .. {right[1]:.4f} with 95 %",
            got=(low, high),
            hint=hint,
        )


# ---------------------------------------------------------------- 4

_JOINTS = [f"joint{k}" for k in range(1, 8)]


def _ordered(student: Any, names: list[str], positions: list[float], joints: list[str]) -> np.ndarray[Any, Any]:
    got = answered(student.in_policy_order(list(names), list(positions), list(joints)), "in_policy_order")
    try:
        return np.asarray(got, dtype=float)
    except (TypeError, ValueError):
        fail("in_policy_order should return numbers", got=got, hint="by-name")
    raise AssertionError


@suite.test("in_policy_order", points=2, name="joints in any order, and a gripper", reread="Exercise 4")
def _order(student: Any) -> None:
    rng = student.rng("order")
    for extra in ([], ["gripper_left", "gripper_right"]):
        names = [str(n) for n in rng.permutation(_JOINTS + extra)]
        positions = [round(float(x), 3) for x in rng.normal(size=len(names))]
        got = _ordered(student, names, positions, _JOINTS)
        right = [positions[names.index(name)] for name in _JOINTS]
        hint = "other-joints-too" if got.shape != (7,) else "by-name"
        expect(
            got.shape == (7,) and np.allclose(got, right),
            f"names {names}, positions {positions}: {right}",
            got=got.tolist(),
            hint=hint,
        )


@suite.test("in_policy_order", points=1, name="a joint is missing", reread="Exercise 4")
def _missing(student: Any) -> None:
    try:
        got = answered(student.in_policy_order(_JOINTS[:6], [0.0] * 6, _JOINTS), "in_policy_order")
    except (KeyError, ValueError):
        return
    except IndexError:
        got = "IndexError"
    fail("joint7 is not in the message", got=got, hint="refuse-what-is-missing")
