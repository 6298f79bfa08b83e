"""The programs on the kit, compared with what genuine Kilted and Jazzy decided.

The genuine logs were recorded by ``python -m tests.conformance_ros --record``, which also compares live; here
nothing genuine is needed.
"""

from __future__ import annotations

import json
import runpy
from pathlib import Path

import pytest

import robotbrain.ros
from robotbrain.ros.context import set_default_context
from tests.conformance_ros.backends import DISTROS, EXPECTED, PROGRAMS, Line, programs, read_log
from tests.conformance_ros.compare import Difference, check_table, compare
from tests.conformance_ros.differences import DIFFERENCES

NAMES = [path.stem for path in programs()]

pytestmark = pytest.mark.skipif(robotbrain.ros.BACKEND == "rclpy", reason="genuine rclpy is installed here")


def run_on_kit(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[Line]:
    """Run a program in this process and return its decision log."""
    target = folder / "log.jsonl"
    monkeypatch.setenv("CONFORMANCE_LOG", str(target))
    monkeypatch.syspath_prepend(str(PROGRAMS))
    set_default_context(None)
    try:
        runpy.run_path(str(PROGRAMS / f"{name}.py"), run_name="__main__")
    finally:
        set_default_context(None)
    return read_log(target)


@pytest.mark.parametrize("name", NAMES)
def test_decides_as_genuine_rclpy(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lines = run_on_kit(name, tmp_path, monkeypatch)
    problems = []
    for distro in DISTROS:
        expected = read_log(EXPECTED / distro / f"{name}.jsonl")
        problems += [f"{distro}: {problem}" for problem in compare(name, distro, lines, expected, DIFFERENCES)]
    assert not problems, "\n".join(problems)


def test_runs_are_repeatable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("executor_multi", "timers"):
        logs = []
        for number in range(2):
            folder = tmp_path / f"{name}{number}"
            folder.mkdir()
            logs.append(run_on_kit(name, folder, monkeypatch))
        assert json.dumps(logs[0]) == json.dumps(logs[1])


def test_every_program_is_recorded_and_nothing_else() -> None:
    for distro in DISTROS:
        assert sorted(path.stem for path in (EXPECTED / distro).glob("*.jsonl")) == NAMES


def test_listed_differences_are_meant() -> None:
    assert check_table(DIFFERENCES, NAMES) == []


GENUINE: list[Line] = [{"event": "a", "x": 1}, {"event": "b", "raised": ["ValueError", "Exception"]}]


def listed(kit: dict[str, int], genuine: dict[str, int]) -> Difference:
    return Difference("p", "a", (kit,), (genuine,), "because it is only an example")


def test_compare_notices() -> None:
    """The comparison itself: equal, different, out of order, missing, listed, and listed but not so any more."""
    assert compare("p", "kilted", GENUINE, GENUINE, ()) == []
    other: list[Line] = [{"event": "a", "x": 2}, GENUINE[1]]
    assert compare("p", "kilted", other, GENUINE, ())
    assert compare("p", "kilted", GENUINE[::-1], GENUINE, ())
    assert compare("p", "kilted", GENUINE[:1], GENUINE, ())
    row = listed({"x": 2}, {"x": 1})
    assert compare("p", "kilted", other, GENUINE, (row,)) == []
    assert compare("p", "kilted", GENUINE, GENUINE, (row,)), "a listed difference that no longer occurs"
    assert compare("p", "kilted", other, GENUINE, (listed({"x": 3}, {"x": 1}),)), "listed with another value"
    assert compare("q", "kilted", other, GENUINE, (row,)), "listed for another program"


def test_an_exception_agrees_when_the_same_clause_catches_it() -> None:
    narrower: list[Line] = [GENUINE[0], {"event": "b", "raised": ["UnicodeError", "ValueError", "Exception"]}]
    assert compare("p", "kilted", narrower, GENUINE, ()) == []
    other: list[Line] = [GENUINE[0], {"event": "b", "raised": ["TypeError", "Exception"]}]
    assert compare("p", "kilted", other, GENUINE, ())
    result: list[Line] = [GENUINE[0], {"event": "b", "result": 1}]
    assert compare("p", "kilted", result, GENUINE, ())


def test_the_table_itself_is_checked() -> None:
    row = listed({"x": 2}, {"x": 1})
    assert check_table((row,), ["p"]) == []
    assert check_table((row,), ["q"])
    assert check_table((row, row), ["p"])
    assert check_table((listed({"x": 1}, {"x": 1}),), ["p"])
    assert check_table((Difference("p", "a", (), ({},), "no"),), ["p"])
