"""Runs a submitted notebook so that whatever one cell does, the other cells still count.

A cell that ends or hangs the kernel is recorded with the reason, the kernel is started anew, and the notebook runs
again without that cell. A *test* that ends the kernel is left out instead (see :mod:`robotbrain.grading.journal`), so
that an exercise loses that test and no more. Every graded cell ends with an output that nbgrader can read.
"""

from __future__ import annotations

import json
import os
import re
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nbclient.client import NotebookClient
from nbformat.notebooknode import NotebookNode, from_dict

from robotbrain.grading import journal
from robotbrain.grading.kernel import CellEnd, CellLimits, Kernel
from robotbrain.grading.report import SCORE_MIME
from robotbrain.grading.suite import AUTOGRADER_VARIABLE, SUITES_VARIABLE

SKIP_TAGS = {"skip-grading", "skip-execution"}  # the second is nbclient's own, which Validate heeds too
JOB_VARIABLE = "ROBOTBRAIN_JOB"
_KEPT_VARIABLES = re.compile(
    r"PATH|HOME|USER|LOGNAME|LANG|LC_\w+|TZ|TMP|TEMP|TMPDIR|SYSTEMROOT|SYSTEMDRIVE|COMSPEC|PATHEXT|APPDATA|"
    r"LOCALAPPDATA|PROGRAMDATA|USERPROFILE|LD_LIBRARY_PATH|DYLD_\w+|VIRTUAL_ENV|CONDA_\w+|PYTHONPATH|PYTHONHASHSEED|"
    r"JUPYTER_\w+|MPLCONFIGDIR|XDG_\w+|ROBOTBRAIN_TIME_SCALE|COVERAGE_\w+",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class Limits:
    """Limits of a grading run.

    Attributes:
        cell_s: time for an ordinary cell (s).
        graded_s: time for a graded cell, whose tests have limits of their own (s).
        grace_s: time to react to the interrupt before the kernel is killed (s).
        wall_s: time for the whole notebook, restarts included (s).
        output_bytes: output kept of one cell (bytes); the rest is dropped as it arrives.
        poisoned: how many cells may end the kernel before the rest is not run.
        restarts: how many times the kernel is started again, for cells and tests together.
    """

    cell_s: float = 120.0
    graded_s: float = 300.0
    grace_s: float = 5.0
    wall_s: float = 900.0
    output_bytes: int = 1_000_000
    poisoned: int = 3
    restarts: int = 8


@dataclass
class Execution:
    """What happened while a notebook ran."""

    notebook: NotebookNode
    incidents: list[str] = field(default_factory=list)
    seconds: float = 0.0


@dataclass
class _Plan:
    """What the next pass leaves out."""

    poisoned: dict[int, tuple[str, str]] = field(default_factory=dict)  # cell index -> (name, message) of its error
    crashed: list[tuple[str, str]] = field(default_factory=list)  # (exercise, test)


def is_graded(cell: Mapping[str, Any]) -> bool:
    """Whether nbgrader takes a score from running this cell (not a manually graded answer)."""
    nbgrader = cell["metadata"].get("nbgrader", {})
    return cell["cell_type"] == "code" and bool(nbgrader.get("grade")) and not nbgrader.get("solution")


def execute_notebook(
    notebook: NotebookNode,
    *,
    cwd: Path,
    limits: Limits | None = None,
    extra_env: Mapping[str, str] | None = None,
    on_progress: Callable[[NotebookNode], None] | None = None,
) -> Execution:
    """Run ``notebook`` in place in a kernel of its own; never raises for what the notebook does.

    Args:
        cwd: working directory of the kernel.
        extra_env: variables for the kernel beyond the few that are passed on (see :func:`kernel_env`).
        on_progress: called with the notebook after each cell, for a caller that may have to kill this process.
    """
    limits = limits or Limits()
    start = time.monotonic()
    deadline = start + limits.wall_s
    run = Execution(notebook)
    plan = _Plan()
    with tempfile.TemporaryDirectory(prefix="robotbrain-") as scratch:
        for attempt in range(limits.restarts + 1):
            log = Path(scratch) / f"journal-{attempt}"
            env = kernel_env(extra_env) | {
                journal.JOURNAL_VARIABLE: str(log),
                journal.CRASHED_VARIABLE: json.dumps(plan.crashed),
            }
            ended = _one_pass(notebook, cwd, env, limits, deadline, plan, run, on_progress)
            if ended is None:
                break
            index, end = ended
            if time.monotonic() >= deadline:
                run.incidents.append(f"the notebook ran longer than {limits.wall_s:g} s")
                note_not_run(notebook, index, f"the notebook used up its {limits.wall_s:g} s")
                break
            spent = _blame(notebook, index, end, journal.unfinished(log), limits, plan, run)
            if spent or attempt == limits.restarts:
                note_not_run(notebook, index + 1, "too many cells before this one ended the kernel")
                break
    run.incidents = list(dict.fromkeys(run.incidents))  # a pass repeats what the one before it met
    for cell in notebook.cells:
        if cell.cell_type == "code":
            make_gradable(cell)
    run.seconds = time.monotonic() - start
    return run


def kernel_env(extra: Mapping[str, str] | None = None) -> dict[str, str]:
    """The environment of a grading kernel: a few variables of this process, and ``extra``.

    What an operator keeps in the environment (tokens, database addresses) stays away from student code.
    """
    kept = {k: v for k, v in os.environ.items() if _KEPT_VARIABLES.fullmatch(k)}
    kept |= {k: os.environ[k] for k in (AUTOGRADER_VARIABLE, SUITES_VARIABLE, JOB_VARIABLE) if k in os.environ}
    # One thread each: several notebooks run side by side, and sums then come out the same on every machine.
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    fixed = {"NBGRADER_EXECUTION": "autograde", "PYTHONHASHSEED": "0", "PYDEVD_DISABLE_FILE_VALIDATION": "1"}
    return kept | threads | fixed | dict(extra or {})


def _one_pass(
    notebook: NotebookNode,
    cwd: Path,
    env: dict[str, str],
    limits: Limits,
    deadline: float,
    plan: _Plan,
    run: Execution,
    on_progress: Callable[[NotebookNode], None] | None,
) -> tuple[int, CellEnd] | None:
    """Run all cells; return the index of the cell that ended the kernel and how, or None if all ran."""
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs, cell.execution_count = [], None
    kernel = Kernel(cwd, env)
    try:
        for index, cell in enumerate(notebook.cells):
            if cell.cell_type != "code" or not cell.source.strip():
                continue
            if SKIP_TAGS & set(cell.metadata.get("tags", [])):
                cell.outputs = [_text("This cell is not run while grading.\n")]
                continue
            if index in plan.poisoned:
                cell.outputs = [_error(*plan.poisoned[index])]
                continue
            allowed = limits.graded_s if is_graded(cell) else limits.cell_s
            left = deadline - time.monotonic()
            seconds = max(0.1, min(allowed, left))
            end = _run_cell(kernel, notebook, index, seconds, limits)
            if end is CellEnd.INTERRUPTED:
                note = f"did not finish in {seconds:.0f} s and was interrupted"
                cell.outputs.insert(0, _text(f"This cell {note}.\n"))
                run.incidents.append(f"{_label(cell, index)}: this cell {note}")
            if end in (CellEnd.DIED, CellEnd.HUNG) or time.monotonic() >= deadline:
                return index, end
            if on_progress is not None:
                on_progress(notebook)
        return None
    finally:
        kernel.kill()


def _run_cell(kernel: Kernel, notebook: NotebookNode, index: int, timeout_s: float, limits: Limits) -> CellEnd:
    cell = notebook.cells[index]
    # knows how messages become outputs: display ids, clear_output, widgets
    keeper = NotebookClient(notebook, record_timing=False)
    keeper.clear_before_next_output = False
    size = 0

    def keep(message: dict[str, Any]) -> None:
        nonlocal size
        length = len(json.dumps(message["content"], default=str))
        size += length
        # The score, or why there is none, is kept after a flood, unless it is a flood itself.
        is_result = message["msg_type"] in ("execute_result", "error") and length <= limits.output_bytes
        if size <= limits.output_bytes or is_result:
            keeper.process_message(message, cell, index)

    end = kernel.run(cell.source, CellLimits(timeout_s, limits.grace_s), keep)
    if size > limits.output_bytes:
        cell.outputs.append(_text(f"Output beyond {limits.output_bytes} bytes was dropped.\n"))
    cell.outputs = _merged(cell.outputs)
    return end


def _blame(
    notebook: NotebookNode,
    index: int,
    end: CellEnd,
    unfinished: tuple[str, str] | None,
    limits: Limits,
    plan: _Plan,
    run: Execution,
) -> bool:
    """Put the test or the cell that ended the kernel on the list of what to leave out; True if the list is full."""
    did = "ended the kernel" if end is CellEnd.DIED else "hung and did not react to an interrupt"
    if unfinished is not None and unfinished not in plan.crashed:
        exercise, test = unfinished
        again = any(e == exercise for e, _ in plan.crashed)
        # A second crash, or a hang, which costs minutes: the rest of this exercise's tests would do the same.
        plan.crashed.append((exercise, journal.ALL_TESTS) if again or end is CellEnd.HUNG else unfinished)
        if end is CellEnd.HUNG:
            plan.crashed.append(unfinished)
        run.incidents.append(f"{exercise}: the code {did} during the test {test!r}")
        return False
    cell = notebook.cells[index]
    allowed = limits.graded_s if is_graded(cell) else limits.cell_s
    message = (
        "this cell ended the kernel"
        if end is CellEnd.DIED
        else f"this cell did not finish in {allowed:g} s and did not react to an interrupt"
    )
    plan.poisoned[index] = ("KernelEnded" if end is CellEnd.DIED else "CellTimeoutError", message)
    run.incidents.append(f"{_label(cell, index)}: {message}")
    cell.outputs = [_error(*plan.poisoned[index]), *cell.outputs]  # nbgrader stops at the first
    return len(plan.poisoned) > limits.poisoned


def _label(cell: NotebookNode, index: int) -> str:
    return str(cell.metadata.get("nbgrader", {}).get("grade_id") or f"cell {index + 1}")


def note_not_run(notebook: NotebookNode, start: int, why: str) -> None:
    """Give every graded cell from index ``start`` on that has no result an error that says why."""
    for cell in notebook.cells[start:]:
        if is_graded(cell) and not _has_result(cell):
            cell.outputs = [_error("NotRun", f"not run: {why}"), *cell.outputs]


def make_gradable(cell: NotebookNode) -> None:
    """Make a code cell's outputs such that nbgrader's rule gives the points that were earned.

    Nbgrader gives nothing to a cell that wrote to stderr, everything to one without a result, and stops at a result
    above the cell's points. So stderr becomes labelled text, and a scoring cell without a sane score gets an error.
    """
    if not is_graded(cell):
        return
    outputs = []
    for output in cell.outputs:
        if output.output_type == "stream" and output.name == "stderr":
            output = _text("[stderr] " + output.text)
        outputs.append(output)
    cell.outputs = _merged(outputs)
    if any(o.output_type == "error" for o in cell.outputs):
        return
    results = [o for o in cell.outputs if o.output_type == "execute_result"]
    points = float(cell.metadata["nbgrader"].get("points", 0))
    if ".score(" in cell.source:
        scores = [o for o in results if SCORE_MIME in o.data]
        if not scores or not 0 <= _number(scores[-1]) <= points:
            cell.outputs = [_error("NoScore", "this cell did not return a score"), *cell.outputs]
    elif results and _number(results[0]) > points:
        cell.outputs = [_error("NoScore", f"this cell returned more than its {points:g} points"), *cell.outputs]


def _number(output: NotebookNode) -> float:
    try:
        return float(output.data.get("text/plain", ""))
    except (TypeError, ValueError):
        return float("nan")


def _has_result(cell: NotebookNode) -> bool:
    return any(o.output_type in ("execute_result", "error") for o in cell.outputs)


def _merged(outputs: list[NotebookNode]) -> list[NotebookNode]:
    """Join neighbouring pieces of the same stream: a kernel sends prints in many pieces."""
    merged: list[NotebookNode] = []
    for output in outputs:
        last = merged[-1] if merged else None
        if last is not None and output.output_type == last.output_type == "stream" and output.name == last.name:
            last.text += output.text
        else:
            merged.append(output)
    return merged


def _text(text: str) -> NotebookNode:
    return from_dict({"output_type": "stream", "name": "stdout", "text": text})


def _error(name: str, message: str) -> NotebookNode:
    return from_dict({"output_type": "error", "ename": name, "evalue": message, "traceback": [f"{name}: {message}"]})
