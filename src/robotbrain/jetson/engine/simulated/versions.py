"""Which names which version of TensorRT has: the stand-in shows no others.

8.6, 10.3, 10.13 and 11.0 were compared with the genuine bindings; 8.5 follows NVIDIA's reference of 8.5.
"""

from __future__ import annotations

import enum
from collections.abc import Callable
from typing import Any, TypeVar

VERSIONS = {"8.5": "8.5.2", "8.6": "8.6.1", "10.3": "10.3.0", "10.13": "10.13.0", "11.0": "11.0.0"}
"""Versions that can be simulated, and what their ``__version__`` says."""

_T = TypeVar("_T", bound=Callable[..., Any])


def number(version: str) -> tuple[int, int]:
    """Return ``(10, 3)`` for ``"10.3"``."""
    major, minor = version.split(".")[:2]
    return int(major), int(minor)


def only(first: str = "8.5", before: str = "99.0") -> Callable[[_T], _T]:
    """Mark a method that only versions from ``first`` on, but before ``before``, have."""

    def mark(method: _T) -> _T:
        method.__dict__["versions"] = (number(first), number(before))
        return method

    return mark


def restrict(kind: type, version: tuple[int, int], **extra: object) -> type:
    """Return a copy of a class with the methods that a version has, and further class attributes."""

    def has(member: object) -> bool:
        function = member.fget if isinstance(member, property) else member
        first, before = getattr(function, "versions", ((0, 0), (99, 0)))
        return bool(first <= version < before)

    kept = {name: member for name, member in vars(kind).items() if name not in ("__dict__", "__weakref__")}
    namespace = {name: member for name, member in kept.items() if has(member)}
    return type(kind.__name__, kind.__bases__, {**namespace, **extra})


_ALWAYS = ("8.5", "99.0")
_ENUMS: dict[str, tuple[tuple[str, int, str, str], ...]] = {
    # member, value, first version, first version without it or with another value
    "NetworkDefinitionCreationFlag": (
        ("EXPLICIT_BATCH", 0, "8.5", "11.0"),
        ("EXPLICIT_PRECISION", 1, "8.5", "10.0"),
        ("STRONGLY_TYPED", 1, "10.0", "11.0"),
        ("STRONGLY_TYPED", 0, "11.0", "99.0"),
    ),
    "BuilderFlag": (
        ("FP16", 0, "8.5", "11.0"),
        ("INT8", 1, "8.5", "11.0"),
        ("TF32", 7, "8.5", "10.0"),
        ("TF32", 6, "10.0", "99.0"),
    ),
    "MemoryPoolType": (("WORKSPACE", 0, *_ALWAYS),),
    "TensorIOMode": (("NONE", 0, *_ALWAYS), ("INPUT", 1, *_ALWAYS), ("OUTPUT", 2, *_ALWAYS)),
    "TensorLocation": (("DEVICE", 0, *_ALWAYS), ("HOST", 1, *_ALWAYS)),
    "DataType": (
        *((name, i, *_ALWAYS) for i, name in enumerate(("FLOAT", "HALF", "INT8", "INT32", "BOOL", "UINT8"))),
        ("INT64", 8, "10.0", "99.0"),
    ),
    "LayerType": (
        ("CONVOLUTION", 0, *_ALWAYS),
        ("QUANTIZE", 33, "8.5", "10.0"),
        ("DEQUANTIZE", 34, "8.5", "10.0"),
        ("QUANTIZE", 32, "10.0", "99.0"),
        ("DEQUANTIZE", 33, "10.0", "99.0"),
    ),
    "Severity": tuple(
        (name, i, *_ALWAYS) for i, name in enumerate(("INTERNAL_ERROR", "ERROR", "WARNING", "INFO", "VERBOSE"))
    ),
}
"""Numbers move between versions (bit 0 of the creation flags meant another flag until 11): write names, not numbers."""


def enums(version: tuple[int, int]) -> dict[str, type[enum.IntEnum]]:
    """Return the enumerations with the members that a version has."""
    made: dict[str, type[enum.IntEnum]] = {}
    for name, members in _ENUMS.items():
        held = {member: value for member, value, first, end in members if number(first) <= version < number(end)}
        functional: Any = enum.IntEnum  # mypy knows its functional form with literals only
        made[name] = functional(name, held)
    return made
