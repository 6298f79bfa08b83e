"""The instructor's notebook as the gradebook knows it, and what is expected of each of its cells."""

from __future__ import annotations

import functools
import logging
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import nbformat
from nbformat.notebooknode import NotebookNode

from robotbrain.errors import InputError

ANSWER, ESSAY, LOCKED, GIVEN = "answer", "essay", "locked", "given"
SKIP_TAG = "skip-grading"
_HIDDEN = re.compile(r"^[^\n]*### BEGIN HIDDEN TESTS[^\n]*\n.*?^[^\n]*### END HIDDEN TESTS[^\n]*\n?", re.M | re.S)
_DEFINED = re.compile(
    r"^(?:async[ \t]+)?(?:def|class)[ \t]+([^\W\d]\w*)"
    r"|^([^\W\d]\w*(?:[ \t]*,[ \t]*[^\W\d]\w*){0,20})[ \t]*(?::[^=\n]{0,200})?=(?!=)",
    re.M,
)
_NAMES: dict[int, dict[str, frozenset[str]]] = {}  # of the masters below, by id(); those live as long as this module


@dataclass(frozen=True)
class Slot:
    """A cell of the master.

    Attributes:
        what: ``answer`` (code of the student's), ``essay`` (text of the student's, graded by hand), ``locked``
            (a test or other cell that is restored), or ``given`` (anything else).
        shown: its text as the students got it.
        names: what a right answer defines at its top level; empty where that is not known.
    """

    number: int
    what: str
    kind: str
    label: str
    id: str
    shown: str
    names: frozenset[str]
    tags: tuple[str, ...]
    graded: bool

    @property
    def title(self) -> str:
        """What the cell is called in a sentence."""
        return self.label or self.id


def grade_id(cell: NotebookNode) -> str:
    """The nbgrader id of a cell, or ``""``."""
    nbgrader = cell.metadata.get("nbgrader")
    found = nbgrader.get("grade_id", "") if isinstance(nbgrader, dict) else ""
    return found if isinstance(found, str) else ""


def is_graded_kind(cell: NotebookNode) -> bool:
    """Whether a master cell is an autograded test cell."""
    nbgrader = cell.metadata["nbgrader"]
    return bool(nbgrader.get("grade")) and not nbgrader.get("solution")


@functools.cache
def _master(path: Path, changed_ns: int) -> NotebookNode:
    from nbgrader.preprocessors import CheckCellMetadata, ClearOutput, ClearSolutions, ComputeChecksums, LockCells

    notebook = nbformat.read(path, as_version=4)
    names = {label: defined(c.source) for c in notebook.cells if (label := grade_id(c))}
    resources: dict[str, Any] = {}
    for preprocessor in (LockCells, ClearSolutions, ClearOutput, CheckCellMetadata, ComputeChecksums):
        step = preprocessor()
        step.log = logging.getLogger("robotbrain.quiet")
        notebook, resources = step.preprocess(notebook, resources)
    _NAMES[id(notebook)] = names
    return notebook


def master_of(source: Path) -> NotebookNode:
    """The instructor's notebook as the gradebook knows it: solutions cleared, hidden tests kept. Do not modify it."""
    if not source.is_file():
        raise InputError("source notebook", given=str(source), expected="an existing file", fix="Check the lab's name.")
    return _master(source.resolve(), source.stat().st_mtime_ns)


def slots_of(master: NotebookNode) -> list[Slot]:
    """What is expected of each cell, in order."""
    solved = _NAMES.get(id(master), {})
    slots = []
    for number, cell in enumerate(master.cells):
        label = grade_id(cell)
        nbgrader = cell.metadata.get("nbgrader") or {}
        if not label:
            what = GIVEN
        elif nbgrader.get("solution"):
            what = ANSWER if cell.cell_type == "code" else ESSAY
        else:
            what = LOCKED if nbgrader.get("grade") or nbgrader.get("locked") else GIVEN
        shown = _HIDDEN.sub("", cell.source).rstrip("\n") if what == LOCKED else cell.source
        names = (defined(cell.source) or solved.get(label, frozenset())) if what == ANSWER else frozenset()
        tags = tuple(cell.metadata.get("tags", ()))
        graded = what == LOCKED and bool(nbgrader.get("grade"))
        slots.append(Slot(number, what, cell.cell_type, label, cell.get("id", ""), shown, names, tags, graded))
    return slots


def defined(source: str) -> frozenset[str]:
    """The names that code binds at the start of a line: functions, classes, variables. It need not compile."""
    names: set[str] = set()
    for match in _DEFINED.finditer(source):
        found = match.group(1) or match.group(2)
        names.update(n.strip() for n in found.split(","))
    return frozenset(names)
