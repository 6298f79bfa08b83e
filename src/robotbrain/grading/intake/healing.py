"""Whatever the file is, a notebook comes out that can be graded, with what was repaired."""

from __future__ import annotations

import copy
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from nbformat.notebooknode import NotebookNode, from_dict

from robotbrain.grading.intake import gate
from robotbrain.grading.intake.cells import REPAIRS_ID, Piece, UnreadableError, read
from robotbrain.grading.intake.master import ANSWER, ESSAY, LOCKED, Slot, slots_of
from robotbrain.grading.intake.recognise import recognise, untouched
from robotbrain.grading.intake.restore import restore

MISSING = "no notebook of this name was submitted"
_MOST_REPAIRS = 40
_MOST_CANDIDATES = 12


@dataclass
class Healed:
    """A gradable notebook.

    Attributes:
        repairs: one sentence for each thing that was wrong.
        readable: False where nothing could be read, so that nothing in it is the student's.
        answered: number of answers that are no longer the template.
    """

    notebook: NotebookNode
    repairs: list[str] = field(default_factory=list)
    readable: bool = True
    answered: int = 0


def heal(path: Path, master: NotebookNode) -> Healed:
    """Read the submission at ``path`` and restore what must not differ from ``master``; never raises."""
    data, why = gate.read_notebook(path)
    if data is None:
        return _nothing(master, why or MISSING)
    return heal_bytes(data, master)


def heal_bytes(data: bytes, master: NotebookNode, remarks: Iterable[str] = ()) -> Healed:
    """Like :func:`heal`, for the content of a file. ``remarks`` come before what is repaired here."""
    slots = slots_of(master)
    repairs: list[str] = []
    known = frozenset(n for s in slots for n in (s.label, s.id) if n)
    try:
        pieces = read(data, known, repairs)
    except UnreadableError as error:
        return _nothing(master, f"the notebook file cannot be read: {error}", remarks)
    except Exception as error:  # a way to be damaged that nobody thought of must not stop the grading of a class
        return _nothing(master, f"the notebook file cannot be read ({type(error).__name__}: {error})"[:300], remarks)
    if len(data) >= gate.LARGEST_NOTEBOOK:
        repairs.append(f"the notebook is larger than {gate.LARGEST_NOTEBOOK // 1_000_000} MB; its beginning was read")
    pieces = restore(recognise(pieces, slots, repairs), slots, repairs)
    answers = [p for p in pieces if p.slot is not None and slots[p.slot].what in (ANSWER, ESSAY)]
    answered = sum(not untouched(p.source, slots[p.slot or 0]) for p in answers)
    healed = Healed(_assemble(pieces, slots, master), [*remarks, *dict.fromkeys(repairs)], answered=answered)
    _say(healed)
    return healed


def choose(received: gate.Received, name: str, master: NotebookNode) -> Healed:
    """Heal the notebook ``name`` of a submission, or the file that best stands for it, and say which one it was.

    A file of the right name counts if it can be read and holds an answer. Otherwise a copy (``lab (1).ipynb``), one in
    a folder or archive, a script or page made from it, or the editor's checkpoint does.
    """
    remarks = list(received.refused)
    right = received.files.get(name)
    first = heal_bytes(right, master, remarks) if right is not None else _nothing(master, MISSING, remarks)
    if first.answered:
        return first
    best, best_name = first, name
    for other in _candidates(received, name):
        healed = heal_bytes(received.files[other], master, [*remarks, _instead(other, name, right, first)])
        if healed.answered > best.answered or (healed.readable and not best.readable):
            best, best_name = healed, other
    return best if best_name != name else first


def _instead(other: str, name: str, right: bytes | None, first: Healed) -> str:
    why = "there is none of that name" if right is None else "cannot be read" if not first.readable else "is empty"
    return f"{other} was graded in place of {name}, " + (why if right is None else f"which {why}")


def _candidates(received: gate.Received, name: str) -> list[str]:
    """Files that may hold the notebook, the likeliest first."""
    stem = PurePosixPath(name).stem.casefold()
    ranked = []
    for other in received.files:
        path = PurePosixPath(other)
        own = path.stem.casefold()
        suffix = path.suffix.casefold()
        checkpoint = gate.CHECKPOINTS in path.parts
        alike = re.fullmatch(re.escape(stem) + r"(?:$|[\W_].*|\d+|copy.*|final.*)", own) is not None
        if other == name or (suffix != ".ipynb" and not alike):
            continue
        if suffix not in (".ipynb", ".py", ".html", ".htm", ".json", ".txt", ".gz", ".ipynb~", ".bak", ".zip", ""):
            continue
        rank = (checkpoint, suffix != ".ipynb", not alike, len(path.parts), -received.ages.get(other, 0.0), other)
        ranked.append((rank, other))
    return [other for _, other in sorted(ranked)][:_MOST_CANDIDATES]


def _assemble(pieces: list[Piece], slots: list[Slot], master: NotebookNode) -> NotebookNode:
    seen = {REPAIRS_ID}
    cells = []
    for number, piece in enumerate(pieces):
        cell: dict[str, Any] = {"cell_type": piece.kind, "metadata": {}, "source": piece.source}
        original = master.cells[piece.slot] if piece.slot is not None else None
        if original is not None and slots[piece.slot or 0].label:
            cell["metadata"]["nbgrader"] = copy.deepcopy(original.metadata["nbgrader"])
        if original is not None and slots[piece.slot or 0].what == LOCKED:
            cell["source"] = original.source  # with the hidden tests
        if piece.tags:
            cell["metadata"]["tags"] = list(piece.tags)
        name = original.get("id", "") if original is not None else piece.id
        name = name if name and name not in seen else f"robotbrain-{number}"
        seen.add(name)
        cell["id"] = name
        if piece.kind == "code":
            cell |= {"outputs": [], "execution_count": None}
        elif piece.attachments:
            cell["attachments"] = piece.attachments
        cells.append(cell)
    metadata = copy.deepcopy(dict(master.metadata))  # kernel and language are the course's choice
    notebook: NotebookNode = from_dict({"cells": cells, "metadata": metadata, "nbformat": 4, "nbformat_minor": 5})
    return notebook


def _nothing(master: NotebookNode, why: str, remarks: Iterable[str] = ()) -> Healed:
    """The empty lab with the reason on top: every exercise ends "not written", which is an explicit zero."""
    slots = slots_of(master)
    pieces = [Piece(s.kind, s.shown, s.id, s.label, s.tags, slot=s.number) for s in slots]
    healed = Healed(_assemble(pieces, slots, master), [*remarks, why], readable=False)
    _say(healed)
    return healed


def _say(healed: Healed) -> None:
    """Put the repairs where the student's feedback shows them."""
    if len(healed.repairs) > _MOST_REPAIRS:
        more = len(healed.repairs) - _MOST_REPAIRS
        healed.repairs[_MOST_REPAIRS:] = [f"and {more} more repairs of this kind"]
    if healed.repairs:
        text = "**Before grading:**\n\n" + "\n".join(f"- {r}" for r in healed.repairs)
        cell = {"cell_type": "markdown", "id": REPAIRS_ID, "metadata": {}, "source": text}
        healed.notebook.cells.insert(0, from_dict(cell))
