"""Which graded cells can be tested in the same copy of the student's process.

A copy keeps the notebook as it is at a graded cell, and costs about as much as all of an exercise's tests. Cells that
only define new names change nothing for the exercises before them: these can be tested in the copy of a later one. That
is decided from the source alone, and in doubt there is a copy; what an exercise's own prose has in backticks are names
that its tests may look for. Within one copy the tests of several exercises follow one another, as they do in the
notebook.
"""

from __future__ import annotations

import ast
import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

_WORD = re.compile(r"\w+")
_ORIGIN = re.compile(r"^\s*from\s+[\w.]+\s+import\b", re.MULTILINE)  # binds none of the names in it
_MARKED = re.compile(r"(`+)(.+?)\1", re.DOTALL)  # how prose names what is to be written
_CHECK = re.compile(r"lab\.check\((['\"])\w+\1\)")
_HARMLESS = {"dataclass", "field", "no_grad", "inference_mode", "lru_cache", "cache", "wraps", "total_ordering"}
_FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
_PLAIN = (
    *(ast.Constant, ast.Tuple, ast.List, ast.Set, ast.Dict, ast.Starred, ast.Slice),
    *(ast.Name, ast.Attribute, ast.Subscript, ast.UnaryOp, ast.BinOp, ast.BoolOp, ast.Compare),
)
Import = tuple[str, str, str]  # module, name in it, name here


def shared_copies(
    cells: Sequence[Mapping[str, Any]], graded: Collection[int], run: Collection[int], files: Iterable[str] = ()
) -> dict[int, int]:
    """For each graded cell, the graded cell whose copy it is tested in: itself or a later one.

    Args:
        graded: indices of the cells that a copy is needed for.
        run: indices of the other code cells that are run.
        files: names of files beside the notebook; importing one of them may do anything.
    """
    local = {name.split("/")[0].removesuffix(".py") for name in files}
    served: dict[int, int] = {}
    group: list[int] = []
    words: set[str] = set()  # in any code so far
    section: set[str] = set()  # names in the prose since the last heading
    asked: set[str] = set()  # names in the group's exercises
    before: set[str] = set()  # what the group's exercises may refer to
    imports: set[Import] = set()

    def close() -> None:
        served.update(dict.fromkeys(group, group[-1]) if group else {})
        group.clear()
        asked.clear()

    for index, cell in enumerate(cells):
        source = str(cell["source"])
        if index not in graded and index not in run and cell.get("cell_type") != "code":
            marked = " ".join(text for _, text in _MARKED.findall(source))
            section = (set() if source.startswith("#") else section) | _words(marked)
            continue
        if index in run and source.strip() and not _CHECK.fullmatch(source.strip()):
            found = _Definitions.of(source, local)
            if group and (found is None or not found.new_beside(before, imports)):
                close()
            imports = _still_meant(imports, _words(source), found.imports if found is not None else set())
        words |= _words(_ORIGIN.sub("", source))
        if index in graded:
            group.append(index)
            asked |= section
            before = words | asked
    close()
    return served


def _still_meant(imports: set[Import], words: Collection[str], more: set[Import]) -> set[Import]:
    """The imports whose names still mean what they brought in after a cell with these words, which imports ``more``."""
    known = {i for i in imports if i in more or i[2] not in words} | more
    names = Counter(name for *_, name in known)
    return {i for i in known if names[i[2]] == 1}


def _words(text: str) -> set[str]:
    return set(_WORD.findall(text))


class _Definitions:
    """The names that a cell binds, if binding names is all it does."""

    def __init__(self) -> None:
        self.names: set[str] = set()
        self.imports: set[Import] = set()
        self.changed: set[str] = set()  # global names whose objects its functions rebind or write to

    @classmethod
    def of(cls, source: str, local: Collection[str]) -> _Definitions | None:
        """What ``source`` defines; None if it does something else too, or cannot be read."""
        try:
            body = ast.parse(source).body
        except (SyntaxError, ValueError, RecursionError, MemoryError):
            return None
        found = cls()
        return found if all(found._take(statement, local, top=True) for statement in body) else None

    def new_beside(self, words: Collection[str], imports: Collection[Import]) -> bool:
        """Whether nothing that was there before changes its meaning."""
        fresh = self.names | {name for *origin, name in self.imports if (*origin, name) not in imports}
        return not any(name in words for name in fresh | self.changed)

    def _take(self, statement: ast.stmt, local: Collection[str], *, top: bool) -> bool:
        """Note what a statement binds; whether it does nothing else."""
        match statement:
            case ast.Pass() | ast.Expr(value=ast.Constant()):
                return True
            case ast.Import(names=aliases) if top:
                modules = [a.name.split(".")[0] for a in aliases]
                self.imports |= {(a.name, "", a.asname or a.name.split(".")[0]) for a in aliases}
                return not any(m in local for m in modules)
            case ast.ImportFrom(module=str(module), names=aliases, level=0) if top:
                self.imports |= {(module, a.name, a.asname or a.name) for a in aliases}
                return module.split(".")[0] not in local and all(a.name != "*" for a in aliases)
            case ast.Assign(targets=targets, value=value):
                parts = [part for t in targets for part in (t.elts if isinstance(t, ast.Tuple) else [t])]
                self.names |= {part.id for part in parts if isinstance(part, ast.Name)} if top else set()
                unpacked = [len(t.elts) for t in targets if isinstance(t, ast.Tuple)]
                same = isinstance(value, ast.Tuple) and all(n == len(value.elts) for n in unpacked)
                return all(isinstance(part, ast.Name) for part in parts) and (same or not unpacked) and _plain(value)
            case ast.AnnAssign(target=ast.Name(id=name), annotation=annotation, value=value):
                self.names |= {name} if top else set()
                return _plain(annotation) and (value is None or _plain(value))
            case ast.FunctionDef() | ast.AsyncFunctionDef():
                self.names |= {statement.name} if top else set()
                self.changed |= _written(statement)
                return _plain_signature(statement)
            case ast.ClassDef(keywords=[]):
                self.names |= {statement.name} if top else set()
                outside = [*statement.bases, *statement.decorator_list]
                return all(map(_plain, outside)) and all(self._take(s, local, top=False) for s in statement.body)
        return False


def _plain(expression: ast.expr) -> bool:
    """Whether evaluating an expression does nothing beside giving its value."""
    if isinstance(expression, ast.Call):
        called = expression.func
        name = called.attr if isinstance(called, ast.Attribute) else called.id if isinstance(called, ast.Name) else ""
        if name not in _HARMLESS:
            return False
    elif not isinstance(expression, _PLAIN):
        return False
    values = [n.value if isinstance(n, ast.keyword) else n for n in ast.iter_child_nodes(expression)]
    return all(_plain(v) for v in values if isinstance(v, ast.expr))


def _plain_signature(function: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    arguments = function.args
    each = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs, arguments.vararg, arguments.kwarg]
    annotations = [a.annotation for a in each if a is not None and a.annotation is not None]
    returns = [function.returns] if function.returns is not None else []
    defaults = [*arguments.defaults, *(d for d in arguments.kw_defaults if d is not None)]
    return all(map(_plain, [*function.decorator_list, *defaults, *annotations, *returns]))


def _written(function: ast.FunctionDef | ast.AsyncFunctionDef) -> set[str]:
    """Names from outside a function that it rebinds, or whose objects it writes to."""
    nodes = list(ast.walk(function))
    written = {name for n in nodes if isinstance(n, ast.Global) for name in n.names}
    own = {n.arg for n in nodes if isinstance(n, ast.arg)}
    own |= {n.id for n in nodes if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
    own |= {n.name for n in nodes if isinstance(n, (*_FUNCTIONS, ast.ClassDef))}
    for node in nodes:
        if isinstance(node, ast.Attribute | ast.Subscript) and not isinstance(node.ctx, ast.Load):
            root: ast.expr = node
            while isinstance(root, ast.Attribute | ast.Subscript):
                root = root.value
            if isinstance(root, ast.Name) and root.id not in own:
                written.add(root.id)
    return written
