"""The notebook file edited: locked cells, labels, points, tags, outputs, kernels."""

from __future__ import annotations

import copy
from collections.abc import Callable

from nbformat.notebooknode import NotebookNode, from_dict
from nbformat.v4 import new_code_cell, new_output

from tests.grading.attacks.attack import ALL_WRONG, Attack

KIND = "notebook file"
Edit = Callable[[NotebookNode], NotebookNode]


def _named(notebook: NotebookNode, name: str) -> NotebookNode:
    return next(c for c in notebook.cells if c.metadata.get("nbgrader", {}).get("grade_id") == name)


def _graded(notebook: NotebookNode) -> list[NotebookNode]:
    return [c for c in notebook.cells if c.metadata.get("nbgrader", {}).get("grade")]


def _each_graded(change: Callable[[NotebookNode], None]) -> Edit:
    def edit(notebook: NotebookNode) -> NotebookNode:
        for cell in _graded(notebook):
            change(cell)
        return notebook

    return edit


def _label(**fields: object) -> Callable[[NotebookNode], None]:
    return lambda cell: cell.metadata["nbgrader"].update(fields)


def _source(text: str) -> Callable[[NotebookNode], None]:
    return lambda cell: cell.update(source=text)


def _tags(*tags: str) -> Callable[[NotebookNode], None]:
    return lambda cell: cell.metadata.update(tags=list(tags))


def _outputs(cell: NotebookNode) -> None:
    cell.outputs = [new_output("execute_result", data={"text/plain": "99.0"}, execution_count=1)]


def _every_answer_tagged(*tags: str) -> Edit:
    def edit(notebook: NotebookNode) -> NotebookNode:
        for cell in notebook.cells:
            if cell.cell_type == "code":
                cell.metadata.tags = list(tags)
        return notebook

    return edit


def _extra_graded(name: str, points: float, source: str, **fields: object) -> Edit:
    def edit(notebook: NotebookNode) -> NotebookNode:
        cell = new_code_cell(source)
        cell.metadata["nbgrader"] = {"grade": True, "solution": False, "locked": True, "task": False,
                                     "schema_version": 3, "points": points, "grade_id": name, **fields}  # fmt: skip
        notebook.cells.append(cell)
        return notebook

    return edit


def _duplicate(name: str, source: str) -> Edit:
    def edit(notebook: NotebookNode) -> NotebookNode:
        for position in (0, len(notebook.cells) + 1):
            cell = copy.deepcopy(_named(notebook, name))
            cell.source = source
            cell["id"] = f"twin-{position}"
            notebook.cells.insert(position, cell)
        return notebook

    return edit


def _same_id(notebook: NotebookNode) -> NotebookNode:
    for cell in _graded(notebook):
        twin = new_code_cell("4.0")
        twin["id"] = cell["id"]
        notebook.cells.insert(0, twin)
        del cell.metadata["nbgrader"]
    return notebook


def _kernel(notebook: NotebookNode) -> NotebookNode:
    notebook.metadata.kernelspec = {"name": "bash", "display_name": "x", "language": "bash"}
    notebook.metadata.language_info = {"name": "bash", "file_extension": "/../../x", "nbconvert_exporter": "os.system"}
    notebook.metadata.robotbrain = {"incidents": [], "seconds": 0, "missing": False, "sound": True}
    notebook.metadata.nbgrader = {"points": 999}
    return notebook


def _moved(notebook: NotebookNode) -> NotebookNode:
    notebook.cells = [*_graded(notebook), *(c for c in notebook.cells if c not in _graded(notebook))]
    return notebook


def _swapped_labels(notebook: NotebookNode) -> NotebookNode:
    """Right and wrong answers exchange their labels, and so do their tests."""
    a, b = _named(notebook, "scale"), _named(notebook, "total")
    a.metadata.nbgrader.grade_id, b.metadata.nbgrader.grade_id = "score-scale", "score-total"
    return notebook


def _other_type(kind: str) -> Callable[[NotebookNode], None]:
    def change(cell: NotebookNode) -> None:
        cell["cell_type"] = kind
        cell.pop("outputs", None)
        cell.pop("execution_count", None)

    return change


def _manual(cell: NotebookNode) -> None:
    cell.metadata["nbgrader"].update(solution=True, locked=False, task=False)


def _setup(source: str) -> Edit:
    def edit(notebook: NotebookNode) -> NotebookNode:
        _named(notebook, "setup").source = source
        return notebook

    return edit


def _huge(notebook: NotebookNode) -> NotebookNode:
    notebook.metadata["deep"] = from_dict({"a": 1})
    here = notebook.metadata
    for _ in range(200):
        here["d"] = from_dict({})
        here = here["d"]
    notebook.cells[0].source = "x" * 3_000_000
    return notebook


def _attachments(notebook: NotebookNode) -> NotebookNode:
    notebook.cells[0].attachments = {"a.png": {"text/html": "<script>alert(1)</script>"}}
    return notebook


def _surrogates(notebook: NotebookNode) -> NotebookNode:
    notebook.cells[0].source = "\ud800 half a character"
    _named(notebook, "scale").source = "scale = '\ud800\x00\x1b'\nprint('\\ud800', scale)\nraise ValueError('\\ud800')"
    notebook.metadata["title"] = "\ud800"
    return notebook


_MINE = "class L:\n    score = check = lambda self, name, hidden=False: 4.0\nlab = L()"
_EDITS: dict[str, Edit] = {
    "test cells that return a number": _each_graded(_source("4.0")),
    "test cells that pass": _each_graded(_source("assert True")),
    "empty test cells": _each_graded(_source("")),
    "commented test cells": _each_graded(lambda c: c.update(source="# " + c.source)),
    "more points": _each_graded(_label(points=99)),
    "negative points": _each_graded(_label(points=-5)),
    "unlocked tests": _each_graded(_label(locked=False)),
    "tests that are answers": _each_graded(_manual),
    "tests that are tasks": _each_graded(_label(task=True, grade=True)),
    "another schema": _each_graded(_label(schema_version=99, checksum="0")),
    "skipped tests": _each_graded(_tags("skip-grading")),
    "skipped by nbclient's tag": _each_graded(_tags("skip-execution", "raises-exception", "remove-cell")),
    "tests in the student's process": _each_graded(_tags("student-process")),
    "tests with outputs from home": _each_graded(_outputs),
    "tests as markdown": _each_graded(_other_type("markdown")),
    "tests as raw text": _each_graded(_other_type("raw")),
    "frozen tests": _each_graded(lambda c: c.metadata.update(editable=False, deletable=False, frozen=True)),
    "every cell skipped": _every_answer_tagged("skip-grading"),
    "every cell in the student's process": _every_answer_tagged("student-process"),
    "a graded cell of one's own": _extra_graded("bonus", 50, "50.0"),
    "a manual cell of one's own": _extra_graded("essay", 50, "x", solution=True),
    "a graded cell with somebody's id": _extra_graded("score-scale", 50, "50.0"),
    "a graded cell with a label of odd types": _extra_graded("bonus", "50", "50.0", grade="yes"),  # type: ignore[arg-type]
    "tests twice": _duplicate("score-scale", "4.0"),
    "the setup twice": _duplicate("setup", _MINE),
    "own cells with the ids of the tests": _same_id,
    "another kernel": _kernel,
    "tests first": _moved,
    "labels exchanged": _swapped_labels,
    "another setup": _setup(_MINE),
    "deep metadata, long text": _huge,
    "attachments": _attachments,
    "halves of characters": _surrogates,
}


def attacks() -> list[Attack]:
    """All attacks of this class."""
    return [Attack(f"notebook with {name}", KIND, edit=edit, wrong=ALL_WRONG) for name, edit in _EDITS.items()]
