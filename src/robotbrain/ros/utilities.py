"""Small helpers (``rclpy.utilities``)."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from robotbrain.ros import arguments
from robotbrain.ros.api import get_default_context, ok, shutdown, try_shutdown

__all__ = [
    "get_available_rmw_implementations",
    "get_default_context",
    "get_rmw_implementation_identifier",
    "ok",
    "remove_ros_args",
    "shutdown",
    "timeout_sec_to_nsec",
    "try_shutdown",
]


def get_rmw_implementation_identifier() -> str:
    """Return the name of the middleware: the kit's is the simulation itself."""
    return "rmw_robotbrain_simulation"


def get_available_rmw_implementations() -> set[str]:
    """Return the names of all middlewares there are."""
    return {get_rmw_implementation_identifier()}


def remove_ros_args(args: Sequence[str] | None = None) -> list[str]:
    """Return the arguments (of the command line when omitted) without those between ``--ros-args`` and ``--``."""
    return arguments.remove_ros_args(sys.argv if args is None else args)


def timeout_sec_to_nsec(timeout_sec: float | None) -> int:
    """Return a time limit in ns; -1 for none."""
    return -1 if timeout_sec is None or timeout_sec < 0 else int(float(timeout_sec) * 1_000_000_000)
