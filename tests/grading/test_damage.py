"""Honest submissions that met with an accident: each ends in a score with a reason, no answer is lost silently.

What is due is stated by each damage in :mod:`tests.grading.damage`: full points, but for the answers that it names.
"""

from __future__ import annotations

import gzip
import json
import os
import random
from pathlib import Path

import nbformat
import pytest
from nbformat.notebooknode import NotebookNode

from robotbrain.grading import intake
from robotbrain.grading.classroom import Options, grade_class
from robotbrain.grading.course import Course
from tests.grading import damage, toylab
from tests.grading.damage import DAMAGES, Damage, Lab

pytestmark = pytest.mark.skipif(os.name != "posix", reason="some of the damages need links, pipes and sockets")
REAL_LABS = ("hw1_rl", "hw2_optimisation", "hw3_performance", "lab_integration")


@pytest.fixture(scope="module")
def toy(course_root: Path) -> Lab:
    return damage.load_lab(Course(course_root, course_root), toylab.LAB)


@pytest.fixture(scope="module")
def real() -> dict[str, Lab]:
    course = Course(toylab.REPOSITORY, toylab.REPOSITORY)
    return {name: damage.load_lab(course, name) for name in REAL_LABS}


def labels(notebook: NotebookNode) -> list[str]:
    return [name for c in notebook.cells if (name := intake.grade_id(c))]


def check(lab: Lab, damages: list[Damage], seed: str, below: Path) -> None:
    outcome = damage.suffer(lab, damages, random.Random(seed), below)
    healed = outcome.healed
    assert outcome.lost == outcome.due, (seed, healed.repairs)
    nbformat.validate(healed.notebook)
    assert labels(healed.notebook) == labels(lab.master), seed
    shown = " ".join(healed.repairs)
    assert all(one.says in shown for one in damages), (seed, healed.repairs)
    assert outcome.due == set() or healed.repairs, seed
    assert not healed.repairs or all(r in healed.notebook.cells[0].source for r in healed.repairs)


def test_the_suite_is_as_large_as_it_says() -> None:
    assert len(DAMAGES) >= 90
    assert len({d.kind for d in DAMAGES}) >= 15
    assert len({d.name for d in DAMAGES}) == len(DAMAGES)


def test_the_measure_itself_sees_a_loss(toy: Lab) -> None:
    assert damage.lost(toy.reference, toy) == set()
    assert damage.lost(toy.stub, toy) == set(toy.answers)


@pytest.mark.parametrize("one", DAMAGES, ids=lambda d: d.name)
def test_a_damaged_toy_lab_keeps_what_is_due(one: Damage, toy: Lab, tmp_path: Path) -> None:
    for seed in range(2):
        check(toy, [one], f"{one.name} {seed}", tmp_path / str(seed))


@pytest.mark.parametrize("one", DAMAGES, ids=lambda d: d.name)
def test_a_damaged_real_lab_keeps_what_is_due(one: Damage, real: dict[str, Lab], tmp_path: Path) -> None:
    name = random.Random(one.name).choice(REAL_LABS)
    check(real[name], [one], f"{one.name} {name}", tmp_path)


LAST = ("retyped cells", "lost labels", "odd fields")  # what makes cells unrecognisable for a further damage
ALONE = ("bombs", "old formats", "other kinds of file")
CLASHING = [  # the second would work on a part or a copy of what the first left
    {"merged cells", "copied cells"},
    {"split cells", "copied cells"},
    {"split cells", "answers elsewhere"},
    {"copied cells", "answers elsewhere"},
]


def _partners(one: Damage) -> list[Damage]:
    """Damages that may come on top of one."""
    mild = [d for d in DAMAGES if d.kind not in (*ALONE, one.kind) and {d.kind, one.kind} not in CLASHING]
    mild = [d for d in mild if d.level != damage.NOTEBOOK or d.kind not in (*LAST, "reordered cells")]
    return random.Random(one.name).sample(mild, 12)


FIRST = [
    d for d in DAMAGES if d.level == damage.NOTEBOOK and d.kind not in ALONE and d.name != "cells are a dictionary"
]


@pytest.mark.parametrize("one", FIRST, ids=lambda d: d.name)
def test_two_damages_at_once_cost_no_more_than_both(one: Damage, toy: Lab, tmp_path: Path) -> None:
    tried = 0
    for number, other in enumerate(_partners(one)):
        both = [other, one] if one.kind in LAST and other.level == damage.NOTEBOOK else [one, other]
        try:
            outcome = damage.suffer(toy, both, random.Random(f"{one.name} {other.name}"), tmp_path / str(number))
        except damage.InapplicableError:  # the first left nothing for the second
            continue
        assert outcome.lost == outcome.due, (other.name, outcome.healed.repairs)
        nbformat.validate(outcome.healed.notebook)
        tried += 1
        if tried == 3:
            return
    assert tried, "no other damage goes with it"


def _dumped(*cells: object) -> bytes:
    return json.dumps({"cells": cells, "metadata": {}, "nbformat": 4, "nbformat_minor": 5}).encode()


def _cell(source: object, **metadata: object) -> dict[str, object]:
    return {"cell_type": "code", "source": source, "metadata": metadata, "outputs": []}


MANY = 200_000
HOSTILE = {
    "a list of empty lists": b'{"cells":[' + b"[]," * (4 * MANY),
    "objects in objects": b'{"a":' * MANY,
    "brackets": b"[" * (8 * MANY),
    "quotes and backslashes": b'{"cells":["' + b'\\"' * (4 * MANY),
    "line ends in a string": b'{"cells": [{"source":"' + b"\n" * (4 * MANY),
    "blanks": b'{"cells":' + b" " * (8 * MANY),
    "beginnings of cells": b'{"cell_type":' * (MANY // 2),
    "conflict markers": b"<<<<<<< a\n" * MANY,
    "marks of cells": b"# %%\n" * MANY,
    "a page of inputs": b"<html>" + b'<div class="jp-InputArea-editor"><pre>' * (MANY // 4),
    "digits": b'{"cells":[' + b"1" * (8 * MANY),
    "surrogates": b'{"cells":[{"source":"' + b"\\ud83d" * MANY + b'"}]}',
    "packed zeros": gzip.compress(bytes(300_000_000), 1),
    "many cells": _dumped(*[_cell("x")] * 20_000),
    "names": _dumped(*[_cell("a," * 20_000)] * 20),
    "annotations": _dumped(*[_cell(("a :" + "b" * 199) * 1900)] * 5),
    "one label on all": _dumped(*[_cell("def scale(x):\n    return 2 *", nbgrader={"grade_id": "scale"})] * 2000),
    "much alike": _dumped(*[_cell("\n".join(f"lab.scor{j}({i})" for j in range(99))) for i in range(500)]),
    "brackets in code": _dumped(*[_cell("{1:" * 59)] * 2000),
}


@pytest.mark.timeout(60)  # whatever takes more than linear work does not end within it
@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_end_in_the_empty_lab(name: str, toy: Lab) -> None:
    healed = intake.heal_bytes(HOSTILE[name], toy.master)
    assert damage.lost(healed.notebook, toy) == set(toy.answers)
    assert labels(healed.notebook) == labels(toy.master)
    assert healed.repairs
    assert len(nbformat.writes(healed.notebook)) < 10_000_000


CLASS = {  # through all of grade-class: damages by name, and the points that are due of 15
    "an answer was split into three": 15.0,
    "all answers stand in one cell at the end": 15.0,
    "the file is utf16 without a mark": 15.0,
    "the template conflicts with the answer": 15.0,
    "it is a script without marks": 15.0,
    "jupyter made a copy": 15.0,
    "the notebook is a link": 0.0,
    "the notebook is a pipe": 0.0,
    "nothing was handed in": 0.0,
}


def test_damaged_submissions_go_through_the_whole_of_grade_class(
    course_root: Path, toy: Lab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROBOTBRAIN_TIME_SCALE", "10")  # the toy's tests have a second, and the machine may be busy
    submitted = tmp_path / "submitted"
    submitted.mkdir()
    students = {}
    for number, name in enumerate(CLASS):
        one = next(d for d in DAMAGES if d.name == name)
        damage.suffer(toy, [one], random.Random(name), tmp_path / "made" / str(number))
        student = f"s{number:02d}"
        students[student] = one
        (tmp_path / "made" / str(number) / "amara").rename(submitted / student)
    result = grade_class(
        Course(course_root, course_root), toylab.LAB, submitted=submitted, out=tmp_path / "out", options=Options()
    )
    rows = {row.student: row for row in result.rows}
    due = {s: CLASS[d.name] for s, d in students.items()}
    assert {s: rows[s].earned for s in students} == due, [row.reason() for row in result.rows]
    assert all(d.says in rows[s].reason() for s, d in students.items())
    assert all(rows[s].reason() for s, d in students.items() if not CLASS[d.name])
