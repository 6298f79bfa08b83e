"""Latencies that say where they come from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from robotbrain.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

MEASURED_HERE = "measured on this host"
TWIN = "twin"
TENSORRT = "TensorRT on this board"
SOURCES = (MEASURED_HERE, TWIN, TENSORRT)
"""Where a latency can come from. A simulated runtime is not among them: it has no latency to tell."""


@dataclass(frozen=True)
class Latency:
    """Time of one inference. ``str`` of it never leaves out the source.

    Attributes:
        median_ms, p99_ms: over the runs, ms; the 99th percentile by linear interpolation.
        runs: timed inferences; 0 for a prediction.
        batch: inputs of one inference.
        source: one of :data:`SOURCES`.
        harness: what was timed, and how.
    """

    median_ms: float
    p99_ms: float
    runs: int
    batch: int
    source: str
    harness: str

    def __post_init__(self) -> None:
        if self.source not in SOURCES:
            raise InputError(
                "source of a latency",
                given=self.source,
                expected="one of " + ", ".join(SOURCES),
                fix="Say where the figure comes from.",
            )

    def __str__(self) -> str:
        figures = f"{self.median_ms:.3f} ms"
        if self.runs:
            figures += f" (median of {self.runs}; p99 {self.p99_ms:.3f} ms)"
        return f"{figures} at batch {self.batch}: {self.source}; {self.harness}"


def summarise(times_ms: Sequence[float], *, batch: int, source: str, harness: str) -> Latency:
    """Return median and 99th percentile of timed inferences.

    Raises:
        InputError: for no times, or times that are negative or not finite.
    """
    times = np.asarray(times_ms, dtype=np.float64)
    if times.ndim != 1 or times.size == 0 or not np.isfinite(times).all() or (times < 0).any():
        raise InputError(
            "times", given=times_ms, expected="at least one time, finite and >= 0 ms", fix="Check the timer."
        )
    return Latency(float(np.median(times)), float(np.percentile(times, 99)), int(times.size), batch, source, harness)


def check_counts(runs: int, warmup: int) -> None:
    """Check how often to run before and while timing.

    Raises:
        InputError: for fewer than one run, or a negative warm-up.
    """
    if runs < 1 or warmup < 0:
        raise InputError(
            "runs and warmup", given=(runs, warmup), expected="runs >= 1 and warmup >= 0", fix="Ask for more runs."
        )
