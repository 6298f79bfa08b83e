"""A made-up class to try grading on: right answers in several styles, named wrong ones, and accidents of every kind.

``autograder/mutants/<lab>/mutants.py`` defines ``MUTANTS`` (and may define ``STYLES``), ``styles.py`` beside it
``STYLES``. A replacement is a whole new cell, or a list of ``(old, new)`` edits of the reference answer. What is to be
handed in beside the notebook (a trained policy, say) lies in ``autograder/reference/<lab>/``.
"""

from __future__ import annotations

import ast
import copy
import json
import re
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import nbformat
from nbformat.notebooknode import NotebookNode

from robotbrain.errors import InputError
from robotbrain.files import write_bytes, write_text
from robotbrain.grading import intake
from robotbrain.grading.course import Course
from robotbrain.grading.marks import SCORED
from robotbrain.grading.suite import load_file

Replacement = str | list[tuple[str, str]]
MANIFEST = "class.json"
ESSAY = "The interval of the gap contains zero, so three worlds cannot tell the two robots apart; thirty might."
_STUDENTS = [
    "amara",
    "bilal",
    "chen",
    "dagny",
    "emeka",
    "farah",
    "goran",
    "hana",
    "ines",
    "jonas",
    "kavya",
    "liam",
    "mei",
    "nadir",
    "olga",
    "pablo",
    "quynh",
    "rosa",
    "sami",
    "tariq",
    "uma",
    "vera",
    "wanda",
    "xavi",
    "yuki",
    "zofia",
    "arjun",
    "bruna",
    "cyril",
    "dorit",
    "elif",
    "femi",
    "gita",
    "hugo",
    "iris",
    "jun",
    "kemal",
    "lena",
    "marek",
    "noor",
]


@dataclass(frozen=True)
class Mutant:
    """A named wrong solution.

    Attributes:
        exercise: the only one (with ``also``) that may lose points.
        hint: key of the hint the student must be shown.
        loses: points it costs in ``exercise``; None: any number above 0.
        replace: grade id of an answer cell -> its new source, or edits of the reference answer.
        also: further exercises that may lose points, for mistakes that do spread.
        files: name of a file beside the notebook -> its content, made from the folder of the reference files; None
            where it is missing.
    """

    name: str
    exercise: str
    hint: str
    describe: str
    replace: Mapping[str, Replacement]
    loses: float | None = None
    also: tuple[str, ...] = ()
    files: Mapping[str, Callable[[Path], bytes | None]] = field(default_factory=dict)


@dataclass(frozen=True)
class Style:
    """A right solution, written differently."""

    name: str
    replace: Mapping[str, Replacement]
    describe: str = ""


def load_mutants(course: Course, lab: str) -> tuple[list[Mutant], list[Style]]:
    """The mutants and styles of ``lab``; empty lists where it has none."""
    mutants: list[Mutant] = []
    styles: list[Style] = []
    for name in ("mutants", "styles"):
        path = course.autograder / "mutants" / lab / f"{name}.py"
        if path.is_file():
            module = load_file(path, f"_robotbrain_{name}_{lab}")
            mutants += getattr(module, "MUTANTS", [])
            styles += getattr(module, "STYLES", [])
    return mutants, styles


class Reference:
    """The instructor's notebooks of a lab as submissions start from them: answers filled in, hidden tests removed."""

    def __init__(self, course: Course, lab: str) -> None:
        self.sources = course.sources(lab)
        self.notebooks = {p.name: _as_submission(p) for p in self.sources}
        self.stubs = {p.name: _without_hidden(copy.deepcopy(intake.master_of(p))) for p in self.sources}

    def copy(self) -> dict[str, NotebookNode]:
        """Fresh notebooks by file name."""
        return copy.deepcopy(self.notebooks)

    def answers(self) -> list[str]:
        """Grade ids of the answer cells, in order."""
        return [intake.grade_id(c) for nb in self.notebooks.values() for c in nb.cells if _is_answer(c)]

    def exercise_after(self, grade_id: str) -> str:
        """The exercise scored by the first test cell after an answer cell."""
        for notebook in self.notebooks.values():
            names = [intake.grade_id(c) for c in notebook.cells]
            if grade_id in names:
                for cell in notebook.cells[names.index(grade_id) :]:
                    if found := SCORED.search(cell.source):
                        return found.group(1)
        return ""

    def edit(self, replace: Mapping[str, Replacement], who: str) -> dict[str, NotebookNode]:
        """The notebooks with some answers replaced; raises :class:`InputError` where an edit does not fit."""
        notebooks = self.copy()
        cells = {intake.grade_id(c): c for nb in notebooks.values() for c in nb.cells if _is_answer(c)}
        for grade_id, change in replace.items():
            if grade_id not in cells:
                raise InputError(
                    f"{who}: cell", given=grade_id, expected=f"one of {', '.join(cells)}", fix="Correct the grade id."
                )
            if isinstance(change, str):
                cells[grade_id].source = change.strip("\n")
                continue
            for old, new in change:
                if cells[grade_id].source.count(old) != 1:
                    raise InputError(
                        f"{who}: text to replace in {grade_id}",
                        given=old,
                        expected=f"text that occurs once, not {cells[grade_id].source.count(old)} times",
                        fix="Quote more of the line.",
                    )
                cells[grade_id].source = cells[grade_id].source.replace(old, new)
        return notebooks


def _as_submission(source: Path) -> NotebookNode:
    """The solution notebook as a perfect student would hand it in."""
    solved = nbformat.read(source, as_version=4)
    stub = _without_hidden(copy.deepcopy(intake.master_of(source)))
    for cell, empty in zip(solved.cells, stub.cells, strict=True):
        if _is_essay(empty):
            empty.source = ESSAY
        elif _is_answer(empty):
            kept = [line for line in cell.source.splitlines() if not re.search(r"(BEGIN|END) SOLUTION", line)]
            empty.source = "\n".join(kept)
    return stub


def _without_hidden(notebook: NotebookNode) -> NotebookNode:
    from nbgrader.preprocessors import ClearHiddenTests, ComputeChecksums

    resources: dict[str, Any] = {}
    for step in (ClearHiddenTests(), ComputeChecksums()):
        notebook, resources = step.preprocess(notebook, resources)
    return notebook


def _is_essay(cell: NotebookNode) -> bool:
    """Whether this is an answer in words, which a person grades."""
    return cell.cell_type == "markdown" and bool(cell.metadata.get("nbgrader", {}).get("solution"))


def _is_answer(cell: NotebookNode) -> bool:
    """Whether students write code here; essays (graded by hand) are left as they are."""
    return cell.cell_type == "code" and bool(cell.metadata.get("nbgrader", {}).get("solution"))


def make_class(
    course: Course, lab: str, out: Path, keep: Callable[[dict[str, Any]], bool] = lambda _: True
) -> dict[str, dict[str, Any]]:
    """Write a class of submissions to ``out/<student>/<lab>/`` and ``out/class.json``, which says what each one is.

    Only those whose entry in the manifest ``keep`` wants are made; it is asked in their order.

    The manifest gives for each student ``kind``, ``name``, ``expect`` (``full``, ``zero``, ``partial``, ``exercise``)
    and, where one exercise suffers, ``exercise``, ``hint``, ``loses`` and ``also``.
    """
    reference = Reference(course, lab)
    mutants, styles = load_mutants(course, lab)
    folder = course.autograder / "reference" / lab
    beside = {p.name: p.read_bytes() for p in sorted(folder.iterdir()) if p.is_file()} if folder.is_dir() else {}
    entries: list[tuple[dict[str, Any], Mapping[str, NotebookNode | str | bytes]]] = []

    def add(kind: str, name: str, expect: str, files: Mapping[str, NotebookNode | str | bytes | None],
            make: Mapping[str, Callable[[Path], bytes | None]] | None = None, **more: Any) -> None:  # fmt: skip
        entry = {"kind": kind, "name": name, "expect": expect, **more}
        if keep(entry):
            made = {name: one(folder) for name, one in (make or {}).items()}
            every = {**({} if expect == "zero" else beside), **files, **made}
            entries.append((entry, {name: content for name, content in every.items() if content is not None}))

    add("reference", "reference", "full", reference.copy())
    for style in styles:
        add("style", style.name, "full", reference.edit(style.replace, f"style {style.name}"))
    for mutant in mutants:
        add(
            "mutant",
            mutant.name,
            "exercise",
            reference.edit(mutant.replace, f"mutant {mutant.name}"),
            mutant.files,
            exercise=mutant.exercise,
            hint=mutant.hint,
            loses=mutant.loses,
            also=list(mutant.also),
            describe=mutant.describe,
        )
    _add_accidents(reference, add)
    if len(entries) > len(_STUDENTS):
        names = [f"{_STUDENTS[i % len(_STUDENTS)]}{i // len(_STUDENTS) or ''}" for i in range(len(entries))]
    else:
        names = _STUDENTS[: len(entries)]
    manifest = {}
    for student, (entry, files) in zip(names, entries, strict=True):
        target = out / student / lab
        shutil.rmtree(out / student, ignore_errors=True)
        target.mkdir(parents=True)
        for name, content in files.items():
            if isinstance(content, bytes):
                write_bytes(target / name, content)
            else:
                write_text(target / name, content if isinstance(content, str) else nbformat.writes(content))
        manifest[student] = entry
    write_text(out / MANIFEST, json.dumps({"lab": lab, "students": manifest}, indent=1) + "\n")
    return manifest


def _add_accidents(reference: Reference, add: Callable[..., None]) -> None:
    """Submissions every class has: unfinished, broken, damaged."""
    answers = reference.answers()
    sources = {intake.grade_id(c): c.source for nb in reference.notebooks.values() for c in nb.cells}
    first = answers[0]
    # A loop in a function is met by its tests; one in a cell of settings might come after all that counts.
    last = next((a for a in reversed(answers) if "def " in sources[a]), answers[-1])
    add("stub", "empty", "zero", reference.stubs)
    half = {name: copy.deepcopy(nb) for name, nb in reference.stubs.items()}
    solved = set(answers[: (len(answers) + 1) // 2])
    for name, notebook in half.items():
        for cell, done in zip(notebook.cells, reference.notebooks[name].cells, strict=True):
            if intake.grade_id(cell) in solved:
                cell.source = done.source
    add("partly", "half-done", "partial", half)
    broken = "def unfinished(:\n    pass"
    add(
        "accident",
        "syntax-error",
        "exercise",
        reference.edit({first: broken}, "syntax-error"),
        exercise=reference.exercise_after(first),
    )
    for name, statement, cell in (
        ("infinite-loop", "while True: pass", last),
        ("kernel-death", "import os; os._exit(1)", first),
    ):
        add(
            "accident",
            name,
            "exercise",
            reference.edit({cell: _insert(sources[cell], statement)}, name),
            exercise=reference.exercise_after(cell),
        )
    add("accident", "deleted-test-cell", "full", _without_last_test(reference.copy()))
    add("accident", "unreadable", "zero", {n: nbformat.writes(nb)[:200] for n, nb in reference.copy().items()})
    add("accident", "nothing-submitted", "zero", {})


def _insert(source: str, statement: str) -> str:
    """Put ``statement`` first into every function of ``source``, or at its beginning where there is none."""
    lines = source.splitlines()
    functions = [n for n in ast.walk(ast.parse(source)) if isinstance(n, (ast.FunctionDef, ast.AsyncFunctionDef))]
    starts = {}
    for function in functions:
        body = function.body
        documented = len(body) > 1 and isinstance(body[0], ast.Expr) and isinstance(body[0].value, ast.Constant)
        starts[body[1 if documented else 0].lineno] = body[1 if documented else 0].col_offset
    for line in sorted(starts, reverse=True):
        lines.insert(line - 1, " " * starts[line] + statement)
    return "\n".join(lines if starts else [statement, *lines])


def _without_last_test(notebooks: dict[str, NotebookNode]) -> dict[str, NotebookNode]:
    notebook = list(notebooks.values())[-1]
    tests = [i for i, c in enumerate(notebook.cells) if SCORED.search(c.source)]
    del notebook.cells[tests[-1]]
    return notebooks
