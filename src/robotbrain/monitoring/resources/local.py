"""The sources that this machine has."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

from robotbrain.errors import RobotBrainError
from robotbrain.monitoring.resources.host import PsutilSource
from robotbrain.monitoring.resources.jetson import JtopSource
from robotbrain.monitoring.resources.nvml import NvmlSource
from robotbrain.monitoring.resources.reading import Missing, Reading, Source, merge, nothing


class Combined:
    """Several sources as one; each value is that of the first that has it.

    Args:
        sources: in order of trust.
        absent: why other sources are not there, by name; said of the values that they would have read.
    """

    def __init__(self, sources: Sequence[Source], absent: dict[str, str] | None = None) -> None:
        self.sources = list(sources)
        self.absent = dict(absent or {})

    @property
    def name(self) -> str:
        """The sources' names."""
        return " + ".join(source.name for source in self.sources)

    def read(self) -> Reading:
        """Read all; one that fails is left out, and its values are missing for that reason."""
        readings = []
        for source in self.sources:
            try:
                readings.append(source.read())
            except Exception as error:
                reason = f"failed: {type(error).__name__}: {error}"
                readings.append(nothing(source.name, reason, time.monotonic()))
        merged = merge(readings)
        values: dict[str, Any] = merged.values()
        for name in _OTHERS_READ:
            if isinstance(values[name], Missing):
                reasons = [values[name].reason, *(f"{who}: {why}" for who, why in self.absent.items())]
                values[name] = Missing("; ".join(reasons))
        return Reading(merged.time_s, merged.source, **values, provenance=merged.provenance)

    def close(self) -> None:
        """Close all."""
        for source in self.sources:
            source.close()


_OTHERS_READ = ("gpu_percent", "gpu_memory_used_mb", "gpu_memory_total_mb", "gpu_mhz", "power_w", "throttled")


def local_source() -> Combined:
    """Return everything that this machine has: jtop on a Jetson, NVML with an NVIDIA GPU, psutil always."""
    sources: list[Source] = []
    absent: dict[str, str] = {}
    for kind in (JtopSource, NvmlSource):
        try:
            sources.append(kind())
        except RobotBrainError as error:
            absent[kind.name] = str(error).partition(";")[0]
    sources.append(PsutilSource())
    return Combined(sources, absent)
