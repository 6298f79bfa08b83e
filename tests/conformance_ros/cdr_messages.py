"""Random messages of every type, as CDR and as plain values: written on one side, read on the other.

Runs on the kit and in a genuine environment alike: ``write FILE`` writes messages of every type of the packages,
``check FILE`` decodes those of a file and prints, as JSON, what is not what the other side says it is.
"""

from __future__ import annotations

import gzip
import importlib
import json
import random
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "ros"))

from ros_random_messages import random_message, to_plain  # type: ignore[import-not-found, unused-ignore]

PACKAGES = (
    "action_msgs", "actionlib_msgs", "builtin_interfaces", "diagnostic_msgs", "geometry_msgs", "lifecycle_msgs",
    "nav_msgs", "rcl_interfaces", "rmw_dds_common", "rosgraph_msgs", "sensor_msgs", "service_msgs", "shape_msgs",
    "std_msgs", "std_srvs", "stereo_msgs", "trajectory_msgs", "type_description_interfaces", "unique_identifier_msgs",
    "visualization_msgs",
)  # fmt: skip
ACTIONS = ("test_msgs/action/Fibonacci",)
SEEDS = 4


def _parts_of_action(name: str, cls: Any) -> Iterator[tuple[str, Any]]:
    for part in ("Goal", "Result", "Feedback"):
        yield f"{name}_{part}", getattr(cls, part)
    yield f"{name}_FeedbackMessage", cls.Impl.FeedbackMessage
    for service in ("SendGoal", "GetResult"):
        for half in ("Request", "Response"):
            yield f"{name}_{service}_{half}", getattr(getattr(cls.Impl, f"{service}Service"), half)


def classes() -> dict[str, Any]:
    """Return every message class of the packages by type name: messages, halves of services, parts of actions."""
    found: dict[str, Any] = {}
    for package in PACKAGES:
        for kind in ("msg", "srv"):
            try:
                module = importlib.import_module(f"{package}.{kind}")
            except ImportError:
                continue
            for name in getattr(module, "__all__", None) or dir(module):
                cls = getattr(module, name)
                if kind == "msg" and hasattr(cls, "get_fields_and_field_types"):
                    found[f"{package}/msg/{name}"] = cls
                elif kind == "srv" and hasattr(cls, "Request") and hasattr(cls, "Response"):
                    found[f"{package}/srv/{name}_Request"] = cls.Request
                    found[f"{package}/srv/{name}_Response"] = cls.Response
    for name in ACTIONS:
        package, kind, short = name.split("/")
        try:
            cls = getattr(importlib.import_module(f"{package}.{kind}"), short)
        except (ImportError, AttributeError):
            continue
        found.update(_parts_of_action(name, cls))
    return found


def fields(cls: Any) -> list[list[str]]:
    return [list(pair) for pair in cls.get_fields_and_field_types().items()]


def write(target: Path) -> None:
    """Write random messages of every type."""
    from rclpy.serialization import serialize_message

    rows = {}
    for name, cls in sorted(classes().items()):
        messages = [random_message(cls, random.Random(f"{name} {seed}")) for seed in range(SEEDS)] + [cls()]
        rows[name] = {
            "fields": fields(cls),
            "messages": [[to_plain(message), serialize_message(message).hex()] for message in messages],
        }
    target.write_bytes(gzip.compress(json.dumps(rows).encode(), mtime=0))


def check(source: Path) -> dict[str, Any]:
    """Decode every message of a file; return counts, and the types that differ or are missing."""
    from rclpy.serialization import deserialize_message

    rows, known = json.loads(gzip.decompress(source.read_bytes())), classes()
    other_fields, wrong, good = [], [], 0
    for name, row in rows.items():
        if name not in known:
            continue
        if fields(known[name]) != row["fields"]:
            other_fields.append(name)
            continue
        for wanted, data in row["messages"]:
            found = to_plain(deserialize_message(bytes.fromhex(data), known[name]))
            # JSON has no tuples; both sides went through it.
            if json.loads(json.dumps(found)) != wanted:
                wrong.append([name, wanted, found])
            else:
                good += 1
    return {
        "types": len(set(rows) & set(known)) - len(other_fields),
        "messages": good,
        "wrong": wrong,
        "other_fields": other_fields,
        "only_there": sorted(set(rows) - set(known)),
        "only_here": sorted(set(known) - set(rows)),
    }


if __name__ == "__main__":
    if sys.argv[1] == "write":
        write(Path(sys.argv[2]))
    else:
        print(json.dumps(check(Path(sys.argv[2]))))
