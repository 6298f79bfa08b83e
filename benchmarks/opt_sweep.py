"""Is the course's Pareto sweep done within ten minutes, and what does it find?

Runs the default sweep into a fresh folder (or goes on in --out), prints the time it took, its table, and the best
compositions on the test split, which nothing was chosen on. With --interrupt it is killed after that many seconds, goes
on, and the rows of before must be there unchanged.

Usage: python benchmarks/opt_sweep.py [--out DIR] [--test-images 800] [--interrupt 60]
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from robotbrain.figures import save
from robotbrain.jetson.tables import format_table
from robotbrain.optimisation.data import scenes
from robotbrain.optimisation.evaluate import mean_iou
from robotbrain.optimisation.sweep import MODULES, RESULTS, Sweep, complete, front_of, load_rows
from robotbrain.optimisation.sweep_plots import plot_sweep
from robotbrain.optimisation.sweep_report import table_rows, write_sweep_report


def interrupted(out: Path, seconds: float) -> int:
    """Start the sweep as a process, kill it, and return how many rows it left."""
    command = [sys.executable, "-m", "robotbrain.cli", "optimise", "sweep", "--out", str(out)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            process.wait(seconds)
        except subprocess.TimeoutExpired:
            process.kill()
    return len(load_rows(out)) if (out / RESULTS).is_file() else 0


def main() -> None:
    """Run it and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--test-images", type=int, default=800)
    parser.add_argument("--interrupt", type=float, metavar="SECONDS")
    arguments = parser.parse_args()
    out = arguments.out or Path(tempfile.mkdtemp(prefix="sweep."))
    begin = time.perf_counter()
    before: list[dict[str, object]] = []
    if arguments.interrupt:
        count = interrupted(out, arguments.interrupt)
        before = [dict(row) for row in load_rows(out)] if count else []
        print(f"killed after {arguments.interrupt:g} s with {count} rows")
    rows = Sweep(out=out).run()
    minutes = (time.perf_counter() - begin) / 60
    print(f"{len(rows)} compositions in {minutes:.1f} minutes, {sum('error' in row for row in rows)} errors")
    if before:
        print(f"rows of before the kill unchanged: {rows[: len(before)] == before}")
    again = time.perf_counter()
    same = Sweep(out=out).run(progress=False) == rows
    print(f"once more: {time.perf_counter() - again:.1f} s, same rows: {same}")
    good = complete(rows)
    head, body = table_rows(good, MODULES)
    print(format_table(head, body))

    test = scenes("test", arguments.test_images, progress=True)
    chosen = {row["label"]: row for where in ("host", *MODULES) for row in front_of(rows, where)}
    reference = mean_iou(out / good[0]["onnx"], test).mean
    lines = []
    for label, row in chosen.items():
        iou = mean_iou(out / row["onnx"], test, optimise=row["precision"] == "fp32").mean
        lines.append([label, f"{iou:.4f}", f"{100 * (reference - iou):+.2f}", f"{row['drop']:+.2f}"])
    print(f"\nTest split, {len(test)} images; teacher {reference:.4f}")
    print(format_table(["on a Pareto front", "mIoU", "lost, test", "lost, validation"], lines))
    print(save(plot_sweep(rows), out / "sweep.png", dpi=150))
    print(write_sweep_report(rows, out / "report.html"))


if __name__ == "__main__":
    main()
