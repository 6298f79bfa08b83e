"""A small lab in a temporary course folder, with the layout of the real one."""

from __future__ import annotations

import copy
import json
import shutil
import textwrap
from pathlib import Path
from typing import Any

import nbformat
from nbformat.notebooknode import NotebookNode
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook

LAB = "toy"
REPOSITORY = Path(__file__).resolve().parents[2]

VISIBLE = """
from robotbrain.grading import Suite, expect, expect_close

suite = Suite("toy")
suite.exercise("scale", title="Scale", points=4)
suite.exercise("total", title="Total", points=6, upstream=("scale",))
suite.exercise("mean", title="Mean", points=5)
suite.hint("square-not-double", "Doubling is multiplying by two, not squaring.")
suite.hint("off-by-one", "Is the last element part of the sum?")
suite.hint("empty-mean", "What is the mean of no numbers? Read the docstring.")
suite.reference("scale", lambda: lambda x: 2 * x)


@suite.test("scale", points=2, name="doubles a number", hint="square-not-double", reread="Part 1",
            success="3 becomes 6", time_limit_s=1.0)
def doubles(student):
    expect_close(student.scale(3.0), 6.0, given="x = 3.0", hint="square-not-double")


@suite.test("total", points=4, hint="off-by-one", time_limit_s=1.0)
def totals(student):
    got = student.total([1.0, 2.0, 3.0])
    expect(got == 12.0, got=got, expected=12.0, given=[1.0, 2.0, 3.0], misconception="one element is left out")


@suite.test("mean", points=3, name="mean of some numbers", time_limit_s=1.0)
def some(student):
    expect_close(student.mean([1.0, 3.0]), 2.0, given=[1.0, 3.0])
"""

HIDDEN = """
from robotbrain.grading import Suite, expect_close

suite = Suite.extending("toy")


@suite.test("scale", points=2, name="doubles other numbers", hint="square-not-double", time_limit_s=1.0)
def secret_doubles(student):
    expect_close(student.scale(-41.5), -83.0, given="SECRET x = -41.5", misconception="SECRET sign")


@suite.test("total", points=2, name="total of other lists", hint="off-by-one", time_limit_s=1.0)
def secret_total(student):
    expect_close(student.total([5.0, 77.25]), 164.5, given="SECRET [5.0, 77.25]")


@suite.test("mean", points=2, name="mean of nothing", hint="empty-mean", time_limit_s=1.0)
def nothing(student):
    expect_close(student.mean([]), 0.0, given="SECRET []")
"""

SOLUTIONS = {
    "scale": "def scale(x):\n    return 2 * x",
    "total": "def total(values):\n    return sum(scale(v) for v in values)",
    "mean": "def mean(values):\n    return sum(values) / len(values) if values else 0.0",
}

MUTANTS = """
from robotbrain.grading.sample import Mutant, Style

MUTANTS = [
    Mutant(
        name="squares",
        exercise="scale",
        hint="square-not-double",
        describe="squares instead of doubling",
        replace={"scale": [("2 * x", "x ** 2")]},
    ),
    Mutant(
        name="mean-of-nothing",
        exercise="mean",
        hint="empty-mean",
        loses=2,
        describe="divides by zero for an empty list",
        replace={"mean": "def mean(values):\\n    return sum(values) / len(values)"},
    ),
]
STYLES = [
    Style(name="one-line", replace={"total": "total = lambda values: float(sum(map(scale, values)))"}),
]
"""


def _solution(name: str) -> str:
    head, *body = SOLUTIONS[name].splitlines()
    return "\n".join([head, "    ### BEGIN SOLUTION", *body, "    ### END SOLUTION"])


def source_notebook() -> NotebookNode:
    """The instructor's notebook of the toy lab."""
    cells = [
        new_markdown_cell("# Toy lab"),
        _cell("setup", "from robotbrain.grading import Lab\nlab = Lab('toy')", locked=True),
    ]
    for name, points in (("scale", 4), ("total", 6), ("mean", 5)):
        cells.append(_cell(name, _solution(name), solution=True))
        cells.append(
            _cell(
                f"score-{name}",
                f'lab.score("{name}")\n### BEGIN HIDDEN TESTS\nlab.score("{name}", hidden=True)\n### END HIDDEN TESTS',
                grade=True,
                locked=True,
                points=points,
            )
        )
    for number, cell in enumerate(cells):
        cell["id"] = f"toy-{number}"
    training = new_code_cell("raise RuntimeError('training must not run while grading')")
    training.metadata["tags"] = ["skip-grading"]
    training["id"] = "toy-training"
    cells.append(training)
    notebook = new_notebook(cells=cells)
    notebook.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
    return notebook


def _cell(grade_id: str, source: str, **fields: Any) -> NotebookNode:
    cell = new_code_cell(source)
    cell.metadata["nbgrader"] = {
        "grade": False,
        "solution": False,
        "locked": False,
        "task": False,
        "schema_version": 3,
        "grade_id": grade_id,
        **fields,
    }
    return cell


def make_course(root: Path) -> Path:
    """Write the toy course below ``root`` and return ``root``."""
    (root / "solutions" / LAB).mkdir(parents=True)
    (root / "labs").mkdir()
    nbformat.write(source_notebook(), root / "solutions" / LAB / f"{LAB}.ipynb")
    autograder = root / "autograder"
    (autograder / "hidden").mkdir(parents=True)
    (autograder / "hidden" / f"{LAB}.py").write_text(HIDDEN)
    (autograder / "mutants" / LAB).mkdir(parents=True)
    (autograder / "mutants" / LAB / "mutants.py").write_text(MUTANTS)
    shutil.copy(REPOSITORY / "autograder" / "nbgrader_config.py", autograder)
    (root / "suites").mkdir()
    (root / "suites" / f"{LAB}.py").write_text(VISIBLE)
    return root


def solved(**answers: str) -> NotebookNode:
    """A submission: the solution notebook's answers, or ``answers`` by grade id, and the released test cells."""
    notebook = copy.deepcopy(source_notebook())
    for cell in notebook.cells:
        grade_id = cell.metadata.get("nbgrader", {}).get("grade_id")
        if grade_id in SOLUTIONS:
            cell.source = textwrap.dedent(answers.get(grade_id, SOLUTIONS[grade_id]))
        elif grade_id and grade_id.startswith("score-"):
            cell.source = cell.source.splitlines()[0]
    return notebook


def submit(root: Path, student: str, notebook: NotebookNode | str | None) -> Path:
    """Put a submission (a notebook, raw text, or nothing) into ``root/<student>/toy``."""
    folder = root / student / LAB
    folder.mkdir(parents=True)
    if notebook is not None:
        text = notebook if isinstance(notebook, str) else json.dumps(notebook)
        (folder / f"{LAB}.ipynb").write_text(text)
    return folder
