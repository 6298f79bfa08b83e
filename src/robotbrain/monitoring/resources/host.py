"""Readings of the computer that this process runs on, through psutil."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from typing import Any

import psutil

from robotbrain.monitoring.resources.reading import Missing, Reading, number_or_missing

_SHORTEST_S = 0.1  # over less, the counters' own grain (often 10 ms) makes the percentage meaningless


class PsutilSource:
    """Processor, memory, clocks and, where the system shows them, temperatures.

    Processor use is the share of time between two looks. ``psutil.cpu_percent()`` returns 0.0 on its first call, which
    looks like an idle machine; here the first look is taken when the source is made, and a reading that comes too soon
    after the one before says so.

    Args:
        pid: process whose memory is read; this one by default.
    """

    name = "psutil"

    def __init__(self, pid: int | None = None) -> None:
        self._process = psutil.Process(pid)
        self._last_s = time.monotonic()
        self._last = _busy_and_total()

    def read(self) -> Reading:
        """Read now."""
        now = time.monotonic()
        total, cores = self._use(now)
        memory = psutil.virtual_memory()
        return Reading(
            time_s=now,
            source=self.name,
            cpu_percent=total,
            cpu_per_core_percent=cores,
            memory_used_mb=(memory.total - memory.available) / 1e6,
            memory_total_mb=memory.total / 1e6,
            process_rss_mb=number_or_missing(lambda: self._process.memory_info().rss / 1e6, "memory of the process"),
            gpu_percent=Missing("does not read GPUs"),
            temperatures_c=_temperatures(),
            power_w=Missing("does not read power"),
            cpu_mhz=_clock(),
        )

    def _use(self, now_s: float) -> tuple[float | Missing, tuple[float, ...] | Missing]:
        elapsed = now_s - self._last_s
        if elapsed < _SHORTEST_S:
            reason = Missing(f"processor use needs {_SHORTEST_S:g} s between two looks, and it was {elapsed:.3f} s")
            return reason, reason
        before, self._last, self._last_s = self._last, _busy_and_total(), now_s
        if len(before) != len(self._last):
            reason = Missing("the number of processors changed")
            return reason, reason
        pairs = [(b1 - b0, t1 - t0) for (b0, t0), (b1, t1) in zip(before, self._last, strict=True)]
        cores = tuple(100 * min(1.0, max(0.0, busy / total)) if total > 0 else 0.0 for busy, total in pairs)
        whole = sum(total for _, total in pairs)
        if whole <= 0:
            reason = Missing("the system's counters of processor time did not move")
            return reason, reason
        return 100 * min(1.0, max(0.0, sum(busy for busy, _ in pairs) / whole)), cores

    def close(self) -> None:
        """Do nothing: it holds nothing."""


def _busy_and_total() -> list[tuple[float, float]]:
    """Return busy and total time of each processor since the system started, s."""
    found = []
    for times in psutil.cpu_times(percpu=True):
        # Linux counts time of guests twice: as theirs and as user time.
        total = sum(times) - getattr(times, "guest", 0.0) - getattr(times, "guest_nice", 0.0)
        found.append((total - times.idle - getattr(times, "iowait", 0.0), total))
    return found


def _temperatures() -> Mapping[str, float] | Missing:
    read: Any = getattr(psutil, "sensors_temperatures", None)
    if read is None:
        return Missing(f"reads no temperatures on {sys.platform}")
    try:
        chips = read()
    except (OSError, RuntimeError, ValueError) as error:
        return Missing(f"temperatures: {error}")
    found = {}
    for chip, sensors in chips.items():
        for index, sensor in enumerate(sensors):
            if sensor.current is not None and -40 < sensor.current < 150:
                label = sensor.label or (str(index) if len(sensors) > 1 else "")
                found[f"{chip} {label}".strip()] = float(sensor.current)
    return found or Missing("the system shows no temperature sensors (usual in a virtual machine)")


def _clock() -> float | Missing:
    try:
        clock = psutil.cpu_freq()
    except (OSError, NotImplementedError, RuntimeError, AttributeError) as error:
        return Missing(f"processor clock: {error}")
    if clock is None or not clock.current:
        return Missing("the system does not show the processor's clock")
    return float(clock.current)
