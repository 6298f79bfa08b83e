"""What is asked of every lesson; each lesson's own tests call these with its notebook."""

from __future__ import annotations

import html.parser
import re
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

from robotbrain import notebooks
from robotbrain.grading import Lab, Report, load_suite

REPO = Path(__file__).resolve().parents[1]
WATCH = """
import sys
sys.path.insert(0, {repo!r})
from tests.seeing import Watch
watch_ = Watch()
del sys.path[0]
"""
LONGEST = 25  # lines of a cell in a lesson
SECTIONS = ("What changed since the course outline", "Going to the real hardware", "Summary")
LONGEST_OPENING = 5 * 200  # words that are read in five minutes
MOVING = re.compile(r"<iframe|<video|<animate|@keyframes|animation-duration")
"""What moves in an output: a replay in 3D, a film, an animated drawing."""


def execute(path: Path, claims: str = "", timeout: int = 90) -> Any:
    """Return the notebook after a run from a clean kernel; a cell that raises fails the test that asks for it.

    Args:
        path: of the notebook.
        claims: what the prose says about results, as code: it runs as a last cell, after the figures are looked at.
        timeout: of a cell, s.
    """
    notebook = nbformat.read(path, as_version=4)
    notebook.cells.insert(0, nbformat.v4.new_code_cell(WATCH.format(repo=str(REPO))))
    notebook.cells.append(nbformat.v4.new_code_cell("watch_.ask()\n" + claims))
    NotebookClient(notebook, timeout=timeout, resources={"metadata": {"path": str(path.parent)}}).execute()
    return notebook


def outputs(notebook: Any, kind: str) -> list[str]:
    """Return all outputs of one MIME type."""
    return [
        output["data"][kind]
        for cell in notebook.cells
        for output in cell.get("outputs", [])
        if kind in output.get("data", {})
    ]


class Tags(html.parser.HTMLParser):
    """Collects the tags of a page with their attributes."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))


def check_form(path: Path, exercises: str) -> None:
    """The file is canonical, its cells are short, and every part of a lesson is there."""
    assert notebooks.problems(path) == ([], [])
    lesson = nbformat.read(path, as_version=4)
    for cell in lesson.cells:
        if cell.cell_type == "code":
            lines = cell.source.splitlines()
            assert len(lines) <= LONGEST, cell.id
            assert max(map(len, lines)) <= 120, cell.id
    text = "\n".join(cell.source for cell in lesson.cells if cell.cell_type == "markdown")
    check_parts(lesson.cells, text)
    assert set(re.findall(r"Exercise (\d)", text)) == set(exercises)
    for target in re.findall(r"\]\(([^)#:]+\.(?:ipynb|svg|png))\)", text):
        assert (path.parent / target).is_file(), target
    for alt, target in re.findall(r"!\[(.*?)\]\((.*?)\)", text):
        assert len(alt) > 40, target


def check_parts(cells: list[Any], text: str) -> None:
    """Objectives, time, the sections that every lesson has and sources are there, and exercises have their checks."""
    opening = cells[0].source
    assert re.match(r"# \S", opening)
    assert len(re.findall(r"^\d\. ", opening.partition("You will be able to")[2], flags=re.MULTILINE)) >= 4
    assert "**Time:** about" in opening and "cells themselves run in under" in opening
    sections = re.findall(r"^## (.+)$", text, flags=re.MULTILINE)
    assert set(SECTIONS) <= set(sections) and sections[-1] == "Summary"
    summary = text.partition("## Summary")[2]
    assert len(re.findall(r"^\* ", summary, flags=re.MULTILINE)) >= 3
    reading = summary.partition("**Further reading.**")[2]
    assert len(re.findall(r"\]\(https?://", reading)) >= 3
    for number, cell in enumerate(cells):
        if cell.cell_type == "markdown" and re.search(r"^#+ Exercise \d", cell.source, flags=re.MULTILINE):
            following = cells[number + 1 : number + 4]  # what is to be done, and the check
            assert any("lab.check(" in c.source for c in following if c.cell_type == "code"), cell.id


def check_motivation(executed: Any) -> None:
    """A lesson begins with something that moves, in a section that takes five minutes at most."""
    words, moving, sections = 0, False, 0
    for cell in executed.cells:
        if cell.cell_type == "markdown":
            sections += len(re.findall(r"^## ", cell.source, flags=re.MULTILINE))
            words += len(cell.source.split()) if sections < 2 else 0
            if re.search(r"^#+ Exercise", cell.source, flags=re.MULTILINE):
                break
        elif any(MOVING.search(output.get("data", {}).get("text/html", "")) for output in cell.outputs):
            moving = True
            break
    assert moving and sections <= 2, "nothing moves before the first exercise"
    assert words <= LONGEST_OPENING


def check_silent(executed: Any) -> None:
    """No cell failed, and none wrote to stderr."""
    for cell in executed.cells:
        for output in cell.get("outputs", []):
            assert output.output_type != "error", cell.id
            assert output.get("name") != "stderr", f"{cell.id}: {output.get('text')}"


def check_readable(executed: Any, figures: int, tables: int = 0) -> None:
    """There are so many figures and tables at least, and each can be read by everybody."""
    pages = outputs(executed, "text/html")
    found = Tags("\n".join(page for page in pages if "<iframe" not in page)).found
    images = [attributes for tag, attributes in found if tag == "img"]
    assert len(images) >= figures
    assert all(len(image.get("alt") or "") > 40 for image in images)
    drawings = [attributes for tag, attributes in found if tag == "svg"]
    assert all(drawing.get("role") == "img" and drawing.get("aria-label") for drawing in drawings)
    assert not outputs(executed, "image/png")  # such an image would have no alt text
    shown = [page for page in pages if page.startswith("<table style")]
    assert len(shown) >= tables and all("<caption" in page and 'scope="row"' in page for page in shown)


def check_open_exercises(executed: Any, suite: str) -> None:
    """A check of an exercise that nobody has begun says just that."""
    reports = [text for text in outputs(executed, "text/plain") if re.search(r"of \d+ points", text)]
    assert len(reports) == len(load_suite(suite).exercises)
    for text in reports:
        assert "not written yet" in text and "hint" not in text and "raised" not in text, text


def check(suite: str, exercise: str, **answers: Any) -> Report:
    """Return the report on a student's answers."""
    return Lab(suite, namespace=answers).check(exercise)


def hints(report: Report) -> set[str]:
    """Return the keys of the hints that a report gives."""
    return {result.hint_key for result in report.results if result.hint_key}


class LessonTests:
    """The tests that every lesson must pass; the ``TestLesson`` of each says what is its own.

    Attributes:
        notebook: file name in ``course/``.
        exercises: their digits.
        figures, tables: how many there are at least.
        claims: what the prose says about results, as code that runs as a last cell.
        timeout: of a cell, s.
    """

    notebook: str
    exercises: str
    figures: int
    tables: int = 0
    claims: str = ""
    timeout: int = 90

    @pytest.fixture(scope="class")
    @classmethod
    def path(cls, repo: Path) -> Path:
        return repo / "course" / cls.notebook

    @pytest.fixture(scope="class")
    @classmethod
    def executed(cls, path: Path) -> Any:
        return execute(path, cls.claims, cls.timeout)

    def test_form(self, path: Path) -> None:
        check_form(path, self.exercises)

    def test_it_runs_from_the_top_and_says_nothing_on_stderr(self, executed: Any) -> None:
        check_silent(executed)

    def test_it_begins_with_something_that_moves(self, executed: Any) -> None:
        check_motivation(executed)

    def test_every_figure_and_table_can_be_read_by_everybody(self, executed: Any) -> None:
        check_readable(executed, self.figures, self.tables)

    def test_open_exercises_are_reported_kindly(self, executed: Any) -> None:
        check_open_exercises(executed, f"lesson_{self.notebook[:2]}")
