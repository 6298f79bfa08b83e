"""Checks of the lesson `05_ddpg_reach`. Nothing here is graded: an answer that is still open is no mistake."""

from __future__ import annotations

from typing import Any

import numpy as np

from robotbrain.grading import Suite, expect, fail
from robotbrain.grading.suites.lesson_tools import answered, equals

suite = Suite("lesson_05")

suite.exercise("discounted_return", title="1 The return, and where it stops", points=3, provides=("discounted_return",))
suite.exercise("pull", title="2 The pull of a reward", points=2, provides=("pull",))
suite.exercise("horizon", title="3 Horizons", points=2, provides=("horizon", "gamma_for"))
suite.exercise("bugs", title="4 Which line?", points=1, provides=("bugs",))

_HINTS = {
    "first-reward-whole": "The first reward counts in full (gamma to the power 0), the next gamma times, and so on.",
    "last-value-discounted": "last_value comes after T rewards: it counts gamma to the power T.",
    "no-future-after-an-end": "After a termination there is nothing: last_value counts only where an episode was cut.",
    "a-cut-has-a-future": "The episode was only cut off: add the value of the state in which it was cut.",
    "inner-derivative": "The derivative of exp(-(d/s)^2) is -2 d / s^2 times the same: mind the inner derivative.",
    "both-parts": "There are two parts: the straight line pulls with 1, and the peak adds its own.",
    "sign-of-the-pull": "pull is positive: by how much the reward GROWS when d shrinks.",
    "works-for-arrays": "Use np.exp and plain arithmetic, so that d may be an array.",
    "seconds": "Steps times dt are seconds: dt / (1 - gamma).",
    "inverse": "gamma_for undoes horizon: gamma = 1 - dt / seconds.",
    "bug-gradient": "Gradients enter where the target networks are called: stop them there or in the next line.",
    "bug-noise": "Something should be added to the action before the environment gets it.",
    "bug-done": "The buffer gives back in line 1 what was pushed in line 9: one of the two must say 1 - done.",
    "bug-timeout": "What the environment says of the end arrives in line 8.",
    "bug-shapes": "reward arrives from the buffer as (B,), Q as (B, 1): they meet in line 3.",
}
for _key, _text in _HINTS.items():
    suite.hint(_key, _text)


# ---------------------------------------------------------------- 1


@suite.test("discounted_return", points=2, name="sums worked out by hand", reread="How good is an action?")
def _sums(student: Any) -> None:
    rng = student.rng("discounted_return")
    cases = [([1.0, 0.0, 2.0], 0.5, 4.0), ([1.0], 0.9, -3.0)]
    cases += [([float(r) for r in rng.normal(size=6)], 0.8, float(rng.normal()) * 5) for _ in range(3)]
    for rewards, gamma, last in cases:
        plain = sum(gamma**k * r for k, r in enumerate(rewards))
        got = answered(student.discounted_return(list(rewards), gamma, True, last), "discounted_return")
        if equals(got, plain):
            continue
        hint = "first-reward-whole"
        if equals(got, plain + gamma ** len(rewards) * last):
            hint = "no-future-after-an-end"
        shown = [round(r, 3) for r in rewards]
        fail(f"rewards {shown}, gamma {gamma}, terminated: {plain:.5g}", got=got, hint=hint)


@suite.test("discounted_return", points=1, name="an episode that was cut off", reread="Exercise 1")
def _cut(student: Any) -> None:
    for rewards, gamma, last, right in (([1.0, 1.0], 0.5, 8.0, 3.5), ([0.0], 0.9, 10.0, 9.0), ([], 0.9, 7.0, 7.0)):
        got = answered(student.discounted_return(list(rewards), gamma, False, last), "discounted_return")
        if equals(got, right):
            continue
        plain = sum(gamma**k * r for k, r in enumerate(rewards))
        hint = "a-cut-has-a-future" if equals(got, plain) else "last-value-discounted"
        fail(f"rewards {rewards}, gamma {gamma}, cut off at a state worth {last}: {right:g}", got=got, hint=hint)


# ---------------------------------------------------------------- 2


def _reward(d: Any, sigma: float, factor: float) -> Any:
    return -d - factor * (1 - np.exp(-((d / sigma) ** 2)))


@suite.test("pull", points=1, name="against differences of the reward", reread="The last two centimetres")
def _pull(student: Any) -> None:
    step = 1e-6
    for sigma, factor in ((0.03, 0.2), (0.1, 1.0)):
        for d in (0.005, 0.0212, 0.06, 0.4):
            got = answered(student.pull(d, sigma, factor), "pull")
            right = (_reward(d - step, sigma, factor) - _reward(d + step, sigma, factor)) / (2 * step)
            try:
                near = bool(np.isclose(float(got), right, rtol=1e-4))
            except (TypeError, ValueError):
                near = False
            if near:
                continue
            hint = "inner-derivative"
            if isinstance(got, int | float | np.floating):
                if np.isclose(float(got), -right, rtol=1e-4):
                    hint = "sign-of-the-pull"
                elif np.isclose(float(got), right - 1, rtol=1e-3, atol=1e-6):
                    hint = "both-parts"
            fail(f"at {d} m with sigma {sigma} m and factor {factor} it is {right:.5g} per metre", got=got, hint=hint)


@suite.test("pull", points=1, name="for an array", reread="Exercise 2")
def _pull_array(student: Any) -> None:
    d = np.linspace(0.0, 0.2, 5)
    try:
        got = np.asarray(answered(student.pull(d), "pull"), dtype=float)
    except (TypeError, ValueError) as error:
        fail(f"pull of an array of five distances raised {type(error).__name__}: {error}", hint="works-for-arrays")
    expect(got.shape == d.shape, "five distances have five answers", got=got.shape, hint="works-for-arrays")


# ---------------------------------------------------------------- 3


@suite.test("horizon", points=1, name="from gamma to seconds", reread="How far to look ahead")
def _horizon(student: Any) -> None:
    for gamma, dt, right in ((0.9, 0.04, 0.4), (0.99, 0.04, 4.0), (0.99, 0.02, 2.0)):
        got = answered(student.horizon(gamma, dt), "horizon")
        expect(equals(got, right), f"gamma {gamma} at steps of {dt} s: {right} s", got=got, hint="seconds")


@suite.test("horizon", points=1, name="and back", reread="Exercise 3")
def _gamma(student: Any) -> None:
    for seconds, dt, right in ((1.0, 0.04, 0.96), (4.0, 0.04, 0.99), (0.5, 0.02, 0.96)):
        got = answered(student.gamma_for(seconds, dt), "gamma_for")
        expect(equals(got, right), f"{seconds} s at steps of {dt} s: {right}", got=got, hint="inverse")


# ---------------------------------------------------------------- 4

_BUGS = {
    "gradients flow into the target networks": ((2, 3, 5), "bug-gradient"),
    "the arm never tries anything that its actor does not name": ((7, 8), "bug-noise"),
    "what is stored as done is later read as not done": ((1, 3, 9), "bug-done"),
    "a time limit counts as the end of the world": ((8, 9), "bug-timeout"),
    "reward (B,) and Q (B, 1) broadcast to a (B, B) table, and only a warning is printed": ((1, 3), "bug-shapes"),
}


@suite.test("bugs", points=1, name="the five bugs", reread="A training loop that never complains")
def _bugs(student: Any) -> None:
    answers = student["bugs"]
    expect(isinstance(answers, dict), "`bugs` should still be the dictionary of the cell", got=answers)
    if all(answers.get(line) is ... for line in _BUGS):
        raise NotImplementedError("bugs")
    for line, (right, hint) in _BUGS.items():
        got = answers.get(line)
        expect(isinstance(got, int) and 1 <= got <= 10, f'for "{line}" give a line from 1 to 10', got=got)
        expect(got in right, f'"{line}" cannot be put right in line {got}', hint=hint)
