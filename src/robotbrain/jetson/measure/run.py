"""Timing a network with trtexec while the board's sensors are read."""

from __future__ import annotations

import queue
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from robotbrain.errors import InputError
from robotbrain.jetson.measure import jtop, tegrastats
from robotbrain.jetson.measure.command import Capabilities
from robotbrain.jetson.measure.samples import Sample, Telemetry, summarise

TRTEXEC_PLACES = ("/usr/src/tensorrt/bin/trtexec", "/usr/local/tensorrt/bin/trtexec", "/opt/tensorrt/bin/trtexec")
"""Where JetPack and NVIDIA's containers put trtexec if it is not on PATH."""

INTERVAL_S = 0.2
"""Time between two readings of the sensors."""

_STARTS = "Starting inference"
_ENDS = ("Warmup completed", "Timing trace has", "=== Performance summary")


@dataclass(frozen=True)
class Recording:
    """What a run left.

    Attributes:
        log: what trtexec printed, all of it or up to the interruption.
        exit_code: of trtexec; None if it was stopped.
        telemetry: of the sensors while the network was timed; None without a sampler.
    """

    log: str
    exit_code: int | None
    telemetry: Telemetry | None

    @property
    def interrupted(self) -> bool:
        """Whether the person at the keyboard stopped it."""
        return self.exit_code is None


class Sampler(Protocol):
    """Something that reads sensors from ``start`` to ``stop``."""

    name: str

    def start(self) -> None:
        """Begin."""

    def stop(self) -> list[tuple[float, Sample]]:
        """End, and return the readings with the monotonic time of each, s."""


class TegrastatsSampler:
    """Reads the sensors through a ``tegrastats`` process."""

    name = "tegrastats"

    def __init__(self, program: Sequence[str] = ("tegrastats",)) -> None:
        self._command = [*program, "--interval", str(round(INTERVAL_S * 1000))]
        self._readings: list[tuple[float, Sample]] = []
        self._child: subprocess.Popen[str] | None = None
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Begin; without the program there will simply be no readings."""
        try:
            self._child = _popen(self._command)
        except OSError:
            return
        self._thread = threading.Thread(target=self._read, name="tegrastats", daemon=True)
        self._thread.start()

    def stop(self) -> list[tuple[float, Sample]]:
        """End the process and return the readings."""
        if self._child is not None:
            stop_process(self._child)
        if self._thread is not None:
            self._thread.join(timeout=5)
        return list(self._readings)

    def _read(self) -> None:
        assert self._child is not None and self._child.stdout is not None
        for line in self._child.stdout:
            try:
                self._readings.append((time.monotonic(), tegrastats.parse_line(line)))
            except InputError:
                continue  # a warning, or a line cut off at the end


class JtopSampler:
    """Reads the sensors through a jtop client that was started already."""

    name = "jtop"

    def __init__(self, client: Any) -> None:
        self._client = client
        self._readings: list[tuple[float, Sample]] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._read, name="jtop", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> list[tuple[float, Sample]]:
        """End, close the client and return the readings."""
        self._stop.set()
        self._thread.join(timeout=5)
        self._client.close()
        return list(self._readings)

    def _read(self) -> None:
        while not self._stop.wait(INTERVAL_S):
            try:
                self._readings.append((time.monotonic(), jtop.poll(self._client)))
            except Exception:  # jtop's service went away: what was read stays
                return


def find_trtexec(named: str | None = None) -> str | None:
    """Return the path of trtexec: the one named, the one on PATH, or where JetPack puts it."""
    if named is not None:
        return shutil.which(named)
    return shutil.which("trtexec") or next((place for place in TRTEXEC_PLACES if shutil.which(place)), None)


def capabilities_of(program: Sequence[str]) -> Capabilities:
    """Ask a trtexec what it can do.

    Raises:
        InputError: if it cannot be run, or is something else.
    """
    return Capabilities.from_help(ask([*program, "--help"], timeout_s=120))


def ask(command: Sequence[str], timeout_s: float = 20) -> str:
    """Return all that a short command prints; the empty string if it cannot be run."""
    try:
        done = subprocess.run(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL, timeout=timeout_s
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout.decode("utf-8", "replace")


def choose_sampler() -> Sampler | None:
    """Return the best way to read this board's sensors, or None if there is none."""
    client = jtop.connect()
    if client is not None:
        return JtopSampler(client)
    found = shutil.which("tegrastats")
    return TegrastatsSampler((found,)) if found else None


def record(
    command: Sequence[str],
    sampler: Sampler | None,
    *,
    warm_up_s: float = 0.0,
    on_line: Callable[[str], None] = lambda _: None,
) -> Recording:
    """Run trtexec to its end, or until interrupted, and return what it left.

    Args:
        command: of trtexec.
        sampler: of the sensors.
        warm_up_s: readings in the first seconds of the inference phase are dropped.
        on_line: called with every line, and twice a second with an empty one in between.

    Raises:
        InputError: if the program cannot be started.
    """
    lines: list[str] = []
    begun = ended = None
    exit_code = None
    readings: list[tuple[float, Sample]] = []
    try:
        child = _popen(command)
    except OSError as error:
        raise InputError("trtexec", given=command[0], expected="a program", fix=f"It says: {error}.") from error
    try:
        if sampler is not None:
            sampler.start()
        for line in _lines(child):
            if line:
                lines.append(line)
                begun = time.monotonic() if _STARTS in line else begun
                ended = time.monotonic() if ended is None and any(word in line for word in _ENDS) else ended
            on_line(line)
        exit_code = child.wait()
    except KeyboardInterrupt:
        pass  # what was printed so far is kept; exit_code stays None
    finally:
        stop_process(child)
        readings = sampler.stop() if sampler is not None else []
    telemetry = None
    if sampler is not None:
        start, end = (float("inf") if begun is None else begun + warm_up_s), ended or time.monotonic()
        telemetry = summarise([sample for when, sample in readings if start <= when <= end], sampler.name)
    return Recording("\n".join(lines) + "\n", exit_code, telemetry)


def stop_process(child: subprocess.Popen[Any], patience_s: float = 5.0) -> None:
    """End a process that may have ended already: ask first, then insist."""
    if child.poll() is not None:
        return
    child.terminate()
    try:
        child.wait(timeout=patience_s)
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait()


def write_log(path: Path, text: str) -> Path:
    """Keep a log beside the profile that was made of it."""
    from robotbrain.files import write_text

    return write_text(path, text)


def _popen(command: Sequence[str]) -> subprocess.Popen[str]:
    return subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        encoding="utf-8",
        errors="replace",
        bufsize=1,
    )


def _lines(child: subprocess.Popen[str]) -> Any:
    """Yield the lines of a process, and an empty string twice a second while there is none."""
    found: queue.Queue[str | None] = queue.Queue()
    stream = child.stdout
    assert stream is not None

    def read() -> None:
        for line in stream:
            found.put(line.rstrip("\n") or " ")
        found.put(None)

    # A thread, because a blocking read would keep Ctrl-C waiting on Windows and hide that time passes.
    threading.Thread(target=read, name="trtexec output", daemon=True).start()
    while True:
        try:
            line = found.get(timeout=0.5)
        except queue.Empty:
            yield ""
            continue
        if line is None:
            return
        yield line
