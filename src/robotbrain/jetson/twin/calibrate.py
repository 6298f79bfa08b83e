"""Calibrating the twin: fit to the published rows, cross-validate, store the result (``robotbrain jetson calibrate``).

The result, ``calibration/fit.json``, holds the coefficients with their covariance, the scale of the intervals, the
errors on left-out rows and a digest of the data it was made from; it is as reproducible as linear algebra is.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from robotbrain.errors import InputError
from robotbrain.files import write_text
from robotbrain.jetson.figures import read_text
from robotbrain.jetson.paths import find_part
from robotbrain.jetson.twin.data import (
    calibration_directory,
    data_digest,
    load_latency_rows,
    load_power_rows,
)
from robotbrain.jetson.twin.fit import Fitted, fit
from robotbrain.jetson.twin.latency import COMPONENTS, Effect
from robotbrain.jetson.twin.power import PowerFit, fit_power, power_errors
from robotbrain.jetson.twin.validate import (
    MIXED_HARNESSES,
    LeftOut,
    Summary,
    covered,
    interval_scale,
    leave_module_out,
    leave_one_out,
    samples,
    summarise,
)

FILE = "fit.json"
VERSION = 1
SIBLINGS = ("orin-nx-16gb", "orin-nano-8gb-super", "agx-orin-64gb")
"""Modules that are left out whole, to see how the model carries over to a module without measurements."""


@dataclass(frozen=True)
class Calibration:
    """A calibrated twin.

    Attributes:
        latency: coefficients of the latency model.
        power: coefficients of the power model.
        scale: factor on the latency model's log standard deviation with which 80 % intervals hold 80 % of rows.
        measured: (family, precision, harness) with calibration rows.
        digest: of the data it was made from.
        errors: summaries of the cross-validation, by name.
    """

    latency: Fitted
    power: PowerFit
    scale: float
    measured: frozenset[tuple[str, str, str]]
    digest: str
    errors: dict[str, dict[str, float]]


@dataclass(frozen=True)
class CalibrationRun:
    """A calibration with what its report shows.

    Attributes:
        calibration: the result.
        left_out: each row with what a model that never saw it says.
        transfer: the same for modules left out whole, by slug.
        power: each row of wall power with its relative leave-one-out error.
    """

    calibration: Calibration
    left_out: list[LeftOut]
    transfer: dict[str, list[LeftOut]]
    power: list[tuple[Any, float]]


def _numbers(summary: Summary) -> dict[str, float]:
    return {key: value for key, value in dataclasses.asdict(summary).items() if not math.isnan(value)}


def calibrate(progress: Callable[[int, int], None] | None = None) -> CalibrationRun:
    """Fit and cross-validate on everything in the calibration directory (about 15 s)."""
    rows = load_latency_rows()
    fitted = fit(samples(rows))
    left_out = leave_one_out(rows, fitted, progress)
    transfer = {slug: leave_module_out(rows, slug, fitted) for slug in SIBLINGS}
    power_rows = load_power_rows()
    powers = power_errors(power_rows)
    power_median = float(np.median([abs(error) for _, error in powers]))
    mixed = [item for item in left_out if item.row.harness in MIXED_HARNESSES]
    errors = {
        "all": {**_numbers(summarise(left_out)), "covered": covered(left_out)},
        "mixed": {**_numbers(summarise(mixed)), "covered": covered(mixed)},
        "wall_power": {"rows": float(len(powers)), "median": power_median},
    }
    for slug, items in transfer.items():
        errors[f"without {slug}"] = _numbers(summarise(items))
        # A harness that nobody ran on a sibling is no test of carrying over from one module to another.
        errors[f"without {slug}, ultralytics"] = _numbers(
            summarise([item for item in items if item.row.harness == "ultralytics"])
        )
    calibration = Calibration(
        latency=fitted,
        power=PowerFit(fit_power(power_rows).values, power_median),
        scale=interval_scale(left_out),
        measured=frozenset((row.where.family, row.precision, row.harness) for row in rows),
        digest=data_digest(),
        errors=errors,
    )
    return CalibrationRun(calibration, left_out, transfer, powers)


def to_json(calibration: Calibration) -> str:
    """Return a calibration as text: rounded well below what matters, so that it reads and compares well."""

    def short(value: float) -> float:
        return float(f"{value:.5g}")

    fitted = calibration.latency
    document = {
        "version": VERSION,
        "digest": calibration.digest,
        "interval_scale": short(calibration.scale),
        "measured": sorted("/".join(key) for key in calibration.measured),
        "errors": {name: {k: short(v) for k, v in summary.items()} for name, summary in calibration.errors.items()},
        "power": {name: short(value) for name, value in calibration.power.values.items()},
        "latency": {
            effect.name: [short(value), short(math.sqrt(variance))]
            for effect, value, variance in zip(fitted.effects, fitted.values, np.diag(fitted.covariance), strict=True)
        },
        "covariance": [[short(v) for v in row[: index + 1]] for index, row in enumerate(fitted.covariance)],
    }
    head = json.dumps({key: value for key, value in document.items() if key != "covariance"}, indent=1)
    rows = ",\n".join("  " + json.dumps(row) for row in document["covariance"])  # type: ignore[attr-defined]
    return head[:-2] + ',\n "covariance": [\n' + rows + "\n ]\n}\n"


def write_calibration(calibration: Calibration) -> Path:
    """Write the result beside the data; return where."""
    path = calibration_directory() / FILE
    write_text(path, to_json(calibration))
    return path


def _effect(name: str) -> Effect:
    component, _, key = name.removesuffix("]").partition("[")
    known = {c.name: c for c in COMPONENTS}[component]
    if not key:
        return Effect(component, "", known.mean, known.sd)
    attributes = "+".join(part.partition("=")[0] for part in key.split("+"))
    return Effect(component, key, 0.0, dict(known.effects)[attributes])


def parse_calibration(text: str, origin: str) -> Calibration:
    """Read a calibration.

    Raises:
        InputError: for anything but what :func:`to_json` writes.
    """
    try:
        data = json.loads(text)
        if data["version"] != VERSION:
            raise ValueError(f"version {data['version']}")
        effects = tuple(_effect(name) for name in data["latency"])
        values = np.array([value for value, _ in data["latency"].values()], dtype=float)
        size = len(values)
        missing = {component.name for component in COMPONENTS} - {effect.name for effect in effects}
        if missing:
            raise ValueError(f"no latency coefficients {sorted(missing)}")
        lower = np.zeros((size, size))
        if [len(row) for row in data["covariance"]] != list(range(1, size + 1)):
            raise ValueError(f"the covariance is not the lower half of {size} x {size} numbers")
        for index, row in enumerate(data["covariance"]):
            lower[index, : index + 1] = row
        covariance = lower + np.tril(lower, -1).T
        power = {str(k): float(v) for k, v in data["power"].items()}
        power_error = float(data["errors"]["wall_power"]["median"])
        missing = {"clock", "arithmetic", "memory"} - set(power)
        if missing:
            raise ValueError(f"no power coefficients {sorted(missing)}")
        scale = float(data["interval_scale"])
        numbers = [*values, *covariance.flat, *power.values(), power_error, scale]
        if not (np.isfinite(numbers).all() and scale > 0):
            raise ValueError("numbers that are not finite")
        return Calibration(
            Fitted(effects, values, covariance),
            PowerFit(power, power_error),
            scale,
            frozenset((a, b, c) for a, b, c in (key.split("/") for key in data["measured"])),
            str(data["digest"]),
            data["errors"],
        )
    except (ValueError, KeyError, TypeError, IndexError, AttributeError, RecursionError) as error:
        raise InputError(
            origin,
            given=f"{type(error).__name__}: {error}",
            expected="a calibration written by `robotbrain jetson calibrate`",
            fix="Run `robotbrain jetson calibrate` again, or restore the file from git.",
        ) from error


@functools.lru_cache(maxsize=4)
def _load(path: Path, _changed: int) -> Calibration:
    return parse_calibration(read_text(path, "text"), str(path))


def load_calibration() -> Calibration:
    """Return the stored calibration.

    Raises:
        InputError: if it is missing or damaged.
    """
    path = find_part(f"calibration/{FILE}")
    return _load(path, path.stat().st_mtime_ns)


def group_summaries(left_out: Sequence[LeftOut], key: Callable[[LeftOut], str]) -> dict[str, Summary]:
    """Return errors by the value of ``key``, sorted by it."""
    groups: dict[str, list[LeftOut]] = {}
    for item in left_out:
        groups.setdefault(key(item), []).append(item)
    return {name: summarise(groups[name]) for name in sorted(groups)}
