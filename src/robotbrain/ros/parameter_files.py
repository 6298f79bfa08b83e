"""Parameter values as text and in YAML files (https://docs.ros.org/en/kilted/How-To-Guides/Parameters-YAML-files.html)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from robotbrain.errors import InputError

_KEY = "ros__parameters"
_EXAMPLE = "planner:\n  ros__parameters:\n    rate: 5.0"


def parse_value(text: str) -> Any:
    """Return a parameter value written as YAML; text that is no YAML is itself."""
    import yaml  # type: ignore[import-untyped]

    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError:
        return text
    return text if value is None or isinstance(value, dict) else _as_parameter(value, text)


def _as_parameter(value: Any, otherwise: Any) -> Any:
    """Return what a parameter can hold: scalars and lists of one type; integers among floats are floats."""
    if isinstance(value, list):
        kinds = {type(item) for item in value}
        if kinds == {int, float}:
            return [float(item) for item in value]
        return value if len(kinds) <= 1 and kinds <= {bool, int, float, str} else otherwise
    return value if isinstance(value, (bool, int, float, str)) else otherwise


def load_yaml(path: Path) -> dict[str, Any]:
    """Return a YAML file's content.

    Raises:
        InputError: the file is missing, or holds no mapping.
    """
    import yaml

    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(
            "parameter file", given=str(path), expected="a file that can be read", fix=f"{error.strerror}."
        ) from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"parameter file {path}", given=str(error), expected="YAML", fix=_EXAMPLE) from None
    if not isinstance(content, dict):
        raise InputError(f"parameter file {path}", given=content, expected="nodes and parameters", fix=_EXAMPLE)
    return content


def flatten(parameters: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield (name, value) of nested parameters, names joined by dots."""
    for key, value in parameters.items():
        name = f"{prefix}{key}"
        if isinstance(value, dict):
            yield from flatten(value, f"{name}.")
        else:
            yield name, _as_parameter(value, str(value))


def read_parameter_file(path: Path) -> list[tuple[str, str, Any]]:
    """Return the parameters of a file as (node name or pattern, parameter, value), in order.

    Raises:
        InputError: the file is missing or is no parameter file.
    """
    found: list[tuple[str, str, Any]] = []

    def walk(content: dict[str, Any], name: str) -> None:
        for key, value in content.items():
            if key == _KEY and isinstance(value, dict):
                found.extend((name, parameter, setting) for parameter, setting in flatten(value))
            elif isinstance(value, dict):
                part = str(key)
                # A node's name may be split into namespaces, or written whole.
                walk(value, part if not name else f"{name.rstrip('/')}/{part.lstrip('/')}")
            else:
                raise InputError(
                    f"parameter file {path}",
                    given=f"{key}: {value!r} under {name or 'the top'}",
                    expected=f"a node's parameters under {_KEY}",
                    fix=_EXAMPLE,
                )

    walk(load_yaml(path), "")
    return found
