from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest
from nbgrader.utils import compute_checksum

from robotbrain.grading import intake
from tests.grading import toylab

IDS = ["setup", "scale", "score-scale", "total", "score-total", "mean", "score-mean"]


@pytest.fixture(scope="module")
def master(course_root: Path) -> Any:
    return intake.master_of(course_root / "solutions" / "toy" / "toy.ipynb")


def heal(tmp_path: Path, master: Any, content: Any) -> intake.Healed:
    path = tmp_path / "toy.ipynb"
    data = content if isinstance(content, (str, bytes)) else json.dumps(content)
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    return intake.heal(path, master)


def ids(healed: intake.Healed) -> list[str]:
    return [name for c in healed.notebook.cells if (name := intake.grade_id(c))]


def test_the_master_keeps_hidden_tests_and_no_solution(master: Any) -> None:
    text = json.dumps(master)
    assert "hidden=True" in text
    assert "2 * x" not in text
    assert all(compute_checksum(c) == c.metadata["nbgrader"]["checksum"] for c in master.cells if intake.grade_id(c))


def test_an_undamaged_submission_needs_no_repair(tmp_path: Path, master: Any) -> None:
    healed = heal(tmp_path, master, toylab.solved())
    assert healed.repairs == []
    assert ids(healed) == IDS
    by_id = {intake.grade_id(c): c for c in healed.notebook.cells}
    assert "hidden=True" in by_id["score-mean"].source
    assert by_id["scale"].source == toylab.SOLUTIONS["scale"]


@pytest.mark.parametrize("victim", IDS)
def test_a_deleted_cell_comes_back_in_its_place(tmp_path: Path, master: Any, victim: str) -> None:
    notebook = toylab.solved()
    notebook.cells = [c for c in notebook.cells if intake.grade_id(c) != victim]
    healed = heal(tmp_path, master, notebook)
    assert ids(healed) == IDS
    assert len(healed.repairs) == 1 and victim in healed.repairs[0]
    assert "2 * x" not in json.dumps(healed.notebook) or victim != "scale"
    assert victim in healed.notebook.cells[0].source  # the student is told on the feedback page


def test_all_cells_deleted_gives_the_empty_lab(tmp_path: Path, master: Any) -> None:
    notebook = toylab.solved()
    notebook.cells = []
    assert ids(heal(tmp_path, master, notebook)) == IDS


def test_tampering_with_tests_points_and_tags_is_undone(tmp_path: Path, master: Any) -> None:
    notebook = toylab.solved()
    for cell in notebook.cells:
        if intake.grade_id(cell) == "score-mean":
            cell.source = "5.0"
            cell.metadata["nbgrader"]["points"] = 500
            cell.metadata["tags"] = ["skip-grading"]
    healed = heal(tmp_path, master, notebook)
    cell = next(c for c in healed.notebook.cells if intake.grade_id(c) == "score-mean")
    assert 'lab.score("mean", hidden=True)' in cell.source
    assert cell.metadata["nbgrader"]["points"] == 5
    assert not cell.metadata.get("tags")


def test_duplicated_and_unlabelled_cells_are_recognised(tmp_path: Path, master: Any) -> None:
    notebook = toylab.solved()
    first = next(c for c in notebook.cells if intake.grade_id(c) == "scale")
    notebook.cells.insert(1, copy.deepcopy(first))
    for cell in notebook.cells:
        if intake.grade_id(cell) in ("mean", "score-mean"):
            del cell.metadata["nbgrader"]  # as some editors do
    healed = heal(tmp_path, master, notebook)
    assert ids(healed) == IDS
    assert len({c["id"] for c in healed.notebook.cells}) == len(healed.notebook.cells)
    assert next(c for c in healed.notebook.cells if intake.grade_id(c) == "mean").source == toylab.SOLUTIONS["mean"]
    assert len(healed.repairs) == 3


def test_a_retyped_cell_becomes_code_again(tmp_path: Path, master: Any) -> None:
    notebook = toylab.solved()
    for cell in notebook.cells:
        if intake.grade_id(cell) == "scale":
            cell.cell_type = "markdown"
            del cell["outputs"], cell["execution_count"]
    healed = heal(tmp_path, master, notebook)
    cell = next(c for c in healed.notebook.cells if intake.grade_id(c) == "scale")
    assert cell.cell_type == "code" and cell.outputs == []


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "empty"),
        (b"{broken", "no list of cells"),
        (b"[1, 2]", "no list of cells"),
        (b'{"cells": 3, "nbformat": 4}', "no list of cells"),
        (b"\xff\xfe\x00", "cannot be read"),
        (b"[" * 100_000, "no list of cells"),
        (b"hello", "not a notebook"),
        (b'{"nbformat": 3, "worksheets": [7]}', "cannot be read"),
    ],
)
def test_unreadable_files_give_the_empty_lab_with_the_reason(
    tmp_path: Path, master: Any, content: bytes, reason: str
) -> None:
    healed = heal(tmp_path, master, content)
    assert not healed.readable
    assert ids(healed) == IDS
    assert reason in healed.repairs[0]
    assert reason in healed.notebook.cells[0].source


def test_odd_but_legible_files_are_read(tmp_path: Path, master: Any) -> None:
    text = json.dumps(toylab.solved())
    assert heal(tmp_path, master, b"\xef\xbb\xbf" + text.encode()).repairs == []
    assert ids(heal(tmp_path, master, text.encode("utf-16"))) == IDS
    raw = json.loads(text)
    raw["cells"] += ["junk", {"cell_type": "weird", "source": ["a", 1]}, {"source": None, "metadata": 3}]
    del raw["metadata"]
    assert ids(heal(tmp_path, master, json.dumps(raw))) == IDS


def test_healing_twice_changes_nothing(tmp_path: Path, master: Any) -> None:
    notebook = toylab.solved()
    del notebook.cells[4]
    once = heal(tmp_path, master, notebook)
    twice = heal(tmp_path, master, once.notebook)
    assert [c.source for c in twice.notebook.cells] == [c.source for c in once.notebook.cells[1:]]
