"""What is read of a machine: each value with where it comes from, or the reason why it is missing."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Protocol

UNITS: Mapping[str, str] = MappingProxyType(
    {
        "cpu_percent": "%",
        "cpu_per_core_percent": "%",
        "memory_used_mb": "MB",
        "memory_total_mb": "MB",
        "process_rss_mb": "MB",
        "gpu_percent": "%",
        "gpu_memory_used_mb": "MB",
        "gpu_memory_total_mb": "MB",
        "temperatures_c": "°C",
        "power_w": "W",
        "cpu_mhz": "MHz",
        "gpu_mhz": "MHz",
        "throttled": "",
    }
)
"""What a reading may hold, and its unit. MB are 1e6 bytes. ``cpu_percent`` is of all cores together, 0 to 100."""


@dataclass(frozen=True)
class Missing:
    """A value that is not there, and why. It is false, so ``if reading.power_w:`` does what it says."""

    reason: str

    def __bool__(self) -> bool:
        return False

    def __str__(self) -> str:
        return f"missing: {self.reason}"


NOT_READ = Missing("this source does not read it")

Number = float | Missing
Value = float | bool | tuple[float, ...] | Mapping[str, float] | Missing


@dataclass(frozen=True)
class Reading:
    """One look at a machine. Nothing is ever 0 because it is unknown: it is :class:`Missing`, with the reason.

    Attributes:
        time_s: when, on a clock that cannot jump (``time.monotonic``); for the twin simulated time.
        source: who read it.
        cpu_percent: all cores together, 0 to 100.
        cpu_per_core_percent: of each.
        memory_used_mb, memory_total_mb: of the machine.
        process_rss_mb: resident memory of this process.
        gpu_percent: share of the time that the GPU was busy, 0 to 100.
        gpu_memory_used_mb, gpu_memory_total_mb: of the GPU's own memory (a Jetson has none: it shares the machine's).
        temperatures_c: by sensor.
        power_w: of the module or the GPU board, whichever the source says.
        cpu_mhz, gpu_mhz: clocks now.
        throttled: whether clocks are held down by heat or power.
        provenance: source by name of the value, filled in by :func:`merge`.
    """

    time_s: float
    source: str
    cpu_percent: Number = NOT_READ
    cpu_per_core_percent: tuple[float, ...] | Missing = NOT_READ
    memory_used_mb: Number = NOT_READ
    memory_total_mb: Number = NOT_READ
    process_rss_mb: Number = NOT_READ
    gpu_percent: Number = NOT_READ
    gpu_memory_used_mb: Number = NOT_READ
    gpu_memory_total_mb: Number = NOT_READ
    temperatures_c: Mapping[str, float] | Missing = NOT_READ
    power_w: Number = NOT_READ
    cpu_mhz: Number = NOT_READ
    gpu_mhz: Number = NOT_READ
    throttled: bool | Missing = NOT_READ
    provenance: Mapping[str, str] = field(default_factory=dict)

    def values(self) -> dict[str, Value]:
        """Return every value by its name, missing ones included."""
        return {name: getattr(self, name) for name in UNITS}

    def source_of(self, name: str) -> str:
        """Return who read a value."""
        return self.provenance.get(name, self.source)

    def missing(self) -> dict[str, str]:
        """Return the reasons by name of what is missing."""
        return {name: value.reason for name, value in self.values().items() if isinstance(value, Missing)}

    def known(self) -> dict[str, float]:
        """Return the plain numbers by name; of the temperatures the highest. What is missing is not there."""
        found: dict[str, float] = {}
        for name, value in self.values().items():
            if isinstance(value, Missing | tuple):
                continue
            if isinstance(value, Mapping):
                found["temperature_c"] = max(value.values())
            else:
                found[name] = float(value)
        return found

    def to_dict(self) -> dict[str, Any]:
        """Return the reading as plain data for JSON; what is missing is ``{"missing": reason}``."""
        plain: dict[str, Any] = {"time_s": self.time_s, "source": self.source}
        for name, value in self.values().items():
            if isinstance(value, Missing):
                plain[name] = {"missing": value.reason}
            elif isinstance(value, Mapping):
                plain[name] = dict(value)
            else:
                plain[name] = list(value) if isinstance(value, tuple) else value
        plain["provenance"] = {name: self.source_of(name) for name, value in self.values().items() if _there(value)}
        return plain

    def __str__(self) -> str:
        lines = []
        for name, value in self.values().items():
            if isinstance(value, Missing):
                lines.append(f"{name:<22} -         {value.reason}")
            else:
                lines.append(f"{name:<22} {shown(value)} {UNITS[name]}".rstrip() + f"  ({self.source_of(name)})")
        return "\n".join(lines)


def shown(value: Value) -> str:
    """Return a value as text."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {number:.0f}" for name, number in value.items())
    if isinstance(value, tuple):
        return " ".join(f"{number:.0f}" for number in value)
    return str(value) if isinstance(value, Missing) else f"{value:.1f}"


def _there(value: Value) -> bool:
    return not isinstance(value, Missing)


class Source(Protocol):
    """Something that reads a machine."""

    @property
    def name(self) -> str:
        """Who it is, for the provenance of its values."""
        ...

    def read(self) -> Reading:
        """Read now. What cannot be read is Missing; raises only when it is broken altogether."""
        ...

    def close(self) -> None:
        """Let go of what it holds."""
        ...


def nothing(source: str, reason: str, time_s: float) -> Reading:
    """Return a reading in which everything is missing for one reason."""
    values: dict[str, Any] = dict.fromkeys(UNITS, Missing(reason))
    return Reading(time_s, source, **values)


def number_or_missing(read: Callable[[], object], what: str) -> Number:
    """Return the finite number that ``read()`` gives, or Missing with the reason when it fails."""
    try:
        value = read()
    except Exception as error:  # drivers and sensors fail in ways of their own
        return Missing(f"{what}: {type(error).__name__}: {error}".rstrip(": "))
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return Missing(f"{what}: got {value!r}")
    return float(value)


def merge(readings: Sequence[Reading]) -> Reading:
    """Return one reading of several: each value is that of the first source that has it, and says which.

    A value that nobody has is missing for the reasons of all that try to read it.
    """
    values: dict[str, Any] = {}
    provenance: dict[str, str] = {}
    for name in UNITS:
        found = [(reading, getattr(reading, name)) for reading in readings]
        first = next(((reading, value) for reading, value in found if _there(value)), None)
        if first is not None:
            values[name] = first[1]
            provenance[name] = first[0].source_of(name)
        else:
            tried = {f"{r.source}: {v.reason}": None for r, v in found if v != NOT_READ}
            values[name] = Missing("; ".join(tried)) if tried else Missing("no source reads it")
    time_s = max((reading.time_s for reading in readings), default=0.0)
    return Reading(time_s, " + ".join(_names(readings)) or "nothing", **values, provenance=provenance)


def _names(readings: Iterable[Reading]) -> list[str]:
    return list(dict.fromkeys(reading.source for reading in readings))
