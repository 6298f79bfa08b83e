"""The times that notebooks state are true: no shorter than what ``benchmarks/notebooks.py`` found."""

from __future__ import annotations

import json
from pathlib import Path

import nbformat
import pytest

from robotbrain.notebooks import stated_seconds

REPO = Path(__file__).resolve().parents[1]
MEASURED: dict[str, dict[str, float]] = json.loads(
    (REPO / "benchmarks" / "notebook_times.json").read_text(encoding="utf-8")
)
LESSONS = [path.relative_to(REPO).as_posix() for path in sorted((REPO / "course").glob("[01][0-9]_*.ipynb"))[1:]]
LABS = [
    path.relative_to(REPO).as_posix()
    for path in sorted((REPO / "solutions").glob("*/*.ipynb"))
    if path.stem == path.parent.name
]


def test_there_are_ten_lessons() -> None:
    assert [Path(name).name[:2] for name in LESSONS] == [f"{number:02d}" for number in range(1, 11)]


@pytest.mark.parametrize(("name", "most"), [*((n, 90) for n in LESSONS), *((n, 300) for n in LABS)])
def test_a_notebook_runs_in_the_time_that_it_states(name: str, most: float) -> None:
    stated = stated_seconds(REPO / name)
    assert stated is not None and stated <= most
    assert MEASURED[name]["cpu_s"] <= stated


def test_the_lessons_run_in_ten_minutes_together() -> None:
    assert sum(MEASURED[name]["cpu_s"] for name in LESSONS) <= 600


def test_labs_and_solutions_state_the_same(tmp_path: Path) -> None:
    for name in LABS:
        assert stated_seconds(REPO / name.replace("solutions", "labs", 1)) == stated_seconds(REPO / name)


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("**Time:** about 60 minutes. The cells themselves run in under 40 seconds.", 40),
        ("The cells themselves run in under 5 minutes, nearly all of it in Part 7.", 300),
        ("The cells themselves run quickly.", None),
    ],
)
def test_stated_times_are_read(tmp_path: Path, text: str, seconds: float | None) -> None:
    nbformat.write(nbformat.v4.new_notebook(cells=[nbformat.v4.new_markdown_cell(text)]), path := tmp_path / "a.ipynb")
    assert stated_seconds(path) == seconds
