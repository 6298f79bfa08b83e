"""Tries things that may take the interpreter down or hang, one after the other, in a process of its own."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import IO, Any


@dataclass(frozen=True)
class Outcome:
    """What became of one trial.

    Attributes:
        state: ``done``, ``raised``, ``died`` (it took the process with it), ``hung`` or ``unable`` (no process).
        message: the error, in one line.
        data: what the trial returned.
    """

    state: str
    message: str = ""
    data: dict[str, Any] = field(default_factory=dict)

    @property
    def fine(self) -> bool:
        """Whether it worked."""
        return self.state == "done"


def try_out(trials: Sequence[str], limit_s: float) -> dict[str, Outcome]:
    """Make the ``trials`` of :mod:`robotbrain.doctor.trials`, each within ``limit_s``; return the outcome of each.

    One process makes them all, as starting Python is the dear part. If a trial kills it or hangs, another process goes
    on with the rest.
    """
    outcomes: dict[str, Outcome] = {}
    while left := [trial for trial in trials if trial not in outcomes]:
        before = len(outcomes)
        with tempfile.TemporaryFile() as errors:
            _one_process(left, limit_s, errors, outcomes)
        if len(outcomes) == before:  # it ended without a word on its first trial
            outcomes[left[0]] = Outcome("unable", "the process ended before it began")
    return outcomes


def _one_process(trials: Sequence[str], limit_s: float, errors: IO[bytes], outcomes: dict[str, Outcome]) -> None:
    """Let one process make ``trials`` as far as it gets."""
    # Without -P a file of the user's folder could stand in for a module; that is for another probe to find.
    safe = ["-P"] if sys.version_info >= (3, 11) else []
    command = [sys.executable, *safe, "-m", "robotbrain.doctor.trials", *trials]
    environment = {**os.environ, "PYTHONFAULTHANDLER": "0", "PYTHONIOENCODING": "utf-8", "MPLBACKEND": "Agg"}
    try:
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=errors, env=environment
        )
    except OSError as error:
        outcomes.update(dict.fromkeys(trials, Outcome("unable", f"Python cannot be started: {error}")))
        return
    lines: queue.Queue[bytes] = queue.Queue()
    reader = threading.Thread(target=_read, args=(process.stdout, lines), daemon=True)
    reader.start()
    current = trials[0]
    try:
        while True:
            try:
                line = lines.get(timeout=limit_s)
            except queue.Empty:
                outcomes[current] = Outcome("hung", f"no answer within {limit_s:g} s")
                return
            if not line:
                break
            with contextlib.suppress(ValueError):  # a line that is not ours
                said = json.loads(line)
                current = said["trial"]
                if said["state"] != "begun":
                    outcomes[current] = Outcome(said["state"], said.get("message", ""), said.get("data", {}))
        code = process.wait(limit_s)
        if current not in outcomes:
            outcomes[current] = Outcome("died", _how(code, errors))
    finally:
        process.kill()
        process.wait()
        if process.stdout is not None:
            reader.join(1.0)
            if not reader.is_alive():
                process.stdout.close()


def _read(stream: IO[bytes] | None, lines: queue.Queue[bytes]) -> None:
    with contextlib.suppress(ValueError, OSError):
        for line in stream or ():
            lines.put(line)
    lines.put(b"")


def _how(code: int, errors: IO[bytes]) -> str:
    """How a process ended, in words, with the last thing it said."""
    words = f"it ended the process with exit code {code}"
    if code < 0:
        try:
            words = f"the system killed the process ({signal.Signals(-code).name})"
        except ValueError:
            words = f"the system killed the process (signal {-code})"
    elif code in _WINDOWS_CODES:
        words = f"the system killed the process ({_WINDOWS_CODES[code]})"
    errors.seek(0)
    said = [line for line in errors.read().decode("utf-8", "replace").splitlines() if line.strip()]
    return f"{words}; its last line: {said[-1].strip()}" if said else words


_WINDOWS_CODES = {0xC0000005: "access violation", 0xC000001D: "illegal instruction", 0xC0000135: "a DLL is missing"}
