"""Importing by name, for the two programs that start jobs."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any


def resolve(name: str) -> Any:
    """The object that ``"package.module:attribute"`` names."""
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)


def import_all(modules: Sequence[str]) -> dict[str, str]:
    """Import what there is of ``modules``; return what failed and why.

    ``"package:name"`` asks for the name as ``from package import name`` does: packages load parts when asked for them.
    """
    failed = {}
    for name in modules:
        package, _, part = name.partition(":")
        try:
            module = importlib.import_module(package)
            if part and not hasattr(module, part):
                importlib.import_module(f"{package}.{part}")
        except Exception as error:  # an optional package; whoever needs it meets the error itself
            failed[name] = f"{type(error).__name__}: {error}"
    return failed
