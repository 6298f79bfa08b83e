"""What the sandbox costs: starting its fork servers, a student's process, a copy of it, a small submission; memory.

Run with ``python benchmarks/grading_sandbox.py``; the times are medians of ``--rounds``. The submission has three
ordinary cells and one graded cell of plain assertions, with the sandbox and the tester on.
"""

from __future__ import annotations

import argparse
import contextlib
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import psutil
from nbformat.notebooknode import NotebookNode
from nbformat.v4 import new_code_cell, new_notebook

from robotbrain.grading.bench import Bench
from robotbrain.grading.sandbox.process import CellLimits, StudentProcess


def submission() -> NotebookNode:
    """A small notebook with a graded cell."""
    sources = ["import numpy as np", "def double(x):\n    return 2 * x", "double(21)", "assert double(3) == 6"]
    notebook = new_notebook(cells=[new_code_cell(source) for source in sources])
    nbgrader = {"grade": True, "solution": False, "locked": True, "points": 1, "grade_id": "double"}
    notebook.cells[-1].metadata["nbgrader"] = nbgrader
    return notebook


def median_ms(action: Callable[[], object], rounds: int) -> float:
    """The median time of ``action`` (ms)."""
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        action()
        times.append(time.perf_counter() - start)
    return 1000 * statistics.median(times)


def proportional_mb(pid: int) -> float:
    """Memory of process ``pid``, what it shares counted in part (MB)."""
    return float(psutil.Process(pid).memory_full_info().pss) / 1e6


def python_below(pid: int) -> int:
    """The Python process below a wrapper, or the process itself."""
    found = [p for p in psutil.Process(pid).children(recursive=True) if p.name().startswith("python")]
    return found[0].pid if found else pid


def main() -> None:
    """Print one table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=20)
    rounds = parser.parse_args().rounds
    with tempfile.TemporaryDirectory() as folder, Bench(Path(folder)) as bench:
        rows = [
            ("student's fork server, start", 1000 * float(bench._students.warm_up()["ready"]), "ms"),
            ("tester's fork server, start", 1000 * float(bench._testers.warm_up()["ready"]), "ms"),
        ]
        server = python_below(bench._students._popen.pid)  # type: ignore[union-attr]
        rows.append(("student's fork server, memory alone", proportional_mb(server), "MB"))

        def start() -> StudentProcess:
            return bench.start_student(bench.limits, "amara", {})

        ready = []
        for _ in range(rounds):
            begun = time.perf_counter()
            with start():
                ready.append(time.perf_counter() - begun)
        rows.append(("student's process, to ready", 1000 * statistics.median(ready), "ms"))
        rows.append(("student's process, to ready and gone", median_ms(lambda: start().close(), rounds), "ms"))
        with start() as process:
            limits = CellLimits(10.0, 1.0)
            number = iter(range(1, 10**6))
            run = median_ms(lambda: process.run("x = 1", next(number), limits, lambda _: None), rounds)
            rows.append(("a cell", run, "ms"))
            rows.append(("student's process, memory of its own", process.peak_bytes() / 1e6, "MB"))
            copy = median_ms(lambda: contextlib.closing(process.snapshot()).__enter__(), rounds)  # type: ignore[type-var]
            rows.append(("a copy for a graded cell", copy, "ms"))
        whole = median_ms(lambda: bench.execute(submission(), lab="", student="amara", files={}), rounds)
        rows.append(("small submission, end to end", whole, "ms"))
        print("layers:", ", ".join(layer.name for layer in bench.layers if layer.active))
        for name, value, unit in rows:
            print(f"{name:40s} {value:8.1f} {unit}")


if __name__ == "__main__":
    main()
