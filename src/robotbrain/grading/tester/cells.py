"""Graded cells of plain assertions, run here with the student's names standing for the student's objects.

A name means, in this order: what the cell itself defined, a builtin, what a locked cell of the notebook imports or
defines (those cells are the course's), the student's object. So a student cannot change what ``sum``, ``np`` or a
helper of the course does to an assertion.
"""

from __future__ import annotations

import ast
import builtins
import contextlib
import traceback
from collections.abc import Iterable, Mapping
from typing import Any

from robotbrain.grading.expect import readable, show
from robotbrain.grading.limits import EndedFromOutsideError
from robotbrain.grading.quiet import BoundedText, quiet
from robotbrain.grading.remote.proxies import Proxy, type_name
from robotbrain.grading.remote.raised import RemoteRaised
from robotbrain.grading.report import Score
from robotbrain.grading.runner import builtin_name

FILENAME = "<graded cell>"
_BEGIN, _END = "### BEGIN HIDDEN TESTS", "### END HIDDEN TESTS"
_FAIL = "__assertion_failed__"
_VALUE = "__asserted_{}__"
_KEPT_OUTPUT = 20_000
_FOUND = "a hidden test found a mistake"
Output = dict[str, Any]


def definitions(sources: Iterable[str]) -> dict[str, ast.stmt]:
    """The statements of the course's own cells that import modules, define functions and set constants, by name."""
    found: dict[str, ast.stmt] = {}
    for source in sources:
        with contextlib.suppress(SyntaxError):  # magics
            for statement in ast.parse(source).body:
                for name in _defined(statement):
                    found[name] = statement
    return found


def _defined(statement: ast.stmt) -> list[str]:
    if isinstance(statement, (ast.Import, ast.ImportFrom)):
        return [alias.asname or alias.name.partition(".")[0] for alias in statement.names if alias.name != "*"]
    if isinstance(statement, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
        return [statement.name]
    if isinstance(statement, ast.Assign) and _is_plain(statement.value):
        return [target.id for target in statement.targets if isinstance(target, ast.Name)]
    return []


def _is_plain(value: ast.expr) -> bool:
    """Whether this is a constant of the course; ``None`` is a place for the student to fill."""
    try:
        return ast.literal_eval(value) is not None
    except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError):
        return False


class _Names(dict[str, Any]):
    """The builtins of a graded cell, and what else a name may mean that the cell did not define.

    Builtins, because Python asks them last and in every scope, those of functions, classes and comprehensions alike.
    """

    def __init__(self, student: Mapping[str, Any], course: Mapping[str, ast.stmt], cell: dict[str, Any]) -> None:
        super().__init__(vars(builtins))
        self._student, self._course, self._cell = student, course, cell

    def __missing__(self, name: str) -> Any:
        if name in self._course:
            exec(compile(ast.Module([self._course[name]], []), "<course cell>", "exec"), self._cell)
            return self._cell[name]
        value = self._student[name]  # a KeyError becomes a NameError
        if type(value) is Proxy and type_name(value) == "module":
            raise ImportError(f"the test uses {name!r}, a module of the notebook: import it in the test cell")
        return value


def run_cell(
    source: str,
    student: Mapping[str, Any],
    course: Mapping[str, ast.stmt],
    given: Mapping[str, Any] | None = None,
    *,
    sealed: bool = False,
) -> list[Output]:
    """Run a graded cell and return its outputs, in notebook format.

    Args:
        sealed: say nothing about how it failed, and keep no prints.
        student: the student's names.
        course: what :func:`definitions` found.
        given: names that are there from the start.

    Raises:
        EndedFromOutsideError: the student's process ended or was interrupted.
    """
    names: dict[str, Any] = {"__name__": "__tests__", _FAIL: _fail, **(given or {})}
    names["__builtins__"] = _Names(student, course, names)
    output = BoundedText(_KEPT_OUTPUT)
    outputs: list[Output] = []
    try:
        tree = _Explained(source).visit(ast.parse(source))
        last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
        with quiet(output):
            exec(compile(ast.fix_missing_locations(tree), FILENAME, "exec"), names)
            value = eval(compile(ast.Expression(last.value), FILENAME, "eval"), names) if last else None
        if value is not None:
            outputs = [_result(value)]
    except EndedFromOutsideError:
        raise
    except BaseException as error:
        outputs = [problem(builtin_name(error), _FOUND)] if sealed else [_error(error)]
    printed = "" if sealed else readable(output.getvalue())
    return [{"output_type": "stream", "name": "stdout", "text": printed}, *outputs] if printed else outputs


def _result(value: Any) -> Output:
    bundle = value._repr_mimebundle_() if isinstance(value, Score) else {"text/plain": readable(show(value))}
    return {"output_type": "execute_result", "data": bundle, "metadata": {}, "execution_count": None}


def _error(error: BaseException) -> Output:
    name, said = type(error).__name__, show(str(error), 1000)
    lines = [f.lineno for f in traceback.extract_tb(error.__traceback__) if f.filename == FILENAME and f.lineno]
    if isinstance(error, RemoteRaised):
        place = f" in line {error.line} of {error.function}" if error.function else ""
        name, said = error.type_name, f"your code raised {error.type_name}{place}: {said}"
    return problem(readable(name), readable(f"{said} (line {lines[-1]} of this cell)" if lines else said))


def problem(name: str, said: str) -> Output:
    """An error as an output."""
    return {"output_type": "error", "ename": name, "evalue": said, "traceback": [f"{name}: {said}"]}


def failed(outputs: Iterable[Output]) -> bool:
    """Whether a cell that ended with ``outputs`` gives no points."""
    return any(output["output_type"] == "error" for output in outputs)


def visible_part(source: str) -> str:
    """A graded cell without the lines that students do not get to see; line numbers stay."""
    hidden = hidden_lines(source)
    return "\n".join("" if number in hidden else line for number, line in enumerate(source.splitlines(), 1))


def hidden_lines(source: str) -> set[int]:
    """Numbers of the lines of a cell that students do not get to see."""
    hidden, inside = set(), False
    for number, line in enumerate(source.splitlines(), 1):
        inside = inside or _BEGIN in line
        if inside:
            hidden.add(number)
        inside = inside and _END not in line
    return hidden


class _Explained(ast.NodeTransformer):
    """Turns ``assert a == b`` into a test that remembers ``a`` and ``b`` for the message."""

    def __init__(self, source: str) -> None:
        self._source, self._count = source, 0

    def visit_Assert(self, node: ast.Assert) -> ast.stmt:
        """Rewrite one assertion."""
        shown: list[tuple[str, str]] = []

        def remembered(expression: ast.expr) -> ast.expr:
            if isinstance(expression, (ast.Starred, ast.GeneratorExp)) or _is_plain(expression):
                return expression
            name = _VALUE.format(self._count)
            self._count += 1
            shown.append((self._text(expression), name))
            return ast.NamedExpr(ast.Name(name, ast.Store()), expression)

        text, test = self._text(node.test), node.test
        if isinstance(test, ast.Compare):
            test.left = remembered(test.left)
            test.comparators = [remembered(c) for c in test.comparators]
        elif isinstance(test, ast.Call):
            test.args = [remembered(argument) for argument in test.args]
        empty = ast.Constant(None)
        names: list[ast.expr] = [ast.Constant(name) for _, name in shown]
        call = ast.Call(
            ast.Name(_FAIL, ast.Load()),
            [
                ast.Constant(text),
                ast.Tuple([ast.Constant(t) for t, _ in shown], ast.Load()),
                ast.Tuple(names, ast.Load()),
                ast.Call(ast.Name("locals", ast.Load()), [], []),
                node.msg or empty,
            ],
            [],
        )
        fail = ast.Expr(call)
        return ast.copy_location(ast.If(ast.UnaryOp(ast.Not(), test), [fail], []), node)

    def _text(self, node: ast.expr) -> str:
        return ast.get_source_segment(self._source, node) or ast.unparse(node)


def _fail(text: str, parts: tuple[str, ...], names: tuple[str, ...], scope: Mapping[str, Any], said: Any) -> None:
    """Raise the error of a failed assertion: what it said, and what was compared."""
    values = [f"{part} is {show(scope[name], 200)}" for part, name in zip(parts, names, strict=True) if name in scope]
    sentence = "" if said is None else f"{show(said)}: "
    raise AssertionError(f"{sentence}`{text}` does not hold" + (": " + ", ".join(values) if values else ""))
