"""Every link after "reread" in a failing check leads to a cell that is there."""

from __future__ import annotations

import functools
import json
import posixpath
from pathlib import Path
from urllib.parse import unquote

import pytest

from robotbrain.errors import InputError
from robotbrain.grading import Lab, load_suite, reread, reread_table
from robotbrain.grading.reread import find_heading, places
from robotbrain.grading.suite import Suite

TABLE = json.loads(reread.TABLE.read_text(encoding="utf-8"))
VAGUE = {"the sections of this lesson"}  # leads to the notebook as a whole


@functools.cache
def cells_of(path: Path) -> set[str]:
    """The ids of a notebook's cells."""
    return {cell["id"] for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]}


def test_the_table_is_that_of_the_notebooks(repo: Path) -> None:
    assert reread_table.build(repo) == TABLE, "run: python -m robotbrain.grading.reread_table"


@pytest.mark.parametrize("lab", TABLE)
def test_every_test_leads_somewhere_that_is_there(repo: Path, lab: str) -> None:
    suite = load_suite(lab)
    here = posixpath.dirname(TABLE[lab]["notebook"])
    assert suite.tests and set(TABLE[lab]["lessons"]) <= set(suite.exercises)
    for test in suite.tests:
        found = places(lab, test.exercise, test.reread, suite.exercises[test.exercise].title)
        assert found, f"{test.exercise}: {test.name} says nowhere what to reread"
        for place in found:
            path, _, cell = place.href.partition("#cell-id=")
            there = cells_of(repo / posixpath.normpath(posixpath.join(here, unquote(path))))
            assert place.text in VAGUE or cell in there, (test.exercise, test.name, place)


def test_a_heading_is_found_by_its_beginning_and_not_by_a_number_that_only_begins_alike() -> None:
    headings = {
        "Exercise 2: a": "two",
        "Exercise 2.1: b (4 points)": "two-one",
        "Exercise 21: c": "many",
        "One, two": "d",
    }
    assert find_heading(headings, "Exercise 2") == "two"
    assert find_heading(headings, "Exercise 2.1, last paragraph") == "two-one"
    assert find_heading(headings, "Exercise 21, the ring, twice") == "many"
    assert find_heading(headings, "One, two") == "d"
    assert find_heading(headings, "Exercise 2 and the brief") == "two"
    assert find_heading(headings, "Exercise 3") == ""


def test_headings_are_those_a_reader_sees() -> None:
    source = "# One `two`\ntext # no\n```\n# a comment\n```\n**Bold start.** more\n### Three"
    cells = [{"cell_type": "markdown", "id": "a", "source": source}, {"cell_type": "code", "id": "b", "source": "# no"}]
    assert dict(reread_table.headings_of({"cells": cells})) == {"One two": "a", "Bold start": "a", "Three": "a"}


def test_a_heading_that_no_lesson_has_is_refused(repo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = tmp_path / "wrong.toml"
    wrong.write_text('[lab_integration]\nastar = ["07: No such heading"]')
    monkeypatch.setattr(reread_table, "CHOSEN", wrong)
    with pytest.raises(InputError, match="No such heading"):
        reread_table.build(repo)


def test_report_shows_the_links_and_escapes_them() -> None:
    answers = {"__name__": "__main__", "deadline_slack_ms": lambda profile, rate: 0.0}
    report = Lab("lab_integration", namespace=answers).check("deadline")
    assert 'lesson 7, “What "real time" means”' in repr(report)
    html = report._repr_html_()  # type: ignore[union-attr]
    assert '<a href="lab_integration.ipynb#cell-id=ex-deadline">Exercise 1.3</a>' in html
    assert (
        'href="../../course/07_perception_control.ipynb#cell-id=realtime"' in html and "&quot;real time&quot;" in html
    )


def test_lab_that_is_in_no_table_keeps_the_words() -> None:
    suite = Suite("elsewhere")
    suite.exercise("one", points=1)

    @suite.test("one", points=1, reread="Part 1 <b>")
    def fails(student: object) -> bool:
        return False

    report = Lab("elsewhere", namespace={}, suite=suite).check("one")
    assert "Part 1 &lt;b&gt;" in report._repr_html_()  # type: ignore[union-attr]
    assert "Part 1 <b>" in repr(report)
