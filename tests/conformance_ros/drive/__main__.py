"""Runs the proof and reports the decisions. ``python -m tests.conformance_ros.drive [--world 7]``."""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import robotbrain
from tests.conformance_ros.backends import DISTROS, cache_folder, genuine
from tests.conformance_ros.drive.extract import planner_source
from tests.conformance_ros.drive.replay import replay

FOLDER = Path(__file__).parent
NEEDS = ("mujoco-core>=4.0.1", "onnxruntime>=1.23", "psutil>=6.0", "rosbags>=0.11", "scipy>=1.14")
"""What robot and brain need beside rclpy; the kit itself is found by its path, never installed there."""


class Processes:
    """The processes of one run, each with a file for what it prints."""

    def __init__(self, python: Path, environment: dict[str, str], folder: Path) -> None:
        self._python, self._environment, self.folder = python, environment, folder
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, name: str, *arguments: str) -> subprocess.Popen[bytes]:
        """Start ``<name>_process.py``."""
        command = [str(self._python), str(FOLDER / f"{name}_process.py"), *arguments]
        with (self.folder / f"{name}.txt").open("wb") as output:
            process = subprocess.Popen(
                command, env=self._environment, cwd=self.folder, stdout=output, stderr=subprocess.STDOUT
            )
        self._running[name] = process
        return process

    def printed(self, name: str) -> str:
        """Return what a process has printed."""
        return (self.folder / f"{name}.txt").read_text(encoding="utf-8", errors="replace")

    def close(self) -> None:
        """End all that still run: asked first, then forced."""
        for process in self._running.values():
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
        deadline = time.monotonic() + 5.0
        for process in self._running.values():
            try:
                process.wait(max(0.1, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def prove(world: int, distro: str, cache: Path, time_limit: float) -> dict[str, Any]:
    """Drive once; return the figures of the decision log."""
    backend = genuine(distro, cache, NEEDS)
    source = Path(robotbrain.__file__).parents[1]
    environment = {**backend.environment(domain=1 + os.getpid() % 90), "PYTHONPATH": str(source)}
    for name in ("ROBOTBRAIN_ROS_BACKEND", "ROS_PYTHON_CHECK_FIELDS"):  # as a robot has it
        del environment[name]
    with tempfile.TemporaryDirectory(prefix="conformance-drive-") as name:
        folder = Path(name)
        environment["ROS_LOG_DIR"] = name
        planner, plans, decisions = folder / "my_planner.py", folder / "plans.jsonl", folder / "decisions.jsonl"
        planner.write_text(planner_source(), encoding="utf-8")
        processes = Processes(backend.python, environment, folder)
        try:
            processes.start("planner", str(planner), str(plans))
            processes.start("robot", str(world), str(folder / "robot.jsonl"))
            brain = processes.start("brain", str(time_limit), str(decisions))
            brain.wait(timeout=time_limit + 120)
        finally:
            processes.close()
        printed = processes.printed("brain")
        if brain.returncode != 0:
            raise RuntimeError(
                "\n".join(f"--- {n}\n{processes.printed(n)[-2000:]}" for n in ("planner", "robot", "brain"))
            )
        counts = Counter(json.loads(line)["topic"] for line in decisions.read_text(encoding="utf-8").splitlines())
        return {
            "distro": distro,
            "world": world,
            "brain": json.loads(printed.strip().splitlines()[-1]),
            "robot": processes.printed("robot").strip().splitlines()[-1],
            "planner process": processes.printed("planner").strip().splitlines()[0],
            "decisions": dict(sorted(counts.items())),
            "replayed on the kit": replay(planner, plans),
        }


def main() -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.conformance_ros.drive", description=__doc__)
    parser.add_argument("--world", type=int, default=7)
    parser.add_argument("--distro", default="kilted", choices=DISTROS)
    parser.add_argument("--time-limit", type=float, default=120.0, help="wall-clock seconds")
    parser.add_argument("--cache", type=Path, help="folder of the virtual environments")
    parser.add_argument("--output", type=Path, help="JSON results; default: drive.json in the cache folder")
    arguments = parser.parse_args()
    cache = cache_folder(arguments.cache)
    result = prove(arguments.world, arguments.distro, cache, arguments.time_limit)
    text = json.dumps(result, indent=1)
    print(text)
    (arguments.output or cache / "drive.json").write_text(text + "\n", encoding="utf-8")
    again = result["replayed on the kit"]
    return 0 if result["brain"]["reached"] and again["plans"] and again["equal"] == again["plans"] else 1


if __name__ == "__main__":
    sys.exit(main())
