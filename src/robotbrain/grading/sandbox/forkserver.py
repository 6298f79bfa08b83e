"""The grader's side of the fork server: start it, ask it for processes, start it again if it dies.

Where there are no pidfds (macOS, Windows) each job gets a fresh Python process instead, with the same calls.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import robotbrain
from robotbrain.errors import RobotBrainError
from robotbrain.grading.sandbox.channel import Channel, ChannelError
from robotbrain.grading.sandbox.handle import Process, kill_tree
from robotbrain.grading.sandbox.spawn import share

_STARTUP_S = 120.0
_ANSWER_S = 60.0
_SOON_S = 0.2
_LARGEST_ANSWER = 1 << 20
_ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",  # sums come out the same on every machine; and a process with threads must not fork
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "ORT_DISABLE_TELEMETRY": "1",  # importing onnxruntime starts a thread otherwise
    "PYTHONHASHSEED": "0",
    "MPLBACKEND": "module://matplotlib_inline.backend_inline",
    # Forking copies page tables; memory in huge pages has few. Forks are three times as fast.
    "GLIBC_TUNABLES": "glibc.malloc.hugetlb=1",
    "PYTHONMALLOC": "malloc",
}


class ServerDied(RobotBrainError):  # noqa: N818 - what happened, not whose error
    """The fork server could not be started, or ended while it was needed."""


@dataclass(frozen=True)
class Recipe:
    """What a fork server prepares and what its children do.

    Attributes:
        entry: ``"module:function"`` that a child calls with (job, sockets).
        preload: modules imported once; one that is missing does no harm.
        prepare: ``"module:function"`` called once before the first child, or ``""``.
        arguments: keyword arguments of ``prepare``, JSON-able or bytes.
        wrapper: command that the Python command is appended to, such as bubblewrap's.
        environment: variables beyond those that every fork server has; the grader's own are not passed on.
        uid: user to become, or None.
    """

    entry: str
    preload: Sequence[str] = ()
    prepare: str = ""
    arguments: Mapping[str, Any] = field(default_factory=dict)
    wrapper: Sequence[str] = ()
    environment: Mapping[str, str] = field(default_factory=dict)
    uid: int | None = None


class ForkServer:
    """Starts processes by ``recipe``; safe to use from several threads.

    It starts on first use, and again if it died. Close it, or use it as a context manager.
    """

    def __init__(self, recipe: Recipe) -> None:
        self.recipe = recipe
        self.ready: dict[str, Any] = {}  # what the server said when it was ready
        self.starts = 0
        self._lock = threading.Lock()
        self._closed = False
        # The kernel ends a bubblewrap when the *thread* that started it ends: this one lives as long as this object.
        self._keeper: ThreadPoolExecutor | None = None
        self._popen: subprocess.Popen[bytes] | None = None
        self._channel: Channel | None = None
        self._log: IO[bytes] | None = None

    def __enter__(self) -> ForkServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def forks(self) -> bool:
        """Whether children are forked from a warm process; otherwise each is a fresh Python."""
        return can_fork()

    def warm_up(self) -> dict[str, Any]:
        """Start the server if it does not run; return what it said when it was ready."""
        with self._lock:
            if self.forks:
                self._ensure()
            return self.ready

    def ends_within(self, timeout_s: float) -> bool:
        """Whether the server has ended, or does so within ``timeout_s``."""
        popen = self._popen
        if popen is None:
            return False
        try:
            popen.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return False
        return True

    def start(self, job: Mapping[str, Any], sockets: Sequence[socket.socket]) -> Process:
        """Start a child that calls the recipe's entry with ``job`` and ``sockets``, which stay open here too.

        Raises:
            ServerDied: after a second try.
        """
        if not self.forks:
            return self._spawn(job, sockets)
        with self._lock:
            for last in (False, True):
                try:
                    return self._ask(self._ensure(), job, sockets)
                except ChannelError as error:
                    said = self._said()
                    self._stop()
                    if last:
                        raise ServerDied(f"the fork server ended: {said or error}") from None
            raise AssertionError

    def close(self) -> None:
        """End the server and all its children, for good, also while it starts; safe to call twice."""
        self._closed = True
        while not self._lock.acquire(timeout=_SOON_S):  # a server that still starts would be waited for
            starting = self._popen
            if starting is not None:
                kill_tree(starting)
        try:
            self._stop()
            if self._keeper is not None:
                self._keeper.shutdown()
                self._keeper = None
        finally:
            self._lock.release()

    def _ask(self, channel: Channel, job: Mapping[str, Any], sockets: Sequence[socket.socket]) -> Process:
        channel.send({"job": dict(job), "fds": len(sockets)}, [s.fileno() for s in sockets], _ANSWER_S)
        answer = channel.receive(_ANSWER_S)
        if answer is None:
            raise ChannelError("no answer")
        pidfd = channel.take_fd()
        return Process(_pid_here(pidfd), pidfd)

    def _ensure(self) -> Channel:
        if self._closed:
            raise ServerDied("the fork server was closed")
        if self._channel is not None and self._popen is not None and self._popen.poll() is None:
            return self._channel
        self._stop()
        if self._keeper is None:
            self._keeper = ThreadPoolExecutor(1, thread_name_prefix="fork-server")
        recipe = self.recipe
        ours, theirs = socket.socketpair()
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 - closed in _stop
        command = [*recipe.wrapper, *python_command(), "robotbrain.grading.sandbox.zygote", str(theirs.fileno())]
        with theirs:
            self._popen = self._keeper.submit(
                subprocess.Popen,
                command,
                pass_fds=[theirs.fileno()],
                env=server_environment(recipe),
                cwd="/",
                stdin=subprocess.DEVNULL,
                stdout=self._log,
                stderr=self._log,
                start_new_session=True,  # a person's Ctrl-C is for us; we end the server
            ).result()
        self._channel = Channel(ours, _LARGEST_ANSWER, accept_fds=True)
        setup = {
            "uid": recipe.uid,
            "preload": list(recipe.preload),
            "prepare": recipe.prepare,
            "arguments": dict(recipe.arguments),
            "entry": recipe.entry,
        }
        try:
            self._channel.send(setup)
            ready = self._channel.receive(_STARTUP_S)
        except ChannelError:
            ready = None
        if ready is None:
            said = self._said()
            self._stop()
            raise ServerDied(f"the fork server did not start: {said or 'no answer'}")
        self.ready, self.starts = ready, self.starts + 1
        return self._channel

    def _said(self) -> str:
        """The last lines that the server wrote to its log."""
        if self._log is None:
            return ""
        if self._popen is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._popen.wait(0.5)
        self._log.seek(0)
        return " ".join(self._log.read()[-2000:].decode(errors="replace").split())

    def _stop(self) -> None:
        if self._channel is not None:
            self._channel.close()  # the server ends when its client is gone
            self._channel = None
        if self._popen is not None:
            try:
                self._popen.wait(1.0)
            except subprocess.TimeoutExpired:
                kill_tree(self._popen)
            self._popen = None
        if self._log is not None:
            self._log.close()
            self._log = None

    def _spawn(self, job: Mapping[str, Any], sockets: Sequence[socket.socket]) -> Process:
        recipe = self.recipe
        posix = os.name == "posix"
        options: dict[str, Any] = {"pass_fds": [s.fileno() for s in sockets]} if posix else {}
        if sys.platform == "win32":
            options["creationflags"] = subprocess.CREATE_NEW_PROCESS_GROUP
        popen = subprocess.Popen(
            [*python_command(), "robotbrain.grading.sandbox.spawn"],
            env=server_environment(recipe),
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=posix,
            **options,
        )
        assert popen.stdin is not None
        setup = {
            "job": dict(job),
            "entry": recipe.entry,
            "preload": list(recipe.preload),
            "prepare": recipe.prepare,
            "arguments": dict(recipe.arguments),
            "sockets": [share(s, popen.pid) for s in sockets],
        }
        with contextlib.suppress(OSError), popen.stdin as pipe:
            pipe.write(json.dumps(setup).encode() + b"\n")
        return Process(popen.pid, None, popen)


def can_fork() -> bool:
    """Whether this platform has what the fork server is made of."""
    return sys.platform == "linux" and hasattr(os, "pidfd_open")


def python_command() -> list[str]:
    """How to run a module of this package in this Python, with nothing from the working directory."""
    return [sys.executable, "-P", "-m"]


def server_environment(recipe: Recipe) -> dict[str, str]:
    """All variables of a fork server; nothing of the grader's own goes to student code."""
    path = os.pathsep.join((str(Path(sys.executable).parent), *(("/usr/local/bin", "/usr/bin", "/bin"))))
    environment = {"PATH": path, "LANG": "C.UTF-8", "TMPDIR": tempfile.gettempdir()}
    if sys.platform == "win32":
        needed = {"SYSTEMROOT", "SYSTEMDRIVE", "TEMP", "PATH", "USERPROFILE"}  # the last one: Path.home()
        environment |= {k: v for k, v in os.environ.items() if k.upper() in needed}
    if not _installed():
        environment["PYTHONPATH"] = str(Path(robotbrain.__file__).parents[1])
    return environment | _ENVIRONMENT | dict(recipe.environment)


def _installed() -> bool:
    """Whether a fresh Python finds this package by itself."""
    parent = str(Path(robotbrain.__file__).parents[1])
    named = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    return parent in sys.path and parent not in named


def _pid_here(pidfd: int) -> int:
    for line in Path(f"/proc/self/fdinfo/{pidfd}").read_text(encoding="utf-8").splitlines():
        if line.startswith("Pid:"):
            return int(line.split()[1])
    raise ChannelError("not a process")
