"""Nodes of one's own in the brain: classes in a Python file, or in the notebook of a lab."""

from __future__ import annotations

import ast
import json
import traceback
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

from robotbrain.errors import InputError
from robotbrain.pipeline.brain import ROLES


def load_part(spec: str) -> tuple[str, Callable[[], Any]]:
    """Return the role and the node class of ``role=file:Class``.

    A Python file is run as it is. Of a notebook, only imports, functions, classes and constants count: what is in its
    code cells at the outermost level, without the calls between them.

    Raises:
        InputError: not of this form, no such file, or no such class in it.
    """
    role, _, place = spec.partition("=")
    file, _, name = place.rpartition(":")
    path = Path(file)
    if role not in ROLES or not path.is_file():
        raise InputError(
            "part",
            given=spec,
            expected=f"ROLE=FILE:CLASS, with a role of {', '.join(ROLES)} and a file that exists",
            fix="Example: --part planner=my_planner.py:MyPlanner.",
        )
    try:
        text = path.read_text(encoding="utf-8")
        tree = definitions(text) if path.suffix == ".ipynb" else ast.parse(text, str(path))
    except (UnicodeDecodeError, SyntaxError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            "part", given=spec, expected="a Python file or a notebook", fix=f"It cannot be read: {error}."
        ) from None
    module = types.ModuleType(path.stem)
    module.__file__ = str(path)
    try:
        exec(compile(tree, str(path), "exec"), module.__dict__)
    except Exception as error:  # whatever a student's file raises while it is loaded
        frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
        line = f", line {frames[-1].lineno}" if frames else ""
        raise InputError(
            "part", given=spec, expected="a file that loads", fix=f"{path}{line}: {type(error).__name__}: {error}"
        ) from error
    found = getattr(module, name, None)
    if not callable(found):
        raise InputError("part", given=spec, expected=f"a class {name!r} in {path}", fix="Check the spelling.")
    return role, found


def definitions(notebook: str) -> ast.Module:
    """Return the imports, functions, classes and constants of a notebook (JSON text); other code is left out.

    A constant is a name in capitals. Cells that are not plain Python (magics) are left out whole.
    """
    kept: list[ast.stmt] = []
    for cell in json.loads(notebook)["cells"]:
        if cell["cell_type"] != "code":
            continue
        try:
            body = ast.parse("".join(cell["source"])).body
        except SyntaxError:
            continue
        kept += [node for node in body if _defines(node)]
    return ast.Module(kept, [])


def _defines(node: ast.stmt) -> bool:
    if isinstance(node, ast.Assign):
        names = [part.id for target in node.targets for part in ast.walk(target) if isinstance(part, ast.Name)]
        return bool(names) and all(name.isupper() for name in names)
    return isinstance(node, (ast.Import, ast.ImportFrom, ast.FunctionDef, ast.ClassDef))
