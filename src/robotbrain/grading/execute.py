"""What a run of a submission is bounded by, what comes of it, and the rules by which nbgrader's points follow.

Every graded cell ends with an output that nbgrader can read: a score, or an error that says why there is none. The
run itself is in :mod:`robotbrain.grading.executor`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from nbformat.notebooknode import NotebookNode

from robotbrain.grading import outputs
from robotbrain.grading.report import SCORE_MIME

SKIP_TAGS = {"skip-grading", "skip-execution"}  # the second is nbclient's own, which Validate heeds too


@dataclass(frozen=True)
class Limits:
    """Limits of a grading run.

    Attributes:
        cell_s: time for an ordinary cell (s).
        graded_s: time for a graded cell, whose tests have limits of their own (s).
        grace_s: time to react to the interrupt before the process is killed (s).
        wall_s: time for all ordinary cells, restarts included, and again for all tests (s).
        output_bytes: output kept of one cell (bytes); the rest is dropped as it arrives.
        poisoned: how many cells may end the process before the rest is not run.
        restarts: how many times the process is started again.
        memory_bytes: memory of all its processes together, and address space of each beyond what it starts with.
        disk_bytes: its private file system, which lies in memory.
        processes: how many processes and threads it may have.
    """

    cell_s: float = 120.0
    graded_s: float = 300.0
    grace_s: float = 5.0
    wall_s: float = 900.0
    output_bytes: int = 1_000_000
    poisoned: int = 3
    restarts: int = 8
    memory_bytes: int = 2 << 30
    disk_bytes: int = 256 << 20
    processes: int = 128


@dataclass
class Execution:
    """What happened while a notebook ran.

    Attributes:
        incidents: what went wrong, one sentence each.
        seconds: wall time (s).
        layers: names of the protections that held (see :mod:`robotbrain.grading.sandbox.layers`).
        sound: False if the grader or its machine failed: such a result is not to be kept.
    """

    notebook: NotebookNode
    incidents: list[str] = field(default_factory=list)
    seconds: float = 0.0
    layers: list[str] = field(default_factory=list)
    sound: bool = True


def is_graded(cell: Mapping[str, Any]) -> bool:
    """Whether nbgrader takes a score from running this cell (not a manually graded answer)."""
    nbgrader = cell["metadata"].get("nbgrader", {})
    return cell["cell_type"] == "code" and bool(nbgrader.get("grade")) and not nbgrader.get("solution")


def label(cell: NotebookNode, index: int) -> str:
    """How incidents call a cell."""
    return str(cell.metadata.get("nbgrader", {}).get("grade_id") or f"cell {index + 1}")


def note_not_run(notebook: NotebookNode, start: int, why: str) -> None:
    """Give every graded cell from index ``start`` on that has no result an error that says why."""
    for cell in notebook.cells[start:]:
        if is_graded(cell) and not any(o.output_type in ("execute_result", "error") for o in cell.outputs):
            cell.outputs = [outputs.error("NotRun", f"not run: {why}"), *cell.outputs]


def make_gradable(cell: NotebookNode) -> None:
    """Make a code cell's outputs such that nbgrader's rule gives the points that were earned.

    Nbgrader gives nothing to a cell that wrote to stderr, everything to one without a result, and stops at a result
    above the cell's points. So stderr becomes labelled text, and a scoring cell without a sane score gets an error.
    """
    if not is_graded(cell):
        return
    kept = []
    for output in cell.outputs:
        if output.output_type == "stream" and output.name == "stderr":
            output = outputs.stream("[stderr] " + output.text)
        kept.append(output)
    cell.outputs = outputs.merged(kept)
    if any(o.output_type == "error" for o in cell.outputs):
        return
    results = [o for o in cell.outputs if o.output_type == "execute_result"]
    points = float(cell.metadata["nbgrader"].get("points", 0))
    if ".score(" in cell.source:
        scores = [o for o in results if SCORE_MIME in o.data]
        if not scores or not 0 <= _number(scores[-1]) <= points:
            cell.outputs = [outputs.error("NoScore", "this cell did not return a score"), *cell.outputs]
    elif results and _number(results[0]) > points:
        message = f"this cell returned more than its {points:g} points"
        cell.outputs = [outputs.error("NoScore", message), *cell.outputs]


def _number(output: NotebookNode) -> float:
    try:
        return float(output.data.get("text/plain", ""))
    except (TypeError, ValueError):
        return float("nan")
