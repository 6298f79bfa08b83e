"""Random messages of any type, built only from what ``get_fields_and_field_types`` says.

Works on the classes of the kit and of genuine rclpy alike.
"""

from __future__ import annotations

import array
import importlib
import random
import re
from typing import Any

import numpy as np

_INTEGERS = {
    f"{sign}int{bits}": (-(2 ** (bits - 1)) if not sign else 0, 2 ** (bits - (0 if sign else 1)) - 1)
    for sign in ("", "u")
    for bits in (8, 16, 32, 64)
}
_CODES = {"int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "int64": "q",
          "uint64": "Q", "float": "f", "double": "d"}  # fmt: skip


def load_class(typename: str) -> Any:
    package, kind, name = typename.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), name)


def _scalar(kind: str, rng: random.Random) -> Any:
    if kind in _INTEGERS:
        low, high = _INTEGERS[kind]
        return rng.choice([low, high, rng.randint(low, high)])
    if kind == "boolean":
        return rng.random() < 0.5
    if kind == "octet":
        return bytes([rng.randrange(256)])
    if kind == "double":
        return rng.choice([0.0, -0.0, float("inf"), 1e-310, rng.uniform(-1e9, 1e9)])
    if kind == "float":
        return float(np.float32(rng.choice([float("-inf"), 1e-40, rng.uniform(-1e9, 1e9), 0.1])))
    if bound := re.fullmatch(r"string<(\d+)>", kind):
        return "b" * rng.choice([0, int(bound[1])])
    if kind == "string":
        return rng.choice(["", "a", "häß", "base_link", "x" * rng.randrange(9)])
    package, name = kind.split("/")
    if name.endswith(("_Goal", "_Result", "_Feedback")):
        action, _, part = name.rpartition("_")
        return random_message(getattr(load_class(f"{package}/action/{action}"), part), rng)
    return random_message(load_class(f"{package}/msg/{name}"), rng)


def random_value(kind: str, rng: random.Random) -> Any:
    """A value for a field of IDL type ``kind``."""
    fixed, sequence = re.fullmatch(r"(.+)\[(\d+)\]", kind), re.fullmatch(r"sequence<(.+?)(?:, (\d+))?>", kind)
    if not fixed and not sequence:
        return _scalar(kind, rng)
    element = (fixed or sequence)[1]
    bound = sequence and sequence[2]
    length = int(fixed[2]) if fixed else rng.choice([0, 1, 2, 3, 5][: int(bound) + 1 if bound else 5])
    items = [_scalar(element, rng) for _ in range(length)]
    if element not in _CODES:
        return items
    if fixed:
        dtype = {"float": "float32", "double": "float64"}.get(element, element)
        return np.array(items, dtype)
    return array.array(_CODES[element], items)


def random_message(cls: Any, rng: random.Random) -> Any:
    """A message with random, often extreme, values in every field (no NaN: it equals nothing)."""
    return cls(**{name: random_value(kind, rng) for name, kind in cls.get_fields_and_field_types().items()})


def to_plain(value: Any) -> Any:
    """The value as JSON can hold it, with the container types rclpy uses made visible."""
    if isinstance(value, array.array):
        return ["array", value.typecode, value.tolist()]
    if isinstance(value, np.ndarray):
        return ["numpy", str(value.dtype), value.tolist()]
    if isinstance(value, list):
        return ["list", [to_plain(item) for item in value]]
    if isinstance(value, bytes):
        return ["bytes", value.hex()]
    if hasattr(value, "get_fields_and_field_types"):
        return [
            type(value).__name__,
            {name: to_plain(getattr(value, name)) for name in value.get_fields_and_field_types()},
        ]
    return [type(value).__name__, value]
