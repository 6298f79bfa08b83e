"""Checks of the lesson `04_rl_tasks`. Nothing here is graded: an answer that is still open is no mistake."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np

from robotbrain.grading import Suite, expect, fail
from robotbrain.grading.suites.lesson_tools import answered, equals

suite = Suite("lesson_04")

suite.exercise("step_reward", title="1 One step's reward", points=3, provides=("step_reward",))
suite.exercise("uprightness", title="2 A term of your own", points=2, provides=("uprightness",))
suite.exercise("endings", title="3 Terminated or truncated?", points=1, provides=("endings",))
suite.exercise("outline_events", title="4 The outline's randomisation", points=3, provides=("outline_events",))

_HINTS = {
    "weights-are-per-second": "Weights are per second: multiply the weighted sum by step_dt.",
    "every-term": "Add weight times value over all the terms, whatever their number and their names.",
    "clip-the-total": "only_positive lifts the total to 0, max(0, total); single terms may be negative.",
    "clip-only-when-asked": "Without only_positive a negative total stays negative.",
    "one-number-per-robot": "Return one number for each robot, shape (num_envs,): take column 2, [:, 2].",
    "sign-of-gravity": "Gravity points down: an upright robot sees (0, 0, -1). Upright shall be +1.",
    "which-axis": "The third component, [:, 2], is the one along the robot's own up axis.",
    "of-this-robot": "Read the data of `env.scene[asset_cfg.name]`, so that the term works for any robot of the scene.",
    "limits-are-truncations": "A clock, a log or a finger on a button ended it, nothing that happened to the robot: "
    "there is a future, and we only did not simulate it.",
    "ends-are-terminations": "Nothing comes after this, for good or bad: the task itself is over.",
    "mode": "startup: once for each robot. interval: again and again during an episode.",
    "interval-in-seconds": "interval_range_s is in seconds: 200 steps of 0.02 s each.",
    "add-not-scale": "added_mass_range is in kg and is added: operation='add'.",
    "which-body": "The mass goes on the trunk: SceneEntityCfg('robot', body_names='base').",
    "both-frictions": "static_friction_range and dynamic_friction_range are both (0.5, 1.25).",
    "push-both-ways": "Up to 0.5 m/s either way: (-0.5, 0.5), for 'x' and for 'y'.",
    "missing-parameter": "The function needs this parameter; print(cfg.events) shows how the task calls it.",
}
for _key, _text in _HINTS.items():
    suite.hint(_key, _text)


# ---------------------------------------------------------------- 1


def _reward(student: Any, values: dict[str, float], weights: dict[str, float], *rest: Any) -> float:
    got = answered(student.step_reward(dict(values), dict(weights), *rest), "step_reward")
    try:
        number = float(got)
    except (TypeError, ValueError):
        fail("step_reward should return one number", got=got)
    return number


@suite.test("step_reward", points=2, name="sums worked out by hand", reread="Weights are per second")
def _sums(student: Any) -> None:
    rng = student.rng("step_reward")
    cases = [({"track": 0.5}, {"track": 2.0}, 0.02)]
    for _ in range(4):
        names = [f"term{i}" for i in range(int(rng.integers(2, 7)))]
        values, weights = rng.uniform(0, 2, len(names)), rng.uniform(-2, 3, len(names))
        cases.append((dict(zip(names, values, strict=True)), dict(zip(names, weights, strict=True)), 0.04))
    for values, weights, step in cases:
        got = _reward(student, values, weights, step)
        plain = sum(weights[name] * values[name] for name in values)
        if equals(got, plain * step):
            continue
        hint = "every-term"
        if equals(got, plain):
            hint = "weights-are-per-second"
        elif plain < 0 and equals(got, 0.0):
            hint = "clip-only-when-asked"
        fail(
            f"terms {_rounded(values)} with weights {_rounded(weights)}, step {step} s: {plain * step:.5g}",
            got=got,
            hint=hint,
        )


@suite.test("step_reward", points=1, name="lifted to zero when asked", reread="Exercise 1")
def _positive(student: Any) -> None:
    for values, weights, right in (
        ({"a": 1.0, "b": 1.0}, {"a": 1.0, "b": -3.0}, 0.0),
        ({"a": 1.0, "b": 1.0}, {"a": 3.0, "b": -1.0}, 0.04),
    ):
        got = _reward(student, values, weights, 0.02, True)
        expect(equals(got, right), f"with only_positive, {weights} gives {right}", got=got, hint="clip-the-total")


def _rounded(numbers: dict[str, float]) -> dict[str, float]:
    return {name: round(float(value), 3) for name, value in numbers.items()}


# ---------------------------------------------------------------- 2


@suite.test("uprightness", points=2, name="robots in all attitudes", reread="Exercise 2")
def _uprightness(student: Any) -> None:
    import torch

    from robotbrain.rl.managers import SceneEntityCfg

    directions = np.array([[0, 0, -1], [0, 0, 1], [1, 0, 0], [0, -1, 0], [0.6, 0, -0.8]], np.float32)
    right = torch.from_numpy(-directions[:, 2])
    views = {
        name: SimpleNamespace(data=SimpleNamespace(projected_gravity_b=SimpleNamespace(torch=torch.from_numpy(seen))))
        for name, seen in (("robot", directions), ("other", -directions))
    }
    env = SimpleNamespace(scene=views, num_envs=len(directions), device=torch.device("cpu"))
    got = answered(student.uprightness(env), "uprightness")
    expect(isinstance(got, torch.Tensor), "a term returns a torch tensor", got=got, hint="one-number-per-robot")
    expect(
        tuple(got.shape) == (len(directions),),
        f"for {len(directions)} robots the shape should be ({len(directions)},)",
        got=tuple(got.shape),
        hint="one-number-per-robot",
    )
    if not torch.allclose(got.float(), right, atol=1e-5):
        hint = "sign-of-gravity" if torch.allclose(got.float(), -right, atol=1e-5) else "which-axis"
        fail(f"for 'down' at {directions.tolist()} it should be {right.tolist()}", got=got.tolist(), hint=hint)
    other = student.uprightness(env, SceneEntityCfg("other"))
    expect(
        torch.allclose(other.float(), -right, atol=1e-5), "asked about another robot", got=other, hint="of-this-robot"
    )


# ---------------------------------------------------------------- 3

_ENDINGS = {
    "the arm's 2 s per target are over, and it gets a new target": "truncated",
    "the mobile robot hits a shelf": "terminated",
    "the gripper dropped the egg, and it broke": "terminated",
    "you pressed the stop button of the training script": "truncated",
    "the walking robot left the square metre of floor that the log covers": "truncated",
    "the robot has docked, which is all it was asked to do": "terminated",
}
_WHY = {"truncated": "limits-are-truncations", "terminated": "ends-are-terminations"}


@suite.test("endings", points=1, name="the six endings", reread="When it is over")
def _endings(student: Any) -> None:
    answers = student["endings"]
    expect(isinstance(answers, dict), "`endings` should still be the dictionary of the cell", got=answers)
    if all(answers.get(line) is ... for line in _ENDINGS):
        raise NotImplementedError("endings")
    for line, right in _ENDINGS.items():
        got = answers.get(line)
        got = got.strip().lower() if isinstance(got, str) else got
        expect(got in _WHY, f'for "{line}" choose "terminated" or "truncated"', got=got)
        expect(got == right, f'"{line}" is not {got}', hint=_WHY[right])


# ---------------------------------------------------------------- 4


def _event(student: Any, name: str, mode: str) -> Any:
    """Return one of the student's events whose mode is right."""
    events = answered(student.outline_events(), "outline_events")
    expect(isinstance(events, dict) and name in events, f"outline_events() should have the key {name!r}", got=events)
    event = events[name]
    if event.mode is ... or any(value is ... for value in event.params) or ... in event.params.values():
        raise NotImplementedError(name)
    expect(event.mode == mode, f"{name} should happen at {mode}", got=event.mode, hint="mode")
    return event


def _needs(event: Any, *names: str) -> None:
    for name in names:
        expect(
            name in event.params,
            f"{event.func.__name__} needs {name}",
            got=sorted(event.params),
            hint="missing-parameter",
        )


def _is_range(got: Any, low: float, high: float) -> bool:
    try:
        return len(got) == 2 and math.isclose(got[0], low) and math.isclose(got[1], high)
    except TypeError:
        return False


@suite.test("outline_events", points=1, name="friction", reread="Exercise 4")
def _friction(student: Any) -> None:
    event = _event(student, "physics_material", "startup")
    _needs(event, "static_friction_range", "dynamic_friction_range", "restitution_range", "num_buckets")
    for name in ("static_friction_range", "dynamic_friction_range"):
        got = event.params[name]
        expect(_is_range(got, 0.5, 1.25), f"{name} should be (0.5, 1.25)", got=got, hint="both-frictions")


@suite.test("outline_events", points=1, name="mass", reread="Exercise 4")
def _mass(student: Any) -> None:
    event = _event(student, "add_base_mass", "startup")
    _needs(event, "asset_cfg", "mass_distribution_params", "operation")
    got = event.params["mass_distribution_params"]
    expect(_is_range(got, -1.0, 3.0), "the added mass is -1 to 3 kg", got=got, hint="add-not-scale")
    expect(event.params["operation"] == "add", "the mass is added", got=event.params["operation"], hint="add-not-scale")
    bodies = event.params["asset_cfg"].body_names
    expect(bodies in ("base", ["base"], ("base",)), "the mass goes on the trunk", got=bodies, hint="which-body")


@suite.test("outline_events", points=1, name="pushes", reread="Exercise 4")
def _push(student: Any) -> None:
    event = _event(student, "push_robot", "interval")
    got = event.interval_range_s
    expect(_is_range(got, 4.0, 4.0), "200 steps of 0.02 s are 4 s", got=got, hint="interval-in-seconds")
    _needs(event, "velocity_range")
    ranges = event.params["velocity_range"]
    expect(isinstance(ranges, dict), "velocity_range is a dictionary by axis", got=ranges, hint="push-both-ways")
    for axis in ("x", "y"):
        got = ranges.get(axis)
        expect(_is_range(got, -0.5, 0.5), f"along {axis} it is (-0.5, 0.5)", got=got, hint="push-both-ways")
