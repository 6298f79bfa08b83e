"""The lesson on DDPG: it runs, and its checks know right from wrong."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest

from tests import lessons
from tests.lessons import hints

CLAIMS = """
assert trained.curve[-1]["success"] >= 0.95 and trained.curve[-1]["step"] * 0.04 < 1800  # half an hour of practice
assert wrong[-1] < 0.12 < wrong[0]
assert np.mean(finals[1.0]) > np.mean(finals[0.05])
assert learn_coin(True) == ["0.50", "1.00", "0.00"] and learn_coin(False) == ["0.50", "0.75", "0.25"]
final = {name: [run[-1] for run in runs.values()] for name, runs in stored["curves"].items()}
assert all(0.014 < run["error_m"] < 0.026 and run["success"] < 0.9 for run in final["distance"])
assert all(run["success"] > 0.97 for run in final["distance and precision"])
assert 6.5 < (-np.gradient(r2, d)).max() < 6.8
assert abs(0.04 / (1 - reach_ddpg_config().gamma) - 0.27) < 0.02 and reach_ddpg_config().tau == 0.02
"""


class TestLesson(lessons.LessonTests):
    notebook = "05_ddpg_reach.ipynb"
    exercises = "1234"
    figures = 4
    tables = 1
    claims = CLAIMS
    timeout = 300


# ---------------------------------------------------------------- the checks


check = partial(lessons.check, "lesson_05")


def discounted_return(rewards: list[float], gamma: float, terminated: bool, last_value: float) -> float:
    total = sum(gamma**k * reward for k, reward in enumerate(rewards))
    return total if terminated else total + gamma ** len(rewards) * last_value


def backwards(rewards: list[float], gamma: float, terminated: bool, last_value: float) -> float:
    total = 0.0 if terminated else last_value
    for reward in reversed(rewards):
        total = reward + gamma * total
    return total


def pull(d: Any, sigma: float = 0.03, factor: float = 0.2) -> Any:
    return 1 + factor * 2 * d / sigma**2 * np.exp(-((d / sigma) ** 2))


BUGS = {
    "gradients flow into the target networks": 2,
    "the arm never tries anything that its actor does not name": 7,
    "what is stored as done is later read as not done": 9,
    "a time limit counts as the end of the world": 8,
    "reward (B,) and Q (B, 1) broadcast to a (B, B) table, and only a warning is printed": 3,
}


def horizon(gamma: float, dt: float) -> float:
    return dt / (1 - gamma)


def gamma_for(seconds: float, dt: float) -> float:
    return 1 - dt / seconds


def test_right_answers_pass() -> None:
    assert check("discounted_return", discounted_return=discounted_return).full
    assert check("discounted_return", discounted_return=backwards).full
    assert check("pull", pull=pull).full
    assert check("horizon", horizon=horizon, gamma_for=gamma_for).full
    assert check("bugs", bugs=BUGS).full


def with_bug(line: str, number: int) -> dict[str, int]:
    return {name: number if line in name else right for name, right in BUGS.items()}


@pytest.mark.parametrize(
    ("exercise", "answers", "hint"),
    [
        (
            "discounted_return",
            {"discounted_return": lambda r, g, t, v: g * discounted_return(r, g, t, v)},
            "first-reward-whole",
        ),
        (
            "discounted_return",
            {"discounted_return": lambda r, g, t, v: discounted_return(r, g, False, v)},
            "no-future-after-an-end",
        ),
        (
            "discounted_return",
            {"discounted_return": lambda r, g, t, v: discounted_return(r, g, True, v)},
            "a-cut-has-a-future",
        ),
        (
            "discounted_return",
            {"discounted_return": lambda r, g, t, v: discounted_return(r, g, True, v) + (0 if t else v)},
            "last-value-discounted",
        ),
        ("pull", {"pull": lambda d, s=0.03, f=0.2: -pull(d, s, f)}, "sign-of-the-pull"),
        ("pull", {"pull": lambda d, s=0.03, f=0.2: pull(d, s, f) - 1}, "both-parts"),
        ("pull", {"pull": lambda d, s=0.03, f=0.2: 1 + f * np.exp(-((d / s) ** 2))}, "inner-derivative"),
        ("pull", {"pull": lambda d, s=0.03, f=0.2: float(pull(d, s, f))}, "works-for-arrays"),
        ("horizon", {"horizon": lambda g, dt: 1 / (1 - g), "gamma_for": gamma_for}, "seconds"),
        ("horizon", {"horizon": horizon, "gamma_for": lambda s, dt: 1 - 1 / s}, "inverse"),
        ("bugs", {"bugs": with_bug("gradients", 8)}, "bug-gradient"),
        ("bugs", {"bugs": with_bug("never tries", 2)}, "bug-noise"),
        ("bugs", {"bugs": with_bug("stored as done", 5)}, "bug-done"),
        ("bugs", {"bugs": with_bug("time limit", 3)}, "bug-timeout"),
        ("bugs", {"bugs": with_bug("broadcast", 5)}, "bug-shapes"),
    ],
)
def test_wrong_answers_get_their_hint(exercise: str, answers: dict[str, Any], hint: str) -> None:
    report = check(exercise, **answers)
    assert not report.full and hint in hints(report), (hints(report), report)


def test_an_answer_of_the_wrong_kind_is_named() -> None:
    for report in (
        check("discounted_return", discounted_return=lambda *_: "much"),
        check("pull", pull=lambda d, s=0, f=0: "hard"),
        check("bugs", bugs={**BUGS, next(iter(BUGS)): "two"}),
    ):
        assert not report.full and not any("Traceback" in (r.message or "") for r in report.results)
