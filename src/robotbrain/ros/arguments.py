"""What stands behind ``--ros-args``: remappings, parameters, parameter files and log levels.

Rules of https://design.ros2.org/articles/ros_command_line_arguments.html: ``-r from:=to``, ``-r node:from:=to``,
``-r __node:=name``, ``-r __ns:=/namespace``, ``-p name:=value``, ``-p node:name:=value``, ``--params-file FILE`` and
``--log-level [logger:=]level``.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from robotbrain.errors import InputError
from robotbrain.ros.exceptions import InvalidNameException
from robotbrain.ros.names import expand
from robotbrain.ros.parameter_files import parse_value, read_parameter_file

ANY_NODE = "/**"
"""Pattern of every node."""


@dataclass
class NodeArguments:
    """Rules in the order given; each holds for the nodes that its pattern matches.

    Attributes:
        remappings: (node name or ``""``, from, to); the first that matches counts.
        parameters: (pattern of full node names, parameter, value); the last that matches counts.
        log_levels: (logger or ``""``, level).
    """

    remappings: list[tuple[str, str, str]] = field(default_factory=list)
    parameters: list[tuple[str, str, Any]] = field(default_factory=list)
    log_levels: list[tuple[str, str]] = field(default_factory=list)

    def merged(self, own: NodeArguments) -> NodeArguments:
        """Return these arguments with those of one node, which take precedence."""
        return NodeArguments(
            own.remappings + self.remappings, self.parameters + own.parameters, self.log_levels + own.log_levels
        )

    def special(self, key: tuple[str, ...], node_name: str) -> str | None:
        """Return the target of a rule such as ``__ns:=`` for a node, or None."""
        return next((to for node, left, to in self.remappings if left in key and node in ("", node_name)), None)

    def names_of(self, node_name: str, namespace: str) -> dict[str, str]:
        """Return the remapped topic and service names of a node, absolute."""
        result: dict[str, str] = {}
        for node, left, right in self.remappings:
            if node in ("", node_name) and not left.startswith("__"):
                full = expand(left, node_name, namespace)
                result.setdefault(full, expand(right, node_name, namespace))
        return result

    def parameters_of(self, full_name: str) -> dict[str, Any]:
        """Return the parameters given to a node."""
        return {name: value for pattern, name, value in self.parameters if matches(pattern, full_name)}


def matches(pattern: str, full_name: str) -> bool:
    """Tell whether a node's full name matches: ``*`` is one token, ``**`` any number of tokens."""
    expression = re.escape(pattern).replace(r"/\*\*", "(?:/[^/]+)*").replace(r"\*", "[^/]+")
    return re.fullmatch(expression, full_name) is not None


def node_pattern(name: str) -> str:
    """Return the pattern of a node name as given in ``-p name:parameter:=value`` or in a file."""
    return name if name.startswith("/") else f"{ANY_NODE}/{name}"


def parse_arguments(args: Sequence[str] | None) -> NodeArguments:
    """Parse the ``--ros-args`` part of a command line; everything else is ignored.

    Raises:
        InvalidNameException: a rule without ``:=``.
        InputError: a parameter file that is missing or not one.
    """
    result, active = NodeArguments(), False
    items = iter(args or ())
    for item in items:
        if item == "--ros-args":
            active = True
        elif item == "--":
            active = False
        elif not active:
            continue
        elif item in ("-r", "--remap"):
            left, right = _rule(next(items, ""), "-r scan:=/lidar/scan")
            node, _, name = left.rpartition(":")
            result.remappings.append((node, name, right))
        elif item in ("-p", "--param"):
            left, right = _rule(next(items, ""), "-p rate:=10")
            node, _, name = left.rpartition(":")
            result.parameters.append((node_pattern(node) if node else ANY_NODE, name, parse_value(right)))
        elif item == "--params-file":
            for node, name, value in read_parameter_file(Path(next(items, ""))):
                result.parameters.append((node_pattern(node), name, value))
        elif item == "--log-level":
            logger, _, level = next(items, "").rpartition(":=")
            result.log_levels.append((logger, level))
    return result


def remove_ros_args(args: Sequence[str]) -> list[str]:
    """Return the arguments that are not ROS's, in order."""
    kept, active = [], False
    for item in args:
        if item == "--ros-args":
            active = True
        elif active and item == "--":
            active = False
        elif not active:
            kept.append(item)
    return kept


def _rule(text: str, example: str) -> tuple[str, str]:
    left, separator, right = text.partition(":=")
    if not separator or not left or not right:
        raise InvalidNameException("ROS argument", given=text, expected="from:=to", fix=f"Example: {example}")
    if left.endswith(":"):
        raise InputError("ROS argument", given=text, expected="node:from:=to", fix=f"Example: {example}")
    return left, right
