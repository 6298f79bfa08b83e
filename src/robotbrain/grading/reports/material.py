"""Where the reports find what they need: executed notebooks, the release, lessons, and the course's own solutions."""

from __future__ import annotations

import ast
import importlib.util
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import nbformat.v4

from robotbrain.errors import InputError, RobotBrainError
from robotbrain.grading.course import Course
from robotbrain.grading.reports.model import GradedClass, read_results
from robotbrain.grading.reports.similarity import given_code, own_code
from robotbrain.grading.suite import load_suite


@dataclass(frozen=True)
class Graded:
    """A graded class and the folder it was graded in (with ``results/``, ``autograded/``, ``gradebook.db``)."""

    results: Path
    base: Path
    graded: GradedClass

    def notebooks(self, student: str) -> list[Path]:
        """The executed notebooks of a student, as nbgrader keeps them."""
        return sorted((self.base / "autograded" / student / self.graded.lab).glob("*.ipynb"))


def find_graded(target: str, course: Course | None) -> Graded:
    """The graded class that ``target`` names: a ``results.json``, or a lab of ``course``."""
    path = Path(target)
    if path.suffix != ".json":
        if course is None:
            raise InputError("lab", given=target, expected="a course folder to look in", fix="Use --course.")
        path = course.results / "results" / target / "results.json"
    path = path.resolve()
    graded = read_results(path)
    base = path.parents[2] if path.parent.parent.name == "results" else path.parent
    return Graded(path, base, graded)


def cells_of(path: Path) -> list[Any]:
    """Cells of a notebook; none where it cannot be read."""
    try:
        return list(nbformat.v4.reads(path.read_text(encoding="utf-8")).cells)
    except (OSError, ValueError, KeyError, AttributeError, TypeError):
        return []


def submitted_code(found: Graded) -> dict[str, list[str]]:
    """Each student's own code cells."""
    return {
        row.student: [source for path in found.notebooks(row.student) for source in own_code(cells_of(path))]
        for row in found.graded.rows
    }


def given_sources(course: Course, lab: str) -> list[list[str]]:
    """The code that every student was given: the release of the lab, and the lessons."""
    release = [cells_of(p) for p in sorted((course.home / "labs" / lab).glob("*.ipynb"))]
    lessons = [cells_of(p) for p in sorted((course.home / "course").glob("*.ipynb"))]
    # The release counts with and without its locked cells: else what spans two cells would look like a student's own.
    return [*map(given_code, release), *map(own_code, release), *map(given_code, lessons)]


def reference_sources(course: Course, lab: str) -> dict[str, list[str]]:
    """The course's own solutions: the instructor's notebooks, and what the suite names as its references."""
    found = {f"solution {p.name}": own_code(cells_of(p)) for p in course.sources(lab)}
    try:
        references = load_suite(lab).references
    except (RobotBrainError, ImportError):
        return found
    for source in references.values():
        if isinstance(source, str) and (text := _definition(source)):
            found[source] = [text]
    return found


def _definition(address: str) -> str:
    """The source text of ``package.module:attribute``, without importing the module; "" if it cannot be found."""
    module, _, attribute = address.partition(":")
    try:
        spec = importlib.util.find_spec(module)
        text = Path(spec.origin).read_text(encoding="utf-8") if spec is not None and spec.origin else ""
        body: Iterable[ast.stmt] = ast.parse(text).body
    except (ImportError, OSError, SyntaxError, ValueError):
        return ""
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == attribute.split(".")[0]:
            return ast.get_source_segment(text, node) or ""
    return ""
