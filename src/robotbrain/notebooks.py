"""The one form in which notebooks are kept under version control.

No outputs, no execution counts, stable cell ids, sorted keys, a fixed kernel: two people who open, run and save the
same notebook leave the same bytes.
"""

from __future__ import annotations

import argparse
import hashlib
import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotbrain.errors import InputError
from robotbrain.files import write_text

if TYPE_CHECKING:
    from nbformat.notebooknode import NotebookNode

LONGEST_CELL = 40  # lines of code that still fit on a screen with what they do
_ID = re.compile(r"[A-Za-z0-9_-]{1,64}")
_STATED = re.compile(r"\bcells themselves run in under (?P<number>\d+) (?P<unit>seconds|minutes)")
_KERNEL = {"display_name": "Python 3 (ipykernel)", "language": "python", "name": "python3"}
_KEPT_NOTEBOOK_METADATA = {"robotbrain", "title", "authors"}
_VOLATILE_CELL_METADATA = {
    "ExecuteTime",
    "collapsed",
    "colab",
    "execution",
    "id",
    "jp-MarkdownHeadingCollapsed",
    "outputId",
    "pycharm",
    "scrolled",
    "trusted",
    "vscode",
}


def canonicalise(notebook: NotebookNode) -> NotebookNode:
    """Bring ``notebook`` (nbformat 4) into canonical form, in place, and return it."""
    kept = {k: v for k, v in notebook.metadata.items() if k in _KEPT_NOTEBOOK_METADATA}
    notebook.metadata = type(notebook)(kept | {"kernelspec": _KERNEL, "language_info": {"name": "python"}})
    notebook.nbformat, notebook.nbformat_minor = 4, 5
    seen: set[str] = set()
    for cell in notebook.cells:
        cell.source = cell.source.replace("\r\n", "\n")
        for key in _VOLATILE_CELL_METADATA & cell.metadata.keys():
            del cell.metadata[key]
        if cell.cell_type == "code":
            cell.outputs, cell.execution_count = [], None
        cell["id"] = _stable_id(cell, seen)
        seen.add(cell["id"])
    return notebook


def canonical_text(notebook: NotebookNode) -> str:
    """``notebook`` in canonical form as the text of its file."""
    import nbformat

    return str(nbformat.writes(canonicalise(notebook), version=4)) + "\n"


def _stable_id(cell: NotebookNode, seen: set[str]) -> str:
    """The cell's own id where it is valid and free, else one that follows from its content."""
    own = cell.get("id", "")
    if _ID.fullmatch(own) and own not in seen:
        return str(own)
    named = cell.metadata.get("nbgrader", {}).get("grade_id", "")
    base = named if _ID.fullmatch(named) else hashlib.sha256(cell.source.encode()).hexdigest()[:8]
    return next(name for name in _variants(base) if name not in seen)


def _variants(base: str) -> Iterator[str]:
    yield base
    number = 2
    while True:
        yield f"{base[:58]}-{number}"
        number += 1


def read(path: Path) -> tuple[str, NotebookNode]:
    """Return the text of a notebook file and the notebook, or raise :class:`InputError`."""
    import nbformat

    try:
        text = path.read_text(encoding="utf-8")
        raw: Any = nbformat.reader.reads(text)
        if raw.get("nbformat") == 4:
            # Ids that are missing must stay missing here: nbformat would fill in random ones.
            for cell in raw["cells"]:
                cell.setdefault("id", "")
            raw["nbformat_minor"] = 5
            return text, nbformat.v4.rwbase.rejoin_lines(raw)
        return text, nbformat.convert(raw, 4)
    except Exception as error:
        raise InputError(
            str(path), given=f"{type(error).__name__}: {error}", expected="a notebook", fix="Repair or remove it."
        ) from None


def problems(path: Path) -> tuple[list[str], list[str]]:
    """Return (errors, warnings) about the notebook at ``path``."""
    text, notebook = read(path)
    warnings = [
        f"cell {number} has {lines} lines; split it (at most {LONGEST_CELL})"
        for number, cell in enumerate(notebook.cells, 1)
        if cell.cell_type == "code" and (lines := cell.source.count("\n") + 1) > LONGEST_CELL
    ]
    errors = []
    if any(c.cell_type == "code" and (c.get("outputs") or c.get("execution_count")) for c in notebook.cells):
        errors.append("it holds outputs or execution counts")
    if canonical_text(notebook) != text and not errors:
        errors.append("it is not in canonical form (cell ids, metadata, key order or line ends)")
    return errors, warnings


def fix(path: Path) -> bool:
    """Bring the file at ``path`` into canonical form; return whether it changed."""
    text, notebook = read(path)
    canonical = canonical_text(notebook)
    if canonical == text:
        return False
    write_text(path, canonical)
    return True


def stated_seconds(path: Path) -> float | None:
    """Return how long a notebook says that its cells run, in s, or None where it does not say.

    It says so in one form, so that tests and pages can read it: "The cells themselves run in under 40 seconds."
    """
    _, notebook = read(path)
    for cell in notebook.cells:
        if cell.cell_type == "markdown" and (found := _STATED.search(cell.source)):
            return int(found["number"]) * (60.0 if found["unit"] == "minutes" else 1.0)
    return None


def find(paths: Iterable[str | Path]) -> list[Path]:
    """Notebook files among ``paths`` and below the folders among them, without checkpoints."""
    found: list[Path] = []
    for path in map(Path, paths):
        if path.is_dir():
            found += [p for p in sorted(path.rglob("*.ipynb")) if ".ipynb_checkpoints" not in p.parts]
        elif path.is_file():
            found.append(path)
        else:
            raise InputError("notebook", given=str(path), expected="an existing file or folder", fix="Check the path.")
    return found


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``robotbrain notebooks``."""
    parser.add_argument("action", choices=["check", "fix"])
    parser.add_argument("paths", nargs="+", metavar="PATH", help="notebooks, or folders that hold them")


def main(arguments: argparse.Namespace) -> int:
    """Run ``robotbrain notebooks``."""
    failed = 0
    for path in find(arguments.paths):
        if arguments.action == "fix" and fix(path):
            print(f"fixed {path}")
        errors, warnings = problems(path)
        for text in warnings:
            print(f"{path}: warning: {text}", file=sys.stderr)
        for text in errors:
            print(f"{path}: {text}. Run: robotbrain notebooks fix {path}", file=sys.stderr)
        failed += bool(errors)
    return 1 if failed else 0
