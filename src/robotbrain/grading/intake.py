"""Reading what students hand in: whatever the file is, a notebook comes out that can be graded, with what was repaired.

Locked and graded cells are restored from the instructor's *master* (the source without its solutions but with the
hidden tests); cells are recognised by grade id, else by cell id, else by text.
"""

from __future__ import annotations

import copy
import functools
import json
import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import nbformat
from nbformat.notebooknode import NotebookNode, from_dict
from nbgrader.preprocessors import CheckCellMetadata, ClearOutput, ClearSolutions, ComputeChecksums, LockCells

from robotbrain.errors import InputError

_LARGEST_BYTES = 50_000_000
_MISSING = "no notebook of this name was submitted"
_REPAIRS_ID = "robotbrain-repairs"


@dataclass
class Healed:
    """A gradable notebook.

    Attributes:
        repairs: one sentence for each thing that was wrong.
        readable: False where nothing could be read, so that nothing in it is the student's.
    """

    notebook: NotebookNode
    repairs: list[str] = field(default_factory=list)
    readable: bool = True


@functools.cache
def _master(path: Path, changed_ns: int) -> NotebookNode:
    notebook = nbformat.read(path, as_version=4)
    resources: dict[str, Any] = {}
    for preprocessor in (LockCells, ClearSolutions, ClearOutput, CheckCellMetadata, ComputeChecksums):
        step = preprocessor()
        step.log = logging.getLogger("robotbrain.quiet")
        notebook, resources = step.preprocess(notebook, resources)
    return notebook


def master_of(source: Path) -> NotebookNode:
    """The instructor's notebook as the gradebook knows it: solutions cleared, hidden tests kept. Do not modify it."""
    if not source.is_file():
        raise InputError("source notebook", given=str(source), expected="an existing file", fix="Check the lab's name.")
    return _master(source.resolve(), source.stat().st_mtime_ns)


def heal(path: Path, master: NotebookNode) -> Healed:
    """Read the submission at ``path`` and restore what must not differ from ``master``; never raises."""
    if not path.is_file():
        return _nothing(master, _MISSING)
    try:
        cells, marked_missing = _read_cells(path)
    except Exception as error:
        return _nothing(master, f"the notebook file cannot be read ({error})")
    if marked_missing:
        return _nothing(master, _MISSING)
    healed = Healed(NotebookNode())
    _recognise(cells, master, healed)
    cells = _restore(cells, master, healed)
    healed.notebook = _assemble(cells, master)
    _say(healed)
    return healed


def placeholder(master: NotebookNode) -> NotebookNode:
    """The notebook that stands for one that was not submitted: nbgrader passes over students without a file."""
    notebook = _nothing(master, _MISSING).notebook
    notebook.metadata["robotbrain"] = {"missing": True}
    return notebook


def _read_cells(path: Path) -> tuple[list[NotebookNode], bool]:
    """The cells of a submission, and whether it is a :func:`placeholder`."""
    if path.stat().st_size > _LARGEST_BYTES:
        raise ValueError(f"it is larger than {_LARGEST_BYTES // 1_000_000} MB")
    data = path.read_bytes()
    if not data.strip():
        raise ValueError("it is empty")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "latin-1")
    try:
        raw = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"it is not a notebook: {error}") from None
    if not isinstance(raw, dict) or not isinstance(raw.get("cells", raw.get("worksheets")), list):
        raise ValueError("it holds no list of cells")
    if raw.get("nbformat") != 4:
        raw = nbformat.convert(nbformat.from_dict(raw), 4)
    metadata = raw.get("metadata")
    ours = metadata.get("robotbrain") if isinstance(metadata, dict) else None
    cells = [_clean_cell(c) for c in raw["cells"] if isinstance(c, dict) and c.get("id") != _REPAIRS_ID]
    return cells, isinstance(ours, dict) and bool(ours.get("missing"))


def _clean_cell(raw: dict[str, Any]) -> NotebookNode:
    """A valid cell without outputs out of anything that resembles one."""
    kind = raw.get("cell_type") if raw.get("cell_type") in ("code", "markdown", "raw") else "markdown"
    source = raw.get("source", "")
    source = "".join(map(str, source)) if isinstance(source, list) else str(source)
    metadata = raw.get("metadata") if isinstance(raw.get("metadata"), dict) else {}
    cell: dict[str, Any] = {"cell_type": kind, "source": source, "metadata": copy.deepcopy(metadata)}
    if isinstance(raw.get("id"), str):
        cell["id"] = raw["id"]
    return from_dict(_as_kind(cell, str(kind)))


def _as_kind(cell: dict[str, Any], kind: str) -> dict[str, Any]:
    cell["cell_type"] = kind
    if kind == "code":
        cell["outputs"], cell["execution_count"] = [], None
    else:
        cell.pop("outputs", None)
        cell.pop("execution_count", None)
    return cell


def grade_id(cell: NotebookNode) -> str:
    """The nbgrader id of a cell, or ``""``."""
    nbgrader = cell.metadata.get("nbgrader")
    found = nbgrader.get("grade_id", "") if isinstance(nbgrader, dict) else ""
    return found if isinstance(found, str) else ""


def _masters(master: NotebookNode) -> dict[str, NotebookNode]:
    return {grade_id(c): c for c in master.cells if grade_id(c)}


def _recognise(cells: list[NotebookNode], master: NotebookNode, healed: Healed) -> None:
    """Leave each grade id on at most one cell, and give lost ids back to the cells they belong to."""
    known = _masters(master)
    taken: set[str] = set()
    for cell in reversed(cells):  # the later copy of a duplicated cell is the one the student sees run last
        name = grade_id(cell)
        if name in known and name not in taken:
            taken.add(name)
        else:
            if name in taken:
                healed.repairs.append(f"the cell {name} occurred twice; the last one counts")
            cell.metadata.pop("nbgrader", None)
    for name, original in known.items():
        if name in taken:
            continue
        unnamed = [c for c in cells if not grade_id(c)]
        match = next((c for c in unnamed if c.get("id") and c.get("id") == original.get("id")), None) or next(
            (c for c in unnamed if c.source.strip() and c.source.strip() == original.source.strip()), None
        )
        if match is not None:
            match.metadata["nbgrader"] = copy.deepcopy(original.metadata["nbgrader"])
            healed.repairs.append(f"the cell {name} had lost its grading label")


def _is_locked(cell: NotebookNode) -> bool:
    nbgrader = cell.metadata["nbgrader"]
    return not nbgrader.get("solution") and bool(nbgrader.get("grade") or nbgrader.get("locked"))


def _restore(cells: list[NotebookNode], master: NotebookNode, healed: Healed) -> list[NotebookNode]:
    known = _masters(master)
    for cell in cells:
        name = grade_id(cell)
        if not name:
            continue
        original = known[name]
        cell.metadata["nbgrader"] = copy.deepcopy(original.metadata["nbgrader"])
        if "tags" in original.metadata or "tags" in cell.metadata:
            cell.metadata["tags"] = list(original.metadata.get("tags", []))
        if cell.cell_type != original.cell_type:
            healed.repairs.append(f"the cell {name} had become a {cell.cell_type} cell")
            _as_kind(cell, original.cell_type)
        if _is_locked(original) and cell.source != original.source:
            # The released text lacks the hidden tests, so a difference here is usually no one's doing.
            cell.source = original.source
    order = [grade_id(c) for c in master.cells if grade_id(c)]
    for position, name in enumerate(order):
        present = {grade_id(c): i for i, c in enumerate(cells) if grade_id(c)}
        if name in present:
            continue
        before = next((present[p] for p in reversed(order[:position]) if p in present), -1)
        cells.insert(before + 1, copy.deepcopy(known[name]))
        kind = "test" if is_graded_kind(known[name]) else "answer" if not _is_locked(known[name]) else "given"
        healed.repairs.append(f"the {kind} cell {name} was missing and has been put back")
    return cells


def is_graded_kind(cell: NotebookNode) -> bool:
    """Whether a master cell is an autograded test cell."""
    nbgrader = cell.metadata["nbgrader"]
    return bool(nbgrader.get("grade")) and not nbgrader.get("solution")


def _assemble(cells: list[NotebookNode], master: NotebookNode) -> NotebookNode:
    notebook = from_dict({"cells": [], "metadata": {}, "nbformat": 4, "nbformat_minor": 5})
    notebook.metadata = copy.deepcopy(master.metadata)  # kernel and language are the course's choice
    seen: set[str] = set()
    for number, cell in enumerate(cells):
        if not cell.get("id") or cell["id"] in seen:
            cell["id"] = f"robotbrain-{number}"
        seen.add(cell["id"])
        _as_kind(cell, cell.cell_type)
    notebook.cells = cells
    return notebook


def _nothing(master: NotebookNode, why: str) -> Healed:
    """The empty lab with the reason on top: every exercise ends "not written", which is an explicit zero."""
    notebook = _assemble([copy.deepcopy(c) for c in master.cells], master)
    healed = Healed(notebook, [why], readable=False)
    _say(healed)
    return healed


def _say(healed: Healed) -> None:
    """Put the repairs where the student's feedback shows them."""
    if healed.repairs:
        text = "**Before grading:**\n\n" + "\n".join(f"- {r}" for r in healed.repairs)
        cell = {"cell_type": "markdown", "id": _REPAIRS_ID, "metadata": {}, "source": text}
        healed.notebook.cells.insert(0, from_dict(cell))
