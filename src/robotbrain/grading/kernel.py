"""One Jupyter kernel that can be interrupted, killed with everything it started, and started again."""

from __future__ import annotations

import contextlib
import enum
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from queue import Empty
from typing import Any

import psutil
from jupyter_client.manager import KernelManager

from robotbrain.errors import RobotBrainError

_POLL_S = 0.25  # how soon a dead kernel is noticed; messages themselves wake the loop at once
_LONGEST_FOLDER = 90  # characters: the path of a Unix socket holds 103 on macOS; beyond, the kernel listens on loopback
_GONE_S = 5.0  # how long killed processes may take to disappear


class KernelStartError(RobotBrainError):
    """The machine did not start a kernel; the submission has not run."""


class CellEnd(enum.Enum):
    """How the execution of a cell ended."""

    DONE = "done"  # with or without an exception of its own
    INTERRUPTED = "interrupted"  # past its time, and the interrupt stopped it
    HUNG = "hung"  # past its time, and the interrupt did not stop it
    DIED = "died"  # the kernel process ended


@dataclass(frozen=True)
class CellLimits:
    """Limits of one cell: time to run (s), then time to react to the interrupt (s)."""

    timeout_s: float
    grace_s: float


class Kernel:
    """A Python kernel in a process of its own.

    Args:
        cwd: its working directory.
        env: its whole environment.
        startup_s: how long it may take to answer first (s).
    """

    def __init__(self, cwd: Path, env: Mapping[str, str], startup_s: float = 90.0) -> None:
        self._sockets = Path(tempfile.mkdtemp(prefix="rb-"))
        self._home = self._sockets / "ipython"  # so that nobody's startup files run
        self._manager = KernelManager(kernel_name="python3")
        # The interpreter that grades is the one that runs the notebook, whatever kernels are installed.
        spec = self._manager.kernel_spec
        assert spec is not None  # ipykernel, which provides it, is a dependency of nbgrader
        spec.argv[0] = sys.executable
        if os.name == "posix" and len(str(self._sockets)) <= _LONGEST_FOLDER:
            self._manager.transport, self._manager.ip = "ipc", str(self._sockets / "k")
        try:
            self._manager.start_kernel(
                cwd=str(cwd),
                env={**env, "IPYTHONDIR": str(self._home)},
                extra_arguments=["--HistoryManager.hist_file=:memory:"],
                stdout=subprocess.DEVNULL,  # what is written past the kernel must not reach the grader's terminal
                stderr=subprocess.DEVNULL,
            )
            self._client = self._manager.client()
            self._client.start_channels()
            self._client.wait_for_ready(timeout=startup_s)
        except BaseException as error:
            self.kill()
            if isinstance(error, Exception):
                raise KernelStartError(f"no kernel could be started: {error}") from error
            raise
        self._client.allow_stdin = False

    def run(self, source: str, limits: CellLimits, on_message: Callable[[dict[str, Any]], None]) -> CellEnd:
        """Run one cell, handing each of its output messages to ``on_message``, until it ends one way or another."""
        request = self._client.execute(source, store_history=True, allow_stdin=False, stop_on_error=False)
        deadline = time.monotonic() + limits.timeout_s
        interrupted = False
        replied: float | None = None
        while True:
            with contextlib.suppress(Empty):
                message = self._client.get_iopub_msg(timeout=_POLL_S)
                if message["parent_header"].get("msg_id") == request:
                    if message["msg_type"] != "status":
                        on_message(message)
                    elif message["content"]["execution_state"] == "idle":
                        return CellEnd.INTERRUPTED if interrupted else CellEnd.DONE
                if time.monotonic() < deadline:
                    continue
            now = time.monotonic()
            if not self.alive():
                return CellEnd.DIED
            if replied is None and self._replied(request):
                replied = now
            if replied is not None and now > replied + 2.0:  # the idle message was lost in a flood of output
                return CellEnd.INTERRUPTED if interrupted else CellEnd.DONE
            if now >= deadline and replied is None:
                if interrupted:
                    return CellEnd.HUNG
                self._manager.interrupt_kernel()
                interrupted, deadline = True, now + limits.grace_s

    def alive(self) -> bool:
        """Whether the kernel process still runs."""
        return bool(self._manager.is_alive())

    def kill(self) -> None:
        """End the kernel and every process below it, at once; safe to call twice."""
        process = getattr(self._manager.provisioner, "process", None)
        if process is not None:
            kill_tree(process.pid)
        if getattr(self, "_client", None) is not None:
            self._client.stop_channels()
        with contextlib.suppress(Exception):  # already gone
            self._manager.shutdown_kernel(now=True)
        with contextlib.suppress(Exception):
            self._manager.cleanup_resources()
        shutil.rmtree(self._sockets, ignore_errors=True)

    def _replied(self, request: str) -> bool:
        with contextlib.suppress(Empty):
            while True:
                if self._client.get_shell_msg(timeout=0)["parent_header"].get("msg_id") == request:
                    return True
        return False


def kill_tree(pid: int) -> None:
    """Kill process ``pid``, its process group where it leads one, and all its descendants."""
    try:
        root = psutil.Process(pid)
        victims = [*root.children(recursive=True), root]
    except psutil.NoSuchProcess:
        victims = []
    if os.name == "posix":
        with contextlib.suppress(ProcessLookupError, PermissionError):
            if os.getpgid(pid) == pid:
                os.killpg(pid, signal.SIGKILL)
    for victim in victims:
        with contextlib.suppress(psutil.NoSuchProcess, psutil.AccessDenied):
            victim.kill()
    psutil.wait_procs([v for v in victims if v.pid != pid], timeout=_GONE_S)  # the caller waits for its own child


def kill_marked(variable: str, value: str) -> int:
    """Kill every process of this user whose environment has ``variable=value``; return how many there were.

    Finds what a submission left behind after its parents ended. The marker is unique to one grading job.
    """
    killed = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.NoSuchProcess, psutil.AccessDenied, psutil.ZombieProcess, OSError):
            if process.pid != os.getpid() and process.environ().get(variable) == value:
                process.kill()
                killed.append(process)
    psutil.wait_procs(killed, timeout=_GONE_S)  # until they are gone they may still write
    return len(killed)
