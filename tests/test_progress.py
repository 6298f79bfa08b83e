"""A bar for who waits at a notebook: shown in a real kernel, and nowhere else."""

from __future__ import annotations

import nbformat
import pytest
from nbclient import NotebookClient

from robotbrain import progress

CELL = """
import time
from robotbrain.progress import bar
with bar("driving", 4.0, "s") as b:
    for _ in range(4):
        time.sleep(0.4)
        b.update(1.0)
"""


def _shown() -> str:
    """What the cell shows in a kernel with this environment: its widgets and its outputs."""
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(CELL)])
    client = NotebookClient(notebook, timeout=60, kernel_name="python3")
    client.execute()
    widgets = [f"{state.get('_model_name')} {state.get('value')}" for state in client.widget_state.values()]
    return " ".join([*widgets, str(notebook.cells[0].outputs)])


def test_a_wait_at_a_notebook_has_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("NBGRADER_EXECUTION", progress.SILENT_VARIABLE):
        monkeypatch.delenv(name, raising=False)
    shown = _shown()
    assert "FloatProgressModel" in shown and "driving" in shown and " of 4 s" in shown


@pytest.mark.parametrize("name", ["NBGRADER_EXECUTION", progress.SILENT_VARIABLE])
def test_nobody_looks_on(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(name, "autograde")
    shown = _shown()
    assert "Progress" not in shown and "driving" not in shown


def test_no_bar_outside_of_notebooks(capfd: pytest.CaptureFixture[str]) -> None:
    with progress.bar("driving", 2.0, "s") as bar:
        bar.update(2.0)
    assert capfd.readouterr() == ("", "")
