"""The cells in a submitted file, whatever kind of file it is."""

from __future__ import annotations

import html
import itertools
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from robotbrain.grading.intake import tolerant
from robotbrain.grading.intake.master import defined
from robotbrain.grading.intake.text import conflict_sides, decode, scrubbed

REPAIRS_ID = "robotbrain-repairs"
MOST_CELLS = 2000
LONGEST_SOURCE = 400_000  # characters of one cell
_LONGEST_TOTAL = 8_000_000
_LARGEST_ATTACHMENTS = 5_000_000
_KINDS = ("code", "markdown", "raw")
_CELL_MARK = re.compile(r"^# ?(?:%%|In ?\[[\d ]*\]:)(.*)$", re.M)
_PYTHON = re.compile(r"^(?:def|class|import|from|async def|@\w)", re.M)
_HTML_INPUT = re.compile(r'class="[^"<>]{0,200}?(?:jp-InputArea-editor|input_area)[^"<>]{0,200}"')
_CELL_KEYS = frozenset({"cell_type", "source", "input"})


class UnreadableError(ValueError):
    """Nothing of a student's can be read from a file; the message says why."""


@dataclass(eq=False)
class Piece:
    """A cell of a submission.

    Attributes:
        label: its nbgrader id, or ``""``.
        slot: number of the master's cell that it stands for, once that is known.
    """

    kind: str
    source: str
    id: str = ""
    label: str = ""
    tags: tuple[str, ...] = ()
    attachments: dict[str, Any] | None = None
    slot: int | None = None
    _named: tuple[str, frozenset[str]] | None = None

    @property
    def names(self) -> frozenset[str]:
        """What its code binds at the top level."""
        if self._named is None or self._named[0] is not self.source:
            self._named = self.source, defined(self.source)
        return self._named[1]


def read(data: bytes, known: frozenset[str], repairs: list[str]) -> list[Piece]:
    """Read the cells in ``data``; raises :class:`UnreadableError` where there are none.

    Args:
        known: grade and cell ids of the lab; cells with these are kept where there are too many.
        repairs: gets a sentence for each thing that was wrong with the file.
    """
    if not data.strip(b"\0 \t\r\n\xef\xbb\xbf"):
        raise UnreadableError("it is empty")
    noted: list[str] = []
    text = decode(data, noted)
    versions = conflict_sides(text)
    if len(versions) > 1:
        noted.append("the file held an unsolved git conflict; of both versions the one with answers counts")
    raw: list[Any] = []
    for version in versions:
        raw += _raw_cells(version, noted)
    pieces = list(_bounded(raw, known, noted))
    repairs += dict.fromkeys(noted)
    return pieces


def _raw_cells(text: str, repairs: list[str]) -> list[Any]:
    head = text[:2000].lstrip().lower()
    if not head:
        raise UnreadableError("it is empty")
    if head.startswith("version https://git-lfs"):
        raise UnreadableError("it is a Git LFS pointer, not the notebook itself")
    if head.startswith(("<!doctype", "<html", "<?xml")):
        return _from_html(text, repairs)
    if head.startswith('"{') and (inner := _notebook_in(_quoted(text))) is not None:
        return _listed(inner)
    if head[:1] not in "{[" and '"cells"' not in text and '"cell_type"' not in text:
        return _from_script(text, repairs)
    cells: list[Any] = []
    listed = False
    for value in tolerant.loads(text, repairs):
        found = _notebook_in(value)
        if found is not None:
            listed = True
            cells += _listed(found)
    if not listed:
        kind = "it is not a notebook" if head[:1] not in "{[" else "it holds no list of cells"
        raise UnreadableError(kind)
    return cells


def _quoted(text: str) -> Any:
    """The JSON text inside a JSON text."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


def _notebook_in(value: Any, depth: int = 0) -> dict[str, Any] | None:
    """The notebook in a JSON value: itself, wrapped in something, a text that holds it, or a bare list of cells."""
    if isinstance(value, str) and depth < 3 and value.lstrip()[:1] == "{":
        return _notebook_in(_quoted(value), depth + 1)
    if isinstance(value, list):
        cells = [c for c in value if isinstance(c, dict) and _CELL_KEYS & c.keys()]
        return {"cells": value} if cells else None
    if not isinstance(value, dict):
        return None
    if isinstance(value.get("cells"), (list, dict)) or _sheets(value):
        return value
    if "cell_type" in value and "source" in value:
        return {"cells": [value]}
    inner = (_notebook_in(v, depth + 1) for v in list(value.values())[:20]) if depth < 3 else iter(())
    return next((n for n in inner if n is not None), None)


def _listed(notebook: Mapping[str, Any]) -> list[Any]:
    cells = notebook.get("cells")
    if isinstance(cells, dict):
        return list(cells.values())
    if isinstance(cells, list):
        return cells
    return [c for sheet in _sheets(notebook) for c in sheet["cells"]]


def _sheets(notebook: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Where nbformat 2 and 3 have their cells."""
    sheets = notebook.get("worksheets")
    found = sheets if isinstance(sheets, list) else []
    return [s for s in found if isinstance(s, dict) and isinstance(s.get("cells"), list)]


def _bounded(raw: list[Any], known: frozenset[str], repairs: list[str]) -> Iterator[Piece]:
    """The cells that are looked at: all that belong to the lab, and of the others as many as a person writes."""
    total = others = 0
    left_out = 0
    for cell in _flat(raw):
        piece = None
        if others < MOST_CELLS or _names(cell) & known:
            piece = _piece(cell)
            others += not ({piece.label, piece.id} & known)
        if piece is None:
            left_out += 1
            continue
        own = bool({piece.label, piece.id} & known)
        if len(piece.source) > LONGEST_SOURCE or (total + len(piece.source) > _LONGEST_TOTAL and not own):
            name = f"the cell {piece.label}" if piece.label in known else "a cell"
            repairs.append(f"the text of {name} was left out: {len(piece.source):,} characters are too many")
            piece.source = ""
        total += len(piece.source)
        if piece.id != REPAIRS_ID:
            yield piece
    if left_out:
        repairs.append(f"the notebook has {left_out:,} cells too many; those were left out")


def _flat(raw: list[Any]) -> Iterator[dict[str, Any]]:
    """Cells in order, with those that slipped into another cell because a bracket was lost."""
    todo = list(reversed(raw))
    while todo:
        cell = todo.pop()
        if not isinstance(cell, dict):
            continue
        lost = [v for v in cell.values() if isinstance(v, dict) and "cell_type" in v]
        lists = [v for k, v in cell.items() if isinstance(v, list) and k != "outputs"]
        lost += [v for part in lists for v in part[:5000] if isinstance(v, dict) and "cell_type" in v]
        todo += reversed(lost)
        yield cell


def _names(cell: Mapping[str, Any]) -> set[str]:
    return {n for n in (cell.get("id"), _label(cell.get("metadata"))) if isinstance(n, str)}


def _label(metadata: Any) -> str:
    nbgrader = metadata.get("nbgrader") if isinstance(metadata, dict) else None
    label = nbgrader.get("grade_id") if isinstance(nbgrader, dict) else None
    return label if isinstance(label, str) else ""


def _piece(cell: Mapping[str, Any]) -> Piece:
    kind = cell.get("cell_type")
    source = _text(cell.get("source", cell.get("input")))
    if kind == "heading":  # nbformat 3
        level = cell.get("level")
        source = f"{'#' * (level if isinstance(level, int) and 0 < level < 7 else 1)} {source}"
    metadata = cell.get("metadata")
    tags = metadata.get("tags") if isinstance(metadata, dict) else None
    name = cell.get("id")
    return Piece(
        str(kind) if kind in _KINDS else "markdown" if kind is not None else "code",
        scrubbed(source),
        name if isinstance(name, str) and re.fullmatch(r"[\w-]{1,64}", name, re.ASCII) else "",
        _label(metadata),
        tuple(t for t in tags[:20] if isinstance(t, str)) if isinstance(tags, list) else (),
        _attachments(cell.get("attachments")),
    )


def _text(value: Any) -> str:
    """The source of a cell out of whatever stands in its place."""
    if isinstance(value, str):
        return value
    if isinstance(value, dict):
        return "" if "cell_type" in value else "\n".join(v for v in value.values() if isinstance(v, str))
    if not isinstance(value, list):
        return "" if value is None else str(value)
    lines: list[str] = []
    todo = list(reversed(value))
    while todo:
        item = todo.pop()
        if isinstance(item, list):
            todo += reversed(item)
        elif not isinstance(item, dict):
            lines.append("" if item is None else str(item))
    whole = len(lines) < 2 or any(line.endswith("\n") for line in lines[:-1])
    return ("" if whole else "\n").join(lines)


def _attachments(value: Any) -> dict[str, Any] | None:
    """Pictures pasted into a text; they are part of an essay."""
    if not isinstance(value, dict):
        return None
    sound = {
        name: {k: v for k, v in bundle.items() if isinstance(k, str) and isinstance(v, str)}
        for name, bundle in list(value.items())[:50]
        if isinstance(name, str) and isinstance(bundle, dict)
    }
    size = sum(len(v) for bundle in sound.values() for v in bundle.values())
    return sound if sound and size <= _LARGEST_ATTACHMENTS else None


def _from_script(text: str, repairs: list[str]) -> list[dict[str, Any]]:
    """Cells of a Python file: split at ``# %%`` or ``# In[ ]:``, as editors and nbconvert write them."""
    marks = list(itertools.islice(_CELL_MARK.finditer(text), MOST_CELLS * 2))
    if not marks and not _PYTHON.search(text):
        raise UnreadableError("it is not a notebook")
    repairs.append("the file was a Python script, not a notebook; its cells were found by their content")
    if not marks:
        return [{"cell_type": "code", "source": text}]
    cells: list[dict[str, Any]] = []
    head = text[: marks[0].start()]
    if any(line.strip() and not line.lstrip().startswith("#") for line in head.splitlines()):
        cells.append({"cell_type": "code", "source": head.strip("\n")})
    ends = [m.start() for m in marks[1:]] + [len(text)]
    for mark, end in zip(marks, ends, strict=True):
        body = text[mark.end() : end].strip("\n")
        if "[markdown]" in mark.group(1) or "[md]" in mark.group(1):
            body = "\n".join(re.sub(r"^# ?", "", line) for line in body.splitlines())
            cells.append({"cell_type": "markdown", "source": body})
        else:
            cells.append({"cell_type": "code", "source": body})
    return cells


def _from_html(text: str, repairs: list[str]) -> list[dict[str, Any]]:
    """Cells of a notebook that was exported as a web page."""
    cells: list[dict[str, Any]] = []
    end = 0
    for mark in _HTML_INPUT.finditer(text):
        if mark.start() < end or len(cells) >= MOST_CELLS:
            continue
        start, end = text.find("<pre", mark.end()), text.find("</pre>", mark.end())
        if start < 0 or end < 0:
            break
        if start < end:
            code = re.sub(r"<[^<>]*>", "", text[start : min(end, start + LONGEST_SOURCE)])
            cells.append({"cell_type": "code", "source": html.unescape(code).strip("\n")})
    if not cells:
        raise UnreadableError("it is a web page, not a notebook; download the notebook itself")
    repairs.append("the file was a web page of the notebook; its code was taken from there")
    return cells
