"""Packages whose names are loaded when first used, so that importing the package stays cheap."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def lazy(package: str, module_of: Mapping[str, str], present: Mapping[str, Any]) -> tuple[Callable[[str], Any], Any]:
    """Return ``__getattr__`` and ``__dir__`` (PEP 562) of a package.

    Args:
        package: its ``__name__``.
        module_of: public name -> module of the package that has it.
        present: the package's ``globals()``.
    """

    def getattr_(name: str) -> Any:
        if name in module_of:
            return getattr(import_module(f"{package}.{module_of[name]}"), name)
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    def dir_() -> list[str]:
        return [*present, *module_of]

    return getattr_, dir_
