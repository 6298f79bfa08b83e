"""How long ONNX files take in ONNX Runtime on this machine: all of them in alternation, so that a ratio is fair."""

from __future__ import annotations

import statistics
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from robotbrain.errors import InputError
from robotbrain.optimisation.evaluate import onnx_session


@dataclass(frozen=True)
class HostLatency:
    """Time of one inference on this machine, ms.

    Attributes:
        median_ms: of the rounds' medians, on the wall clock.
        fastest_ms: of the rounds' medians: the one that other processes disturbed least.
        cpu_ms: median of the rounds' means of processor time. With one thread this is what the wall clock shows on a
            machine that does nothing else, and it stays that on a busy one.
        rounds_ms: median of each round, in order; round k of every file ran right after one another.
        cpu_rounds_ms: mean processor time of each round.
    """

    median_ms: float
    fastest_ms: float
    cpu_ms: float
    rounds_ms: tuple[float, ...]
    cpu_rounds_ms: tuple[float, ...]


def host_latency(
    paths: Mapping[str, Path], *, rounds: int = 7, min_ms: float = 40.0, threads: int = 1, batch: int = 1
) -> dict[str, HostLatency]:
    """Measure all files in turns: A, B, C, A, B, C, ...

    A busy neighbour then slows all of them, and their ratio (:func:`speedup`) is worth more than their times.

    Args:
        paths: name -> ONNX file with one float32 input.
        rounds: turns of each file, at least 1; 5 or more for a figure to be quoted.
        min_ms: each turn repeats the inference for at least this long.
        threads: that ONNX Runtime may use.
        batch: size of the input's first axis where it is open.
    """
    if not paths or rounds < 1 or not min_ms >= 0 or threads < 1 or batch < 1:
        raise InputError(
            "host_latency",
            given=f"{len(paths)} files, rounds={rounds}, min_ms={min_ms}, threads={threads}, batch={batch}",
            expected="at least one file and one round, thread and image; min_ms 0 or more",
            fix="Use rounds=7.",
        )
    runs = {name: _Run(onnx_session(path, threads=threads), batch) for name, path in paths.items()}
    for run in runs.values():  # warm caches, and learn how many inferences make a turn
        run.calibrate(min_ms)
    taken: dict[str, list[tuple[float, float]]] = {name: [] for name in runs}
    for _ in range(rounds):
        for name, run in runs.items():
            taken[name].append(run.turn())
    result = {}
    for name, turns in taken.items():
        wall, cpu = zip(*turns, strict=True)
        result[name] = HostLatency(statistics.median(wall), min(wall), statistics.median(cpu), wall, cpu)
    return result


def speedup(slow: HostLatency, fast: HostLatency, *, cpu: bool = False) -> float:
    """Return how many times faster ``fast`` is: the median of the ratios of neighbouring turns.

    Args:
        slow: of the same measurement as ``fast``.
        fast: likewise.
        cpu: by processor time instead of the wall clock.
    """
    pairs = zip(slow.cpu_rounds_ms, fast.cpu_rounds_ms, strict=True) if cpu else None
    pairs = pairs or zip(slow.rounds_ms, fast.rounds_ms, strict=True)
    return statistics.median(s / max(f, 1e-9) for s, f in pairs)


class _Run:
    """One session with a fixed input."""

    def __init__(self, session: Any, batch: int) -> None:
        entry = session.get_inputs()[0]
        sizes = [batch if k == 0 and not isinstance(s, int) else s for k, s in enumerate(entry.shape)]
        shape = [s if isinstance(s, int) else 64 for s in sizes]
        values = np.random.default_rng(0).standard_normal(shape)
        self._session, self._feed = session, {entry.name: values.astype(np.float32)}
        self._repeats = 1

    def calibrate(self, min_ms: float) -> None:
        self.turn()
        self._repeats = 3
        self._repeats = max(1, round(min_ms / max(self.turn()[0], 1e-3)))

    def turn(self) -> tuple[float, float]:
        """Return the median wall time and the mean processor time of an inference in this turn, ms."""
        times = []
        cpu = time.process_time()
        for _ in range(self._repeats):
            begin = time.perf_counter()
            self._session.run(None, self._feed)
            times.append(time.perf_counter() - begin)
        return statistics.median(times) * 1e3, (time.process_time() - cpu) * 1e3 / self._repeats
