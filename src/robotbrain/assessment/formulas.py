"""Formulas of a question bank, e.g. ``2 * cores * mhz / 1000``: arithmetic and nothing else."""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Mapping
from typing import Any

from robotbrain.errors import InputError

_OPERATORS: dict[type[ast.AST], Callable[..., float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.USub: operator.neg,
}
_FUNCTIONS: dict[str, Callable[..., float]] = {
    "abs": abs,
    "ceil": math.ceil,
    "exp": math.exp,
    "floor": math.floor,
    "log": math.log,
    "log10": math.log10,
    "log2": math.log2,
    "max": max,
    "min": min,
    "round": round,
    "sqrt": math.sqrt,
}


def evaluate(formula: str, values: Mapping[str, Any]) -> float:
    """Return the value of ``formula``, in which the names of ``values`` may occur.

    Raises:
        InputError: it is no formula, names something unknown, or has no finite value.
    """
    try:
        result = float(_value(ast.parse(formula, mode="eval").body, values))
    except (SyntaxError, KeyError, TypeError, ValueError, ArithmeticError) as error:
        raise _error(formula, f"{type(error).__name__}: {error}") from None
    if not math.isfinite(result):
        raise _error(formula, str(result))
    return result


def _value(node: ast.AST, values: Mapping[str, Any]) -> Any:
    match node:
        case ast.Constant(value=int() | float() as number):
            return number
        case ast.Name(id="pi"):
            return math.pi
        case ast.Name(id=name):
            return values[name]
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
            return _OPERATORS[type(op)](_value(left, values), _value(right, values))
        case ast.UnaryOp(operand=operand, op=op) if type(op) in _OPERATORS:
            return _OPERATORS[type(op)](_value(operand, values))
        case ast.Call(func=ast.Name(id=name), args=args, keywords=[]):
            return _FUNCTIONS[name](*(_value(a, values) for a in args))
    raise ValueError("arithmetic only")


def _error(formula: str, problem: str) -> InputError:
    return InputError(
        "formula",
        given=f"{formula} ({problem})",
        expected=f"arithmetic on the question's parameters, {', '.join(_FUNCTIONS)} and pi, with a finite value",
        fix="Correct it in the bank.",
    )
