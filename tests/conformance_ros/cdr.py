"""CDR both ways between the kit and genuine rclpy, for every message type; see :mod:`cdr_messages`."""

from __future__ import annotations

import json
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from tests.conformance_ros.backends import HERE, Backend

SCRIPT = HERE / "cdr_messages.py"


def _run(backend: Backend, *arguments: str) -> str:
    done = subprocess.run(
        backend.command(SCRIPT, *arguments),
        env=backend.environment(domain=0),
        cwd=HERE,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    if done.returncode != 0:
        raise RuntimeError(f"{SCRIPT.name} on {backend.name}:\n{done.stderr[-3000:]}")
    return done.stdout


def exchange(kit: Backend, genuine: Backend) -> dict[str, Any]:
    """Let each side read what the other wrote; return the answers of both, by direction."""
    answers = {}
    with tempfile.TemporaryDirectory(prefix="conformance-cdr-") as folder:
        for writer, reader in ((genuine, kit), (kit, genuine)):
            file = Path(folder) / f"{writer.name}.json.gz"
            _run(writer, "write", str(file))
            answers[f"{writer.name} to {reader.name}"] = json.loads(_run(reader, "check", str(file)))
    return answers


def problems_of(answers: dict[str, Any]) -> list[str]:
    """Return what is wrong with an exchange; empty when all messages came out equal and no type is missing."""
    found = []
    for direction, answer in answers.items():
        for key in ("wrong", "other_fields", "only_there", "only_here"):
            if answer[key]:
                found.append(f"CDR {direction}: {key}: {str(answer[key])[:500]}")
        if not answer["messages"]:
            found.append(f"CDR {direction}: nothing was compared")
    return found
