"""Made-up graded classes and notebooks for the tests of the reports, and a strict reader of their pages."""

from __future__ import annotations

import base64
import re
import struct
import zlib
from collections.abc import Sequence
from html.parser import HTMLParser
from typing import Any

from nbformat import NotebookNode
from nbformat.notebooknode import from_dict

from robotbrain.grading.report import SCORE_MIME

VOID = {"meta", "img", "br", "rect", "line", "hr", "link", "input"}
ALLOWED = frozenset(
    re.findall(
        r"\w+",
        "html head meta title style body a header nav main section article footer div span p pre code h1 h2 h3 h4 ul ol"
        " li dl dt dd table caption thead tbody tr th td strong b em figure figcaption img br details summary svg rect"
        " line text",
    )
)
LAYERS = ("bubblewrap", "namespaces", "seccomp", "limits")
URLS = re.compile(r"#[a-z][\w-]*|data:image/png;base64,[A-Za-z0-9+/]+=*|(?:[\w.~%()-]+/)*[\w.~%()-]+\.html|")


class Page(HTMLParser):
    """Reads a page and refuses whatever a report must not hold; collects text, links, ids, headings."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.problems: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.tags: list[str] = []
        self.headings: list[int] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.shown: list[str] = []
        self.feed(text)
        self.close()
        if self.open:
            self.problems.append(f"left open: {self.open}")

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        if tag not in ALLOWED:
            self.problems.append(f"<{tag}>")
        if tag not in VOID:
            self.open.append(tag)
        if re.fullmatch(r"h[1-6]", tag):
            self.headings.append(int(tag[1]))
        for name, value in attrs:
            self.attributes.append((tag, name, value or ""))
            if name.startswith("on") or name in ("style", "srcset", "srcdoc", "formaction", "action", "background"):
                self.problems.append(f"{tag} {name}={value!r}")
            if name in ("href", "src") and not URLS.fullmatch(value or ""):
                self.problems.append(f"{tag} {name}={value!r}")
            if name == "http-equiv" and value != "Content-Security-Policy":
                self.problems.append(f"meta {value}")
            if name == "id":
                self.ids.append(value or "")
            if name == "href":
                self.links.append(value or "")

    def handle_endtag(self, tag: str) -> None:
        if tag in VOID:
            return
        if not self.open or self.open[-1] != tag:
            self.problems.append(f"</{tag}> closes {self.open[-1:]}")
        if tag in self.open:
            while self.open.pop() != tag:
                pass

    def handle_comment(self, data: str) -> None:
        self.problems.append(f"<!--{data[:40]}-->")

    def handle_pi(self, data: str) -> None:
        self.problems.append(f"<?{data[:40]}>")

    def handle_data(self, data: str) -> None:
        if "style" in self.open:
            return
        self.shown.append(data)

    @property
    def text(self) -> str:
        return "".join(self.shown)


def png(width: int = 2, height: int = 2) -> bytes:
    """A small valid PNG."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = b"".join(b"\0" + b"\x7f" * width for _ in range(height))
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def png64(width: int = 2, height: int = 2) -> str:
    return base64.b64encode(png(width, height)).decode()


def test_entry(name: str = "a test", *, share: float = 1.0, points: float = 2.0, **more: Any) -> dict[str, Any]:
    """A test as in results.json."""
    entry: dict[str, Any] = {
        "exercise": "scale",
        "name": name,
        "points": points,
        "earned": points * share,
        "verdict": "passed" if share == 1 else "failed",
        "hidden": False,
    }
    return (
        entry | dict.fromkeys(("message", "given", "expected", "got", "misconception", "hint_key", "hint"), "") | more
    )


test_entry.__test__ = False  # type: ignore[attr-defined]


def exercise(name: str, tests: list[dict[str, Any]], **more: Any) -> dict[str, Any]:
    """An exercise as in results.json, worth what its tests are."""
    entry = {
        "grade_id": f"score-{name}",
        "exercise": name,
        "points": sum(t["points"] for t in tests),
        "earned": sum(t["earned"] for t in tests),
        "error": "",
        "substituted": [],
        "tests": tests,
    }
    return entry | more


def student(name: str, exercises: list[dict[str, Any]], **more: Any) -> dict[str, Any]:
    """A student as in results.json."""
    return {"student": name, "exercises": exercises, "incidents": [], "seconds": 1.0, "layers": list(LAYERS)} | more


def binary_class(matrix: list[list[int]]) -> dict[str, Any]:
    """A class with one exercise of one point per column, each with one test."""
    students = [
        student(
            f"s{i}",
            [
                exercise(f"e{j}", [test_entry("t", share=float(x), points=1.0, exercise=f"e{j}")])
                for j, x in enumerate(row)
            ],
        )
        for i, row in enumerate(matrix)
    ]
    return {"version": 1, "lab": "toy", "students": students}


def new_output(output_type: str, **fields: Any) -> NotebookNode:
    """An output, valid or not."""
    return from_dict({"output_type": output_type, **fields})


def _cell(kind: str, source: str, label: dict[str, Any] | None = None, outputs: Sequence[NotebookNode] = ()) -> Any:
    """A cell, valid or not: what a student's file holds is checked by nobody."""
    cell: dict[str, Any] = {"cell_type": kind, "id": "a", "source": source, "metadata": {}}
    if label is not None:
        cell["metadata"]["nbgrader"] = label
    if kind == "code":
        cell |= {"outputs": list(outputs), "execution_count": None}
    return from_dict(cell)


def notebook(*own: NotebookNode, report: dict[str, Any] | None = None) -> NotebookNode:
    """An executed notebook: the answers, and one graded cell with ``report``."""
    label = {"grade": True, "solution": False, "locked": True, "grade_id": "score-scale", "points": 4}
    outputs = []
    if report is not None:
        outputs = [new_output("execute_result", data={"text/plain": "4", SCORE_MIME: report}, metadata={})]
    cells = [_cell("markdown", "# Toy lab"), *own, _cell("code", "lab.score('scale')", label, outputs)]
    return from_dict({"cells": cells, "metadata": {}, "nbformat": 4, "nbformat_minor": 5})


def answer(source: str, *outputs: NotebookNode, kind: str = "code", grade_id: str = "scale") -> NotebookNode:
    """A student's answer cell."""
    label = {"grade": kind != "code", "solution": True, "locked": False, "grade_id": grade_id}
    return _cell("code" if kind == "code" else "markdown", source, label, outputs)
