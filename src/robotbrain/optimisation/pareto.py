"""The Pareto front: what no other choice beats in every respect at once."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from robotbrain.errors import InputError

Row = TypeVar("Row")
Key = str | Callable[[Any], float]


def dominates(one: Sequence[float], other: Sequence[float]) -> bool:
    """Return whether ``one`` is nowhere larger and somewhere smaller (both to be minimised, of the same length)."""
    return all(a <= b for a, b in zip(one, other, strict=True)) and any(a < b for a, b in zip(one, other, strict=True))


def pareto_front(rows: Sequence[Row], keys: Sequence[Key]) -> list[Row]:
    """Return the rows that no other row dominates, in their order.

    Args:
        rows: mappings, or anything that the keys can be called with.
        keys: what to minimise: names of entries (``"-name"`` maximises), or functions of a row. Rows that agree in
            all of them stay together or go together.

    Raises:
        InputError: for no keys, or a value that is missing or not a number.
    """
    if isinstance(keys, str) or not keys:
        raise InputError("keys", given=keys, expected="a list of one key or more", fix='Try ["drop", "latency_ms"].')
    points = [tuple(_value(row, key, index) for key in keys) for index, row in enumerate(rows)]
    return [row for row, point in zip(rows, points, strict=True) if not any(dominates(q, point) for q in points)]


def _value(row: Any, key: Key, index: int) -> float:
    given: Any
    if not isinstance(key, str):
        given, sign, shown = key(row), 1.0, getattr(key, "__name__", "key")
    else:
        shown, sign = key.removeprefix("-"), -1.0 if key.startswith("-") else 1.0
        given = row.get(shown) if isinstance(row, Mapping) else getattr(row, shown, None)
    if isinstance(given, bool) or not isinstance(given, int | float) or math.isnan(given):
        raise InputError(
            f"{shown} of row {index}", given=given, expected="a number", fix="Leave rows out that were not measured."
        )
    return sign * float(given)
