"""Robot and brain as child processes, for the tests of this folder."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

PATIENCE_S = 60.0
"""A child that has not done by then what a test waits for never will."""


class Child:
    """A ``robotbrain`` command in a process of its own."""

    def __init__(self, folder: Path, name: str, *arguments: object, python: str = sys.executable, **variables: str):
        self.output_path = folder / f"{name}.txt"
        environment = {
            **os.environ,
            "ROBOTBRAIN_LINK_DIR": str(folder),
            "ROBOTBRAIN_ROS_BACKEND": "kit",
            "PYTHONUNBUFFERED": "1",
            **variables,
        }
        command = [python, "-m", "robotbrain.cli", *map(str, arguments)]
        with self.output_path.open("wb") as out:
            self.process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT, env=environment, cwd=folder)

    @property
    def output(self) -> str:
        return self.output_path.read_text(encoding="utf-8", errors="replace")

    def wait_for(self, text: str) -> str:
        """Wait for a line with ``text`` in the output and return it."""
        self.wait_until(lambda: text in self.output, f"says {text!r}")
        return next(line for line in self.output.splitlines() if text in line)

    def wait_until(self, condition: Callable[[], Any], what: str) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            if self.process.poll() is not None and not condition():
                raise AssertionError(f"it ended ({self.process.returncode}) before it {what}:\n{self.output}")
            if time.monotonic() > deadline:
                raise AssertionError(f"it never {what}:\n{self.output}")
            time.sleep(0.05)

    def finish(self) -> int:
        """Wait for its end and return its exit code."""
        return self.process.wait(PATIENCE_S)

    def end(self) -> int:
        """Ask it to end (SIGTERM; on Windows that kills) and return its exit code."""
        self.process.terminate()
        return self.finish()

    def kill(self) -> None:
        self.process.kill()
        self.process.wait(PATIENCE_S)


class Robot(Child):
    """``robotbrain robot`` on any free port, with its log."""

    def __init__(self, folder: Path, *arguments: object, **keywords: Any):
        self.log_path = folder / "robot.jsonl"
        self._events: list[dict[str, Any]] = []
        self._read = 0
        super().__init__(
            folder,
            "robot",
            "robot",
            "--world",
            1,
            "--difficulty",
            0.2,
            "--port",
            0,
            "--log",
            self.log_path,
            *arguments,
            **keywords,
        )

    def port(self) -> int:
        line = self.wait_for("listening on")
        return int(line.split(";")[0].rpartition(":")[2])

    def events(self, kind: str | None = None) -> list[dict[str, Any]]:
        """Return the entries of its log so far."""
        if self.log_path.exists():
            with self.log_path.open("rb") as log:
                log.seek(self._read)
                whole, end, _ = log.read().rpartition(b"\n")  # the last line may be half written
            self._read += len(whole) + len(end)
            self._events += [json.loads(line) for line in whole.splitlines()]
        return [entry for entry in self._events if kind in (None, entry["event"])]

    def speed(self) -> float:
        """Return how fast it truly is, m/s or rad/s, whichever is more."""
        self.events()
        truth = next((event for event in reversed(self._events) if event["event"] == "truth"), {"v": 0.0, "w": 0.0})
        return float(max(abs(truth["v"]), abs(truth["w"])))


def brain(folder: Path, port: int, *arguments: object, **keywords: Any) -> Child:
    """Start ``robotbrain drive --robot ros``."""
    return Child(folder, "brain", "drive", "--robot", "ros", "--address", f"127.0.0.1:{port}", *arguments, **keywords)
