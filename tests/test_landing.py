"""The landing notebook lists all there is, with the times that the notebooks themselves state, and its links hold."""

from __future__ import annotations

import re
from pathlib import Path

import nbformat
import pytest

from robotbrain.notebooks import stated_seconds

ROW = re.compile(r"^\| \[[^\]]+\]\(([^)]+)\) \| .+? \| .+? \| (\d+) (s|min) \|$", re.MULTILINE)


@pytest.fixture(scope="module")
def landing(repo: Path) -> str:
    notebook = nbformat.read(repo / "course" / "00_welcome.ipynb", as_version=4)
    return "\n\n".join(cell.source for cell in notebook.cells if cell.cell_type == "markdown")


def test_every_notebook_is_listed_with_the_time_that_it_states(repo: Path, landing: str) -> None:
    listed = {
        (repo / "course" / path).resolve(): int(number) * (60 if unit == "min" else 1)
        for path, number, unit in ROW.findall(landing)
    }
    there = [*(repo / "course").glob("[0-9]*.ipynb"), *(repo / "labs").glob("*/*.ipynb")]
    assert listed == {p: stated_seconds(p) for p in there if p.name != "00_welcome.ipynb"}


def test_every_link_leads_to_a_file(repo: Path, landing: str) -> None:
    links = [link for link in re.findall(r"\]\(([^)#]+)", landing) if "://" not in link]
    assert links and [link for link in links if not (repo / "course" / link).is_file()] == []


def test_it_says_how_to_hand_in_and_where_help_is(landing: str) -> None:
    for word in ("Validate", "Assignment List", "Fetch", "Submit", "view feedback", "robotbrain doctor", "reread"):
        assert word in landing, word
