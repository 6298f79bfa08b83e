"""Python code of a configuration for genuine Isaac Lab."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from typing import Any

from robotbrain.errors import InputError
from robotbrain.rl.isaaclab._source import Sources
from robotbrain.rl.managers import ObservationGroupCfg

WIDTH = 120
_NOT_THERE = frozenset({"debug_vis"})  # no effect here, drawn there


class Emitter:
    """Turns values into expressions, and objects full of terms into classes."""

    def __init__(self, sources: Sources) -> None:
        self.sources = sources

    def value(self, value: Any, where: str, indent: int = 0) -> str:
        """An expression for ``value``.

        Raises:
            InputError: something that cannot be written as code, e.g. a tensor.
        """
        if isinstance(value, float) and not math.isfinite(value):
            self.sources.imports.add("import math")
            return "math.nan" if math.isnan(value) else "math.inf" if value > 0 else "-math.inf"
        if isinstance(value, str):
            return json.dumps(value, ensure_ascii=False)
        if value is None or isinstance(value, bool | int | float):
            return repr(value)
        if isinstance(value, slice):
            return repr(value)
        if isinstance(value, list | tuple):
            ends = "[]" if isinstance(value, list) else "()"
            items = [self.value(item, f"{where}[{i}]", indent + 4) for i, item in enumerate(value)]
            return _join(ends, items, indent, trailing=isinstance(value, tuple) and len(value) == 1)
        if isinstance(value, Mapping):
            items = [
                f"{self.value(k, where)}: {self.value(v, f'{where}[{k!r}]', indent + 4)}" for k, v in value.items()
            ]
            return _join("{}", items, indent)
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            return self.config(value, where, indent)
        if callable(value):
            return self.sources.reference(value, where)
        raise InputError(
            where,
            given=f"{type(value).__name__}: {value!r}",
            expected="numbers, texts, lists, dictionaries, configurations, functions",
            fix="Give the numbers themselves, e.g. tensor.tolist().",
        )

    def config(self, cfg: Any, where: str, indent: int = 0) -> str:
        """A constructor call with the fields that differ from their defaults."""
        name = self.sources.reference(type(cfg), where)
        arguments = []
        for field in dataclasses.fields(cfg):
            value = getattr(cfg, field.name)
            if field.name in _NOT_THERE or _equals(value, _default(field)):
                continue
            arguments.append(f"{field.name}={self.value(value, f'{where}.{field.name}', indent + 4)}")
        return name + _join("()", arguments, indent)

    def terms(self, name: str, group: Any, where: str, base: str = "") -> str:
        """A configclass with one attribute for each term of ``group``, and its settings in ``__post_init__``."""
        self.sources.imports.add("from isaaclab.utils import configclass")
        settings = {f.name for f in dataclasses.fields(ObservationGroupCfg)} if base else set()
        items = group.items() if isinstance(group, Mapping) else vars(group).items()
        lines, after = [], []
        for key, value in items:
            if key in settings:
                default = ObservationGroupCfg.__dataclass_fields__[key]
                if not _equals(value, _default(default)):
                    after.append(f"        self.{key} = {self.value(value, f'{where}.{key}', 8)}")
            elif value is not None:
                lines.append(f"    {key} = {self.value(value, f'{where}.{key}', 4)}")
        if after:
            lines += ["", "    def __post_init__(self):", *after]
        return f"@configclass\nclass {name}{f'({base})' if base else ''}:\n" + "\n".join(lines or ["    pass"]) + "\n"


def _default(field: Any) -> Any:
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return field.default


def _equals(value: Any, default: Any) -> bool:
    if default is dataclasses.MISSING or type(value) is not type(default):
        return False
    return bool(value == default)


def _join(ends: str, items: list[str], indent: int, trailing: bool = False) -> str:
    line = ends[0] + ", ".join(items) + ("," if trailing else "") + ends[1]
    if not items or (len(line) + indent < WIDTH - 24 and "\n" not in line):
        return line
    pad = " " * (indent + 4)
    return ends[0] + "\n" + "".join(f"{pad}{item},\n" for item in items) + " " * indent + ends[1]
