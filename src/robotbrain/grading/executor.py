"""Runs one submission: its cells in the student's process, its graded cells in the tester.

First the *pass*: every ordinary cell runs in order. At graded cells the student's process forks snapshots, which keep
the notebook as it is at that place (one for several where nothing can have changed, see
:mod:`robotbrain.grading.copies`). A cell that ends or hangs the process is left out, and the pass begins anew
in a fresh process. Then the *scoring*: nothing that the student's process says is listened to any more; the tester
asks the snapshots, first all visible tests, then all hidden ones, so that what a hidden test passes in cannot come
back in the report of a visible one. A test that ends its snapshot costs that test; the next ones get a fresh copy.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, Protocol

from nbformat.notebooknode import NotebookNode

from robotbrain.grading import outputs
from robotbrain.grading.copies import shared_copies
from robotbrain.grading.execute import SKIP_TAGS, Execution, Limits, is_graded, label, make_gradable, note_not_run
from robotbrain.grading.sandbox.process import CellEnd, CellLimits, StudentProcess
from robotbrain.grading.sandbox.snapshots import Snapshot
from robotbrain.grading.scoring import Graded, Scorer, question_of
from robotbrain.grading.tester_link import TesterProcess

STUDENT_PROCESS_TAG = "student-process"  # a graded cell that must see the student's process, e.g. its plots
_SHORTEST_S = 0.1
_LOST = "the student's process was ended from outside"


class Lost(Exception):  # noqa: N818 - what happened
    """The student's process was ended from outside: the grader's fault or the machine's, not the submission's."""


class Starter(Protocol):
    """What the executor needs of a :class:`~robotbrain.grading.bench.Bench`."""

    def start_student(self, limits: Limits, student: str, files: Mapping[str, bytes]) -> StudentProcess:
        """A fresh student's process with the submission's files."""

    def start_tester(
        self, lab: str, student: str, files: Mapping[str, bytes], sources: Sequence[Mapping[str, Any]]
    ) -> TesterProcess:
        """A fresh tester, which may read the sources of all code cells."""


@dataclass
class _State:
    """What the run has come to."""

    poisoned: dict[int, tuple[str, str]] = field(default_factory=dict)  # cell index -> (name, message) of its error
    restarts: int = 0
    incidents: list[str] = field(default_factory=list)


class Executor:
    """Runs one submission; used once.

    Args:
        starter: where processes come from.
        notebook: whose outputs are written in place; its locked cells must have been restored from the master.
        lab: the lab's name.
        student: who handed it in.
        files: the submission's further files.
        limits: of this run.
    """

    def __init__(
        self,
        starter: Starter,
        notebook: NotebookNode,
        *,
        lab: str,
        student: str,
        files: Mapping[str, bytes],
        limits: Limits,
    ) -> None:
        self._starter, self._notebook, self._limits = starter, notebook, limits
        self._lab, self._student, self._files = lab, student, files
        self._state = _State()
        self._layers: list[str] = []
        self._process: StudentProcess | None = None
        self._ahead: StudentProcess | None = None  # started, and not used yet
        self._tester_ahead: TesterProcess | None = None
        self._testing: TesterProcess | None = None
        self._stop = len(notebook.cells)  # cells from here on are not run
        self._graded = [
            Graded(index, cell, question_of(cell.source))
            for index, cell in enumerate(notebook.cells)
            if _for_tester(cell)
        ]
        self._by_index = {g.index: g for g in self._graded}

    def run(self) -> Execution:
        """Run everything; never raises for what the submission does.

        Raises:
            Lost, ServerDied, StartError: the machine failed; the submission can be run again.
        """
        start = time.monotonic()
        self._deadline = start + self._limits.wall_s
        # A process ends with the thread that started it: this one stays until all is over.
        helper = ThreadPoolExecutor(1, thread_name_prefix="start")
        try:
            self._prepare(helper)
            self._pass()
            graded = [g for g in self._graded if g.index < self._stop]
            if graded:
                Scorer(
                    graded,
                    start_tester=self._tester,
                    fresh=self._fresh,
                    memory_kills=lambda: self._process.out_of_memory() if self._process is not None else 0,
                    look=self._look,
                    limits=self._limits,
                    incidents=self._state.incidents,
                ).run()
                for cell in graded:
                    cell.cell.outputs = cell.outputs or []
        finally:
            helper.shutdown()  # first: what it starts is to be ended, too
            self._end_process()
            if self._ahead is not None:
                self._ahead.close()
            if self._tester_ahead is not None:
                self._tester_ahead.close()
        for cell in self._notebook.cells:
            if cell.cell_type == "code":
                make_gradable(cell)
        incidents = list(dict.fromkeys(self._state.incidents))
        return Execution(self._notebook, incidents, time.monotonic() - start, self._layers)

    def _prepare(self, helper: ThreadPoolExecutor) -> None:
        """Start the processes and see which copies are needed, side by side: a process in the making mostly waits."""
        started = helper.submit(self._start_ahead)
        try:
            cells = self._notebook.cells
            run = [i for i, c in enumerate(cells) if c.cell_type == "code" and not _skipped(c)]
            ordinary = [i for i in run if i not in self._by_index]
            self._served = shared_copies(cells, [i for i in run if i in self._by_index], ordinary, self._files)
            if self._graded:
                self._tester_ahead = self._start_tester()
        finally:
            started.result()

    def _start_ahead(self) -> None:
        self._ahead = self._start_student()

    # ------------------------------------------------------------------ the pass

    def _pass(self) -> None:
        """Run all ordinary cells, again without the one that ended the process."""
        while True:
            ended = self._one_pass()
            if ended is None:
                return
            index, end = ended
            if time.monotonic() >= self._deadline:
                self._state.incidents.append(f"the notebook ran longer than {self._limits.wall_s:g} s")
                self._stop_at(index, f"the notebook used up its {self._limits.wall_s:g} s")
                return  # what came before is kept in snapshots
            self._blame(index, end)
            if len(self._state.poisoned) > self._limits.poisoned:
                self._stop_at(index + 1, "too many cells before this one ended the Python process")
            self._state.restarts += 1
            if self._state.restarts > self._limits.restarts:
                self._stop_at(0, "the Python process had to be started too many times")

    def _stop_at(self, index: int, why: str) -> None:
        """Run no cell from ``index`` on, and say so in those that are graded."""
        self._stop = min(self._stop, index)
        note_not_run(self._notebook, self._stop, why)

    def _one_pass(self) -> tuple[int, CellEnd] | None:
        """One fresh process; return the index of the cell that ended it and how, or None if all ran."""
        self._end_process()
        process, self._ahead = self._ahead or self._start_student(), None
        self._process = process
        self._layers = process.layers
        number = 0
        for index, cell in enumerate(self._notebook.cells[: self._stop]):
            if cell.cell_type != "code":
                continue
            graded = self._by_index.get(index)
            cell.outputs, cell.execution_count = [], None
            if not cell.source.strip():
                continue
            if _skipped(cell):
                cell.outputs = [outputs.stream("This cell is not run while grading.\n")]
                continue
            if index in self._state.poisoned:
                cell.outputs = [outputs.error(*self._state.poisoned[index])]
                continue
            number += 1
            cell.execution_count = number
            if graded is not None:
                if self._served[index] == index:
                    self._share(index, process.snapshot())
                continue
            end = self._run_cell(process, index, number)
            if end in (CellEnd.DIED, CellEnd.HUNG) or time.monotonic() >= self._deadline:
                return index, end
        return None

    def _share(self, index: int, snapshot: Snapshot | None) -> None:
        """Let all graded cells that can be tested in the copy made at cell ``index`` be tested there."""
        for graded in self._graded:
            if self._served.get(graded.index) == index:
                graded.snapshot = snapshot

    def _run_cell(self, process: StudentProcess, index: int, number: int) -> CellEnd:
        cell = self._notebook.cells[index]
        allowed = self._limits.graded_s if is_graded(cell) else self._limits.cell_s
        seconds = max(_SHORTEST_S, min(allowed, self._deadline - time.monotonic()))
        kept = outputs.CellOutputs(self._limits.output_bytes)
        before = process.out_of_memory()
        end = process.run(cell.source, number, CellLimits(seconds, self._limits.grace_s), kept.take)
        cell.outputs = kept.result()
        for output in cell.outputs:
            if output.output_type == "execute_result":
                output.execution_count = number
        if end is CellEnd.DIED:
            if not process.fell():
                raise Lost(_LOST)
            if process.out_of_memory() > before:
                self._state.incidents.append(f"{label(cell, index)}: this cell used up the memory")
        if end is CellEnd.INTERRUPTED:
            note = f"did not finish in {seconds:.0f} s and was interrupted"
            cell.outputs.insert(0, outputs.stream(f"This cell {note}.\n"))
            self._state.incidents.append(f"{label(cell, index)}: this cell {note}")
        return end

    def _look(self) -> None:
        """Raise if the student's processes or the tester were ended from outside."""
        if self._process is not None and self._process.taken_away():
            raise Lost(_LOST)
        if self._testing is not None and self._testing.taken_away():
            raise Lost("the tester was ended from outside")

    def _blame(self, index: int, end: CellEnd) -> None:
        """Leave out, from now on, the cell that ended the process."""
        cell = self._notebook.cells[index]
        allowed = self._limits.graded_s if is_graded(cell) else self._limits.cell_s
        if end is CellEnd.DIED:
            reason = "KernelEnded", "this cell ended the Python process"
        else:
            reason = "CellTimeoutError", f"this cell did not finish in {allowed:g} s and did not react to an interrupt"
        self._state.poisoned[index] = reason
        self._state.incidents.append(f"{label(cell, index)}: {reason[1]}")
        cell.outputs = [outputs.error(*reason), *cell.outputs]

    # ------------------------------------------------------------------ processes

    def _start_student(self) -> StudentProcess:
        return self._starter.start_student(self._limits, self._student, self._files)

    def _tester(self) -> TesterProcess:
        """A fresh tester: the one that was started ahead, if it still runs, and later others."""
        tester, self._tester_ahead = self._tester_ahead, None
        if tester is not None and not tester.alive():
            tester.close()
            tester = None
        self._testing = tester or self._start_tester()
        return self._testing

    def _start_tester(self) -> TesterProcess:
        sources = []
        for cell in self._notebook.cells:
            if cell.cell_type == "code":
                nbgrader = cell.metadata.get("nbgrader", {})
                locked = bool(nbgrader.get("locked") or (nbgrader.get("grade") and not nbgrader.get("solution")))
                sources.append({"source": cell.source, "grade_id": nbgrader.get("grade_id", ""), "locked": locked})
        return self._starter.start_tester(self._lab, self._student, self._files, sources)

    def _fresh(self) -> Snapshot | None:
        """A copy of the student's process as the notebook left it, which may take another pass."""
        for _ in range(2):
            process = self._process
            if process is not None and process.alive():
                snapshot = process.snapshot() or process.serve()
                if snapshot is not None:
                    return snapshot
            self._state.restarts += 1
            if self._state.restarts > self._limits.restarts or time.monotonic() >= self._deadline:
                return None
            written = [(c, c.get("outputs"), c.get("execution_count")) for c in self._notebook.cells]
            if self._one_pass() is not None:
                return None
            for cell, shown, count in written:  # nothing that is said after the first test is to be seen
                if cell.cell_type == "code":
                    cell.outputs, cell.execution_count = shown, count
        return None

    def _end_process(self) -> None:
        for graded in self._graded:
            if graded.snapshot is not None:
                graded.snapshot.close()
                graded.snapshot = None
        if self._process is not None:
            self._process.close()
            self._process = None


def _skipped(cell: NotebookNode) -> bool:
    return bool(SKIP_TAGS & set(cell.metadata.get("tags", [])))


def _for_tester(cell: NotebookNode) -> bool:
    return is_graded(cell) and STUDENT_PROCESS_TAG not in cell.metadata.get("tags", [])
