"""The lesson on tasks for reinforcement learning: it runs, and its checks know right from wrong."""

from __future__ import annotations

import copy
import math
from functools import partial
from typing import Any

import pytest

from tests import lessons
from tests.lessons import hints

CLAIMS = """
assert tracked.fell.sum() <= 1 and tracked.error.nanmean() < 0.1 and tracked.yaw_error.nanmean() < 0.1
shipped, crouching = (height[50:].mean() for height in heights)
assert 31 < shipped < 33 and 0.5 < shipped - crouching < 3
assert round(curve["env_steps"][-1] / 1e6, 1) == 7.0 and round(curve["env_steps"][-1] * 0.02 / 3600) == 39
assert np.interp(2.0, steps, curve["velocity_error_m_s"]) < 0.3 < curve["velocity_error_m_s"][0]
recipe = json.loads(velocity.SHIPPED_RECIPE.read_text())
assert recipe["command"].startswith("robotbrain rl train velocity --seed 0")
assert np.exp(-((0.5 / 0.25) ** 2)) < 0.02
"""


class TestLesson(lessons.LessonTests):
    notebook = "04_rl_tasks.ipynb"
    exercises = "1234"
    figures = 4
    tables = 3
    claims = CLAIMS
    timeout = 300


# ---------------------------------------------------------------- the checks


check = partial(lessons.check, "lesson_04")


def step_reward(
    values: dict[str, float], weights: dict[str, float], step_dt: float, only_positive: bool = False
) -> float:
    total = sum(weights[name] * value for name, value in values.items()) * step_dt
    return max(0.0, total) if only_positive else total


def uprightness(env: Any, asset_cfg: Any = None, sign: float = -1.0, axis: int = 2) -> Any:
    name = "robot" if asset_cfg is None else asset_cfg.name
    return sign * env.scene[name].data.projected_gravity_b.torch[:, axis]


ENDINGS = {
    "the arm's 2 s per target are over, and it gets a new target": "truncated",
    "the mobile robot hits a shelf": "terminated",
    "the gripper dropped the egg, and it broke": "terminated",
    "you pressed the stop button of the training script": "truncated",
    "the walking robot left the square metre of floor that the log covers": "truncated",
    "the robot has docked, which is all it was asked to do": "terminated",
}


def outline_events(**changes: Any) -> Any:
    """The right events; changes are given as event__field=value or event__params__name=value (None: leave it out)."""
    from robotbrain.rl import mdp
    from robotbrain.rl.managers import EventTermCfg, SceneEntityCfg

    friction = {
        "asset_cfg": SceneEntityCfg("robot", body_names=".*"),
        "static_friction_range": (0.5, 1.25),
        "dynamic_friction_range": [0.5, 1.25],
        "restitution_range": (0.0, 0.0),
        "num_buckets": 64,
    }
    mass = {
        "asset_cfg": SceneEntityCfg("robot", body_names="base"),
        "mass_distribution_params": (-1.0, 3.0),
        "operation": "add",
    }
    push = {"velocity_range": {"x": (-0.5, 0.5), "y": (-0.5, 0.5)}}
    events = {
        "physics_material": EventTermCfg(func=mdp.randomize_rigid_body_material, mode="startup", params=friction),
        "add_base_mass": EventTermCfg(func=mdp.randomize_rigid_body_mass, mode="startup", params=mass),
        "push_robot": EventTermCfg(
            func=mdp.push_by_setting_velocity, mode="interval", interval_range_s=(4.0, 4.0), params=push
        ),
    }
    for key, value in changes.items():
        name, *where = key.split("__")
        if len(where) == 1:
            setattr(events[name], where[0], value)
        elif value is None:
            del events[name].params[where[1]]
        else:
            events[name].params[where[1]] = value
    return lambda: copy.deepcopy(events)


def test_right_answers_pass() -> None:
    assert check("step_reward", step_reward=step_reward).full
    assert check("uprightness", uprightness=uprightness).full
    assert check("endings", endings=ENDINGS).full
    assert check("outline_events", outline_events=outline_events()).full


def upside(other: str) -> dict[str, str]:
    return dict.fromkeys(ENDINGS, other)


@pytest.mark.parametrize(
    ("exercise", "answers", "hint"),
    [
        ("step_reward", {"step_reward": lambda v, w, dt, p=False: step_reward(v, w, 1.0, p)}, "weights-are-per-second"),
        ("step_reward", {"step_reward": lambda v, w, dt, p=False: step_reward(v, w, dt, True)}, "clip-only-when-asked"),
        ("step_reward", {"step_reward": lambda v, w, dt, p=False: step_reward(v, w, dt)}, "clip-the-total"),
        ("step_reward", {"step_reward": lambda v, w, dt, p=False: dt * max(v[k] * w[k] for k in v)}, "every-term"),
        ("uprightness", {"uprightness": lambda e, a=None: uprightness(e, a, sign=1.0)}, "sign-of-gravity"),
        ("uprightness", {"uprightness": lambda e, a=None: uprightness(e, a, axis=0)}, "which-axis"),
        ("uprightness", {"uprightness": lambda e, a=None: uprightness(e, a).mean()}, "one-number-per-robot"),
        ("uprightness", {"uprightness": lambda e, a=None: uprightness(e, a)[:, None]}, "one-number-per-robot"),
        ("uprightness", {"uprightness": lambda e, a=None: uprightness(e)}, "of-this-robot"),
        ("endings", {"endings": upside("terminated")}, "limits-are-truncations"),
        ("endings", {"endings": upside("truncated")}, "ends-are-terminations"),
        ("outline_events", {"outline_events": outline_events(add_base_mass__mode="reset")}, "mode"),
        (
            "outline_events",
            {"outline_events": outline_events(push_robot__interval_range_s=(200, 200))},
            "interval-in-seconds",
        ),
        (
            "outline_events",
            {"outline_events": outline_events(add_base_mass__params__operation="scale")},
            "add-not-scale",
        ),
        (
            "outline_events",
            {"outline_events": outline_events(push_robot__params__velocity_range={"x": (0, 0.5)})},
            "push-both-ways",
        ),
        (
            "outline_events",
            {"outline_events": outline_events(physics_material__params__dynamic_friction_range=(0.5, 1))},
            "both-frictions",
        ),
        (
            "outline_events",
            {"outline_events": outline_events(physics_material__params__num_buckets=None)},
            "missing-parameter",
        ),
    ],
)
def test_wrong_answers_get_their_hint(exercise: str, answers: dict[str, Any], hint: str) -> None:
    report = check(exercise, **answers)
    assert not report.full and hint in hints(report), (hints(report), report)


def test_the_trunk_is_the_body() -> None:
    from robotbrain.rl.managers import SceneEntityCfg

    everywhere = SceneEntityCfg("robot", body_names=".*")
    report = check("outline_events", outline_events=outline_events(add_base_mass__params__asset_cfg=everywhere))
    assert "which-body" in hints(report)


def test_an_answer_of_the_wrong_kind_is_named() -> None:
    assert not check("step_reward", step_reward=lambda v, w, dt, p=False: "much").full
    assert not check("uprightness", uprightness=lambda env, a=None: math.pi).full
    report = check("outline_events", outline_events=lambda: 3)
    assert not report.full and not any("Traceback" in (r.message or "") for r in report.results)
