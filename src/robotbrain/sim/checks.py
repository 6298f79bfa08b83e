"""Checks of single values, with messages that say what to change."""

from __future__ import annotations

import math
import numbers
from collections.abc import Iterable

from robotbrain.errors import InputError


def check_range(what: str, value: object, low: float, high: float) -> None:
    """Raise ``InputError`` unless ``value`` is a finite number in [low, high]."""
    real = not isinstance(value, bool) and isinstance(value, numbers.Real)
    number = float(value) if real else math.nan  # type: ignore[arg-type]
    if not math.isfinite(number) or not low <= number <= high:
        raise InputError(
            what, given=value, expected=f"a finite number in [{low:g}, {high:g}]", fix="Change this value."
        )


def check_each(what: str, values: object, size: int, low: float, high: float) -> None:
    """Raise ``InputError`` unless ``values`` are ``size`` finite numbers in [low, high]."""
    given = tuple(values) if isinstance(values, Iterable) else (values,)
    if len(given) != size:
        raise InputError(what, given=values, expected=f"{size} numbers", fix="Change this value.")
    for i, value in enumerate(given):
        check_range(f"{what}[{i}]", value, low, high)


def check_seed(what: str, seed: object) -> int:
    """Return ``seed`` as an ``int``; raise ``InputError`` unless it is an integer >= 0."""
    if isinstance(seed, bool) or not isinstance(seed, numbers.Integral) or seed < 0:
        raise InputError(what, given=seed, expected="an integer >= 0", fix="Pass for example seed=7.")
    return int(seed)
