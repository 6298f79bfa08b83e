"""``robotbrain jetson calibrate``: fit the twin to the published measurements, say how well it does, store it."""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotbrain.errors import InputError
from robotbrain.jetson.tables import format_table

if TYPE_CHECKING:
    from robotbrain.jetson.twin.calibrate import CalibrationRun

TOLERANCE = 1e-3
"""By how much stored and new numbers may differ, relative or absolute: other linear algebra rounds otherwise."""


def calibrate_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``robotbrain jetson calibrate``."""
    parser.epilog = (
        "It takes about half a minute. Stopped half-way (Ctrl-C), it leaves the stored calibration as it was."
    )
    parser.add_argument(
        "--check", action="store_true", help="write no calibration; exit code 1 if the stored one is out of date"
    )
    parser.add_argument("--report", type=Path, metavar="FILE.html", help="write a page with figures and all errors")


def calibrate_main(arguments: argparse.Namespace) -> int:
    """Calibrate; 1 if ``--check`` finds that the stored calibration differs."""
    from robotbrain.jetson.twin.calibrate import to_json, write_calibration

    if arguments.report is not None and arguments.report.suffix.lower() not in (".html", ".htm"):
        raise InputError("--report", given=str(arguments.report), expected="a name that ends in .html", fix="Add it.")
    run = run_with_bar()
    print(error_table(run))
    if arguments.report is not None:
        from robotbrain.jetson.report import write_report

        print(f"\nreport: {write_report(run, arguments.report)}")
    if arguments.check:
        found = differences(_stored(), json.loads(to_json(run.calibration)))
        for line in found[:10]:
            print(f"differs: {line}", file=sys.stderr)
        if found:
            print(
                f"The stored calibration is out of date in {len(found)} places: run `robotbrain jetson calibrate`.",
                file=sys.stderr,
            )
            return 1
        print("\nThe stored calibration is up to date.")
        return 0
    try:
        path = write_calibration(run.calibration)
    except OSError as error:
        raise InputError(
            "calibration",
            given=str(error),
            expected="a folder of profiles that can be written to",
            fix="Copy autograder/profiles and let ROBOTBRAIN_PROFILES name the copy.",
        ) from error
    print(f"\nwritten: {path}")
    return 0


def run_with_bar() -> CalibrationRun:
    """Calibrate with a progress bar on standard error (none where that is no terminal)."""
    from tqdm import tqdm

    from robotbrain.jetson.twin.calibrate import calibrate

    with tqdm(desc="leaving out one network at a time", unit="fit", file=sys.stderr, disable=None, leave=False) as bar:

        def progress(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        return calibrate(progress)


def error_table(run: CalibrationRun) -> str:
    """Return the errors on left-out rows as a table."""
    names = {
        "all": "each network left out in turn",
        "mixed": "  of these, harnesses with mixed architectures",
        "wall_power": "wall power, each network left out in turn",
    }
    rows = []
    for name, errors in run.calibration.errors.items():
        title = names.get(name, name if not name.startswith("without ") else f"all of {name.removeprefix('without ')}")
        cells = [_percent(errors.get(key)) for key in ("median", "p90", "within_20", "covered", "baseline_median")]
        rows.append((title, f"{errors['rows']:.0f}", *cells))
    head = ("left out", "rows", "median error", "90th pct", "within 20 %", "in 80 % interval", "FLOPs/peak median")
    return format_table(head, rows)


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f} %"


def _stored() -> Any:
    from robotbrain.jetson.paths import find_part
    from robotbrain.jetson.twin.calibrate import FILE

    path = find_part(f"calibration/{FILE}")
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(
            str(path), given=str(error), expected="a JSON file", fix="Run `robotbrain jetson calibrate` to make it."
        ) from error


def differences(stored: Any, made: Any, where: str = "") -> list[str]:
    """Return the places at which two calibrations differ by more than TOLERANCE, with both values."""
    if isinstance(stored, dict) and isinstance(made, dict):
        found = []
        for key in [*stored, *(key for key in made if key not in stored)]:
            place = f"{where}.{key}" if where else key
            if key not in stored or key not in made:
                found.append(f"{place} is only in the {'new' if key in made else 'stored'} one")
            else:
                found += differences(stored[key], made[key], place)
        return found
    if isinstance(stored, list) and isinstance(made, list) and len(stored) == len(made):
        pairs = enumerate(zip(stored, made, strict=True))
        return [line for index, (a, b) in pairs for line in differences(a, b, f"{where}[{index}]")]
    numbers = [not isinstance(value, bool) and isinstance(value, int | float) for value in (stored, made)]
    same = math.isclose(stored, made, rel_tol=TOLERANCE, abs_tol=TOLERANCE) if all(numbers) else _alike(stored, made)
    return [] if same else [f"{where}: {_shown(stored)} stored, {_shown(made)} now"]


def _alike(stored: object, made: object) -> bool:
    return type(stored) is type(made) and stored == made


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "..."
