"""How well does a brain drive when something is wrong? The same worlds with each fault, and without."""

from __future__ import annotations

import hashlib
import json
import math
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from robotbrain.errors import InputError, RobotBrainError
from robotbrain.files import write_text
from robotbrain.monitoring.critical_path import Chains
from robotbrain.monitoring.faults import (
    Blackout,
    CpuHog,
    DropFrames,
    Fault,
    FrozenSensor,
    LateFrames,
    Noise,
    Outliers,
    SensorBias,
    Slowdown,
    StampOffset,
    WrongFrameId,
)
from robotbrain.monitoring.robustness_results import NOTHING, Robustness, Row, plain

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from robotbrain.pipeline.brain import RunResult
    from robotbrain.ros.context import SimContext

Faults = Mapping[str, Mapping[str, Sequence[Fault]]]
"""Faults to try: name -> severity in words -> what is injected together."""

Runner = Callable[[int, Sequence[Callable[[Any], object]]], "RunResult"]
"""Drives one world: ``runner(seed, attach)``."""


def standard_faults() -> dict[str, dict[str, list[Fault]]]:
    """Return faults of every kind in a few severities, for the kit's brain."""
    return {
        "scan noise": {f"{s * 100:g} cm": [Noise("/scan", s)] for s in (0.02, 0.05, 0.15)},
        "scan outliers": {f"{r:.0%}": [Outliers("/scan", r)] for r in (0.02, 0.1, 0.3)},
        "gyro bias": {f"{b:g} rad/s": [SensorBias("/imu", (0.0, 0.0, b))] for b in (0.02, 0.1, 0.3)},
        "wheels worn": {f"{1 - s:.0%}": [SensorBias("/joint_states", scale=2 - s)] for s in (0.98, 0.9)},
        "images lost": {f"{r:.0%}": [DropFrames("/camera/image", r, burst=10.0)] for r in (0.3, 0.6, 0.9)},
        "scans late": {f"{d} ms": [LateFrames("/scan", float(d))] for d in (50, 200, 450)},
        "points late": {f"{d} ms": [LateFrames("/perception/points", float(d))] for d in (100, 500)},
        "scan frame wrong": {"map": [WrongFrameId("/scan", "map")]},
        "scan clock off": {f"{o:+d} ms": [StampOffset("/scan", float(o))] for o in (-50, -200, 50)},
        "lidar hangs": {"from 8 to 12 s": [FrozenSensor("/scan", during=(8.0, 12.0))]},
        "camera dark": {"from 5 to 10 s": [Blackout("/camera/image", during=(5.0, 10.0))]},
        "CPU taken": {f"{n} threads": [CpuHog(n)] for n in (4, 16)},
        "GPU slow": {f"{f:g} x": [Slowdown("gpu", f)] for f in (2.0, 10.0)},
    }


def robustness(
    seeds: Iterable[int],
    faults: Faults | None = None,
    *,
    runner: Runner | None = None,
    results: str | Path | None = None,
    progress: bool = True,
    **settings: Any,
) -> Robustness:
    """Drive the same worlds without a fault and with each fault in each severity.

    Args:
        seeds: of the worlds; the same for all, so that results are paired.
        faults: what to try; None: :func:`standard_faults`.
        runner: drives one world; None: :func:`robotbrain.pipeline.brain.drive` with ``settings``.
        results: JSON file that is written after every run; what it already holds (of the same settings) is not run
            again, so a test that was stopped goes on where it was.
        progress: show a progress bar.
        settings: for ``drive``, e.g. ``profile="nano-4gb", time_limit=60``.

    Raises:
        InputError: for no seeds, a results file that is none, or settings that ``drive`` refuses.
    """
    from tqdm import tqdm

    worlds = list(dict.fromkeys(int(seed) for seed in seeds))
    if not worlds:
        raise InputError("seeds", given="none", expected="at least one world", fix="range(7000, 7020), say.")
    chosen = standard_faults() if faults is None else faults
    cases: list[tuple[str, str, Sequence[Fault]]] = [(NOTHING, "", ())]
    cases += [(name, severity, found) for name, levels in chosen.items() for severity, found in levels.items()]
    drive_one = runner or _driver(settings)
    store = _Store(results)
    rows = []
    with tqdm(total=len(cases) * len(worlds), unit="drive", file=sys.stderr, disable=not progress or None) as bar:
        # World by world: a test that is stopped early has something to say about every fault.
        for seed in worlds:
            for name, severity, injected in cases:
                key = _key(seed, injected, settings)
                row = store.find(key, name, severity)
                if row is None:
                    row = _run(drive_one, seed, name, severity, injected)
                    store.add(key, row)
                rows.append(row)
                bar.update()
    order = {(name, severity): place for place, (name, severity, _) in enumerate(cases)}
    return Robustness(tuple(sorted(rows, key=lambda row: (order[row.fault, row.severity], row.seed))))


def _driver(settings: Mapping[str, Any]) -> Runner:
    from robotbrain.pipeline.brain import drive

    return lambda seed, attach: drive(seed, attach=[_quiet, *attach], **{"trace": True, **settings})


def _quiet(context: SimContext) -> None:
    # What nodes have to say about a fault would be said hundreds of times.
    context.log_sink = lambda _: None


def _run(drive_one: Runner, seed: int, name: str, severity: str, injected: Sequence[Fault]) -> Row:
    from robotbrain.ros import CallbackError

    try:
        run = drive_one(seed, [fault.install for fault in injected])
    except CallbackError as error:
        # A node that does not survive the fault: that is a result, not a reason to stop.
        cause = error.cause
        reason = f"{type(cause).__name__}: {cause}" if not isinstance(cause, RobotBrainError) else str(cause)
        return Row(name, severity, seed, False, reason, math.nan, math.nan, math.nan)
    latency = _latency_ms(run)
    p50, p99 = (float(v) for v in np.percentile(latency, [50, 99])) if len(latency) else (math.nan, math.nan)
    return Row(name, severity, seed, run.success, run.reason, run.seconds, p50, p99)


def _latency_ms(run: RunResult) -> NDArray[np.float64]:
    """Return the end-to-end latency of each command, ms: by what was published when, whatever was done to it since."""
    if run.trace is None:
        return run.e2e_ms
    try:
        return np.array(Chains(run.trace).oldest_ns(), dtype=np.float64) * 1e-6
    except InputError:
        return np.zeros(0)  # not one command had a measurement behind it


def _key(seed: int, injected: Sequence[Fault], settings: Mapping[str, Any]) -> str:
    """Return what identifies a run: its world, its faults with their parameters, and the settings."""
    words = f"{seed} {[repr(fault) for fault in injected]} {sorted((k, repr(v)) for k, v in settings.items())}"
    return hashlib.sha256(words.encode()).hexdigest()[:24]


class _Store:
    """Rows in a JSON file, by key."""

    def __init__(self, path: str | Path | None) -> None:
        self._path = None if path is None else Path(path)
        self._rows: dict[str, dict[str, Any]] = {}
        if self._path is not None and self._path.exists():
            try:
                stored = json.loads(self._path.read_text(encoding="utf-8"))
                self._rows = dict(stored["rows"])
            except (ValueError, KeyError, TypeError) as error:
                raise InputError(
                    "results file",
                    given=str(self._path),
                    expected="a file that robustness() wrote",
                    fix="Choose another name; it would be overwritten.",
                ) from error

    def find(self, key: str, fault: str, severity: str) -> Row | None:
        found = self._rows.get(key)
        if found is None:
            return None
        values: dict[str, Any] = {name: math.nan if value is None else value for name, value in found.items()}
        values.update(fault=fault, severity=severity)
        return Row(**values)

    def add(self, key: str, row: Row) -> None:
        self._rows[key] = plain(asdict(row))
        if self._path is not None:
            write_text(self._path, json.dumps({"rows": self._rows}, indent=1) + "\n")
