"""The simulated robot on genuine rclpy. ``robot_process.py WORLD LOG``."""

from __future__ import annotations

import signal
import sys
from pathlib import Path

import robotbrain.ros  # noqa: F401 - before rclpy
from robotbrain.link.robot import RobotOptions, run_robot


def interrupt(*_: object) -> None:
    raise KeyboardInterrupt


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, interrupt)
    run_robot(
        RobotOptions(world=int(sys.argv[1]), transport="rclpy", log=Path(sys.argv[2])),
        lambda text: print(text, flush=True),
    )
