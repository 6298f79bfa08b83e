"""TOML for measured profiles: writing (the standard library only reads), and typed reading that says where it errs."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from datetime import datetime
from typing import Any

from robotbrain.errors import InputError


def table(title: str, values: Mapping[str, object]) -> list[str]:
    """Return the lines of a table, with an empty one before it; none at all if every value is None."""
    lines = pairs(values)
    return ["", f"[{title}]", *lines] if lines else []


def pairs(values: Mapping[str, object]) -> list[str]:
    """Return a line for each value that is not None."""
    return [f"{_key(name)} = {_value(value)}" for name, value in values.items() if value is not None]


class Reader:
    """Typed access to a TOML document.

    Args:
        name: of the file, for error messages.
        data: the document. Its top level is the table ``""`` in the methods below.
    """

    def __init__(self, name: str, data: Mapping[str, Any]) -> None:
        self.name, self.data = name, data

    def error(self, key: str, given: object, expected: str) -> InputError:
        """Return the error for a key that does not hold what it must."""
        return InputError(
            f"{self.name}: {key}", given=given, expected=expected, fix="Measure again, or compare with another profile."
        )

    def group(self, name: str) -> Mapping[str, Any]:
        """Return a table; an empty one if it is not there."""
        found = self.data.get(name, {}) if name else self.data
        if not isinstance(found, Mapping):
            raise self.error(name, found, "a table")
        return found

    def maybe(self, group: str, key: str, kind: type[Any]) -> Any:
        """Return a value of this type, or None if it is not there."""
        value = self.group(group).get(key)
        right = isinstance(value, kind) and (kind is bool or not isinstance(value, bool))
        if value is not None and not right:
            raise self.error(_where(group, key), value, f"of type {kind.__name__}")
        return value

    def get(self, group: str, key: str, kind: type[Any]) -> Any:
        """Return a value of this type."""
        value = self.maybe(group, key, kind)
        if value is None:
            raise self.error(_where(group, key), None, f"a value of type {kind.__name__}")
        return value

    def number(self, group: str, key: str, *, low: float = 0.0) -> float | None:
        """Return a finite number of at least ``low``, or None if it is not there."""
        value = self.group(group).get(key)
        if value is None:
            return None
        if not is_number(value) or not low <= value < 1e12:
            raise self.error(_where(group, key), value, f"a number, {low:g} or more")
        return float(value)

    def texts(self, group: str, key: str) -> tuple[str, ...]:
        """Return a list of texts, empty if it is not there."""
        value = self.maybe(group, key, list) or []
        if not all(isinstance(item, str) for item in value):
            raise self.error(_where(group, key), value, "a list of texts")
        return tuple(value)


def is_number(value: object) -> bool:
    """Say whether it is a finite number (and no truth value)."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _where(group: str, key: str) -> str:
    return f"[{group}] {key}" if group else key


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _string(name)


def _value(value: object) -> str:
    for kind, text in _WRITERS:
        if isinstance(value, kind):
            return text(value)
    raise TypeError(f"no TOML form for {type(value).__name__}")


def _string(text: str) -> str:
    named = {"\b": "\\b", "\t": "\\t", "\n": "\\n", "\f": "\\f", "\r": "\\r", '"': '\\"', "\\": "\\\\"}
    whole = text.encode("utf-8", "replace").decode("utf-8")  # lone surrogates cannot be stored in UTF-8
    return '"' + "".join(named.get(c) or (f"\\u{ord(c):04x}" if c < " " or c == "\x7f" else c) for c in whole) + '"'


_WRITERS: tuple[tuple[type[Any] | tuple[type[Any], ...], Callable[[Any], str]], ...] = (
    (bool, lambda value: "true" if value else "false"),
    (int, str),
    (float, lambda value: repr(float(value))),
    (str, _string),
    (datetime, lambda value: value.isoformat().replace("+00:00", "Z")),
    ((list, tuple), lambda value: "[" + ", ".join(_value(item) for item in value) + "]"),
)
