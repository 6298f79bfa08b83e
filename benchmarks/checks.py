"""How long a student waits for the answer of each `check` cell, and what every failing check says.

Run: ``python benchmarks/checks.py [LAB ...] [--kind reference|stub]``. The cells of a lab run in one process, top to
bottom, like in a kernel. At each check cell three times are taken, in CPU seconds of the process and its children:

- *first*: the first time in a fresh kernel, with whatever is imported and prepared then;
- *again*: the same answer once more, and the tests of all that it builds on too, as after an edit;
- *alone*: the exercise's own tests of that second time.

CPU time is what the answer would take on an idle machine; a busy one adds waiting.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parents[1]
AIM_S = 1.0


@dataclass(frozen=True)
class Row:
    """What one check took, in s."""

    lab: str
    kind: str
    exercise: str
    first: float
    again: float
    alone: float
    slowest: str

    def text(self) -> str:
        """The row of the table, marked where somebody waits."""
        late = " LATE" if self.again > AIM_S else ""
        cells = (self.lab, self.kind, self.exercise, f"{self.first:.2f}", f"{self.again:.2f}", f"{self.alone:.2f}")
        return f"| {' | '.join(cells)} | {self.slowest} |{late}"


def cpu_seconds() -> float:
    """CPU time of this process and of those it has waited for, in s."""
    spent = os.times()
    return spent.user + spent.system + spent.children_user + spent.children_system


def time_lab(name: str, kind: str) -> Iterator[Row]:
    """Run a lab's cells in this process and time its checks."""
    from robotbrain.grading import Lab
    from robotbrain.grading.course import find_course
    from robotbrain.grading.marks import SCORED
    from robotbrain.grading.sample import Reference

    reference = Reference(find_course(REPOSITORY), name)
    notebooks = reference.copy() if kind == "reference" else reference.stubs
    names: dict[str, Any] = {"__name__": "__main__"}
    for notebook in notebooks.values():
        for cell in notebook.cells:
            checks = cell.source.startswith("lab.check(")
            skipped = "skip-grading" in cell.metadata.get("tags", []) and not checks
            if cell.cell_type != "code" or skipped or SCORED.search(cell.source):
                continue
            if checks:
                lab: Lab = names["lab"]
                yield time_check(lab, kind, cell.source.split('"')[1])
                continue
            with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(NotImplementedError):
                exec(compile(cell.source, f"<{cell.id}>", "exec"), names)


def time_check(lab: Any, kind: str, exercise: str) -> Row:
    """Time one check, first and again."""
    with contextlib.redirect_stdout(io.StringIO()):
        start = cpu_seconds()
        lab.check(exercise)
        first = cpu_seconds() - start
        lab._runs._runs.clear()  # what an edit of an earlier cell would do
        start, wall = cpu_seconds(), time.perf_counter()
        report = lab.check(exercise)
        again, waited = cpu_seconds() - start, time.perf_counter() - wall
    own = sum(result.seconds for result in report.results)
    longest = max(report.results, key=lambda result: result.seconds)
    # Seconds of a test are wall time; of this process' CPU time they are the same share.
    return Row(
        lab.name, kind, exercise, first, again, again * own / max(waited, 1e-9), f"{longest.name} {longest.seconds:.2f}"
    )


def run_here(lab: str, kind: str) -> None:
    """Time one lab in a copy of its folder, with the files that its reference hands in, and print the rows."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(shutil.copytree(REPOSITORY / "solutions" / lab, Path(folder) / lab))
        handed_in = REPOSITORY / "autograder" / "reference" / lab
        if kind == "reference" and handed_in.is_dir():
            shutil.copytree(handed_in, place, dirs_exist_ok=True)
        os.chdir(place)
        for row in time_lab(lab, kind):
            print(row.text(), flush=True)
        os.chdir(REPOSITORY)


def main() -> int:
    """Time the labs, each in a process of its own, and print one table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("labs", nargs="*", metavar="LAB", help="default: every lab")
    parser.add_argument("--kind", choices=("reference", "stub"), help="answers: right or missing (default: both)")
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    kinds = [arguments.kind] if arguments.kind else ["reference", "stub"]
    if arguments.here:
        run_here(arguments.labs[0], kinds[0])
        return 0
    labs = arguments.labs or sorted(p.name for p in (REPOSITORY / "solutions").iterdir() if any(p.glob("*.ipynb")))
    print("| lab | answers | check | first (CPU s) | again | alone | its slowest test, wall (s) |")
    print("| --- | --- | --- | --: | --: | --: | --- |", flush=True)
    failed = 0
    for lab in labs:
        for kind in kinds:
            command = [sys.executable, __file__, lab, "--kind", kind, "--here"]
            failed += subprocess.run(command, env=os.environ | {"OMP_NUM_THREADS": "1"}, check=False).returncode != 0
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
