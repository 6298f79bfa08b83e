"""A course with everything nbgrader's gradebook can hold, and executed submissions made without executing anything."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path

import nbformat
from nbformat.notebooknode import NotebookNode, from_dict
from nbformat.v4 import new_code_cell, new_markdown_cell

from robotbrain.grading import intake
from tests.grading import toylab

CONFIG = """
c.LateSubmissionPlugin.penalty_method = "zero"
c.LimitOutput.max_lines = 5
"""


def make_course(root: Path, config: str = CONFIG) -> Path:
    """The toy course with an essay, a program and a task for a person to grade, and files beside the notebook."""
    toylab.make_course(root)
    path = root / "solutions" / toylab.LAB / f"{toylab.LAB}.ipynb"
    notebook = toylab.source_notebook()
    notebook.cells += [_essay(), _program(), _task()]
    nbformat.write(notebook, path)
    (path.parent / "data").mkdir()
    (path.parent / "data" / "numbers.csv").write_text("1,2\n")
    (path.parent / "given.py").write_text("VALUE = 1\n")
    with (root / "autograder" / "nbgrader_config.py").open("a") as file:
        file.write(config)
    return root


def solved_with_extras() -> NotebookNode:
    """A submission of this course with the right answers, but for those that a person grades."""
    notebook = toylab.solved()
    empty = "# YOUR CODE HERE\nraise NotImplementedError()"
    notebook.cells += [_essay(), _program(), _task()]
    notebook.cells[-2].source = empty
    return notebook


def _cell(cell: NotebookNode, grade_id: str, **fields: object) -> NotebookNode:
    shared = {"grade": False, "solution": False, "locked": False, "task": False, "schema_version": 3}
    cell.metadata["nbgrader"] = {**shared, "grade_id": grade_id, **fields}
    cell["id"] = grade_id
    return cell


def _essay() -> NotebookNode:
    return _cell(new_markdown_cell("Why?"), "essay", grade=True, solution=True, points=3)


def _program() -> NotebookNode:
    source = "### BEGIN SOLUTION\nplot()\n### END SOLUTION"
    return _cell(new_code_cell(source), "program", grade=True, solution=True, points=2)


def _task() -> NotebookNode:
    return _cell(new_markdown_cell("Build a robot."), "task", task=True, locked=True, points=4)


def executed(path: Path, source: Path, results: Mapping[str, object]) -> NotebookNode:
    """The healed submission at ``path`` as a run would leave it.

    Args:
        results: grade id -> the score its cell returned, or a text that it wrote to stderr.
    """
    notebook = copy.deepcopy(intake.heal(path, intake.master_of(source)).notebook)
    for number, cell in enumerate(notebook.cells):
        if cell.cell_type != "code":
            continue
        cell.execution_count = number
        result = results.get(intake.grade_id(cell))
        if isinstance(result, str):
            cell.outputs = [from_dict({"output_type": "stream", "name": "stderr", "text": result})]
        elif result is not None:
            data = {"text/plain": str(result), "text/html": f"<b>{result}</b>"}
            output = {"output_type": "execute_result", "data": data, "metadata": {}, "execution_count": number}
            text = from_dict({"output_type": "stream", "name": "stdout", "text": "line\n" * 9})
            cell.outputs = [text, from_dict(output)]
        elif "score(" in cell.source:
            error = {"output_type": "error", "ename": "ValueError", "evalue": "no", "traceback": ["x"] * 300}
            cell.outputs = [from_dict(error)]
    return notebook
