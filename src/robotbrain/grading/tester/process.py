"""The tester's process: prepared once for a class, then forked for each submission."""

from __future__ import annotations

import ast
import contextlib
import functools
import gc
import os
import socket
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from robotbrain.grading.lab import Notice
from robotbrain.grading.remote import rehearse
from robotbrain.grading.remote.raised import StudentInterrupted
from robotbrain.grading.report import Score
from robotbrain.grading.runs import Runs
from robotbrain.grading.source import Submission, read_ahead
from robotbrain.grading.student import STUDENT_VARIABLE
from robotbrain.grading.suite import (
    AUTOGRADER_VARIABLE,
    Suite,
    hidden_path,
    instructors_code,
    load_hidden_suite,
    load_suite,
)
from robotbrain.grading.tester.cells import Output, definitions, failed, hidden_lines, problem, run_cell, visible_part
from robotbrain.grading.tester.control import Control, ExecutorGone
from robotbrain.grading.tester.world import RemoteWorld, StudentLost

_CELL_S = 300.0  # for a cell of assertions where the job does not say
_MEMORY_BYTES = 4 << 30
_COLLECT_AFTER = 20_000  # objects; a tester does not live long enough to be worth tidying more often
_PREPARED: dict[str, tuple[Suite, Suite]] = {}


def prepare(autograder: str, labs: Sequence[str] = ()) -> None:
    """Load the tests of ``labs``, hidden ones included, read what every submission contains, and fill caches."""
    os.environ[AUTOGRADER_VARIABLE] = autograder
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.set_num_threads(1)  # a process with threads must not fork
    for lab in labs:
        _, complete = suites_of(lab)
        steps: list[Callable[[], object]] = [functools.partial(complete.load_reference, n) for n in complete.references]
        steps += [*complete.warmers, functools.partial(rehearse, complete)]
        steps.append(functools.partial(read_ahead, instructors_code(Path(autograder), lab)))
        for warm in steps:
            try:
                warm()
            except Exception:  # the tests that need it will say so
                traceback.print_exc()


def suites_of(lab: str) -> tuple[Suite, Suite]:
    """The visible and the complete suite of a lab."""
    if lab not in _PREPARED:
        visible = load_suite(lab)
        _PREPARED[lab] = visible, load_hidden_suite(lab) if hidden_path(lab) is not None else visible
    return _PREPARED[lab]


def main(job: dict[str, Any], sockets: Sequence[socket.socket]) -> None:
    """Test one submission as the executor at the other end of the first socket asks; see :class:`Session`."""
    os.environ[AUTOGRADER_VARIABLE] = job["autograder"]
    os.environ[STUDENT_VARIABLE] = job["student"]
    os.environ["NBGRADER_EXECUTION"] = "autograde"
    _limit_memory(_MEMORY_BYTES)
    gc.set_threshold(_COLLECT_AFTER)
    try:
        Session(job, Control(sockets[0])).serve()
    except ExecutorGone:  # the executor needs no answer any more
        return


def _limit_memory(size: int) -> None:
    """Let what a student's process sends fill this process, but not the machine."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        resource.setrlimit(resource.RLIMIT_DATA, (size, size))


class Session:
    """Scores exercises and runs graded cells until the executor has asked for everything."""

    def __init__(self, job: dict[str, Any], control: Control) -> None:
        self._control = control
        self._limits = job.get("limits") or {}
        visible, complete = suites_of(job["lab"]) if job.get("lab") else (None, None)
        sources = job.get("sources") or []
        self._submission = Submission(sources)
        self._course: dict[str, ast.stmt] = definitions(c["source"] for c in sources if c.get("locked"))
        self._suite = complete or Suite("none")
        files = Path(job["files"]) if job.get("files") else None
        self._world = RemoteWorld(self._suite, control, files, self._refusal)
        self._runs = Runs(visible or self._suite, self._world, complete)
        self._incidents: list[str] = []
        self._seen: dict[str, list[Output]] = {}  # what the visible part of a cell of assertions gave

    def _refusal(self, exercise: str) -> str:
        reason, doubts = self._submission.why_forbidden(exercise, self._suite)
        self._incidents += doubts
        return reason

    def serve(self) -> None:
        """Do what the executor asks until it says ``end``."""
        while True:
            message = self._control.receive()
            match message["op"]:
                case "end":
                    return
                case "student":
                    self._world.connected(message["student"], self._control.socket(message))
                case "gone":
                    self._world.connected(message["student"], None, message["why"])
                case "score":
                    self._answer(self._scored, message)
                case "cell":
                    self._answer(self._ran, message)

    def _answer(self, work: Any, message: dict[str, Any]) -> None:
        self._world.use(message["student"])
        error = ""
        try:
            outputs = work(message)
        except ExecutorGone:
            raise
        except Exception as broken:  # of the lab, not of the student
            error = f"{type(broken).__name__}: {broken}"
            traceback.print_exc()
            outputs = [problem("TestsBroken", "these tests are broken, please tell the course staff")]
        incidents, self._incidents = list(dict.fromkeys(self._incidents)), []
        self._control.send(event="outputs", outputs=outputs, error=error, incidents=incidents)

    def _scored(self, message: dict[str, Any]) -> list[Output]:
        if message["hidden"]:
            self._world.seal()
        report = self._runs.report(message["exercise"], hidden=bool(message["hidden"]))
        return [_score_output(Score(report))]

    def _ran(self, message: dict[str, Any]) -> list[Output]:
        """Run a cell of assertions: first what students see of it, later, in silence, the whole."""
        source, key = message["source"], str(message.get("grade_id") or message["student"])
        if not message.get("hidden", True):
            self._seen[key] = self._run_cell(visible_part(source), key, sealed=False)
            return self._seen[key]
        seen = self._seen.get(key)
        if seen is not None and (failed(seen) or not hidden_lines(source)):
            return seen
        self._world.seal()
        outputs = self._run_cell(source, key, sealed=True)
        return outputs if failed(outputs) else [*(o for o in seen or () if o["output_type"] == "stream"), *outputs]

    def _run_cell(self, source: str, name: str, *, sealed: bool) -> list[Output]:
        limit = float(self._limits.get("graded_s") or _CELL_S)
        given = {"lab": _LabInCell(self._runs)}
        try:
            with self._world.timed("", name, limit):
                return run_cell(source, self._world.namespace(), self._course, given, sealed=sealed)
        except StudentInterrupted:
            return [problem("CellTimeoutError", f"your code did not finish in {limit:g} s")]
        except StudentLost as lost:
            return [problem("KernelEnded", lost.outcome.message)]


class _LabInCell:
    """What ``lab`` is in a cell that scores among other things."""

    def __init__(self, scorer: Runs) -> None:
        self._runs = scorer

    def check(self, exercise: str) -> Notice:
        return Notice(f"{exercise}: the score below tells.")

    def score(self, exercise: str, hidden: bool = False) -> Score:
        return Score(self._runs.report(exercise, hidden=hidden))


def _score_output(score: Score) -> Output:
    data = score._repr_mimebundle_()
    return {"output_type": "execute_result", "data": data, "metadata": {}, "execution_count": None}
