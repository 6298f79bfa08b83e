"""A process of its own for a planner file: spins ``MyPlanner`` and records what it was asked and what it answered.

``planner_process.py FILE LOG`` on genuine rclpy. The file is imported as it is; the recording looks on from outside.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import robotbrain.ros  # makes rclpy the kit's where there is no genuine one

import rclpy  # isort: skip
from rclpy.executors import ExternalShutdownException
from rclpy.serialization import serialize_message


def load(file: Path) -> Any:
    """Return the class ``MyPlanner`` of a file."""
    spec = importlib.util.spec_from_file_location("my_planner", file)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.MyPlanner


def recorded(planner: Any, log: Path) -> Any:
    """Return the planner class with its callbacks watched."""

    class Recorded(planner):  # type: ignore[misc]
        def on_map(self, msg: Any) -> None:
            write("map", map=serialize_message(msg).hex())
            super().on_map(msg)

        def plan(self, request: Any, response: Any) -> Any:
            asked = serialize_message(request).hex()
            answer = super().plan(request, response)
            write("plan", request=asked, response=serialize_message(answer).hex())
            return answer

    def write(event: str, **fields: str) -> None:
        with log.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"event": event, **fields}) + "\n")

    return Recorded


def main() -> None:
    rclpy.init()
    genuine = robotbrain.ros.BACKEND == "rclpy"
    print("genuine rclpy " + metadata.version("rclpy") if genuine else "the kit", flush=True)
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(recorded(load(Path(sys.argv[1])), Path(sys.argv[2]))())


if __name__ == "__main__":
    main()
