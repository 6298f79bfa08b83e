"""A literal subset of rclpy in deterministic simulated time.

Importing this package makes ``import rclpy``, ``from geometry_msgs.msg import Twist``, ``from nav_msgs.srv
import GetPlan`` … resolve to the kit when genuine rclpy is absent; when it is installed the kit steps aside
and :data:`BACKEND` is ``"rclpy"``. Set the environment variable ``ROBOTBRAIN_ROS_BACKEND=kit`` to simulate on
a machine that has ROS 2.

The simulation itself is :class:`SimContext`; :func:`charge` and :func:`charge_work` add to the cost of the running
callback, ``await`` of :func:`sleep` lets time pass in an ``async def`` one, and :class:`DeviceResources` are what
callbacks share.
"""

from __future__ import annotations

import os

from robotbrain.ros.api import charge, charge_work
from robotbrain.ros.asynchronous import sleep
from robotbrain.ros.context import CallbackRecord, CostModel, MessageRecord, SimContext
from robotbrain.ros.exceptions import CallbackError, ReentrancyError, SimulationDeadlockError
from robotbrain.ros.resources import DeviceResources
from robotbrain.ros.shim import install as _install
from robotbrain.ros.shim import uninstall as _uninstall

__all__ = [
    "BACKEND",
    "CallbackError",
    "CallbackRecord",
    "CostModel",
    "DeviceResources",
    "MessageRecord",
    "ReentrancyError",
    "SimContext",
    "SimulationDeadlockError",
    "charge",
    "charge_work",
    "install",
    "sleep",
    "uninstall",
]

BACKEND: str
"""Where ``rclpy`` comes from: ``"kit"`` or ``"rclpy"``; ``""`` after :func:`uninstall`."""


def install(*, force: bool = False) -> str:
    """Make the imports resolve as described above; return and set :data:`BACKEND`.

    Args:
        force: use the kit although genuine rclpy is installed.
    """
    global BACKEND
    BACKEND = _install(force=force)
    return BACKEND


def uninstall() -> None:
    """Undo :func:`install` (for tests)."""
    global BACKEND
    _uninstall()
    BACKEND = ""


install(force=os.environ.get("ROBOTBRAIN_ROS_BACKEND") == "kit")
