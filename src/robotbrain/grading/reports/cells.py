"""A student's own cells and their outputs as harmless HTML.

Nothing is passed on: code becomes coloured text, text stays text, a picture is kept if it is a PNG by its own bytes,
and everything else (HTML, SVG, JavaScript, widgets) is shown by its plain text or named.
"""

from __future__ import annotations

import base64
import binascii
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from markupsafe import Markup

from robotbrain.grading.marks import SCORED
from robotbrain.grading.report import SCORE_MIME
from robotbrain.grading.reports.page import clean

_PNG = b"\x89PNG\r\n\x1a\n"
LARGEST_PICTURE = 2_000_000  # bytes
LARGEST_PAGE = 8_000_000  # bytes of pictures in one page
LONGEST_SOURCE, LONGEST_OUTPUT = 20_000, 6_000  # characters
MOST_OUTPUTS = 20  # of one cell
_COLOURED = 20_000  # characters that are worth the time of highlighting


@dataclass(frozen=True)
class Output:
    """One output: text of a ``kind`` (``"text"``, ``"error"``, ``"note"``), or a picture (its data URL)."""

    kind: str
    text: str = ""
    width: int = 0
    height: int = 0


@dataclass(frozen=True)
class Cell:
    """One cell as it is shown. ``heading`` is the last heading of the course's text before it."""

    number: int
    kind: str  # "code" or "text"
    name: str
    heading: str
    source: str
    code: Markup
    outputs: list[Output] = field(default_factory=list)


def own_cells(cells: Iterable[Mapping[str, Any]]) -> list[Cell]:
    """The cells a student could write: all code that is not locked, and text answers."""
    found, heading, budget = [], "", LARGEST_PAGE
    for number, cell in enumerate(cells, 1):
        label = cell["metadata"].get("nbgrader") or {}
        source = str(cell["source"])
        answer = bool(label.get("solution") or label.get("task"))
        if cell["cell_type"] != "code" and not answer:
            titles = [line.lstrip("# ") for line in source.splitlines() if line.startswith("#")]
            heading = titles[-1][:120] if titles else heading
            continue
        if (label.get("locked") and not answer) or not source.strip() or SCORED.search(source):
            continue
        outputs = []
        for output in list(cell.get("outputs") or [])[:MOST_OUTPUTS]:
            shown = _output(output, budget)
            if shown is not None:
                outputs.append(shown)
                budget -= len(shown.text) if shown.kind == "picture" else 0
        if len(cell.get("outputs") or []) > MOST_OUTPUTS:
            outputs.append(Output("note", f"{len(cell['outputs']) - MOST_OUTPUTS} more outputs are not shown."))
        kind = "code" if cell["cell_type"] == "code" else "text"
        code = highlighted(source) if kind == "code" else Markup("")
        found.append(Cell(number, kind, str(label.get("grade_id", "")), heading, source, code, outputs))
    return found


def highlighted(source: str) -> Markup:
    """Python as coloured, escaped text; very long code without colours, and cut."""
    if len(source) > _COLOURED:
        return Markup.escape(clean(source, LONGEST_SOURCE))
    from pygments import highlight
    from pygments.formatters.html import HtmlFormatter
    from pygments.lexers.python import PythonLexer

    formatter = HtmlFormatter(nowrap=True)
    return Markup(highlight(clean(source, LONGEST_SOURCE), PythonLexer(stripnl=False), formatter).rstrip("\n"))


def _output(output: Mapping[str, Any], budget: int) -> Output | None:
    kind = output.get("output_type")
    if kind == "stream":
        return Output("text", clean(_joined(output.get("text")), LONGEST_OUTPUT))
    if kind == "error":
        told = _joined(output.get("traceback"), "\n") or f"{output.get('ename')}: {output.get('evalue')}"
        return Output("error", clean(told, LONGEST_OUTPUT))
    data = output.get("data")
    if not isinstance(data, Mapping) or SCORE_MIME in data:
        return None  # scores are told above, from the tests themselves
    if "image/png" in data:
        return _picture(data["image/png"], budget)
    if "text/plain" in data:
        note = "" if set(data) == {"text/plain"} else "\n(shown as text)"
        return Output("text", clean(_joined(data["text/plain"]), LONGEST_OUTPUT) + note)
    kinds = ", ".join(sorted(clean(str(k), 60) for k in list(data)[:5]))
    return Output("note", f"An output that only a notebook can show ({kinds}).")


def _picture(encoded: object, budget: int) -> Output:
    """A PNG as a data URL made anew from its bytes; anything that only says it is one becomes a note."""
    text = _joined(encoded)
    if len(text) > 2 * LARGEST_PICTURE:
        return Output("note", f"A picture of more than {LARGEST_PICTURE / 1e6:.0f} MB is too large for this page.")
    try:
        data = base64.b64decode("".join(text.split()), validate=True)
    except (binascii.Error, ValueError):
        data = b""
    if not data.startswith(_PNG) or len(data) < 33 or data[12:16] != b"IHDR":
        return Output("note", "A picture that is not a PNG is not shown.")
    width, height = struct.unpack(">II", data[16:24])
    if len(data) > min(LARGEST_PICTURE, budget) or not 0 < width * height <= 40_000_000:
        return Output("note", f"A picture of {len(data) / 1e6:.1f} MB ({width} x {height}) is too large for this page.")
    return Output("picture", Markup(f"data:image/png;base64,{base64.b64encode(data).decode()}"), width, height)


def _joined(value: object, between: str = "") -> str:
    """Text of the notebook format: a string, or a list of pieces."""
    if isinstance(value, list):
        return between.join(map(str, value))
    return "" if value is None else str(value)
