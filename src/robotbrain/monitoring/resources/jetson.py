"""Readings of a real Jetson: through jtop, or the lines of tegrastats."""

from __future__ import annotations

import contextlib
import subprocess
import threading
import time
from collections.abc import Iterable, Sequence
from typing import Any

from robotbrain.errors import InputError, MissingDependencyError, RobotBrainError
from robotbrain.jetson.measure import jtop
from robotbrain.jetson.measure.samples import Sample
from robotbrain.jetson.measure.tegrastats import parse_line
from robotbrain.monitoring.resources.reading import Missing, Reading

_MIB = 2**20 / 1e6


def reading_of(sample: Sample, source: str, time_s: float) -> Reading:
    """Return the reading in a sample of a board's sensors."""

    def number(value: float | None, what: str, factor: float = 1.0) -> float | Missing:
        return Missing(f"{what} was not in what the board said") if value is None else factor * value

    return Reading(
        time_s=time_s,
        source=source,
        memory_used_mb=number(sample.ram_used_mb, "memory", _MIB),
        memory_total_mb=number(sample.ram_total_mb, "memory", _MIB),
        gpu_percent=number(sample.gpu_load, "GPU load", 100.0),
        gpu_memory_used_mb=Missing("a Jetson's GPU shares the machine's memory"),
        gpu_memory_total_mb=Missing("a Jetson's GPU shares the machine's memory"),
        temperatures_c=dict(sample.temperatures_c) or Missing("no temperature was in what the board said"),
        power_w=number(sample.module_w, "the rails that make up the module"),
        cpu_mhz=number(sample.cpu_mhz, "the processors' clock"),
        gpu_mhz=number(sample.gpu_mhz, "the GPU's clock"),
    )


class JtopSource:
    """A Jetson through jtop (package ``jetson-stats`` and its service).

    Args:
        client: a started jtop client; one is started by default.

    Raises:
        MissingDependencyError: the package is missing or its service does not answer.
    """

    name = "jtop"

    def __init__(self, client: Any = None) -> None:
        found = jtop.connect() if client is None else client
        if found is None:
            raise MissingDependencyError(
                "jetson-stats (or its service)",
                needed_for="reading a Jetson through jtop",
                install="sudo pip3 install -U jetson-stats, then restart",
            )
        self._client: Any = found

    def read(self) -> Reading:
        """Return what the client last received."""
        return reading_of(jtop.poll(self._client), self.name, time.monotonic())

    def close(self) -> None:
        """Stop the client."""
        with contextlib.suppress(Exception):
            self._client.close()


class TegrastatsSource:
    """A Jetson through tegrastats, which every JetPack has.

    Args:
        lines: what it prints, as it comes; the program is started by default.
        command: that prints it.

    Raises:
        MissingDependencyError: there is no such program.
    """

    name = "tegrastats"

    def __init__(
        self, lines: Iterable[str] | None = None, command: Sequence[str] = ("tegrastats", "--interval", "500")
    ) -> None:
        self._process: subprocess.Popen[str] | None = None
        if lines is None:
            try:
                self._process = subprocess.Popen(list(command), stdout=subprocess.PIPE, text=True)
            except OSError as error:
                raise MissingDependencyError(
                    command[0], needed_for="reading a Jetson's sensors", install="it comes with JetPack"
                ) from error
            lines = self._process.stdout
        assert lines is not None
        self._lock = threading.Lock()
        self._latest: tuple[float, Sample] | None = None
        self._ended = False
        self._first = threading.Event()
        self._reader = threading.Thread(target=self._follow, args=(lines,), name="tegrastats", daemon=True)
        self._reader.start()

    def _follow(self, lines: Iterable[str]) -> None:
        for line in lines:
            with contextlib.suppress(InputError):
                sample = parse_line(line)
                with self._lock:
                    self._latest = (time.monotonic(), sample)
                self._first.set()
        self._ended = True
        self._first.set()

    def read(self) -> Reading:
        """Return the newest line's reading; waits up to 2 s for the first.

        Raises:
            RobotBrainError: the program ended, or printed nothing.
        """
        self._first.wait(2.0)
        with self._lock:
            latest = self._latest
        if latest is None or (self._ended and self._process is not None):
            raise RobotBrainError("tegrastats ended" if self._ended else "tegrastats has printed nothing yet")
        return reading_of(latest[1], self.name, latest[0])

    def close(self) -> None:
        """End the program."""
        if self._process is not None:
            with contextlib.suppress(OSError):
                self._process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(2.0)
