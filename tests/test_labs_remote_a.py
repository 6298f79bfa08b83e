"""The project lab and homework 3 as they are graded: the student's objects in another process, reached by the codec."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robotbrain.grading import CheckFailure, Student
from robotbrain.grading.course import find_course
from robotbrain.grading.sample import Mutant, load_mutants
from robotbrain.grading.student import STUDENT_VARIABLE
from robotbrain.grading.suite import load_file
from robotbrain.grading.suites import lab_integration_planning as plans
from tests.conftest import REPO
from tests.remote_labs import (
    LabBench,
    Liar,
    Tape,
    check_mutant,
    check_right_answers,
    earned_by,
    verdicts,
)

LABS = ("lab_integration", "hw3_performance")
MUTANTS = [(lab, mutant) for lab in LABS for mutant in load_mutants(find_course(REPO), lab)[0]]
STYLES = [(lab, style) for lab in LABS for style in load_mutants(find_course(REPO), lab)[1]]

_BENCHES: dict[str, LabBench] = {}


def bench_of(lab: str) -> LabBench:
    """Return the lab's bench, made once."""
    if lab not in _BENCHES:
        _BENCHES[lab] = LabBench(REPO, lab)
    return _BENCHES[lab]


@pytest.fixture(autouse=True)
def student(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> str:
    """Each test grades another student, so that all draws of inputs have their turn."""
    monkeypatch.setenv(STUDENT_VARIABLE, request.node.name)
    return str(request.node.name)


@pytest.fixture(autouse=True, scope="module")
def forget() -> Iterator[None]:
    """Let go of the labs afterwards."""
    yield
    _BENCHES.clear()


@pytest.mark.parametrize("lab", LABS)
def test_the_reference_earns_everything_and_the_stub_nothing(lab: str) -> None:
    bench = bench_of(lab)
    check_right_answers(bench, {})
    empty = bench.namespace(stub=True)
    results = bench.remote(empty)
    assert not any(r.earned for rs in results.values() for r in rs)
    assert verdicts(results) == verdicts(bench.local(empty))


@pytest.mark.parametrize(("lab", "style"), STYLES, ids=lambda value: getattr(value, "name", value))
def test_every_style_earns_everything(lab: str, style: Any) -> None:
    check_right_answers(bench_of(lab), style.replace)


@pytest.mark.parametrize(("lab", "mutant"), MUTANTS, ids=lambda value: getattr(value, "name", value))
def test_every_mutant_loses_its_own_exercise_with_its_own_hint(lab: str, mutant: Mutant) -> None:
    check_mutant(bench_of(lab), mutant)


@pytest.mark.parametrize("lab", LABS)
def test_objects_that_agree_with_everything_earn_nothing(lab: str) -> None:
    bench = bench_of(lab)
    names = [name for exercise in bench.suite.exercises.values() for name in exercise.provides]
    assert earned_by(bench, dict.fromkeys(names, Liar())) == 0
    assert earned_by(bench, {name: lambda *args, **kwargs: Liar() for name in names}) == 0


@pytest.mark.parametrize("lab", LABS)
def test_answers_noted_down_in_the_notebook_are_worth_nothing_while_grading(
    lab: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A student who records what a right solution answers to the visible tests gains nothing for the graded ones."""
    bench = bench_of(lab)
    names = bench.namespace()
    tape = Tape()
    functions = {
        name: names[name]
        for exercise in bench.suite.exercises.values()
        for name in exercise.provides
        if inspect.isfunction(names[name]) and name != "repair"  # what it returns is an answer, not a table of them
    }
    monkeypatch.delenv(STUDENT_VARIABLE)
    bench.local({**names, **{name: tape.recording(name, function) for name, function in functions.items()}})
    monkeypatch.setenv(STUDENT_VARIABLE, "somebody")
    played = {**bench.namespace(), **{name: tape.playing(name) for name in functions}}
    results = bench.remote(played)
    answered = [name for name, exercise in bench.suite.exercises.items() if set(functions) & set(exercise.provides)]
    kept = {r.name: r.earned for name in answered for r in results[name] if r.earned}
    assert sum(kept.values()) <= 2, kept  # a rate or a role may be the same by chance


@pytest.mark.parametrize(
    ("kind", "names"),
    [
        ("weighted", ("manhattan-heuristic", "ignores-costs")),
        ("open", ("diagonal-costs-one", "manhattan-heuristic")),
        ("cornered", ("cuts-corners",)),
    ],
)
def test_each_maze_catches_the_wrong_searches_that_it_is_for(repo: Path, kind: str, names: tuple[str, ...]) -> None:
    bench = bench_of("lab_integration")
    pool = load_file(repo / "autograder" / "hidden" / "lab_integration.py", "_mazes").mazes()[kind]
    for mutant in (m for m in bench.mutants if m.name in names):
        student = Student(bench.namespace(mutant.replace), "test", frozenset())
        for maze in pool:
            for seed in range(4):  # laid down in several ways
                with pytest.raises(CheckFailure) as caught:
                    plans.compare_astar(student, maze.turned(np.random.default_rng(seed)))
                assert caught.value.hint == mutant.hint
