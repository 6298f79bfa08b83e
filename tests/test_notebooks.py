from __future__ import annotations

import json
from pathlib import Path

import nbformat
import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output

from robotbrain import cli, notebooks
from robotbrain.errors import InputError


def messy(path: Path) -> Path:
    code = new_code_cell("x = 1\r\nx", outputs=[new_output("stream", text="1")], execution_count=7)
    notebook = new_notebook(cells=[new_markdown_cell("# Hi"), code, new_code_cell("x = 1\nx")])
    code = notebook.cells[1]
    code.metadata.update({"scrolled": True, "tags": ["keep"], "execution": {"iopub.status.busy": "now"}})
    notebook.cells[2]["id"] = code["id"]
    notebook.metadata = nbformat.from_dict({"kernelspec": {"name": "mine"}, "widgets": {}, "title": "T"})
    path.write_text(json.dumps(notebook), encoding="utf-8")
    return path


def test_fixing_once_is_enough_and_keeps_the_content(tmp_path: Path) -> None:
    path = messy(tmp_path / "a.ipynb")
    assert notebooks.fix(path)
    text = path.read_text()
    assert not notebooks.fix(path) and path.read_text() == text
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert [c.source for c in notebook.cells] == ["# Hi", "x = 1\nx", "x = 1\nx"]
    assert notebook.cells[1].outputs == [] and notebook.cells[1].execution_count is None
    assert dict(notebook.cells[1].metadata) == {"tags": ["keep"]}
    assert notebook.metadata["kernelspec"]["name"] == "python3" and notebook.metadata["title"] == "T"
    assert len({c["id"] for c in notebook.cells}) == 3
    assert notebooks.problems(path) == ([], [])


def test_missing_ids_become_the_same_ids_every_time(tmp_path: Path) -> None:
    raw = json.loads(json.dumps(new_notebook(cells=[new_code_cell("a"), new_code_cell("a"), new_code_cell("b")])))
    for cell in raw["cells"]:
        del cell["id"]
    raw["nbformat_minor"] = 4
    texts = []
    for name in ("a.ipynb", "b.ipynb"):
        (tmp_path / name).write_text(json.dumps(raw))
        notebooks.fix(tmp_path / name)
        texts.append((tmp_path / name).read_text())
    assert texts[0] == texts[1]


def test_long_cells_are_warned_about(tmp_path: Path) -> None:
    path = tmp_path / "a.ipynb"
    nbformat.write(new_notebook(cells=[new_code_cell("x\n" * 60)]), path)
    notebooks.fix(path)
    errors, warnings = notebooks.problems(path)
    assert errors == [] and "61 lines" in warnings[0]


def test_the_command_checks_and_fixes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = messy(tmp_path / "a.ipynb")
    assert cli.main(["notebooks", "check", str(tmp_path)]) == 1
    assert "holds outputs" in capsys.readouterr().err
    assert cli.main(["notebooks", "fix", str(path)]) == 0
    assert cli.main(["notebooks", "check", str(tmp_path)]) == 0


def test_what_is_no_notebook_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.ipynb").write_text("{")
    with pytest.raises(InputError, match=r"a\.ipynb"):
        notebooks.problems(tmp_path / "a.ipynb")
    with pytest.raises(InputError, match="existing file"):
        notebooks.find([tmp_path / "none"])
