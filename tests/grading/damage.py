"""Accidents that befall honest submissions, each with the answers that may be lost by it: usually none.

A damage works on one of three levels: the cells of the notebook (a dictionary), the bytes of its file, or the folder
that is handed in. It returns the grade ids of the answers whose points are gone with it; the others are due in full.
"""

from __future__ import annotations

import ast
import codecs
import copy
import gzip
import io
import json
import os
import random
import re
import socket
import zipfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nbformat.notebooknode import NotebookNode

from robotbrain.grading import intake, sample
from robotbrain.grading.course import Course

Cells = list[dict[str, Any]]
NOTEBOOK, FILE, FOLDER = "notebook", "file", "folder"


@dataclass(frozen=True)
class Lab:
    """A lab with a perfect submission.

    Attributes:
        answers: grade ids of the answers in code.
        wanted: by answer, the statement that must define each of its names when its test runs.
    """

    name: str
    master: NotebookNode
    reference: NotebookNode
    stub: NotebookNode
    answers: list[str]
    wanted: dict[str, dict[str, str]]
    course: Path

    @property
    def file(self) -> str:
        return f"{self.name}.ipynb"


def load_lab(course: Course, name: str) -> Lab:
    reference = sample.Reference(course, name)
    (source,) = course.sources(name)
    notebook = reference.notebooks[source.name]
    cells = {intake.grade_id(c): c for c in notebook.cells}
    wanted = {a: bindings(cells[a].source) for a in reference.answers()}
    return Lab(
        name,
        intake.master_of(source),
        notebook,
        reference.stubs[source.name],
        reference.answers(),
        wanted,
        course.home,
    )


def bindings(source: str) -> dict[str, str]:
    """What code binds at its top level: the syntax tree of the statement by name; nothing if it is not Python."""
    try:
        body = ast.parse(source).body
    except (SyntaxError, ValueError, MemoryError, RecursionError):
        return {}
    found = {}
    for statement in body:
        if isinstance(statement, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            found[statement.name] = ast.dump(statement)
        elif isinstance(statement, ast.Assign):
            for target in ast.walk(ast.Tuple(statement.targets, ast.Load())):
                if isinstance(target, ast.Name) and isinstance(target.ctx, ast.Store):
                    found[target.id] = ast.dump(statement)
    return found


def lost(notebook: NotebookNode, lab: Lab) -> set[str]:
    """The answers that would lose their points: when its test runs, one of its names is not what the answer made it.

    The notebook is not run but followed: every cell that is Python binds its names, in order.
    """
    bound: dict[str, str] = {}
    waiting = list(lab.answers)
    gone = set()
    tests = [intake.grade_id(c) for c in lab.master.cells if _graded(c)]
    for cell in notebook.cells:
        if cell.cell_type != "code":
            continue
        name = intake.grade_id(cell)
        if name in tests:
            due = _answers_before(lab, name)
            gone |= {a for a in due if a in waiting and any(bound.get(n) != d for n, d in lab.wanted[a].items())}
            waiting = [a for a in waiting if a not in due]
        elif "skip-grading" not in cell.metadata.get("tags", ()):
            bound |= bindings(cell.source)
    return gone | set(waiting)


def _graded(cell: NotebookNode) -> bool:
    return bool(intake.grade_id(cell)) and intake.is_graded_kind(cell)


def _answers_before(lab: Lab, test: str) -> set[str]:
    due: set[str] = set()
    for cell in lab.master.cells:
        name = intake.grade_id(cell)
        if name in lab.answers:
            due.add(name)
        if name == test:
            return due
    return set()


Change = Callable[[Any, random.Random, Lab], Iterable[str] | None]


@dataclass(frozen=True)
class Damage:
    """An accident; ``says`` is a word of the reason that the student is given, ``""`` where nothing need be said."""

    name: str
    kind: str
    level: str
    change: Change
    says: str = ""


DAMAGES: list[Damage] = []


def damage(kind: str, level: str, says: str = "") -> Callable[[Change], Change]:
    def add(change: Change) -> Change:
        DAMAGES.append(Damage(change.__name__.replace("_", " "), kind, level, change, says))  # type: ignore[attr-defined]
        return change

    return add


@dataclass
class Outcome:
    healed: intake.Healed
    lost: set[str]
    due: set[str] = field(default_factory=set)


def suffer(lab: Lab, damages: list[Damage], rng: random.Random, below: Path) -> Outcome:
    """Hand in the reference with ``damages`` in ``below/<student>/<lab>``, take it in, and see what is lost.

    Raises :class:`InapplicableError` where a later damage finds nothing to work on.
    """
    folder = below / "amara" / lab.name
    folder.mkdir(parents=True)
    due: set[str] = set()
    notebook = json.loads(json.dumps(lab.reference))
    for one in [d for d in damages if d.level == NOTEBOOK]:
        due |= set(_applied(one, notebook, rng, lab) or ())
    data = written(notebook)
    for one in [d for d in damages if d.level == FILE]:
        data, *gone = _applied(one, data, rng, lab)
        due |= set(*gone)
    (folder / lab.file).write_bytes(data)
    for one in [d for d in damages if d.level == FOLDER]:
        due |= set(one.change(folder, rng, lab) or ())
    received = intake.receive(folder, below=below, protected=[lab.course / "autograder", lab.course / "solutions"])
    healed = intake.choose(received, lab.file, lab.master)
    return Outcome(healed, lost(healed.notebook, lab), due)


class InapplicableError(Exception):
    """There is nothing (left) that a damage could damage."""


def _applied(one: Damage, target: Any, rng: random.Random, lab: Lab) -> Any:
    try:
        return one.change(target, rng, lab)
    except (IndexError, StopIteration, AttributeError) as error:
        raise InapplicableError(one.name) from error


def written(notebook: dict[str, Any]) -> bytes:
    return (json.dumps(notebook, indent=1, sort_keys=True, ensure_ascii=False) + "\n").encode("utf-8", "surrogatepass")


def _name(cell: dict[str, Any]) -> str:
    metadata = cell.get("metadata")
    nbgrader = metadata.get("nbgrader") if isinstance(metadata, dict) else None
    return str(nbgrader.get("grade_id", "")) if isinstance(nbgrader, dict) else ""


def _at(cells: Cells, name: str) -> int:
    return next(i for i, c in enumerate(cells) if _name(c) == name)


def _present(cells: Cells, lab: Lab) -> list[str]:
    names = [_name(c) for c in cells]
    return [a for a in lab.answers if names.count(a) == 1]


def _tests(cells: Cells) -> list[int]:
    return [i for i, c in enumerate(cells) if _name(c) and _locked(c) and "score(" in str(c["source"])]


def _locked(cell: dict[str, Any]) -> bool:
    return bool(cell["metadata"]["nbgrader"].get("locked"))


def _test_after(cells: Cells, index: int) -> int:
    return next(i for i in _tests(cells) if i > index)


def _code(source: str, **metadata: Any) -> dict[str, Any]:
    return {"cell_type": "code", "execution_count": None, "metadata": metadata, "outputs": [], "source": source}


def _stub(lab: Lab, name: str) -> str:
    return str(next(c.source for c in lab.stub.cells if intake.grade_id(c) == name))


def _functional(cells: Cells, lab: Lab) -> list[str]:
    """Answers whose template already names what they define, which is how an answer in another cell is found."""
    return [a for a in _present(cells, lab) if bindings(_stub(lab, a))]


# --- cells that were moved, copied, cut


@damage("deleted cells", NOTEBOOK, "put back")
def a_test_cell_was_deleted(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    del nb["cells"][rng.choice(_tests(nb["cells"]))]


@damage("deleted cells", NOTEBOOK, "put back")
def all_test_cells_were_deleted(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    tests = set(_tests(nb["cells"]))
    nb["cells"] = [c for i, c in enumerate(nb["cells"]) if i not in tests]


@damage("deleted cells", NOTEBOOK, "put back")
def an_answer_was_deleted(nb: dict[str, Any], rng: random.Random, lab: Lab) -> set[str]:
    name = rng.choice(_present(nb["cells"], lab))
    del nb["cells"][_at(nb["cells"], name)]
    return {name}


@damage("deleted cells", NOTEBOOK)
def the_setup_cell_was_deleted(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    del nb["cells"][next(i for i, c in enumerate(nb["cells"]) if c["cell_type"] == "code")]


@damage("deleted cells", NOTEBOOK)
def all_text_was_deleted(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    nb["cells"] = [c for c in nb["cells"] if c["cell_type"] == "code"]


@damage("copied cells", NOTEBOOK, "occurred twice")
def an_answer_was_copied(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    index = _at(nb["cells"], rng.choice(_present(nb["cells"], lab)))
    nb["cells"].insert(rng.randrange(len(nb["cells"]) + 1), copy.deepcopy(nb["cells"][index]))


@damage("copied cells", NOTEBOOK, "occurred twice")
def the_template_was_copied_below_the_answer(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    name = rng.choice(_present(nb["cells"], lab))
    index = _at(nb["cells"], name)
    template = copy.deepcopy(nb["cells"][index]) | {"source": _stub(lab, name)}
    nb["cells"].insert(rng.randrange(index + 1, len(nb["cells"]) + 1), template)


@damage("copied cells", NOTEBOOK)
def an_unlabelled_copy_of_the_template_stands_below(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    name = rng.choice(_present(nb["cells"], lab))
    nb["cells"].insert(_at(nb["cells"], name) + 1, _code(_stub(lab, name)))


@damage("copied cells", NOTEBOOK, "occurred")
def every_cell_occurs_twice(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    nb["cells"] = [copy.deepcopy(c) for c in nb["cells"] for _ in range(2)]


@damage("copied cells", NOTEBOOK, "occurred twice")
def a_broken_draft_was_copied_below(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    index = _at(nb["cells"], rng.choice(_present(nb["cells"], lab)))
    nb["cells"].insert(index + 1, copy.deepcopy(nb["cells"][index]) | {"source": "def draft(:\n    ..."})


def _split(nb: dict[str, Any], rng: random.Random, lab: Lab, labels: tuple[bool, ...]) -> None:
    name = rng.choice([a for a in _present(nb["cells"], lab) if str(_cell(nb, a)["source"]).count("\n") > 0])
    index = _at(nb["cells"], name)
    lines = str(nb["cells"][index]["source"]).split("\n")
    cuts = sorted(rng.sample(range(1, len(lines)), min(len(lines) - 1, len(labels) - 1)))
    parts = []
    for label, (a, b) in zip(labels, zip([0, *cuts], [*cuts, len(lines)], strict=True), strict=False):
        part = copy.deepcopy(nb["cells"][index]) | {"source": "\n".join(lines[a:b])}
        if not label:
            part["metadata"] = {}
            part["id"] = f"new-{rng.randrange(10**9)}"
        parts.append(part)
    nb["cells"][index : index + 1] = parts


def _cell(nb: dict[str, Any], name: str) -> dict[str, Any]:
    return dict(nb["cells"][_at(nb["cells"], name)])


@damage("split cells", NOTEBOOK)
def an_answer_was_split_and_both_parts_kept_the_label(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    _split(nb, rng, lab, (True, True))


@damage("split cells", NOTEBOOK)
def an_answer_was_split_and_the_first_part_kept_the_label(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    _split(nb, rng, lab, (True, False))


@damage("split cells", NOTEBOOK)
def an_answer_was_split_and_the_last_part_kept_the_label(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    _split(nb, rng, lab, (False, True))


@damage("split cells", NOTEBOOK)
def an_answer_was_split_into_three(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    _split(nb, rng, lab, (True, False, False))


def _merge(cells: Cells, first: int, last: int) -> None:
    merged = cells[first] | {"source": "\n\n".join(str(c["source"]) for c in cells[first : last + 1])}
    cells[first : last + 1] = [merged]


@damage("merged cells", NOTEBOOK)
def an_answer_was_merged_with_its_test(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    index = _at(nb["cells"], rng.choice(_present(nb["cells"], lab)))
    _merge(nb["cells"], index, index + 1 if nb["cells"][index + 1]["cell_type"] == "code" else index)


@damage("merged cells", NOTEBOOK)
def several_cells_were_merged(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    cells = nb["cells"]
    index = _at(cells, rng.choice(_present(cells, lab)))
    last = min(len(cells) - 1, index + rng.randrange(1, 6))
    while any(c["cell_type"] != "code" or c["metadata"].get("tags") for c in cells[index : last + 1]):
        last -= 1
    _merge(cells, index, last)


@damage("merged cells", NOTEBOOK)
def a_heading_was_merged_into_an_answer(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    cells = nb["cells"]
    index = _at(cells, rng.choice(_present(cells, lab)))
    if index and cells[index - 1]["cell_type"] == "markdown":
        _merge(cells, index - 1, index)


@damage("retyped cells", NOTEBOOK, "had become")
def an_answer_became_text(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    cell = nb["cells"][_at(nb["cells"], rng.choice(_present(nb["cells"], lab)))]
    cell["cell_type"] = rng.choice(["markdown", "raw"])
    cell.pop("outputs", None)


@damage("retyped cells", NOTEBOOK)
def every_cell_became_text(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    for cell in nb["cells"]:
        cell["cell_type"] = "markdown"


@damage("retyped cells", NOTEBOOK)
def types_are_unknown_words(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    for cell in rng.sample(nb["cells"], len(nb["cells"]) // 2):
        cell["cell_type"] = rng.choice(["Code", "python", "", 7, None])


@damage("reordered cells", NOTEBOOK)
def a_test_was_moved_to_the_top(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    nb["cells"].insert(0, nb["cells"].pop(rng.choice(_tests(nb["cells"]))))


@damage("reordered cells", NOTEBOOK)
def an_answer_was_moved_to_the_end(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    nb["cells"].append(nb["cells"].pop(_at(nb["cells"], rng.choice(_present(nb["cells"], lab)))))


@damage("reordered cells", NOTEBOOK)
def all_cells_were_shuffled(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    rng.shuffle(nb["cells"])


@damage("reordered cells", NOTEBOOK)
def the_notebook_is_upside_down(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    nb["cells"].reverse()


@damage("answers elsewhere", NOTEBOOK)
def two_answers_stand_in_each_others_cells(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    names = _functional(nb["cells"], lab)
    if len(names) > 1:
        a, b = (nb["cells"][_at(nb["cells"], n)] for n in rng.sample(names, 2))
        a["source"], b["source"] = b["source"], a["source"]


def _move_out(nb: dict[str, Any], rng: random.Random, lab: Lab, leave: str) -> tuple[dict[str, Any], int]:
    name = rng.choice(_functional(nb["cells"], lab))
    index = _at(nb["cells"], name)
    cell = nb["cells"][index]
    moved = _code(cell["source"])
    moved["id"] = f"new-{rng.randrange(10**9)}"
    cell["source"] = {"empty": "", "stub": _stub(lab, name), "comment": "# see below"}[leave]
    return moved, index


@damage("answers elsewhere", NOTEBOOK)
def an_answer_was_written_in_a_new_cell_below_the_template(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    moved, index = _move_out(nb, rng, lab, rng.choice(["empty", "stub", "comment"]))
    nb["cells"].insert(index + 1, moved)


@damage("answers elsewhere", NOTEBOOK, "above its own")
def an_answer_was_written_in_a_new_cell_above_the_template(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    moved, index = _move_out(nb, rng, lab, "stub")
    nb["cells"].insert(index, moved)


@damage("answers elsewhere", NOTEBOOK, "below its test")
def an_answer_was_written_below_its_test(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    moved, index = _move_out(nb, rng, lab, rng.choice(["empty", "stub"]))
    nb["cells"].insert(_test_after(nb["cells"], index) + 1, moved)


@damage("answers elsewhere", NOTEBOOK, "below its test")
def an_answer_was_written_at_the_end_with_its_helper_before_it(
    nb: dict[str, Any], rng: random.Random, lab: Lab
) -> None:
    moved, _ = _move_out(nb, rng, lab, "stub")
    nb["cells"] += [_code("def unrelated():\n    return 1"), moved]


@damage("answers elsewhere", NOTEBOOK)
def all_answers_stand_in_one_cell_at_the_end(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    sources = []
    for name in _functional(nb["cells"], lab):
        cell = nb["cells"][_at(nb["cells"], name)]
        sources.append(cell["source"])
        cell["source"] = _stub(lab, name)
    nb["cells"].append(_code("\n\n\n".join(sources)))


@damage("answers elsewhere", NOTEBOOK)
def an_answer_was_written_into_the_next_answers_cell(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    names = _functional(nb["cells"], lab)
    if len(names) > 1:
        i = rng.randrange(len(names) - 1)
        a, b = (nb["cells"][_at(nb["cells"], n)] for n in names[i : i + 2])
        b["source"] = f"{a['source']}\n\n\n{b['source']}"
        a["source"] = _stub(lab, names[i])


@damage("answers elsewhere", NOTEBOOK)
def an_answer_was_written_into_the_answer_before(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    names = _functional(nb["cells"], lab)
    if len(names) > 1:
        i = rng.randrange(len(names) - 1)
        a, b = (nb["cells"][_at(nb["cells"], n)] for n in names[i : i + 2])
        a["source"] = f"{a['source']}\n\n\n{b['source']}"
        b["source"] = _stub(lab, names[i + 1])


@damage("answers elsewhere", NOTEBOOK, "changed")
def an_answer_was_written_into_its_test_cell(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    moved, index = _move_out(nb, rng, lab, "stub")
    test = nb["cells"][_test_after(nb["cells"], index)]
    test["source"] = f"{moved['source']}\n\n{test['source']}"


# --- locked cells


@damage("locked cells", NOTEBOOK, "was restored")
def a_test_was_edited(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    nb["cells"][rng.choice(_tests(nb["cells"]))]["source"] = "1000.0"


@damage("locked cells", NOTEBOOK)
def points_and_flags_were_edited(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    for index in _tests(nb["cells"]):
        nb["cells"][index]["metadata"]["nbgrader"] |= {"points": 500, "grade": False, "solution": True, "locked": False}


@damage("locked cells", NOTEBOOK)
def everything_was_tagged_not_to_run(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    for cell in nb["cells"]:
        if _name(cell):
            cell["metadata"]["tags"] = ["skip-grading"]


# --- fields of cells


@damage("lost labels", NOTEBOOK)
def every_label_is_gone(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    for cell in nb["cells"]:
        cell["metadata"].pop("nbgrader", None)


@damage("lost labels", NOTEBOOK)
def every_cell_id_is_gone(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    for cell in nb["cells"]:
        cell.pop("id", None)
    nb["nbformat_minor"] = 2


@damage("lost labels", NOTEBOOK)
def labels_and_ids_are_gone(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    every_label_is_gone(nb, rng, lab)
    for cell in nb["cells"]:
        cell["id"] = f"{rng.randrange(16**8):08x}"


@damage("lost labels", NOTEBOOK)
def labels_are_of_the_wrong_type(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    for cell in nb["cells"]:
        if _name(cell) and rng.random() < 0.5:
            cell["metadata"]["nbgrader"] = rng.choice([None, 3, [], "scale", {"grade_id": 7}, {"grade_id": None}])


@damage("odd fields", NOTEBOOK)
def the_notebooks_metadata_is_null(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    nb["metadata"] = rng.choice([None, 3, [], "x", {"kernelspec": None}])


@damage("odd fields", NOTEBOOK)
def metadata_of_cells_is_null(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    for cell in nb["cells"]:
        if rng.random() < 0.5:
            cell["metadata"] = rng.choice([None, 3, [], "x"])


@damage("odd fields", NOTEBOOK)
def sources_are_lists_of_lists(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    for cell in nb["cells"]:
        lines = str(cell["source"]).splitlines(keepends=True)
        cut = rng.randrange(len(lines) + 1)
        cell["source"] = [lines[:cut], [lines[cut:]], None]


@damage("odd fields", NOTEBOOK)
def sources_are_lines_without_line_ends(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    for cell in nb["cells"]:
        cell["source"] = str(cell["source"]).split("\n")


@damage("odd fields", NOTEBOOK)
def line_ends_are_of_another_system(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    for cell in nb["cells"]:
        cell["source"] = str(cell["source"]).replace("\n", rng.choice(["\r\n", "\r"]))


@damage("odd fields", NOTEBOOK)
def ids_are_invalid_or_repeated(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    for cell in nb["cells"]:
        cell["id"] = rng.choice(["same", "", "ü" * 100, 3, None, "a b"])


@damage("odd fields", NOTEBOOK)
def outputs_are_broken(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    for cell in nb["cells"]:
        cell["outputs"] = rng.choice([None, 3, "x", [None], [{"output_type": 3}], {"a": [1]}])
        cell["execution_count"] = rng.choice(["*", -1, [], None])


@damage("odd fields", NOTEBOOK)
def junk_stands_between_the_cells(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    for junk in (None, 3, "text", [], {}, {"source": None}, {"cell_type": "code"}, [1, [2]]):
        nb["cells"].insert(rng.randrange(len(nb["cells"]) + 1), junk)


@damage("odd fields", NOTEBOOK)
def cells_are_a_dictionary(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    nb["cells"] = {f"{i:04d}": c for i, c in enumerate(nb["cells"])}


@damage("odd fields", NOTEBOOK, "cannot be read")
def cells_are_null(nb: dict[str, Any], rng: random.Random, lab: Lab) -> set[str]:
    nb["cells"] = None
    return set(lab.answers)


@damage("odd fields", NOTEBOOK)
def lone_surrogates_stand_in_comments(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    cell = nb["cells"][_at(nb["cells"], rng.choice(_present(nb["cells"], lab)))]
    cell["source"] = f"# \ud83d alone\n{cell['source']}"


# --- the format


@damage("old formats", NOTEBOOK)
def the_format_is_nbformat_3(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    cells = nb.pop("cells")
    for cell in cells:
        if cell["cell_type"] == "code":
            cell["input"] = cell.pop("source")
            cell |= {"language": "python", "collapsed": False, "prompt_number": 1}
        elif str(cell["source"]).startswith("# "):
            cell |= {"cell_type": "heading", "level": 1, "source": str(cell["source"])[2:]}
    nb |= {"nbformat": 3, "nbformat_minor": 0, "worksheets": [{"cells": cells, "metadata": {}}]}


@damage("old formats", NOTEBOOK)
def the_version_is_missing_or_odd(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    nb["nbformat"] = rng.choice([None, "4", 99, 4.5, []])
    nb["nbformat_minor"] = rng.choice([None, "5", -1])


# --- the bytes


def _recoded(data: bytes, encoding: str) -> tuple[bytes]:
    return (data.decode("utf-8", "replace").encode(encoding, "replace"),)


@damage("encodings", FILE)
def a_byte_order_mark_was_added(data: bytes, rng: random.Random, lab: Lab) -> tuple[bytes]:
    return (codecs.BOM_UTF8 + data,)


@damage("encodings", FILE, "UTF-16")
def the_file_is_utf16(data: bytes, rng: random.Random, lab: Lab) -> tuple[bytes]:
    return _recoded(data, "utf-16")


@damage("encodings", FILE, "UTF-16")
def the_file_is_utf16_without_a_mark(data: bytes, rng: random.Random, lab: Lab) -> tuple[bytes]:
    return _recoded(data, rng.choice(["utf-16-le", "utf-16-be"]))


@damage("encodings", FILE, "UTF-32")
def the_file_is_utf32(data: bytes, rng: random.Random, lab: Lab) -> tuple[bytes]:
    return _recoded(data, rng.choice(["utf-32", "utf-32-le", "utf-32-be"]))


@damage("encodings", FILE)
def the_file_is_latin1(data: bytes, rng: random.Random, lab: Lab) -> tuple[bytes]:
    return _recoded(data.replace(b"# ", "# ü ".encode(), 1), "latin-1")


@damage("encodings", FILE)
def the_file_has_windows_line_ends(data: bytes, rng: random.Random, lab: Lab) -> tuple[bytes]:
    return (data.replace(b"\n", b"\r\n"),)


@damage("encodings", FILE, "zero bytes")
def zero_bytes_follow_or_stand_between(data: bytes, rng: random.Random, lab: Lab) -> tuple[bytes]:
    at = rng.choice([0, len(data), data.index(b"\n", rng.randrange(len(data) // 2))])
    return (data[:at] + bytes(rng.choice([1, 4096])) + data[at:],)


@damage("encodings", FILE, "damaged")
def stray_bytes_stand_between_lines(data: bytes, rng: random.Random, lab: Lab) -> tuple[bytes]:
    at = data.index(b'"cells"')
    return (data[:at] + b'"stray": "\xff \xc3\xbc \xe2\x82\xac \xc3\xa4",\n ' + data[at:],)


@damage("packed", FILE, "gzip")
def the_file_is_gzip(data: bytes, rng: random.Random, lab: Lab) -> tuple[bytes]:
    return (gzip.compress(data, mtime=0),)


@damage("packed", FILE, "ZIP")
def the_file_is_a_zip_archive(data: bytes, rng: random.Random, lab: Lab) -> tuple[bytes]:
    return (
        zipped({"handed_in/lab.ipynb": data, "__MACOSX/handed_in/._lab.ipynb": b"\0\5\x16\7", "notes.txt": b"hello"}),
    )


def zipped(files: dict[str, bytes]) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return out.getvalue()


@damage("broken JSON", FILE, "breaks off")
def the_file_breaks_off(data: bytes, rng: random.Random, lab: Lab) -> tuple[bytes, set[str]]:
    text = data.decode("utf-8", "replace")
    ends = _ends(text)
    cut = rng.randrange(ends[0][1], len(text))
    begins = [0, *(end for _, end in ends)]
    inside = max(b for b in begins if b <= cut)
    own = next((e for _, e in ends if e > inside), len(text))
    cut = min(cut, inside + (own - inside) // 2)  # in the first half of a cell, so that its text is not complete
    kept = {name for name, end in ends if end <= cut}
    return text[:cut].encode(), {a for a in lab.answers if a not in kept}


def _ends(text: str) -> list[tuple[str, int]]:
    """Where the text of each cell ends in a file of :func:`written`."""
    notebook = json.loads(text)
    found = []
    for count, cell in enumerate(notebook["cells"], 1):
        part = written(notebook | {"cells": notebook["cells"][:count]}).decode()
        same = next((i for i, (x, y) in enumerate(zip(text, part, strict=False)) if x != y), len(part))
        found.append((_name(cell), same))
    return found


@damage("broken JSON", FILE)
def commas_are_too_many(data: bytes, rng: random.Random, lab: Lab) -> tuple[bytes]:
    return (re.sub(rb"\n( *[\]}])", lambda m: b",\n" + m[1] if rng.random() < 0.3 else b"\n" + m[1], data),)


@damage("broken JSON", FILE)
def commas_are_lost(data: bytes, rng: random.Random, lab: Lab) -> tuple[bytes]:
    return (re.sub(rb",\n", lambda m: b"\n" if rng.random() < 0.2 else m[0], data),)


@damage("broken JSON", FILE)
def numbers_are_not_json(data: bytes, rng: random.Random, lab: Lab) -> tuple[bytes]:
    return (data.replace(b'"execution_count": null', b'"execution_count": ' + rng.choice([b"NaN", b"0x1", b"None"])),)


@damage("broken JSON", FILE)
def keys_are_repeated(data: bytes, rng: random.Random, lab: Lab) -> tuple[bytes]:
    data = data.replace(b'"source": ', b'"source": [],\n   "source": ', 3)
    return (data.replace(b'{\n "cells"', b'{\n "cells": [],\n "cells"').rstrip()[:-1] + b',\n "cells": []\n}',)


@damage("broken JSON", FILE, "more than one")
def an_older_notebook_stands_before_it(data: bytes, rng: random.Random, lab: Lab) -> tuple[bytes]:
    return (written(json.loads(json.dumps(lab.stub))) + data,)


@damage("broken JSON", FILE)
def other_text_stands_around_it(data: bytes, rng: random.Random, lab: Lab) -> tuple[bytes]:
    return (b"$ cat lab.ipynb\n" + data + b"\n$ exit\n",)


@damage("broken JSON", FILE)
def it_is_wrapped_in_something(data: bytes, rng: random.Random, lab: Lab) -> tuple[bytes]:
    notebook = json.loads(data)
    wrapped = rng.choice([{"content": notebook, "type": "notebook"}, notebook["cells"], {"a": {"b": notebook}}])
    return (json.dumps(json.dumps(notebook) if rng.random() < 0.25 else wrapped).encode(),)


@damage("broken JSON", FILE)
def closing_brackets_of_a_cell_are_lost(data: bytes, rng: random.Random, lab: Lab) -> tuple[bytes]:
    places = [m.start() for m in re.finditer(rb"\n  \},\n", data)]
    at = rng.choice(places)
    return (data[:at] + data[at + 5 :],)


@damage("git conflicts", FILE, "conflict")
def a_conflict_stands_in_metadata(data: bytes, rng: random.Random, lab: Lab) -> tuple[bytes]:
    old = b'   "execution_count": null,\n'
    new = b"<<<<<<< HEAD\n" + old + b"=======\n" + old.replace(b"null", b"7") + b">>>>>>> branch\n"
    return (data.replace(old, new, rng.choice([1, 3, -1])),)


def _conflict(data: bytes, rng: random.Random, lab: Lab, *, answer_first: bool) -> bytes:
    mine = json.loads(data)
    present = [c for c in mine["cells"] if isinstance(c, dict)]
    name = rng.choice(_present(present, lab))
    other = copy.deepcopy(mine)
    other["cells"][_at(other["cells"], name)]["source"] = _stub(lab, name)
    a, b = written(mine).splitlines(keepends=True), written(other).splitlines(keepends=True)
    start = next(i for i, (x, y) in enumerate(zip(a, b, strict=False)) if x != y)
    back = next(i for i, (x, y) in enumerate(zip(a[::-1], b[::-1], strict=False)) if x != y)
    first, second = (a, b) if answer_first else (b, a)
    middle = [b"<<<<<<< HEAD\n", *first[start : len(first) - back], b"=======\n"]
    return b"".join([*a[:start], *middle, *second[start : len(second) - back], b">>>>>>> x\n", *a[len(a) - back :]])


@damage("git conflicts", FILE, "conflict")
def the_answer_conflicts_with_the_template(data: bytes, rng: random.Random, lab: Lab) -> tuple[bytes]:
    return (_conflict(data, rng, lab, answer_first=True),)


@damage("git conflicts", FILE, "conflict")
def the_template_conflicts_with_the_answer(data: bytes, rng: random.Random, lab: Lab) -> tuple[bytes]:
    return (_conflict(data, rng, lab, answer_first=False),)


@damage("git conflicts", NOTEBOOK, "conflict")
def a_conflict_stands_in_an_answer(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    name = rng.choice(_present(nb["cells"], lab))
    cell = nb["cells"][_at(nb["cells"], name)]
    sides = [cell["source"], "def half_done(:\n    pass"]
    rng.shuffle(sides)
    cell["source"] = f"<<<<<<< HEAD\n{sides[0]}\n=======\n{sides[1]}\n>>>>>>> main"


@damage("other kinds of file", FILE, "script")
def it_is_a_script_with_cell_marks(data: bytes, rng: random.Random, lab: Lab) -> tuple[bytes]:
    return (script(json.loads(data), rng.choice(["# %%", "# In[ ]:", "#%%"])),)


def script(notebook: dict[str, Any], mark: str) -> bytes:
    parts = ["#!/usr/bin/env python\n# coding: utf-8\n"]
    for cell in notebook["cells"]:
        source = _text(cell)
        if cell["cell_type"] == "code":
            parts.append(f"{mark}\n{source}\n")
        elif "%%" in mark:
            parts.append(
                f"{mark} [markdown]\n" + "\n".join(f"# {line}".rstrip() for line in source.splitlines()) + "\n"
            )
        else:
            parts.append("\n".join(f"# {line}".rstrip() for line in source.splitlines()) + "\n\n")
    return "\n".join(parts).encode("utf-8", "replace")


def _text(cell: dict[str, Any]) -> str:
    """The source of a cell as nbconvert would write it."""
    source = cell["source"]
    if isinstance(source, str):
        return source
    lines = [x for part in source for x in (part if isinstance(part, list) else [part or ""])]
    lines = [x for part in lines for x in (part if isinstance(part, list) else [part])]
    return ("" if any(x.endswith("\n") for x in lines) else "\n").join(lines)


@damage("other kinds of file", FILE, "script")
def it_is_a_script_without_marks(data: bytes, rng: random.Random, lab: Lab) -> tuple[bytes]:
    cells = [c for c in json.loads(data)["cells"] if isinstance(c, dict) and "raise RuntimeError" not in _text(c)]
    return ("\n\n".join(_text(c) for c in cells if not _text(c).startswith("#")).encode("utf-8", "replace"),)


@damage("other kinds of file", FILE, "web page")
def it_is_an_exported_page(data: bytes, rng: random.Random, lab: Lab) -> tuple[bytes]:
    return (page(json.loads(data)).encode(),)


def page(notebook: dict[str, Any]) -> str:
    """A notebook as nbconvert exports it, as far as matters here."""
    import html

    cells = []
    for cell in notebook["cells"]:
        source = html.escape(_text(cell))
        if cell["cell_type"] == "code":
            coloured = re.sub(r"\b(def|return|class)\b", r'<span class="k">\1</span>', source)
            inner = f'<div class="highlight hl-ipython3"><pre><span></span>{coloured}\n</pre></div>'
            cells.append(
                f'<div class="jp-CodeMirrorEditor jp-Editor jp-InputArea-editor" data-type="inline">{inner}</div>'
            )
        else:
            cells.append(f'<div class="jp-RenderedHTMLCommon">{source}</div>')
    return "<!DOCTYPE html>\n<html><head><title>lab</title></head><body>" + "\n".join(cells) + "</body></html>"


@damage("other kinds of file", FILE, "web page")
def it_is_a_login_page(data: bytes, rng: random.Random, lab: Lab) -> tuple[bytes, set[str]]:
    return b"<!DOCTYPE html><html><body><form>Password: <input></form></body></html>", set(lab.answers)


@damage("other kinds of file", FILE, "LFS")
def it_is_a_pointer_to_another_store(data: bytes, rng: random.Random, lab: Lab) -> tuple[bytes, set[str]]:
    return b"version https://git-lfs.github.com/spec/v1\noid sha256:12\nsize 3\n", set(lab.answers)


@damage("other kinds of file", FILE, "cannot be read")
def it_is_noise(data: bytes, rng: random.Random, lab: Lab) -> tuple[bytes, set[str]]:
    return b"\x89PNG\r\n\x1a\n" + rng.randbytes(5000), set(lab.answers)


@damage("other kinds of file", FILE, "is empty")
def it_is_empty(data: bytes, rng: random.Random, lab: Lab) -> tuple[bytes, set[str]]:
    return rng.choice([b"", b"\n \n", bytes(10_000), codecs.BOM_UTF8]), set(lab.answers)


# --- bombs


@damage("bombs", FILE)
def metadata_is_nested_deeply(data: bytes, rng: random.Random, lab: Lab) -> tuple[bytes]:
    deep = rng.choice([b"[" * 30_000 + b"]" * 30_000, b'{"a":' * 30_000 + b"1" + b"}" * 30_000])
    return (data.replace(b'{\n "cells"', b'{\n "bomb": ' + deep + b',\n "cells"', 1),)


@damage("bombs", NOTEBOOK, "too many")
def cells_are_without_number(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    nb["cells"] += [{"cell_type": "code", "source": ""}] * 20_000


@damage("bombs", NOTEBOOK, "left out")
def a_cell_of_the_students_is_a_giant(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    nb["cells"].insert(rng.randrange(len(nb["cells"]) + 1), _code("x = '" + "a" * 3_000_000 + "'"))


@damage("bombs", NOTEBOOK)
def an_output_is_a_giant(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    giant = {"output_type": "stream", "name": "stdout", "text": '[{",' * 600_000}
    nb["cells"].insert(0, _code("print()") | {"outputs": [giant]})


@damage("bombs", NOTEBOOK)
def code_of_the_students_is_nested_deeply(nb: dict[str, Any], rng: random.Random, lab: Lab) -> None:
    bombs = ["(" * 50_000, "-" * 50_000 + "1", "f = " + "lambda: " * 20_000 + "1", "{1:" * 9000, "not " * 50_000 + "x"]
    for bomb in bombs:
        nb["cells"].insert(rng.randrange(len(nb["cells"]) + 1), _code(bomb))


# --- the folder


def _write(path: Path, data: bytes | str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data if isinstance(data, bytes) else data.encode())


def _renamed(folder: Path, lab: Lab, name: str) -> None:
    data = (folder / lab.file).read_bytes()
    (folder / lab.file).unlink()
    _write(folder / name, data)


@damage("wrong names", FOLDER, "in place of")
def the_browser_added_a_number(folder: Path, rng: random.Random, lab: Lab) -> None:
    _renamed(folder, lab, f"{lab.name} ({rng.randrange(1, 9)}).ipynb")


@damage("wrong names", FOLDER, "in place of")
def jupyter_made_a_copy(folder: Path, rng: random.Random, lab: Lab) -> None:
    _renamed(folder, lab, rng.choice([f"{lab.name}-Copy1.ipynb", f"{lab.name}_final_FINAL.ipynb", "Untitled3.ipynb"]))


@damage("wrong names", FOLDER, "in place of")
def the_name_is_in_capitals(folder: Path, rng: random.Random, lab: Lab) -> None:
    _renamed(folder, lab, lab.file.upper().replace(".IPYNB", rng.choice([".ipynb", ".IPYNB"])))


@damage("wrong names", FOLDER, "in place of")
def the_browser_added_an_extension(folder: Path, rng: random.Random, lab: Lab) -> None:
    _renamed(folder, lab, lab.file + rng.choice([".txt", ".json"]))


@damage("wrong names", FOLDER, "in place of")
def it_lies_in_a_folder(folder: Path, rng: random.Random, lab: Lab) -> None:
    _renamed(folder, lab, f"{lab.name}/{rng.choice(['', 'work/'])}{lab.file}")


@damage("wrong names", FOLDER, "in place of")
def it_lies_in_an_archive(folder: Path, rng: random.Random, lab: Lab) -> None:
    data = zipped({f"{lab.name}/{lab.file}": (folder / lab.file).read_bytes(), "../../x.py": b"1"})
    (folder / lab.file).unlink()
    _write(folder / "homework.zip", data)


@damage("wrong names", FOLDER, "in place of")
def only_the_editors_checkpoint_is_there(folder: Path, rng: random.Random, lab: Lab) -> None:
    _renamed(folder, lab, f".ipynb_checkpoints/{lab.name}-checkpoint.ipynb")


@damage("two notebooks", FOLDER, "in place of")
def the_untouched_lab_has_the_right_name(folder: Path, rng: random.Random, lab: Lab) -> None:
    _renamed(folder, lab, f"{lab.name} (1).ipynb")
    _write(folder / lab.file, written(json.loads(json.dumps(lab.stub))))


@damage("two notebooks", FOLDER, "in place of")
def a_broken_file_has_the_right_name(folder: Path, rng: random.Random, lab: Lab) -> None:
    _renamed(folder, lab, f"{lab.name}-Copy1.ipynb")
    _write(folder / lab.file, rng.choice([b"", bytes(100), b"{", b"<html>"]))


@damage("two notebooks", FOLDER)
def the_untouched_lab_lies_beside_it(folder: Path, rng: random.Random, lab: Lab) -> None:
    for name in (f"{lab.name}-Copy1.ipynb", f".ipynb_checkpoints/{lab.name}-checkpoint.ipynb", f"old/{lab.file}"):
        _write(folder / name, written(json.loads(json.dumps(lab.stub))))


@damage("no plain file", FOLDER, "no notebook")
def nothing_was_handed_in(folder: Path, rng: random.Random, lab: Lab) -> set[str]:
    (folder / lab.file).unlink()
    return set(lab.answers)


@damage("no plain file", FOLDER, "link")
def the_notebook_is_a_link(folder: Path, rng: random.Random, lab: Lab) -> set[str]:
    target = folder.parent.parent / "other.ipynb"
    (folder / lab.file).rename(target)
    (folder / lab.file).symlink_to(target)
    return set(lab.answers)


@damage("no plain file", FOLDER, "link")
def a_folder_above_is_a_link(folder: Path, rng: random.Random, lab: Lab) -> set[str]:
    victim = rng.choice([folder, folder.parent])
    target = folder.parent.parent / "elsewhere"
    victim.rename(target)
    victim.symlink_to(target)
    return set(lab.answers)


@damage("no plain file", FOLDER, "pipe")
def the_notebook_is_a_pipe(folder: Path, rng: random.Random, lab: Lab) -> set[str]:
    (folder / lab.file).unlink()
    os.mkfifo(folder / lab.file)
    return set(lab.answers)


@damage("no plain file", FOLDER, "no notebook")
def the_notebook_is_a_folder(folder: Path, rng: random.Random, lab: Lab) -> set[str]:
    (folder / lab.file).unlink()
    (folder / lab.file).mkdir()
    return set(lab.answers)


@damage("no plain file", FOLDER, "hard link")
def the_notebook_is_a_hard_link_to_the_solution(folder: Path, rng: random.Random, lab: Lab) -> set[str]:
    (folder / lab.file).unlink()
    os.link(next((lab.course / "solutions" / lab.name).glob("*.ipynb")), folder / lab.file)
    return set(lab.answers)


@damage("odd files beside it", FOLDER, "socket")
def pipes_and_sockets_lie_beside_it(folder: Path, rng: random.Random, lab: Lab) -> None:
    os.mkfifo(folder / "pipe")
    here = Path.cwd()
    os.chdir(folder)  # the name of a socket must be short
    try:
        with socket.socket(socket.AF_UNIX) as one:
            one.bind("sock")
    finally:
        os.chdir(here)


@damage("odd files beside it", FOLDER, "larger than")
def a_giant_with_holes_lies_beside_it(folder: Path, rng: random.Random, lab: Lab) -> None:
    with (folder / "data.bin").open("wb") as file:
        file.truncate(10**12)


@damage("odd files beside it", FOLDER, "more than")
def a_thousand_files_lie_beside_it(folder: Path, rng: random.Random, lab: Lab) -> None:
    for number in range(1000):
        (folder / f"{number:04d}.txt").touch()


@damage("odd files beside it", FOLDER, "name")
def files_have_strange_names(folder: Path, rng: random.Random, lab: Lab) -> None:
    undecodable = os.fsdecode(b"\xff\xfe.txt")
    for name in ("CON.txt", "a:b", "tab\there", "dot.", "x" * 200, "..\\..\\grades.csv", "nul", undecodable):
        (folder / name).touch()


@damage("odd files beside it", FOLDER, "upper and lower case")
def names_differ_in_case_only(folder: Path, rng: random.Random, lab: Lab) -> None:
    for name in ("Helper.py", "helper.py", "HELPER.py"):
        _write(folder / name, "x = 1")


@damage("odd files beside it", FOLDER, "link")
def links_lie_beside_it(folder: Path, rng: random.Random, lab: Lab) -> None:
    (folder / "hidden").symlink_to(lab.course)
    (folder / "loop").symlink_to(folder)
    (folder / "passwd").symlink_to("/etc/passwd")
    os.link(lab.course / "autograder" / "nbgrader_config.py", folder / "config.py")


@damage("odd files beside it", FOLDER, "too deep")
def folders_are_nested_deeply(folder: Path, rng: random.Random, lab: Lab) -> None:
    (folder / "/".join("a" * 30)).mkdir(parents=True)
