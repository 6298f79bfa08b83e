"""The map of the course outline: complete, and every cell that it names is there."""

from __future__ import annotations

import json
import re
from collections import Counter
from pathlib import Path

import pytest

from robotbrain import outline
from robotbrain.errors import InputError
from robotbrain.outline import Cell, Change, Entry, Outline

COUNTS = {"heading": 38, "item": 49, "snippet": 13}  # counted in the outline, which is not part of the repository


@pytest.fixture(scope="module")
def known(repo: Path) -> Outline:
    return outline.read_outline(repo / outline.DATA)


def cells_of(known: Outline) -> list[tuple[str, Cell]]:
    return [(one.key, cell) for one in (*known.entries, *known.changes) for cell in one.cells]


def test_everything_in_the_outline_has_its_entry(known: Outline) -> None:
    assert Counter(entry.kind for entry in known.entries) == COUNTS
    assert all(entry.kind == "heading" for entry in known.entries if entry.part) and known.entries[0].part
    for before, entry in zip(known.entries, known.entries[1:], strict=False):
        assert not (before.kind == "snippet" and entry.kind == "item"), entry.key  # items stand before code


def test_keys_are_stable_names_and_unique(known: Outline) -> None:
    for those in (known.entries, known.changes):
        keys = [one.key for one in those]
        assert len(set(keys)) == len(keys)
        assert all(re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", key) for key in keys)
    assert len({entry.words for entry in known.entries}) == len(known.entries)


def test_each_cell_is_there(known: Outline, repo: Path) -> None:
    ids = {}
    for key, cell in cells_of(known):
        if cell.path not in ids:
            ids[cell.path] = {c["id"] for c in json.loads((repo / cell.path).read_text(encoding="utf-8"))["cells"]}
        assert cell.id in ids[cell.path], f"{key}: {cell.path}#{cell.id}"
    for one in (*known.entries, *known.changes):
        assert len(set(one.cells)) == len(one.cells), one.key


def test_every_notebook_teaches_something_of_it(known: Outline, repo: Path) -> None:
    here = {p.relative_to(repo) for folder in ("course", "labs") for p in (repo / folder).rglob("*.ipynb")}
    here = {path for path in here if ".ipynb_checkpoints" not in path.parts}
    assert {cell.path for entry in known.entries for cell in entry.cells} == here


def test_what_is_planned_is_not_there_yet(known: Outline, repo: Path) -> None:
    for entry in known.entries:
        assert not (entry.planned and (repo / entry.planned).exists()), (
            f"{entry.planned} has come: name its cells at {entry.key}"
        )


def test_what_has_changed_names_who_says_so(known: Outline) -> None:
    assert len(known.changes) >= 30
    for change in known.changes:
        assert change.said and change.today and change.since and change.sources, change.key
        for _, address in change.sources:
            assert re.match(r"https://|\.\./|$", address), change.key


def test_the_page_says_what_the_data_say(known: Outline, repo: Path) -> None:
    written = (repo / outline.PAGE).read_text(encoding="utf-8")
    assert written == outline.page(known, repo), 'Run: python -c "from robotbrain.outline import write; write()"'


def test_links_of_the_page_lead_somewhere(repo: Path) -> None:
    page = repo / outline.PAGE
    targets = set(re.findall(r"\]\(([^)]+)\)", page.read_text(encoding="utf-8")))
    assert len(targets) > 40
    for target in targets:
        assert target.startswith("https://") or (page.parent / target).is_file(), target


def notebook(path: Path, *cells: tuple[str, str, str]) -> Path:
    made = [{"id": id, "cell_type": kind, "source": source.splitlines(keepends=True)} for id, kind, source in cells]
    path.write_text(json.dumps({"cells": made}), encoding="utf-8")
    return path


def test_a_cell_stands_under_the_heading_before_it(tmp_path: Path) -> None:
    path = notebook(
        tmp_path / "a.ipynb",
        ("title", "markdown", "# Title\n\nWords."),
        ("code", "code", "# no heading"),
        ("shell", "markdown", "```\n# no heading either\n```"),
        ("read", "markdown", "Words.\n\n### Exercise 1: later\n\nMore."),
        ("after", "code", "1"),
        ("mixed", "markdown", "Words.\n\n## Next\n\nMore."),
        ("points", "markdown", "### Exercise 2: a task (12 points)"),
        ("last", "code", "1"),
    )
    assert outline.sections(path) == {
        "title": "Title",
        "code": "Title",
        "shell": "Title",
        "read": "Title",
        "after": "Title",
        "mixed": "Next",
        "points": "Exercise 2: a task",
        "last": "Next",
    }


def test_the_page_joins_cells_of_one_section_and_protects_its_tables(tmp_path: Path) -> None:
    (tmp_path / "labs").mkdir()
    path = notebook(tmp_path / "labs" / "a.ipynb", ("x", "markdown", "## A|B"), ("y", "code", "1"))
    cells = tuple(Cell("Lab", path.relative_to(tmp_path), id) for id in ("x", "y"))
    one = Entry("a", "heading", "One", cells, part=True)
    two = Entry("b", "item", "Two | 3", cells[1:], planned="p")
    changes = (Change("c", "Part", "said", "today", "2020", (("who", "https://a.b"), ("book", "")), cells),)
    written = outline.page(Outline((one, two), changes), tmp_path)
    assert "1 headings, 1 items, 0 snippets" in written
    assert "| **One** | heading | [Lab](../labs/a.ipynb): A\\|B (`x`, `y`) |\n" in written
    assert "| Two \\| 3 | item | [Lab](../labs/a.ipynb): A\\|B (`y`) (More of this is in preparation.) |\n" in written
    proof = "2020<br>[who](https://a.b); book<br>[Lab](../labs/a.ipynb): A\\|B (`x`, `y`)"
    assert f"| said | today | {proof} |\n" in written


GOOD = """
[notebooks]
a = { path = "course/a.ipynb", name = "A" }
[[entries]]
key = "k"
kind = "item"
words = "w"
cells = ["a#x"]
[[changes]]
key = "k"
part = "p"
said = "s"
today = "t"
since = "2020"
sources = [["who", "https://a.b"], ["book"]]
cells = ["a#x"]
"""


def test_the_file_is_read_as_written(tmp_path: Path) -> None:
    path = tmp_path / "outline.toml"
    path.write_text(GOOD)
    known = outline.read_outline(path)
    cell = Cell("A", Path("course/a.ipynb"), "x")
    assert known.entries == (Entry("k", "item", "w", (cell,)),)
    assert known.changes[0].sources == (("who", "https://a.b"), ("book", "")) and known.changes[0].cells == (cell,)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('kind = "item"', 'kind = "chapter"'),
        ('cells = ["a#x"]', 'cells = ["b#x"]'),
        ('cells = ["a#x"]', "cells = []"),
        ('words = "w"\n', ""),
        ('today = "t"\n', 'todey = "t"\n'),
        ('sources = [["who", "https://a.b"], ["book"]]', "sources = [[]]"),
        ("[notebooks]", "[notebooks"),
        ("[notebooks]", "[others]"),
    ],
)
def test_a_mistake_in_the_file_is_named(tmp_path: Path, old: str, new: str) -> None:
    path = tmp_path / "outline.toml"
    path.write_text(GOOD.replace(old, new, 1))
    with pytest.raises(InputError, match=r"outline\.toml"):
        outline.read_outline(path)
