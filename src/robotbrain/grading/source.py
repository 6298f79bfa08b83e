"""Does the *text* of an answer use what the exercise forbids? Asked in the tester, where the student's code cannot lie.

:mod:`robotbrain.grading.forbidden` looks at objects and sees more, but in a hostile process it sees what it is shown.
Here only text counts: what an answer's code imports and names, directly or through the notebook's other code. What is
certain is a reason to refuse, and so is an answer whose own code cannot be read off its text; what elsewhere merely
looks like a way around the ban is a doubt for a person to look at.
"""

from __future__ import annotations

import ast
import contextlib
import functools
import importlib
import re
from collections import defaultdict, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import FunctionType, ModuleType
from typing import Any

from robotbrain.grading.forbidden import module_banned
from robotbrain.grading.suite import Ban, Suite

_IMPORTING = frozenset({"__import__", "import_module", "run_module", "find_spec", "resolve_name", "reload"})
_RUNNING = frozenset({"exec", "eval", "compile", "run_cell", "run_line_magic", "run_cell_magic", "system", "getoutput"})
_REACHING = frozenset(
    {"__builtins__", "__code__", "__globals__", "__loader__", "__spec__", "__subclasses__", "_getframe", "f_back"}
    | {"f_globals", "f_locals", "getsource", "get_objects", "get_referents", "get_referrers", "meta_path"}
    | {"user_global_ns", "user_ns"}
)
_HIDING = frozenset({"ctypes", "dill", "gc", "marshal", "pickle", "runpy", "pkgutil", "imp"})
_TAME = frozenset({"collect", "disable", "dump", "dumps", "enable", "isenabled"})
_HARMLESS_MAGICS = frozenset(
    {"matplotlib", "time", "timeit", "load_ext", "autoreload", "config", "pip", "precision", "pdb", "capture"}
)
_CHANGING = frozenset({"setattr", "update", "__setitem__", "__setattr__", "push", "setdefault"})
_MOST_DOUBTS = 10
_DOTTED = re.compile(r"[A-Za-z_][\w.]*(:[\w.]+)?")
_DOTTED_INSIDE = re.compile(r"[A-Za-z_]\w*(?:\.\w+)+")
_LITERAL = (ast.Lambda, ast.Name, ast.Attribute, ast.IfExp, ast.Tuple, ast.List, ast.Dict, ast.Set)
_LONGEST_TEXT = 100_000
_NAMING = (ast.Import, ast.ImportFrom, ast.Assign)
_PLAIN_FIELDS = frozenset({"ctx", "op", "ops", "names", "id", "attr", "arg", "name", "type_comment"})
_FIELDS: dict[type, tuple[str, ...]] = {}  # where nodes of a kind may hold others
_FOLDABLE = (ast.Constant, ast.BinOp, ast.JoinedStr, ast.Subscript, ast.Call)


@dataclass(frozen=True)
class _Piece:
    """A part of the student's text that makes a name mean something."""

    node: ast.AST
    only_if_callable: bool = False  # a call's result; how data came about is not judged


class Submission:
    """The code of a notebook.

    Args:
        cells: all code cells in order: ``source``, and ``locked`` if the course wrote it.
    """

    def __init__(self, cells: Sequence[Mapping[str, Any]]) -> None:
        parsed = [(number, cell, _parse(str(cell["source"]))) for number, cell in enumerate(cells, 1)]
        self._aliases = _aliases(part for _, _, text in parsed for part in text.naming)
        self._student = [(n, node) for n, cell, text in parsed if not cell.get("locked") for node in text.statements]
        self._pieces: dict[str, list[_Piece]] = defaultdict(list)
        self._readings: dict[ast.AST, _Reading] = {}
        for _, node in self._student:
            for name, piece in _pieces(node):
                self._pieces[name].append(piece)

    def why_forbidden(self, exercise: str, suite: Suite) -> tuple[str, list[str]]:
        """Return why the answer to ``exercise`` is refused, or ``""``, and what merely looks like it should be."""
        ban = suite.ban_of(exercise)
        own = suite.exercises[exercise].provides
        others = {name for entry in suite.exercises.values() for name in entry.provides} - set(own)
        references = {name: suite.load_reference(name) for name in own if name in suite.references}
        judge = _Judge(ban, list(references.values()))
        doubts = self._doubts if exercise in suite.bans else []
        tricks: list[str] = []
        for piece in self._reached(own, others, any(callable(r) for r in references.values())):
            used = next(filter(judge.certain, self._read(piece).uses), None)
            if used:
                reason = f"`{own[0]}` uses `{used}`, which is or holds the course's own solution; write your own"
                return reason, doubts
            tricks += self._read(piece).tricks
        if exercise in suite.bans and not any(name in self._pieces for name in own):
            tricks += [doubt.rpartition(": ")[2].strip("`") for doubt in doubts]  # made by one of these, if at all
        if exercise in suite.bans and tricks:
            reason = f"`{own[0]}` is made with `{tricks[0]}`, of which nobody can tell what it does; write it plainly"
            return reason, doubts
        return "", doubts

    @functools.cached_property
    def _doubts(self) -> list[str]:
        tricks = ((number, what) for number, node in self._student for what in self._read(node).tricks)
        sentences = (f"cell {number}: looks like a way around what is forbidden: `{what}`" for number, what in tricks)
        return list(dict.fromkeys(sentences))[:_MOST_DOUBTS]

    def _read(self, node: ast.AST) -> _Reading:
        """What can be read off a piece of code: once, though most exercises ask about the same pieces."""
        if node not in self._readings:
            self._readings[node] = _Reading(node, self._aliases)
        return self._readings[node]

    def _reached(self, own: Sequence[str], others: set[str], is_callable: bool) -> Iterator[ast.AST]:
        """What the answer is made of: its definitions, and those of what they use."""
        names, todo = set(own), [(name, piece) for name in own for piece in self._pieces.get(name, ())]
        while todo:
            name, piece = todo.pop()
            if piece.only_if_callable and not (is_callable and name in own):
                continue
            yield piece.node
            loaded = self._read(piece.node).loads - names - others
            names |= loaded
            todo += [(used, more) for used in loaded for more in self._pieces.get(used, ())]


class _Reading:
    """What can be read off a piece of code."""

    def __init__(self, node: ast.AST, aliases: Mapping[str, str]) -> None:
        self._node, self._aliases = node, aliases

    @functools.cached_property
    def uses(self) -> tuple[str, ...]:
        """Dotted names that it uses, by whatever way can be read off the text."""
        return tuple(dict.fromkeys(filter(None, self._uses(self._node, self._aliases))))

    @functools.cached_property
    def tricks(self) -> tuple[str, ...]:
        """Parts of it whose meaning cannot be read off the text."""
        return tuple(_tricks(self._node, self._aliases))

    @functools.cached_property
    def loads(self) -> set[str]:
        """Names in it that are not its own."""
        return _globals_of(self._node)

    def _uses(self, node: ast.AST, aliases: Mapping[str, str]) -> Iterator[str]:
        """Dotted names that ``node`` and what is in it use; some may be empty."""
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)):
            local = _locals(node)
            aliases = {name: dotted for name, dotted in aliases.items() if name not in local} | _aliases(_walk(node))
        yield from self._used(node, aliases)
        for child in _children(node):
            in_chain = isinstance(node, ast.Attribute) and isinstance(child, (ast.Attribute, ast.Name))
            docstring = isinstance(node, ast.Expr) and isinstance(child, ast.Constant)
            if not in_chain and not docstring:
                yield from self._uses(child, aliases)

    def _used(self, node: ast.AST, aliases: Mapping[str, str]) -> Iterator[str]:
        """What this node names by itself."""
        if isinstance(node, ast.ImportFrom) and not node.level:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, (ast.Attribute, ast.Name)):
            yield _dotted(node, aliases)
        elif isinstance(node, ast.Call) and _called(node) in _RUNNING and node.args:
            text = _folded(node.args[0])
            for statement in _parse(text).statements if isinstance(text, str) else ():
                yield from self._uses(statement, self._aliases)
        elif isinstance(node, ast.Call) and _called(node) == "getattr" and len(node.args) > 1:
            yield f"{_dotted(node.args[0], aliases)}.{_folded(node.args[1])}"
        text = _folded(node)
        if isinstance(text, str) and _DOTTED.fullmatch(text):
            yield text.replace(":", ".")
        elif isinstance(text, str):  # code for another interpreter, say
            yield from _DOTTED_INSIDE.findall(text[:_LONGEST_TEXT])


class _Judge:
    """What is banned."""

    def __init__(self, ban: Ban, references: Sequence[Any]) -> None:
        self._ban, self._references = ban, references

    def certain(self, dotted: str) -> bool:
        """Whether ``dotted`` is from a banned module, and using it is what the ban is meant for."""
        names = dotted.split(".")
        if not module_banned(dotted, self._ban) or names[-1] in self._ban.allow:
            return False
        if names[-1] == "*" or names[0] != "robotbrain":
            return True
        found = _found(dotted)
        whole = (_found(".".join(names[:cut])) for cut in range(2, len(names)))  # an attribute of a function, say
        return isinstance(found, ModuleType) or self._solves(found) or any(map(self._solves, whole))

    def _solves(self, found: Any) -> bool:
        if any(found is reference for reference in self._references):
            return True
        own = isinstance(found, FunctionType) and module_banned(found.__module__, self._ban)
        return own and found.__name__ not in self._ban.allow


def _tricks(node: ast.AST, aliases: Mapping[str, str]) -> Iterator[str]:
    """Pieces of code whose meaning cannot be read off the text."""
    for part in _walk(node):
        if isinstance(part, ast.Call) and part.args:
            called, argument = _called(part), _folded(part.args[0])
            if called in _IMPORTING and not isinstance(argument, str):
                yield _shown(part)
            elif called in ("run_line_magic", "run_cell_magic") and argument in _HARMLESS_MAGICS:
                continue
            builtin = called in ("exec", "eval", "compile")  # not `re.compile`
            unseen = called in _RUNNING and (not builtin or (_is_builtin(part.func) and not isinstance(argument, str)))
            if unseen or (called == "getattr" and _dotted(part.args[0], aliases) and not _all_known(part.args[1:2])):
                yield _shown(part)
        elif isinstance(part, ast.Attribute) and (part.attr in _REACHING or _hides(part, aliases)):
            yield _shown(part)
        elif isinstance(part, ast.Name) and part.id == "__builtins__":
            yield part.id
        elif isinstance(part, ast.Subscript) and _called(part.value) == "globals" and _folded(part.slice) is None:
            yield _shown(part)
        elif isinstance(part, ast.Name) and _hides(part, aliases):
            yield part.id


def _is_builtin(function: ast.expr) -> bool:
    return isinstance(function, ast.Name) or ast.unparse(function).startswith(("builtins.", "__builtins__"))


def _hides(node: ast.AST, aliases: Mapping[str, str]) -> bool:
    """Whether this is a function that makes code or objects out of bytes or out of nowhere."""
    module, _, name = _dotted(node, aliases).partition(".")
    return module in _HIDING and bool(name) and name not in _TAME


@dataclass(frozen=True)
class _Text:
    """What a cell's text is.

    Attributes:
        statements: in order.
        naming: the parts, wherever they stand, that may give a name to something that is imported.
    """

    statements: tuple[ast.stmt, ...] = ()
    naming: tuple[ast.AST, ...] = ()

    @classmethod
    def of(cls, statements: Sequence[ast.stmt]) -> _Text:
        """The text of these statements."""
        naming = (part for node in statements for part in _walk(node) if isinstance(part, _NAMING))
        return cls(tuple(statements), tuple(naming))


@functools.lru_cache(maxsize=1024)  # most cells of a notebook are the course's own, the same in every submission
def _parse(source: str) -> _Text:
    """The statements of a cell, magics and all; none where it is no Python (then it defines nothing either)."""
    if len(source) > _LONGEST_TEXT:
        return _Text()
    with contextlib.suppress(SyntaxError, ValueError, RecursionError, MemoryError):
        return _Text.of(ast.parse(source).body)
    with contextlib.suppress(ImportError, SyntaxError, ValueError, RecursionError, MemoryError):
        from IPython.core.inputtransformer2 import TransformerManager

        transformed: str = TransformerManager().transform_cell(source)
        return _Text.of(ast.parse(transformed).body)
    return _Text()


def read_ahead(sources: Iterable[str]) -> None:
    """Read cells that are likely to come, such as those of the notebook as it was handed out."""
    for source in sources:
        _parse(source)


def _children(node: ast.AST) -> list[ast.AST]:
    """The nodes right below ``node``, in the order of the text; operators, contexts and names of imports aside."""
    fields = _FIELDS.get(type(node))
    if fields is None:
        named = () if isinstance(node, ast.Constant) else node._fields
        fields = _FIELDS[type(node)] = tuple(name for name in named if name not in _PLAIN_FIELDS)
    found: list[ast.AST] = []
    for name in fields:
        value = getattr(node, name, None)
        if isinstance(value, list):
            found += [entry for entry in value if isinstance(entry, ast.AST)]
        elif isinstance(value, ast.AST):
            found.append(value)
    return found


def _walk(node: ast.AST) -> Iterator[ast.AST]:
    """``node`` and all nodes below it, in the order of ``ast.walk``, in a third of its time."""
    todo = deque([node])
    while todo:
        node = todo.popleft()
        yield node
        todo += _children(node)


def _pieces(statement: ast.stmt) -> Iterator[tuple[str, _Piece]]:
    """The names to which a statement gives a meaning, whether at top level, inside ``if`` and such, or by a detour."""
    if isinstance(statement, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
        yield statement.name, _Piece(statement)
    elif isinstance(statement, (ast.Import, ast.ImportFrom)):
        yield from ((alias.asname or alias.name.partition(".")[0], _Piece(statement)) for alias in statement.names)
    elif isinstance(statement, (ast.Assign, ast.AnnAssign, ast.AugAssign)):
        value = statement.value
        if value is not None:
            piece = _Piece(value, not isinstance(value, _LITERAL))
            targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
            yield from ((name, piece) for target in targets for name in _targets(target))
    elif isinstance(statement, ast.Expr):
        for call in _walk(statement):
            if isinstance(call, ast.Call) and _called(call) in _CHANGING:
                parts = [inner for argument in (*call.args, *call.keywords) for inner in _walk(argument)]
                named = {p.id for p in parts if isinstance(p, ast.Name)} | {
                    p.arg for p in parts if isinstance(p, ast.keyword)
                }
                named |= {p.value for p in parts if isinstance(p, ast.Constant) and isinstance(p.value, str)}
                yield from ((name, _Piece(statement)) for name in named if name)
    else:
        for child in _children(statement):
            inner = child.body if isinstance(child, (ast.ExceptHandler, ast.match_case)) else [child]
            for node in inner:
                if isinstance(node, ast.stmt):
                    yield from _pieces(node)


def _targets(target: ast.expr) -> Iterator[str]:
    """Names that an assignment changes: ``f = ..``, ``f.attribute = ..``, ``globals()["f"] = ..``."""
    for part in _walk(target):
        if isinstance(part, ast.Name):
            yield part.id
        elif isinstance(part, ast.Subscript) and isinstance(name := _folded(part.slice), str):
            yield name


def _globals_of(node: ast.AST) -> set[str]:
    """Names in a piece of code that are not its own."""
    if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)):
        inner = set().union(*map(_globals_of, _children(node)))
        return inner - _locals(node)
    if isinstance(node, ast.Name):
        return {node.id}
    return set().union(*map(_globals_of, _children(node)))


def _aliases(parts: Iterable[ast.AST]) -> dict[str, str]:
    """What imported names stand for, in the order in which ``parts`` give them."""
    found: dict[str, str] = {}
    for part in parts:
        if isinstance(part, ast.Import):
            for alias in part.names:
                whole = alias.name if alias.asname else alias.name.partition(".")[0]
                found[alias.asname or whole] = whole
        elif isinstance(part, ast.ImportFrom) and part.module and not part.level:
            found |= {alias.asname or alias.name: f"{part.module}.{alias.name}" for alias in part.names}
        elif isinstance(part, ast.Assign) and isinstance(part.value, (ast.Name, ast.Attribute, ast.Call)):
            dotted = _dotted(part.value, found)
            if dotted:
                found |= {t.id: dotted for t in part.targets if isinstance(t, ast.Name)}
    return found


def _dotted(node: ast.AST, aliases: Mapping[str, str]) -> str:
    """The module or attribute that an expression names, such as ``robotbrain.pipeline.planning``; else ``""``."""
    if isinstance(node, ast.Name):
        return aliases.get(node.id, "")
    if isinstance(node, ast.Attribute):
        root = _dotted(node.value, aliases)
        return f"{root}.{node.attr}" if root else ""
    if isinstance(node, ast.Call) and _called(node) in _IMPORTING and node.args:
        name = _folded(node.args[0])
        top = isinstance(name, str) and _called(node) == "__import__" and len(node.args) < 4 and not node.keywords
        return (name.partition(".")[0] if top else name) if isinstance(name, str) else ""
    if isinstance(node, ast.Subscript):  # sys.modules["..."]
        name = _folded(node.slice)
        return name if isinstance(name, str) and _dotted(node.value, aliases) == "sys.modules" else ""
    return ""


def _locals(function: ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda) -> set[str]:
    """Names that mean something of their own inside a function."""
    arguments = function.args
    named = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs, arguments.vararg, arguments.kwarg]
    found = {argument.arg for argument in named if argument is not None}
    todo: list[ast.AST] = list(function.body) if isinstance(function.body, list) else [function.body]
    outer: set[str] = set()
    while todo:
        node = todo.pop()
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            found.add(node.id)
        elif isinstance(node, (ast.Global, ast.Nonlocal)):
            outer.update(node.names)
        if not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda, ast.ClassDef)):
            todo += _children(node)
    return found - outer


def _all_known(nodes: Sequence[ast.AST]) -> bool:
    return all(isinstance(_folded(node), str) for node in nodes)


def _called(node: ast.AST) -> str:
    """The last name of what a call calls."""
    function = node.func if isinstance(node, ast.Call) else None
    return (
        function.attr if isinstance(function, ast.Attribute) else function.id if isinstance(function, ast.Name) else ""
    )


def _folded(node: ast.AST) -> Any:
    """The constant that an expression is, pieced together or not; None where that cannot be told."""
    if not isinstance(node, _FOLDABLE):
        return None
    match node:
        case ast.Constant(value=str() | bytes() | int() as value):
            return value
        case ast.BinOp(left=left, op=ast.Add(), right=right):
            parts = [_folded(left), _folded(right)]
            return "".join(parts) if all(isinstance(p, str) for p in parts) else None
        case ast.JoinedStr(values=values):
            texts = [_folded(v.value if isinstance(v, ast.FormattedValue) else v) for v in values]
            return "".join(texts) if all(isinstance(t, str) for t in texts) else None
        case ast.Subscript(value=ast.Constant(value=str() as text), slice=ast.Slice(None, None, step)) if step:
            with contextlib.suppress(ValueError, TypeError):
                return text[:: ast.literal_eval(step)]
        case ast.Call(func=ast.Attribute(value=ast.Constant(value=str() | bytes() as text), attr=attr), args=args):
            values = [_constant(argument) for argument in args]
            if attr in ("join", "format", "replace", "lower", "strip", "decode") and None not in values:
                with contextlib.suppress(Exception):
                    return getattr(text, attr)(*values)
    return None


def _constant(node: ast.AST) -> Any:
    if isinstance(node, (ast.List, ast.Tuple)):
        parts = [_folded(part) for part in node.elts]
        return None if None in parts else parts
    return _folded(node)


def _found(dotted: str) -> Any:
    """The object of this package that a dotted name means, or None."""
    parts = dotted.split(".")
    for cut in range(len(parts), 0, -1):
        with contextlib.suppress(ImportError, AttributeError):
            return functools.reduce(getattr, parts[cut:], importlib.import_module(".".join(parts[:cut])))
    return None


def _shown(node: ast.AST) -> str:
    text = ast.unparse(node)
    return text if len(text) <= 80 else text[:77] + "..."
