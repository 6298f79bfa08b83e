"""Validation, expansion and remapping of ROS names (https://design.ros2.org/articles/topic_and_service_names.html)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from robotbrain.ros.exceptions import (
    InvalidNameException,
    InvalidNamespaceException,
    InvalidNodeNameException,
    InvalidServiceNameException,
    InvalidTopicNameException,
)

_TOKEN = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_RULE = "letters, digits and '_' between '/', no token starting with a digit"


def check_node_name(name: str) -> str:
    """Return ``name``; raise InvalidNodeNameException when it breaks the rules."""
    if not isinstance(name, str) or not _TOKEN.fullmatch(name) or len(name) > 255:
        raise InvalidNodeNameException(
            "node name",
            given=name,
            expected="letters, digits and '_', not starting with a digit",
            fix="Use a name such as 'planner'; a namespace goes in namespace=.",
        )
    return name


def check_namespace(namespace: str | None) -> str:
    """Return the namespace as an absolute name (``/`` for none); raise InvalidNamespaceException."""
    if not namespace or namespace == "/":
        return "/"
    absolute = namespace if namespace.startswith("/") else "/" + namespace
    if not all(_TOKEN.fullmatch(token) for token in absolute[1:].split("/")):
        raise InvalidNamespaceException("namespace", given=namespace, expected=_RULE, fix="Example: '/robot1'.")
    return absolute


def expand(name: str, node_name: str, namespace: str, *, service: bool = False) -> str:
    """Return the absolute form of a topic or service name.

    ``/x`` stays, ``x`` gets the namespace, ``~/x`` gets namespace and node name; ``{node}`` and ``{ns}`` are replaced.

    Raises:
        InvalidTopicNameException, InvalidServiceNameException: the name breaks the rules.
    """
    kind = "service name" if service else "topic name"
    error: type[InvalidNameException] = InvalidServiceNameException if service else InvalidTopicNameException
    if not isinstance(name, str) or not name:
        raise error(kind, given=name, expected="a non-empty string", fix="Example: 'scan' or '/scan'.")
    base = "" if namespace == "/" else namespace
    full = name.replace("{node}", node_name).replace("{ns}", base).replace("{namespace}", base)
    if full == "~" or full.startswith("~/"):
        full = f"{base}/{node_name}{full[1:]}"
    elif not full.startswith("/"):
        full = f"{base}/{full}"
    if not all(_TOKEN.fullmatch(token) for token in full[1:].split("/")):
        raise error(kind, given=name, expected=_RULE, fix="No spaces, dashes, '//' or trailing '/'.")
    return full


@dataclass
class NodeArguments:
    """What ``--ros-args`` said: ``-r from:=to`` remappings and ``-p name:=value`` parameters."""

    remappings: dict[str, str] = field(default_factory=dict)
    parameters: dict[str, Any] = field(default_factory=dict)
    node_name: str | None = None
    namespace: str | None = None

    def merged(self, other: NodeArguments) -> NodeArguments:
        """Return these arguments, with those of ``other`` taking precedence."""
        return NodeArguments(
            self.remappings | other.remappings,
            self.parameters | other.parameters,
            other.node_name or self.node_name,
            other.namespace or self.namespace,
        )


def parse_arguments(args: Sequence[str] | None) -> NodeArguments:
    """Parse the ``--ros-args`` part of a command line; everything else is ignored.

    Raises:
        InvalidNameException: a rule without ``:=``.
    """
    result, active = NodeArguments(), False
    items = iter(args or ())
    for item in items:
        if item == "--ros-args":
            active = True
        elif item == "--":
            active = False
        elif active and item in ("-r", "--remap", "-p", "--param"):
            rule = next(items, "")
            left, separator, right = rule.partition(":=")
            if not separator or not left or not right:
                raise InvalidNameException(
                    "ROS argument", given=rule, expected="from:=to", fix="Example: -r scan:=/lidar/scan"
                )
            if item in ("-p", "--param"):
                result.parameters[left] = _literal(right)
            elif left == "__node" or left == "__name":
                result.node_name = right
            elif left == "__ns":
                result.namespace = right
            else:
                result.remappings[left] = right
    return result


def _literal(text: str) -> Any:
    """Read a parameter value as YAML does for scalars and simple lists."""
    lowered = text.strip()
    if lowered.lower() in ("true", "false"):
        return lowered.lower() == "true"
    for convert in (int, float):
        try:
            return convert(lowered)
        except ValueError:
            continue
    if lowered.startswith("[") and lowered.endswith("]"):
        return [_literal(part) for part in lowered[1:-1].split(",") if part.strip()]
    return lowered.strip("'\"")
