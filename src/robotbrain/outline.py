"""What the course outline asks for, the cells that teach it, and the page that says so.

``course/outline.toml`` is the data, ``course/OUTLINE.md`` the page. After a change of the data, or of a heading in a
notebook, in the checkout: ``python -c "from robotbrain.outline import write; write()"``. A test compares the two.
"""

from __future__ import annotations

import json
import os
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from robotbrain.errors import InputError
from robotbrain.files import write_text

DATA, PAGE = Path("course/outline.toml"), Path("course/OUTLINE.md")
KINDS = ("heading", "item", "snippet")
_CHANGES = ("the outline says", "today", "since when, who says so, and where it is shown")


@dataclass(frozen=True, slots=True)
class Cell:
    """A cell of a notebook.

    Attributes:
        name: of the notebook, for a reader, e.g. ``"Lesson 3"``.
        path: of the notebook, from the repository's root.
        id: of the cell.
    """

    name: str
    path: Path
    id: str


@dataclass(frozen=True, slots=True)
class Entry:
    """A heading, a list item or a code snippet of the outline.

    Attributes:
        key: for good, whatever becomes of the words.
        kind: one of :data:`KINDS`.
        words: what it is about.
        cells: where it is taught, the most important one first.
        part: whether a new part of the outline begins here.
        planned: path of what is still to come for it; empty where all is there.
    """

    key: str
    kind: str
    words: str
    cells: tuple[Cell, ...]
    part: bool = False
    planned: str = ""


@dataclass(frozen=True, slots=True)
class Change:
    """Something that the outline says and that is not so.

    Attributes:
        key: for good.
        part: of the course that it belongs to.
        said: what the outline says.
        today: what is true.
        since: when it changed.
        sources: (text, address) of who says so; without an address where there is no stable one.
        cells: where the course shows it.
    """

    key: str
    part: str
    said: str
    today: str
    since: str
    sources: tuple[tuple[str, str], ...]
    cells: tuple[Cell, ...]


@dataclass(frozen=True, slots=True)
class Outline:
    """The whole outline, in its order, and what is no longer true in it."""

    entries: tuple[Entry, ...]
    changes: tuple[Change, ...]


def read_outline(path: Path = DATA) -> Outline:
    """Return what a file like ``course/outline.toml`` says.

    Raises:
        InputError: if something in it is missing or cannot be.
    """
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
        known = {short: (str(entry["name"]), Path(entry["path"])) for short, entry in data["notebooks"].items()}
        entries = tuple(_entry(raw, known) for raw in data["entries"])
        changes = tuple(_change(raw, known) for raw in data["changes"])
    except (OSError, tomllib.TOMLDecodeError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            str(path),
            given=f"{type(error).__name__}: {error}",
            expected="notebooks, entries and changes as in course/outline.toml",
            fix="Compare with its neighbours in the file.",
        ) from None
    return Outline(entries, changes)


def _entry(raw: Mapping[str, Any], known: Mapping[str, tuple[str, Path]]) -> Entry:
    if raw["kind"] not in KINDS:
        raise ValueError(f"{raw['key']} is a {raw['kind']}")
    return Entry(**{**raw, "cells": _cells(raw["cells"], known)})


def _change(raw: Mapping[str, Any], known: Mapping[str, tuple[str, Path]]) -> Change:
    sources = tuple((text, *(address or [""])) for text, *address in raw["sources"])
    return Change(**{**raw, "sources": sources, "cells": _cells(raw["cells"], known)})


def _cells(references: Sequence[str], known: Mapping[str, tuple[str, Path]]) -> tuple[Cell, ...]:
    if not references:
        raise ValueError("an entry without a cell")
    return tuple(Cell(*known[short], id) for short, _, id in (reference.partition("#") for reference in references))


def sections(notebook: Path) -> dict[str, str]:
    """Return the heading under which each cell of a notebook stands, by the cell's id."""
    found, heading = {}, ""
    for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
        inside = list(_headings("".join(cell["source"]))) if cell["cell_type"] == "markdown" else []
        # A cell may end with the heading of the exercise that follows; its own text belongs to the section before.
        own = [text for first, level, text in inside if first or level <= 2]
        found[cell["id"]] = own[0] if own else heading
        heading = next((text for _, _, text in reversed(inside) if not text.startswith("Exercise")), heading)
    return found


def _headings(source: str) -> Iterator[tuple[bool, int, str]]:
    """Yield whether it is the first line, the level, and the text of each heading of a Markdown cell."""
    fenced = False
    for number, line in enumerate(source.splitlines()):
        fenced ^= line.startswith("```")
        match = re.match(r"(#+) +(.+)", line)
        if match and not fenced:
            yield number == 0, len(match[1]), re.sub(r" \(\d+ points.*\)$", "", match[2].strip())


def page(outline: Outline, root: Path) -> str:
    """Return the text of ``course/OUTLINE.md``.

    Args:
        outline: what to write down.
        root: of the repository, whose notebooks name their sections.
    """
    used = [one.cells for one in outline.entries] + [one.cells for one in outline.changes]
    titles = {path: sections(root / path) for path in {cell.path for cells in used for cell in cells}}
    taught, changed = [], []
    for entry in outline.entries:
        if entry.part:
            taught += ["", f"### {entry.words}", "", *_head("in the outline", "what it is", "where it is taught")]
        words = f"**{_text(entry.words)}**" if entry.kind == "heading" else _text(entry.words)
        soon = " (More of this is in preparation.)" if entry.planned else ""
        taught.append(_row(words, entry.kind, _links(entry.cells, titles) + soon))
    for part, changes in groupby(outline.changes, key=lambda change: change.part):
        changed += ["", f"### {part}", "", *_head(*_CHANGES)]
        for change in changes:
            proof = (_text(change.since), _sources(change.sources), _links(change.cells, titles))
            changed.append(_row(_text(change.said), _text(change.today), "<br>".join(proof)))
    counts = ", ".join(f"{sum(e.kind == kind for e in outline.entries)} {kind}s" for kind in KINDS)
    taught_lines, changed_lines = "\n".join(taught), "\n".join(changed)
    return f"""# What the outline says, and where it is taught

This course follows an outline: one week of a lecture on robot brains, edge computers and reinforcement learning.
The first part of this page goes through all of it, in its order and in our words, and says where each is taught.
The second part is about what is no longer true in it, or never was.

The outline holds {counts} of code. Links lead to a notebook; after them stand
the section in it and, `like-this`, the id of the cell.

## Where it is taught
{taught_lines}

## What is no longer true
{changed_lines}

*From the start* means that it never was as the outline says. Sources were looked up in November 2026.
"""


def _head(*titles: str) -> list[str]:
    return [_row(*titles), _row(*("---" for _ in titles))]


def _row(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def _links(cells: Sequence[Cell], titles: Mapping[Path, Mapping[str, str]]) -> str:
    """Return links to the notebooks, each with the sections and ids of its cells."""
    found = []
    for path, group in groupby(cells, key=lambda cell: cell.path):
        same = list(group)
        target = Path(os.path.relpath(path, PAGE.parent)).as_posix()
        by_title = groupby(same, key=lambda cell: titles[path][cell.id])
        inside = "; ".join(f"{_text(title)} ({', '.join(f'`{c.id}`' for c in those)})" for title, those in by_title)
        found.append(f"[{same[0].name}]({target}): {inside}")
    return ". ".join(found)


def _sources(sources: Sequence[tuple[str, str]]) -> str:
    return "; ".join(f"[{_text(text)}]({address})" if address else _text(text) for text, address in sources)


def _text(words: str) -> str:
    """Return words that cannot end a cell of a table."""
    return words.replace("|", "\\|")


def write(root: Path | None = None) -> Path:
    """Write ``course/OUTLINE.md`` of a checkout (by default the present folder) and return its path."""
    root = root or Path.cwd()
    return write_text(root / PAGE, page(read_outline(root / DATA), root))
