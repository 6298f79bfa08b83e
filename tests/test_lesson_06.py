"""The lesson on sim to real: it runs, and its checks know right from wrong."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.stats import t

from tests import lessons
from tests.lessons import hints

CLAIMS = """
values = {name: report.values(name, "surrogate") for name in report.rows}
assert 0.25 < values["plain"].mean() < 0.42 and values["randomised"].mean() > 0.97
assert report.values("plain", "simulation").mean() > 0.99 > report.values("randomised", "simulation").mean()
alone = report.dissected("plain")
assert alone["delays"] < 0.6 and min(v for k, v in alone.items() if k != "delays") > 0.95
assert max(report.sensitivity("plain"), key=lambda k: abs(report.sensitivity("plain")[k])) == "command_delay_s"
assert max(map(abs, report.sensitivity("randomised").values())) < 0.5
assert "4 of 4" in motions[0].label and "4 of 4" not in motions[1].label
assert max(reach_over_ros([(0.5, 0.3, 0.4), (0.4, -0.3, 0.6)], serial=7)) < 0.02
assert learned.success and not learned.collisions and learned.seconds > 24 and learned.path_length > 10
import json
from robotbrain.rl.tasks import navigation
recipe = json.loads(navigation.SHIPPED_RECIPE.read_text())
assert recipe["minutes"] < 12 and 0.9e6 < recipe["env_steps"] < 1e6
assert {"reached": 448, "episodes": 512, "collisions": 34}.items() <= recipe["evaluation"][0].items()
"""


class TestLesson(lessons.LessonTests):
    notebook = "06_sim_to_real.ipynb"
    exercises = "1234"
    figures = 3
    tables = 1
    claims = CLAIMS


# ---------------------------------------------------------------- the checks


check = partial(lessons.check, "lesson_06")


def with_play(motor: list[float], play: float, start: float = 0.0) -> list[float]:
    arm, found = start, []
    for angle in motor:
        if arm < angle - play / 2:
            arm = angle - play / 2
        elif arm > angle + play / 2:
            arm = angle + play / 2
        found.append(arm)
    return found


def forgets(motor: list[float], play: float, start: float = 0.0) -> list[float]:
    return [with_play([angle], play, start)[0] for angle in motor]


REMEDIES = {
    "the field bus delivers each command 10 to 20 ms late": "latency",
    "the hand carries a camera that is in no model, 0.6 kg": "load",
    "it is February, and the grease is stiff": "friction",
    "the angles that are read jitter by a fraction of a degree": "noise",
    "the motors are warm and give 80 % of what they should": "motor",
}


def interval(values: list[float], ddof: int = 1, root: bool = True, quantile: float | None = None) -> Any:
    n, middle = len(values), np.mean(values)
    half = (quantile or t.ppf(0.975, n - 1)) * np.std(values, ddof=ddof) / (np.sqrt(n) if root else 1)
    return middle - half, middle + half


def in_policy_order(names: list[str], positions: list[float], joint_names: list[str]) -> list[float]:
    found = dict(zip(names, positions, strict=True))
    return [found[name] for name in joint_names]


def test_right_answers_pass() -> None:
    assert check("with_play", with_play=with_play).full
    assert check("with_play", with_play=lambda m, p, s=0.0: np.array(with_play(m, p, s))).full
    assert check("remedies", remedies=REMEDIES).full
    assert check("interval", interval=interval).full
    assert check("in_policy_order", in_policy_order=in_policy_order).full


@pytest.mark.parametrize(
    ("exercise", "answers", "hint"),
    [
        ("with_play", {"with_play": lambda m, p, s=0.0: with_play(m, 2 * p, s)}, "half-on-each-side"),
        ("with_play", {"with_play": forgets}, "remembers"),
        ("with_play", {"with_play": lambda m, p, s=0.0: [0.8 * a for a in m]}, "moves-only-when-pushed"),
        ("with_play", {"with_play": lambda m, p, s=0.0: with_play(m, p, s)[-1:]}, "one-per-motor-angle"),
        ("remedies", {"remedies": dict.fromkeys(REMEDIES, "noise")}, "remedy-latency"),
        ("remedies", {"remedies": dict.fromkeys(REMEDIES, "latency")}, "remedy-load"),
        ("interval", {"interval": lambda v: interval(v, quantile=1.96)}, "student-not-normal"),
        ("interval", {"interval": lambda v: interval(v, ddof=0)}, "divide-by-n-minus-one"),
        ("interval", {"interval": lambda v: interval(v, root=False)}, "root-n"),
        ("interval", {"interval": lambda v: interval(v, quantile=2.776)}, "between-trainings"),
        ("interval", {"interval": lambda v: interval(v)[0]}, "both-ends-of-the-interval"),
        ("in_policy_order", {"in_policy_order": lambda n, p, j: p[:7]}, "by-name"),
        (
            "in_policy_order",
            {"in_policy_order": lambda n, p, j: [x for _, x in sorted(zip(n, p, strict=True))]},
            "other-joints-too",
        ),
        (
            "in_policy_order",
            {"in_policy_order": lambda n, p, j: [dict(zip(n, p, strict=True)).get(x, 0.0) for x in j]},
            "refuse-what-is-missing",
        ),
    ],
)
def test_wrong_answers_get_their_hint(exercise: str, answers: dict[str, Any], hint: str) -> None:
    report = check(exercise, **answers)
    assert not report.full and hint in hints(report), (hints(report), report)


def test_an_answer_of_the_wrong_kind_is_named() -> None:
    for report in (
        check("with_play", with_play=lambda *_: "loose"),
        check("interval", interval=lambda v: None),
        check("in_policy_order", in_policy_order=lambda *_: "joints"),
        check("remedies", remedies=7),
    ):
        assert not report.full and not any("Traceback" in (r.message or "") for r in report.results)
