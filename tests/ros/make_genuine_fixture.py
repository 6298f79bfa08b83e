"""Writes ``data/genuine_kilted.json.gz``: what genuine rclpy does with every message type, as an oracle.

Not run by the tests. In a virtual environment of its own (Linux x86-64, Python 3.11 or later)::

    pip install ros-kilted-rclpy ros-kilted-rmw-fastrtps-cpp ros-kilted-common-interfaces ros-kilted-test-msgs
    python tests/ros/make_genuine_fixture.py
"""

from __future__ import annotations

import gzip
import importlib
import json
import random
from pathlib import Path

from ros_random_messages import random_message, to_plain

TARGET = Path(__file__).parent / "data" / "genuine_kilted.json.gz"
PACKAGES = (
    "action_msgs",
    "actionlib_msgs",
    "builtin_interfaces",
    "diagnostic_msgs",
    "geometry_msgs",
    "lifecycle_msgs",
    "nav_msgs",
    "rcl_interfaces",
    "rmw_dds_common",
    "rosgraph_msgs",
    "sensor_msgs",
    "service_msgs",
    "shape_msgs",
    "std_msgs",
    "std_srvs",
    "stereo_msgs",
    "trajectory_msgs",
    "type_description_interfaces",
    "unique_identifier_msgs",
    "visualization_msgs",
)
ACTIONS = ("test_msgs/action/Fibonacci",)


def action_classes(typename: str) -> dict[str, type]:
    package, kind, name = typename.split("/")
    action = getattr(importlib.import_module(f"{package}.{kind}"), name)
    impl = action.Impl
    return {
        f"{typename}_Goal": action.Goal,
        f"{typename}_Result": action.Result,
        f"{typename}_Feedback": action.Feedback,
        f"{typename}_SendGoal_Request": impl.SendGoalService.Request,
        f"{typename}_SendGoal_Response": impl.SendGoalService.Response,
        f"{typename}_GetResult_Request": impl.GetResultService.Request,
        f"{typename}_GetResult_Response": impl.GetResultService.Response,
        f"{typename}_FeedbackMessage": impl.FeedbackMessage,
    }


def classes() -> dict[str, type]:
    found = {}
    for action in ACTIONS:
        found |= action_classes(action)
    for package in PACKAGES:
        for kind in ("msg", "srv"):
            try:
                module = importlib.import_module(f"{package}.{kind}")
            except ImportError:
                continue
            for name, cls in vars(module).items():
                if kind == "msg" and hasattr(cls, "get_fields_and_field_types"):
                    found[f"{package}/msg/{name}"] = cls
                elif kind == "srv" and hasattr(cls, "Request") and hasattr(cls, "Response"):
                    found[f"{package}/srv/{name}_Request"] = cls.Request
                    found[f"{package}/srv/{name}_Response"] = cls.Response
    return found


def constants(cls: type) -> dict[str, object]:
    """The metaclass of a generated class holds its constants, and its field defaults under another name."""
    namespace = type(cls).__prepare__("", ())
    return {name: to_plain(value) for name, value in namespace.items() if not name.endswith("__DEFAULT")}


def main() -> None:
    from rclpy.serialization import serialize_message

    oracle = {}
    for typename, cls in sorted(classes().items()):
        message = random_message(cls, random.Random(typename))
        oracle[typename] = {
            "fields": list(cls.get_fields_and_field_types().items()),
            "constants": constants(cls),
            "default": to_plain(cls()),
            "default_repr": repr(cls()),
            "filled": to_plain(message),
            "filled_repr": repr(message),
            "cdr": serialize_message(message).hex(),
            "default_cdr": serialize_message(cls()).hex(),
        }
    TARGET.parent.mkdir(exist_ok=True)
    TARGET.write_bytes(gzip.compress(json.dumps(oracle).encode(), mtime=0))
    print(f"{len(oracle)} types, {TARGET.stat().st_size} bytes")


if __name__ == "__main__":
    main()
