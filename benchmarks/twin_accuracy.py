"""How well the Jetson twin predicts published rows that it has not seen.

Run with ``python benchmarks/twin_accuracy.py`` (about half a minute on one core); ``--families`` adds a fit for every
architecture family, left out of one harness at a time with everything of its kind. Errors are relative, of the median
row; ``in 80 %`` is the share of rows in their 80 % interval; the baseline is FLOPs over the dense peak times one
efficiency for the group, fitted to its other rows.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence

import numpy as np

from robotbrain.jetson.twin.calibrate import CalibrationRun, calibrate
from robotbrain.jetson.twin.data import LatencyRow, load_latency_rows
from robotbrain.jetson.twin.fit import Fitted
from robotbrain.jetson.twin.precisions import architecture_of
from robotbrain.jetson.twin.validate import MIXED_HARNESSES, Z80, LeftOut, predict_left_out, summarise

HEAD = ("rows", "median", "p90", "within 20 %", "bias", "in 80 %", "baseline", "ratio")
WIDTHS = (6, 8, 8, 12, 8, 8, 9, 7)


def line(name: str, items: Sequence[LeftOut], scale: float) -> str:
    """Return one line of the table."""
    if not items:
        return f"{name:34}" + "no rows".rjust(WIDTHS[0] + 8)
    found = summarise(items)
    bias = math.exp(float(np.median([math.log(i.predicted_ms / i.row.latency_ms) for i in items]))) - 1
    inside = float(np.mean([abs(i.z) <= Z80 * scale for i in items]))
    cells = [f"{found.rows}", f"{found.median:.1%}", f"{found.p90:.1%}", f"{found.within_20:.0%}", f"{bias:+.1%}"]
    cells.append(f"{inside:.0%}")
    if math.isnan(found.baseline_median):
        cells += ["-", "-"]
    else:
        cells += [f"{found.baseline_median:.0%}", f"{found.baseline_median / found.median:.1f}x"]
    return f"{name:34}" + "".join(cell.rjust(width) for cell, width in zip(cells, WIDTHS, strict=True))


def grouped(items: Sequence[LeftOut], key: Callable[[LatencyRow], str]) -> dict[str, list[LeftOut]]:
    """Return items by the value of ``key``, sorted by it."""
    groups: dict[str, list[LeftOut]] = {}
    for item in items:
        groups.setdefault(key(item.row), []).append(item)
    return dict(sorted(groups.items()))


def families_left_out(fitted: Fitted) -> dict[str, list[LeftOut]]:
    """Leave out whole architecture families, one harness at a time."""
    rows = load_latency_rows()
    result: dict[str, list[LeftOut]] = {}
    for unit in sorted({(row.harness, architecture_of(row)) for row in rows}):

        def keep(row: LatencyRow, unit: tuple[str, str] = unit) -> bool:
            return (row.harness, architecture_of(row)) != unit

        result[f"{unit[0]} without {unit[1]}"] = predict_left_out(rows, keep, fitted)
    return result


def harnesses_left_out(fitted: Fitted) -> dict[str, list[LeftOut]]:
    """Leave out whole harnesses: what carrying over to one that nobody published rows of (trtexec) is worth."""
    rows = load_latency_rows()
    return {
        f"without {harness}": predict_left_out(rows, lambda row, out=harness: row.harness != out, fitted)  # type: ignore[misc]
        for harness in sorted({row.harness for row in rows})
    }


def outside(run: CalibrationRun) -> list[LeftOut]:
    """Predict the rows that are kept as a look from outside."""
    rows = [*load_latency_rows(), *load_latency_rows(uses=("check",))]
    return predict_left_out(rows, lambda row: row.use == "fit", run.calibration.latency)


def report(families: bool) -> None:
    """Print the table."""
    run = calibrate()
    scale = run.calibration.scale
    print(f"{'':34}" + "".join(name.rjust(width) for name, width in zip(HEAD, WIDTHS, strict=True)))
    print("Leave-one-out: each network in turn, on one module, precision and harness")
    print(line("  all", run.left_out, scale))
    print(line("  mixed architectures", [i for i in run.left_out if i.row.harness in MIXED_HARNESSES], scale))
    for name, items in grouped(run.left_out, lambda row: row.harness).items():
        print(line(f"  {name}", items, scale))
    for name, items in grouped(run.left_out, lambda row: f"{row.module} {row.precision} {row.harness}").items():
        print(line(f"    {name}", items, scale))
    print("A module left out, predicted from the others")
    for slug, items in run.transfer.items():
        print(line(f"  {slug}", items, scale))
        for name, part in grouped(items, lambda row: row.harness).items():
            print(line(f"    {name}", part, scale))
    print("Rows that are in no fit (host programs of others, end to end; predicted as trtexec)")
    for name, items in grouped(outside(run), lambda row: row.module).items():
        print(line(f"  {name}", items, scale))
    print("A harness left out")
    for name, items in harnesses_left_out(run.calibration.latency).items():
        print(line(f"  {name}", items, scale))
    if families:
        print("An architecture family left out of a harness")
        left_out = families_left_out(run.calibration.latency)
        print(line("  all", [item for items in left_out.values() for item in items], scale))
        for name, items in left_out.items():
            print(line(f"  {name}", items, scale))
    print("Wall power, each network left out on its module")
    powers = {"all": run.power}
    for row, error in run.power:
        powers.setdefault(row.module, []).append((row, error))
    for name, pairs in powers.items():
        errors = np.abs([error for _, error in pairs])
        cells = [f"{len(pairs)}", f"{np.median(errors):.1%}", f"{np.percentile(errors, 90):.1%}"]
        cells += [f"{np.mean(errors <= 0.2):.0%}", f"{np.median([error for _, error in pairs]):+.1%}"]
        print(f"  {name:32}" + "".join(cell.rjust(width) for cell, width in zip(cells, WIDTHS[:5], strict=True)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--families", action="store_true", help="leave out architecture families as well")
    report(parser.parse_args().families)


if __name__ == "__main__":
    main()
