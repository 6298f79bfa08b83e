"""The kit's terms and configurations against the genuine signatures that the conformance run stored (facts only).

The run itself, with the genuine wheel: ``make conformance-isaaclab``.
"""

from __future__ import annotations

import json

import pytest

from robotbrain.rl.isaaclab.names import ISAACLAB_VERSION, NAMES, page
from tests.conformance_isaaclab import facts
from tests.conformance_isaaclab.checks import STORE

GENUINE: facts.Facts = json.loads(STORE.read_text(encoding="utf-8"))
KIT = facts.facts_of(0)


def test_every_name_has_the_genuine_signature() -> None:
    assert facts.compare(KIT, GENUINE) == []


def test_enough_is_compared() -> None:
    assert {name for name in KIT if name.startswith("mdp.")} >= {f"mdp.{name}" for name in facts.terms()}
    assert len(facts.terms()) > 90 and set(GENUINE) == set(KIT)


@pytest.mark.parametrize(
    ("name", "row", "change"),
    [
        ("mdp.track_lin_vel_xy_exp", 1, ["sigma", "required"]),
        ("mdp.feet_air_time_variance", 3, ["max_time", "0.4"]),
        ("mdp.JointPositionActionCfg", 3, ["debug_vis", "True"]),
        ("ppo.RslRlPpoAlgorithmCfg", 0, ["class_name", "'DDPG'"]),
    ],
)
def test_drift_is_noticed(name: str, row: int, change: list[str]) -> None:
    drifted = {key: [list(r) for r in rows] for key, rows in GENUINE.items()}
    assert drifted[name][row] != change
    drifted[name][row] = change
    assert [wrong for wrong, _ in facts.compare(KIT, drifted)] == [name]
    del drifted[name]
    assert facts.compare(KIT, drifted) == [(name, "Isaac Lab has no such name")]


def test_meant_differences_have_reasons_and_are_used() -> None:
    for key, reason in facts.DIFFERENCES.items():
        name, _, field = key.rpartition(".")
        assert reason, key
        rows = [row for row in KIT.get(name, []) + GENUINE.get(name, []) if row[0] == field]
        assert rows and not (len(rows) == 2 and rows[0] == rows[1]), f"{key} does not differ any more"


def test_the_page_is_written_from_the_table() -> None:
    from pathlib import Path

    import robotbrain.rl.isaaclab as package

    text = Path(package.__file__).with_name("OUTDATED_NAMES.md").read_text(encoding="utf-8")
    assert text == page(), "run python -m robotbrain.rl.isaaclab.names"
    assert ISAACLAB_VERSION in text
    assert all(name.old in text and name.today in text for name in NAMES)
