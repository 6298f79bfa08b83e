"""The rest of the brain on genuine rclpy: all roles but the planner. ``brain_process.py TIME_LIMIT DECISIONS``."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import robotbrain.ros  # noqa: F401 - before rclpy
from robotbrain.pipeline.remote import RemoteOptions, drive_remote

from rclpy.node import Node  # isort: skip


class NoPlanner(Node):  # type: ignore[misc, unused-ignore]
    """Stands where the planner would: offers nothing, so that the service comes from the other process."""

    def __init__(self) -> None:
        super().__init__("planner_is_elsewhere")


def main() -> None:
    options = RemoteOptions(transport="rclpy", time_limit=float(sys.argv[1]), decisions=Path(sys.argv[2]))
    result = drive_remote(options, parts={"planner": NoPlanner}, say=lambda text: print(text, flush=True))
    print(json.dumps({"reached": result.reached, "reason": result.reason, "seconds": result.seconds}), flush=True)


if __name__ == "__main__":
    main()
