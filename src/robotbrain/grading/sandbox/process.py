"""The grader's handle on one student's process: run cells, take snapshots, interrupt, kill.

Nothing that comes from the other side is trusted: messages have a size limit, their form is checked field by field,
and what breaks a rule counts as a death of the process.
"""

from __future__ import annotations

import contextlib
import dataclasses
import enum
import json
import os
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robotbrain.grading.sandbox import monitor
from robotbrain.grading.sandbox.cgroups import Bounds, Cgroups, Group
from robotbrain.grading.sandbox.channel import Channel, ChannelClosed, ChannelError, readable
from robotbrain.grading.sandbox.forkserver import ForkServer
from robotbrain.grading.sandbox.handle import Process
from robotbrain.grading.sandbox.snapshots import Served, Snapshot

_READY_S = 60.0
_ANSWER_S = 10.0
_GONE_S = 5.0
_SOON_S = 0.2
_SLACK_BYTES = 64 << 10
_FORKED = "forked"

OnMessage = Callable[[dict[str, Any]], None]


class CellEnd(enum.Enum):
    """How the execution of a cell ended."""

    DONE = "done"  # with or without an exception: the outputs tell
    INTERRUPTED = "interrupted"  # it ran too long and then reacted to the interrupt
    DIED = "died"
    HUNG = "hung"  # it did not react to the interrupt


class StartError(Exception):
    """The student's process did not come up; no fault of the submission."""


@dataclass(frozen=True)
class CellLimits:
    """How long one cell may run, and how long it may take to react to the interrupt (s)."""

    timeout_s: float
    grace_s: float


@dataclass(frozen=True)
class Room:
    """What one submission may use beyond time.

    Attributes:
        memory_bytes: by all its processes together.
        disk_bytes: on its private file system.
        files: on its private file system.
        processes: and threads.
    """

    memory_bytes: int = 2 << 30
    disk_bytes: int = 256 << 20
    files: int = 4096
    processes: int = 128


class StudentProcess:
    """A fresh student's process; use it as a context manager, so that nothing of it is left.

    Args:
        server: where it comes from.
        environment: all variables that the student's code may see.
        folder: its working directory where it cannot have a private one.
        room: what it may use.
        output_bytes: kept of one cell.
        cpu_s: processor time that each of its processes may use (s).
        cgroups: makes the group it is put in.

    Raises:
        StartError, ServerDied: it did not come up.
    """

    def __init__(
        self,
        server: ForkServer,
        *,
        environment: Mapping[str, str],
        folder: str,
        room: Room,
        output_bytes: int,
        cpu_s: float,
        cgroups: Cgroups,
    ) -> None:
        self._cgroups = cgroups
        self._alone = not server.forks  # no monitor, no copies, and descriptors cannot be sent later
        self._copies = server.forks
        self._own_rpc: socket.socket | None = None
        self._group: Group | None = None
        ours, theirs = socket.socketpair()
        self._line, their_line = socket.socketpair()
        self._channel = Channel(ours, 2 * output_bytes + _SLACK_BYTES)
        self.exit_code: int | None = None
        self._broke_rules = False
        self._served: Served | None = None
        self._afterwards: list[Callable[[], object]] = []
        self._facts = b""
        self._process: Process | None = None
        job = {
            "environment": dict(environment),
            "folder": folder,
            "bounds": {**dataclasses.asdict(room), "cpu_s": cpu_s},
            "output_bytes": output_bytes,
        }
        try:
            with theirs, their_line:
                self._start(server, job, [theirs, their_line])
            self._contain(Bounds(room.memory_bytes, room.processes))
            self.layers = self._let_go()
        except (ChannelError, OSError) as error:
            self.close()
            raise StartError(f"the student's process did not come up: {error}") from None
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> StudentProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def put_file(self, name: str, data: bytes) -> None:
        """Put a file into the working directory."""
        with contextlib.suppress(ChannelClosed):
            self._channel.send({"op": "file", "name": name, "data": data}, timeout_s=_ANSWER_S)

    def run(self, source: str, number: int, limits: CellLimits, on_message: OnMessage) -> CellEnd:
        """Run one cell, handing each of its outputs to ``on_message``, until it ends one way or another."""
        try:
            self._channel.send({"op": "run", "source": source, "number": number}, timeout_s=_ANSWER_S)
            deadline = time.monotonic() + limits.timeout_s
            interrupted = False
            while True:
                message = self._channel.receive(max(0.0, deadline - time.monotonic()))
                if message is None or (time.monotonic() >= deadline and message.get("op") != "done"):
                    if interrupted:
                        return CellEnd.HUNG
                    self.interrupt()
                    interrupted, deadline = True, time.monotonic() + limits.grace_s
                    continue
                operation = message.get("op")
                if operation == "done":
                    return CellEnd.INTERRUPTED if interrupted else CellEnd.DONE
                on_message(message)
        except ChannelClosed:
            return CellEnd.DIED
        except ChannelError:
            self._broke_rules = True
            return CellEnd.DIED

    def snapshot(self) -> Snapshot | None:
        """Fork the process; None if it has threads, which a fork would not copy, or is gone."""
        if not self._copies or self._threads() != 1:
            return None
        ours, theirs = socket.socketpair()
        try:
            with theirs:
                self._channel.send({"op": "snapshot"}, [theirs.fileno()], _ANSWER_S)
            message = self._answer()
            if message.get("op") == _FORKED:
                return Snapshot(ours, self._copy(message.get("pid")))
        except ChannelError:
            self._copies = False  # whoever does not answer once is not asked again: it would cost its time each time
        ours.close()
        return None

    def serve(self) -> Snapshot | None:
        """Let the process itself answer tests; it runs no further cell, and there is one connection for all."""
        if self._served is not None and self._served.alive():
            return self._served
        ours, theirs = (self._own_rpc, None) if self._own_rpc is not None else socket.socketpair()
        try:
            self._channel.send({"op": "serve"}, [theirs.fileno()] if theirs is not None else [], _ANSWER_S)
            if theirs is not None:
                theirs.close()
        except ChannelError:
            ours.close()
            return None
        self._served = Served(ours, self)
        return self._served

    def interrupt(self) -> None:
        """Raise ``KeyboardInterrupt`` in the code that runs."""
        if self._alone and self._process is not None:
            self._process.interrupt()
            return
        with contextlib.suppress(OSError):
            self._line.sendall(monitor.INTERRUPT)

    def alive(self) -> bool:
        """Whether the process still runs."""
        return self._process is not None and not self._process.wait(0)

    def ends_within(self, timeout_s: float) -> bool:
        """Whether the process ends within ``timeout_s``."""
        return self._process is None or self._process.wait(timeout_s)

    def fell(self) -> bool:
        """Whether it is the process's own doing that it no longer answers: then its monitor lives to say so."""
        if self._alone or self._broke_rules or self.exit_code is not None:
            return True
        if self.out_of_memory():  # the kernel may have picked the monitor, which is in the same group
            return True
        with contextlib.suppress(OSError, ValueError):
            for fact in self._tell(_GONE_S):
                if "exit" in fact:
                    return True
        # A monitor that lives while the student's process does: that one closed the line, and goes on. A monitor that
        # is being killed has closed its own line a little before it counts as ended.
        return not self.ends_within(_GONE_S)

    def taken_away(self) -> bool:
        """Whether its monitor has ended without a word, or does so at once: no doing of the process, nor of ours."""
        return self._process is not None and self.ends_within(_SOON_S) and not self.fell()

    def out_of_memory(self) -> int:
        """How many of its processes the kernel has killed for want of memory."""
        return self._group.out_of_memory() if self._group is not None else 0

    def peak_bytes(self) -> int:
        """The most memory that it used, where a control group counts it."""
        return self._group.peak_bytes() if self._group is not None else 0

    def fileno(self) -> int | None:
        """A descriptor that is readable once the process is gone, or None."""
        return self._process.fileno() if self._process is not None else None

    def close(self) -> None:
        """End the process and everything it started, at once; safe to call twice."""
        with contextlib.suppress(OSError):
            self._line.close()  # the monitor ends everything
        self._channel.close()
        if self._process is not None:
            if self._alone or not self._process.wait(_GONE_S):
                self._process.kill()
            self._process.close()
            self._process = None
        if self._group is not None:
            self._cgroups.discard(self._group)
            self._group = None
        while self._afterwards:
            self._afterwards.pop()()

    def on_close(self, function: Callable[[], object]) -> None:
        """Have ``function`` called once the process has ended."""
        self._afterwards.append(function)

    def _start(self, server: ForkServer, job: dict[str, Any], sockets: list[socket.socket]) -> None:
        if not self._alone:
            self._process = server.start(job, sockets)
            return
        self._own_rpc, theirs = socket.socketpair()
        with theirs:
            self._process = server.start(job, [*sockets, theirs])

    def _let_go(self) -> list[str]:
        """Let the process shut itself in and begin; return the layers that hold."""
        if not self._alone:
            self._line.sendall(monitor.GO)
        ready = self._channel.receive(_READY_S)
        if ready is None or ready.get("op") != "ready":
            raise StartError("the student's process did not come up")
        layers = [str(layer) for layer in ready["layers"]]  # so far only trusted code has run there
        return [*layers, "cgroup"] if self._group is not None else layers

    def _contain(self, bounds: Bounds) -> None:
        if self._cgroups.bases and self._process is not None:
            self._group = self._cgroups.make(bounds)
            self._group.add(self._process.pid)

    def _answer(self) -> dict[str, Any]:
        """The answer to a question; outputs that a thread writes meanwhile are dropped."""
        deadline = time.monotonic() + _ANSWER_S
        while True:
            message = self._channel.receive(max(0.0, deadline - time.monotonic()))
            if message is None or time.monotonic() >= deadline:  # a flood is no answer either
                raise ChannelError("no answer")
            if message.get("op") in (_FORKED, "failed", "served"):
                return message

    def _threads(self) -> int:
        """How many threads the process has; 0 if it is gone or that cannot be told."""
        try:
            self._line.sendall(monitor.THREADS)
            for fact in self._tell(_ANSWER_S):
                if "threads" in fact:
                    return int(fact["threads"])
        except OSError:
            pass
        return 0

    def _tell(self, timeout_s: float) -> Iterator[dict[str, Any]]:
        """What the monitor says, until it is silent or gone."""
        deadline = time.monotonic() + timeout_s
        while readable(self._line, max(0.0, deadline - time.monotonic())):
            chunk = self._line.recv(4096)
            if not chunk:
                return
            *lines, self._facts = (self._facts + chunk).split(b"\n")
            for line in lines:
                fact = json.loads(line)
                if "exit" in fact:
                    self.exit_code = int(fact["exit"])
                yield fact

    def _copy(self, number: object) -> Process:
        """The snapshot that calls itself ``number`` in its own pid namespace.

        The student's process sends no descriptor: the kernel counts those on their way per user, and all submissions
        are the same user.
        """
        if self._process is not None:
            for student in _children(self._process.pid):
                for pid in _children(student):
                    if _own_number(pid) == number:
                        with contextlib.suppress(OSError):
                            handle = os.pidfd_open(pid)
                            if pid in _children(student):  # else the number may be another's by now
                                return Process(pid, handle)
                            os.close(handle)
        raise ChannelError("no snapshot of this process")


def _children(pid: int) -> list[int]:
    """The children of process ``pid``; none if it is gone."""
    found: list[int] = []
    with contextlib.suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            found += map(int, (task / "children").read_text().split())
    return found


def _own_number(pid: int) -> int | None:
    """The number of process ``pid`` as it sees it itself."""
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{pid}/status").read_text(encoding="utf-8").splitlines():
            if line.startswith("NSpid:"):
                return int(line.split()[-1])
    return None
