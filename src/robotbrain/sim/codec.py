"""Frozen dataclasses from JSON-like data, with every value checked against its annotation."""

from __future__ import annotations

import dataclasses
import math
import types
from collections.abc import Mapping
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from robotbrain.errors import InputError

T = TypeVar("T")


def decode(kind: type[T], data: object, where: str) -> T:
    """Build a ``kind`` (a dataclass) from ``data`` (mappings, sequences and scalars as JSON gives them).

    Args:
        kind: the dataclass to build. Fields may be dataclasses, tuples, literals, and plain scalars.
        data: what ``dataclasses.asdict`` returned, or the same after a trip through JSON.
        where: name of ``data`` in messages.

    Raises:
        InputError: naming the path to the first value that is missing, unknown, of a wrong kind or not finite.
    """
    return _value(kind, data, where)  # type: ignore[no-any-return]


def _value(hint: Any, data: object, where: str) -> Any:
    origin = get_origin(hint)
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return _record(hint, data, where)
    if origin is tuple:
        return _sequence(get_args(hint), data, where)
    if origin is Literal:
        if data not in get_args(hint):
            raise _wrong(where, data, "one of " + ", ".join(map(repr, get_args(hint))))
        return data
    if origin is types.UnionType:
        choices = [arg for arg in get_args(hint) if arg is not type(None)]
        return None if data is None else _value(choices[0], data, where)
    if hint is float:
        if isinstance(data, bool) or not isinstance(data, (int, float)) or not math.isfinite(data):
            raise _wrong(where, data, "a finite number")
        return float(data)
    if not isinstance(data, hint) or (hint is int and isinstance(data, bool)):
        raise _wrong(where, data, f"a value of type {hint.__name__}")
    return data


def _record(kind: type[Any], data: object, where: str) -> Any:
    if not isinstance(data, Mapping):
        raise _wrong(where, data, f"a mapping with the fields of {kind.__name__}")
    hints = get_type_hints(kind)
    names = [f.name for f in dataclasses.fields(kind) if f.init]
    if set(data) != set(names):
        missing, unknown = sorted(set(names) - set(data)), sorted(set(map(str, data)) - set(names))
        raise _wrong(where, {"missing": missing, "unknown": unknown}, f"exactly the fields {', '.join(names)}")
    return kind(**{name: _value(hints[name], data[name], f"{where}.{name}") for name in names})


def _sequence(args: tuple[Any, ...], data: object, where: str) -> tuple[Any, ...]:
    if not isinstance(data, (list, tuple)):
        raise _wrong(where, data, "a list")
    if len(args) == 2 and args[1] is Ellipsis:
        args = (args[0],) * len(data)
    if len(args) != len(data):
        raise _wrong(where, data, f"a list of {len(args)} values")
    return tuple(_value(arg, item, f"{where}[{i}]") for i, (arg, item) in enumerate(zip(args, data, strict=True)))


def _wrong(where: str, given: object, expected: str) -> InputError:
    return InputError(where, given=given, expected=expected, fix="Write it with to_dict() of this version.")
