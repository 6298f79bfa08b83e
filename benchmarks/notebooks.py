"""How long every notebook takes from a clean kernel, beside the time that it states.

Run with ``python benchmarks/notebooks.py`` (``course/08* --again`` for some, anew; ``--write`` keeps the figures in
benchmarks/notebook_times.json, which tests compare with what the notebooks say). Lessons run where they are, labs as
their solutions in a copy of their folder, homework 1 with its own training. One after the other; what has run already
with the same bytes is not run again, so the same command goes on after Ctrl-C.

Two times are given. Wall is what a clock on the wall says, and depends on who else uses the machine. CPU is what the
kernel and its children used, user and system together: with one thread (``OMP_NUM_THREADS=1``) on an idle machine the
two agree, and where threads work side by side CPU is the larger one. It needs no quiet machine, so it is what a stated
time is compared with.
"""

from __future__ import annotations

import argparse
import datetime
import hashlib
import json
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import nbformat
import psutil
from nbclient import NotebookClient

from robotbrain.files import write_text
from robotbrain.grading.suite import AUTOGRADER_VARIABLE
from robotbrain.notebooks import stated_seconds

REPOSITORY = Path(__file__).resolve().parents[1]
KEPT = Path(__file__).with_name("notebook_times.json")
CELL_LIMIT_S = 1800
SLOWEST = 3


def cpu_seconds(process: psutil.Process) -> float:
    """Return the CPU time of a process and its children, those that have ended included, in s."""
    total = 0.0
    for one in (process, *process.children(recursive=True)):
        try:
            times = one.cpu_times()
        except psutil.NoSuchProcess:
            continue
        total += times.user + times.system + times.children_user + times.children_system
    return total


@contextmanager
def place_of(path: Path) -> Iterator[Path]:
    """Yield the folder to run a notebook in: its own for a lesson, a copy for a lab, which writes files."""
    if path.parent.name == "course":
        yield path.parent
        return
    with tempfile.TemporaryDirectory() as folder:
        yield Path(shutil.copytree(path.parent, Path(folder) / path.parent.name))


class Clock:
    """Times the cells of a notebook while it runs."""

    def __init__(self) -> None:
        self.cells: dict[str, float] = {}
        self.kernel: psutil.Process | None = None
        self.before = 0.0

    def watch(self, client: NotebookClient) -> None:
        """Find the kernel of a client that has started one."""
        if self.kernel is None:
            self.kernel = psutil.Process(client.km.provisioner.process.pid)

    def total(self) -> float:
        """CPU seconds of the kernel so far, its start included."""
        return cpu_seconds(self.kernel) if self.kernel else 0.0


def run(path: Path) -> dict[str, Any]:
    """Run a notebook from a clean kernel and return its times, in s.

    Raises:
        nbclient.exceptions.CellExecutionError: where a cell fails.
    """
    notebook, clock = nbformat.read(path, as_version=4), Clock()

    def begin(cell: Any, **_: Any) -> None:
        clock.watch(client)
        clock.before = clock.total()

    def end(cell: Any, **_: Any) -> None:
        clock.cells[cell.id] = round(clock.total() - clock.before, 2)

    with place_of(path) as folder:
        client = NotebookClient(
            notebook,
            timeout=CELL_LIMIT_S,
            resources={"metadata": {"path": str(folder)}},
            on_cell_execute=begin,
            on_cell_executed=end,
        )
        start = time.perf_counter()
        client.execute()
        wall = time.perf_counter() - start
    slowest = sorted(clock.cells.items(), key=lambda item: -item[1])[:SLOWEST]
    # The kernel is gone by now; what it used before its first cell (imports of its own) is within half a second.
    cpu = sum(clock.cells.values())
    return {"wall_s": round(wall, 1), "cpu_s": round(cpu, 1), "slowest": dict(slowest)}


def digest(path: Path) -> str:
    """Return what tells one text of a notebook from another."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def row(name: str, stated: float | None, times: dict[str, Any]) -> str:
    """Return a line of the table."""
    cells = ", ".join(f"{cell} {seconds:.1f}" for cell, seconds in times["slowest"].items())
    said = "-" if stated is None else f"{stated:.0f}"
    late = "  LATE" if stated is not None and times["cpu_s"] > stated else ""
    return f"| {name} | {said} | {times['cpu_s']:.1f} | {times['wall_s']:.1f} | {cells} |{late}"


def main() -> None:
    """Run the notebooks and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("notebooks", nargs="*", type=Path, help="default: all of course/ and solutions/")
    parser.add_argument("--state", type=Path, default=REPOSITORY / "build" / "notebook_times.json")
    parser.add_argument("--again", action="store_true", help="run also what has run already")
    parser.add_argument("--write", action="store_true", help=f"keep the figures in {KEPT.name}")
    arguments = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"
    os.environ.setdefault(AUTOGRADER_VARIABLE, str(REPOSITORY / "autograder"))  # solutions call their hidden tests
    paths = [path.resolve() for path in arguments.notebooks] or sorted(
        path for folder in ("course", "solutions") for path in (REPOSITORY / folder).rglob("*.ipynb")
        if ".ipynb_checkpoints" not in path.parts
    )  # fmt: skip
    state = json.loads(arguments.state.read_text(encoding="utf-8")) if arguments.state.is_file() else {}
    print("| notebook | stated (s) | CPU (s) | wall (s) | slowest cells (CPU s) |\n| --- | --: | --: | --: | --- |")
    shown = {}
    for path in paths:
        name, mark = path.relative_to(REPOSITORY).as_posix(), digest(path)
        if arguments.again or state.get(name, {}).get("sha256") != mark:
            state[name] = {"sha256": mark, "date": datetime.date.today().isoformat(), **run(path)}
            arguments.state.parent.mkdir(parents=True, exist_ok=True)
            write_text(arguments.state, json.dumps(state, indent=1, sort_keys=True) + "\n")
        shown[name] = state[name]
        print(row(name, stated_seconds(path), state[name]), flush=True)
    lessons = [times for name, times in shown.items() if name.startswith("course/")]
    print(
        f"lessons together: {sum(t['cpu_s'] for t in lessons):.0f} s CPU, "
        f"{sum(t['wall_s'] for t in lessons):.0f} s on the wall"
    )
    if arguments.write:
        kept = json.loads(KEPT.read_text(encoding="utf-8")) if KEPT.is_file() else {}
        kept |= {name: {k: times[k] for k in ("cpu_s", "wall_s", "date")} for name, times in shown.items()}
        write_text(KEPT, json.dumps(kept, indent=1, sort_keys=True) + "\n")


if __name__ == "__main__":
    main()
