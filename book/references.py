"""The page of references: what the notebooks recommend, and who says that the outline is out of date."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import nbformat

from robotbrain.outline import read_outline

_READING = re.compile(r"\*\*Further reading\.\*\* (?P<text>.+?)(?:\n\n|\Z)", re.DOTALL)
_TITLE = re.compile(r"^# (.+)$", re.MULTILINE)
# A full stop ends a reference if no initial stands before it, and something new begins after it.
_ENDS = re.compile(r"(?<!\b[A-Z])\. (?=[A-Z\[])")
_REFERENCE = re.compile(r"\]\(|\b(19|20)\d\d\b")


def readings(text: str) -> list[str]:
    """Return the references of a paragraph, in its order, each without the full stop at its end."""
    if " · " in text:
        return [piece.strip().rstrip(".") for piece in text.split(" · ")]
    found: list[str] = []
    for piece in (piece.strip().rstrip(".") for piece in _ENDS.split(text)):
        if found and not _REFERENCE.search(piece):
            found[-1] += f". {piece}"  # a remark on the one before it
        else:
            found.append(piece)
    return found


def _markdown(notebook: Path) -> list[str]:
    return [cell.source for cell in nbformat.read(notebook, 4).cells if cell.cell_type == "markdown"]


def title(notebook: Path) -> str:
    """Return the heading that a notebook begins with."""
    return next(match[1] for source in _markdown(notebook) if (match := _TITLE.search(source)))


def recommended(notebook: Path) -> list[str]:
    """Return the references that a notebook ends with."""
    return [
        one for source in _markdown(notebook) for match in _READING.finditer(source) for one in readings(match["text"])
    ]


def outline_sources(outline: Path) -> list[str]:
    """Return who says what is no longer true in the outline, each once, by name."""
    linked = {
        f"[{text}]({address})" for c in read_outline(outline).changes for text, address in c.sources if "://" in address
    }
    return sorted(linked, key=str.casefold)


def page(root: Path, notebooks: list[str]) -> str:
    """Return the page as Markdown.

    Args:
        root: where the sources of the book lie.
        notebooks: their paths from there, in the order of the book.
    """
    return "\n".join([*_lines(root, notebooks), ""])


def _lines(root: Path, notebooks: list[str]) -> Iterator[str]:
    yield "# References"
    yield "\nEverything that the lessons and labs recommend, where they recommend it. "
    yield "The addresses were looked up in November 2026; they need a network, the rest of this book does not."
    for name in notebooks:
        if found := recommended(root / name):
            yield f"\n## {title(root / name)}\n\n[The page]({name})\n"
            yield from (f"* {one}" for one in found)
    yield "\n## Sources on what is no longer true\n\n[The table](course/CHANGES.md) says what each of them shows.\n"
    yield from (f"* {one}" for one in outline_sources(root / "course" / "outline.toml"))
