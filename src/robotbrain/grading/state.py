"""What results of tests may depend on: the notebook's own functions and classes, and its plain constants."""

from __future__ import annotations

from collections.abc import Mapping
from types import CodeType, FunctionType
from typing import Any

_PLAIN = (bool, int, float, str)


def state_of(namespace: Mapping[str, Any]) -> dict[str, Any]:
    """The part of a notebook's globals that results may depend on.

    Data objects are left out: a cell that plots or drives must not make every upstream test run again.
    """
    here = namespace.get("__name__", "__main__")
    return {
        name: value
        for name, value in namespace.items()
        if not name.startswith("_")
        and (
            isinstance(value, _PLAIN)
            or ((isinstance(value, type) or callable(value)) and getattr(value, "__module__", None) == here)
        )
    }


def unchanged(before: Mapping[str, Any], now: Mapping[str, Any], *, grown: bool = False) -> bool:
    """Whether two states are of the very same objects.

    Args:
        grown: names that were added since do not count.
    """
    names_fit = before.keys() <= now.keys() if grown else before.keys() == now.keys()
    return names_fit and all(_same(value, now[name]) for name, value in before.items())


def _same(a: Any, b: Any) -> bool:
    return a is b or (type(a) is type(b) and isinstance(a, (*_PLAIN, tuple)) and a == b)


def token_of(value: Any) -> Any:
    """What tells an object of a state from others, also after the process was forked: plain, and comparable."""
    if isinstance(value, _PLAIN):
        return value
    members = vars(value).values() if isinstance(value, type) else (value,)
    inner = (getattr(member, "__func__", getattr(member, "fget", member)) for member in members)
    codes = tuple(hash(f.__code__) for f in inner if isinstance(f, FunctionType) and isinstance(f.__code__, CodeType))
    return (id(value), type(value).__name__, codes)
