"""Validation and expansion of ROS names (https://design.ros2.org/articles/topic_and_service_names.html)."""

from __future__ import annotations

import re

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
    full = name
    if "{" in name:
        full = name.replace("{node}", node_name).replace("{ns}", namespace).replace("{namespace}", namespace)
    if full == "~" or full.startswith("~/"):
        full = f"{base}/{node_name}{full[1:]}"
    elif not full.startswith("/"):
        full = f"{base}/{full}"
    if not all(_TOKEN.fullmatch(token) for token in full[1:].split("/")):
        raise error(kind, given=name, expected=_RULE, fix="No spaces, dashes, '//' or trailing '/'.")
    return full
