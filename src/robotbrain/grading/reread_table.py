"""Looks up where headings stand: ``python -m robotbrain.grading.reread_table`` writes ``reread.json``."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from robotbrain.errors import InputError
from robotbrain.files import write_text
from robotbrain.grading.reread import TABLE

CHOSEN = Path(__file__).with_name("reread.toml")
_HEADING = re.compile(r"^(?:#{1,6} +(.+?)\s*$|\*\*(.+?)\.?\*\*)", re.MULTILINE)  # a paragraph's bold beginning, too
_FENCE = re.compile(r"^(```|~~~).*?^\1", re.MULTILINE | re.DOTALL)


def headings_of(notebook: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """The headings of a notebook as a reader sees them, and the ids of their cells."""
    for cell in notebook["cells"]:
        if cell["cell_type"] == "markdown":
            for found in _HEADING.finditer(_FENCE.sub("", "".join(cell["source"]))):
                yield (found[1] or found[2]).replace("`", ""), cell["id"]


def build(root: Path) -> dict[str, Any]:
    """Make the table from the notebooks of the course in ``root``; raises :class:`InputError` for a wrong choice."""
    chosen = tomllib.loads(CHOSEN.read_text(encoding="utf-8"))
    lessons = {path.name[:2]: path for path in sorted((root / "course").glob("[0-9][0-9]_*.ipynb"))}
    headings = {number: dict(headings_of(_read(path))) for number, path in lessons.items()}
    table = {
        f"lesson_{number}": _entry(root, path, headings[number], {})
        for number, path in lessons.items()
        if number != "00"
    }
    for path in sorted((root / "labs").glob("*/*.ipynb")):
        pointers = {
            exercise: [_pointer(root, lessons, headings, exercise, word) for word in words]
            for exercise, words in chosen.get(path.parent.name, {}).items()
        }
        table[path.parent.name] = _entry(root, path, dict(headings_of(_read(path))), pointers)
    return table


def write(root: Path) -> Path:
    """Write the table where :mod:`robotbrain.grading.reread` reads it."""
    return write_text(TABLE, json.dumps(build(root), indent=1, ensure_ascii=False) + "\n")


def _entry(root: Path, path: Path, headings: Mapping[str, str], lessons: Mapping[str, Any]) -> dict[str, Any]:
    return {"notebook": path.relative_to(root).as_posix(), "headings": headings, "lessons": lessons}


def _pointer(
    root: Path, lessons: Mapping[str, Path], headings: Mapping[str, Mapping[str, str]], exercise: str, word: str
) -> list[str]:
    number, _, heading = word.partition(": ")
    if heading not in headings.get(number, {}):
        raise InputError(
            f"{CHOSEN.name}, {exercise}",
            given=word,
            expected=f"a lesson's number and one of its headings: {', '.join(headings.get(number, {}))}",
            fix="Correct the heading, or choose another.",
        )
    return [number.lstrip("0"), heading, lessons[number].relative_to(root).as_posix(), headings[number][heading]]


def _read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text(encoding="utf-8"))  # type: ignore[no-any-return]


if __name__ == "__main__":
    print(write(Path(__file__).resolve().parents[3]))
