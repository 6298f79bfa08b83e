"""The shell that runs a submission's cells reads them as IPython does, only with less work."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from IPython.core.async_helpers import _should_be_async
from IPython.core.inputtransformer2 import TransformerManager

from robotbrain.grading.sandbox.shell import Shell, Transforms

REPOSITORY = Path(__file__).parents[2]
ODD = (
    "%time x = 1\ny = 2",
    "x = %env HOME\ny = 2",
    "x = !ls\ny = 2",
    "!ls\nx = 1",
    "def f():\n    %time pass\n    return 1",
    "%%capture\nprint(1)",
    "len?\nx = 1",
    "x = (5\n%time)",
    'text = """\n%time\n!ls\n"""',
    ">>> x = 1\n>>> y = 2",
    "In [1]: x = 1\nIn [2]: y = 2",
    "    x = 1\n    y = 2",
    "\n\n  \nx = 1\ny = 2",
    ";f a b\nx = 1",
    "/f a\nx = 1",
    "def broken(:\n%time",
    "x = 1\n\\",
    "x = 'caf\u00e9'\r\ny = 2",
    "x = 1\x0cy = 2\n%time",
    "x = 1\0\n%time",
    "f(" * 3000,
    "",
)


@pytest.mark.parametrize("source", ODD)
def test_magics_are_found_wherever_ipython_finds_them(source: str) -> None:
    assert Transforms().transform_cell(source) == TransformerManager().transform_cell(source)


@pytest.mark.parametrize("path", sorted((REPOSITORY / "solutions").rglob("*.ipynb")), ids=lambda path: path.stem)
def test_the_cells_of_the_labs_come_out_as_in_ipython(path: Path) -> None:
    cells = [c for c in json.loads(path.read_text(encoding="utf-8"))["cells"] if c["cell_type"] == "code"]
    assert cells
    for source in ("".join(cell["source"]) for cell in cells):
        assert Transforms().transform_cell(source) == TransformerManager().transform_cell(source)


def test_a_notebooks_own_transformations_count() -> None:
    class Doubled:
        """Doubles the number in the first line, once."""

        priority = 1

        @classmethod
        def find(cls, tokens_by_line: list[list[object]]) -> Doubled | None:
            return cls() if "21" in str(tokens_by_line[0]) else None

        start_line, start_col = 0, 0

        def sortby(self) -> tuple[int, int, int]:
            return 0, 0, self.priority

        def transform(self, lines: list[str]) -> list[str]:
            return [lines[0].replace("21", "42"), *lines[1:]]

    ours, theirs = Transforms(), TransformerManager()
    for manager in (ours, theirs):
        manager.token_transformers.append(Doubled)
    assert ours.transform_cell("x = 21\ny = 2") == theirs.transform_cell("x = 21\ny = 2") == "x = 42\ny = 2\n"


@pytest.mark.parametrize(
    "source",
    ["x = 1", "await f()", "async with f() as g:\n    pass", "def awaited(): pass", "[x async for x in y]", "("],
)
def test_cells_that_await_are_known_as_in_ipython(source: str) -> None:
    shell = Shell.__new__(Shell)
    assert shell.should_run_async(source, transformed_cell=source) == _should_be_async(source)
