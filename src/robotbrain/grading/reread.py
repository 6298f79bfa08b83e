"""Where to reread: links from a failing check to the cell that explains it.

A test names a heading of its own notebook ("Exercise 2.2, last paragraph"); ``reread.toml`` names headings of lessons
for the exercises of labs. Where these stand in the notebooks is looked up once, by ``python -m
robotbrain.grading.reread_table``, and kept in ``reread.json``: while a student works, the notebook on the disk may be
half-written. Links name a cell's id, which JupyterLab opens and scrolls to, also in another notebook.
"""

from __future__ import annotations

import functools
import json
import posixpath
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

TABLE = Path(__file__).with_name("reread.json")


@dataclass(frozen=True)
class Place:
    """Something to reread: what it is called, and the address relative to the student's notebook."""

    text: str
    href: str


def places(lab: str, exercise: str, reread: str, title: str = "") -> list[Place]:
    """What to reread for a test: a heading of its own notebook first, then lessons; nothing for an unknown lab.

    Args:
        reread: what the test names; without it, the exercise's own heading.
        title: the exercise's, which begins with its number: ``"2.2 A*"``.
    """
    entry = _table().get(lab)
    if entry is None:
        return []
    own = entry["notebook"]
    named = reread or f"Exercise {title.split(' ')[0]}"
    cell = find_heading(entry["headings"], named)
    found = [Place(named, _address(own, own, cell))] if cell or reread else []
    for lesson, heading, path, cell in entry["lessons"].get(exercise, []):
        found.append(Place(f"lesson {lesson}, “{heading}”", _address(own, path, cell)))
    return found


def find_heading(headings: Mapping[str, str], named: str) -> str:
    """The cell of the heading that ``named`` begins with or is, or ``""``: ``"Exercise 2.2, last paragraph"``."""
    while named:
        for heading, cell in headings.items():
            if heading == named or re.match(re.escape(named) + r"[:(. ] ?(?!\d)", heading):
                return cell
        named = named[: max(named.rfind(","), named.rfind(" and "), 0)]
    return ""


def _address(here: str, there: str, cell: str) -> str:
    way = quote(posixpath.relpath(there, posixpath.dirname(here)))
    return f"{way}#cell-id={cell}" if cell else way


@functools.cache
def _table() -> dict[str, Any]:
    table: dict[str, Any] = json.loads(TABLE.read_text(encoding="utf-8"))
    return table
