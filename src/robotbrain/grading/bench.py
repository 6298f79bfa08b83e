"""The grader's two fork servers, and what a host gives to protect the one from the other."""

from __future__ import annotations

import atexit
import contextlib
import copy
import os
import shutil
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import psutil
from nbformat.notebooknode import NotebookNode

from robotbrain.errors import InputError
from robotbrain.grading.execute import Execution, Limits, make_gradable, note_not_run
from robotbrain.grading.executor import Executor, Lost
from robotbrain.grading.sandbox import recipes
from robotbrain.grading.sandbox.cgroups import Cgroups
from robotbrain.grading.sandbox.forkserver import ForkServer, ServerDied
from robotbrain.grading.sandbox.layers import NAMES, Layer, layers_of, required_missing
from robotbrain.grading.sandbox.process import Room, StartError, StudentProcess
from robotbrain.grading.scheduler import usable_cores
from robotbrain.grading.tester_link import TesterProcess

_TRIES = 3
_CPU_SLACK_S = 30.0
_ABANDONED_S = 3600.0  # a folder of a grader that is gone is removed after this time, when the next one starts


class Bench:
    """Executes submissions; safe to use from several threads. Close it, or use it as a context manager.

    Args:
        autograder: the folder with the hidden tests.
        require_sandbox: refuse to work where the host lacks a layer that matters.
        limits: of each submission.
        preload_labs: labs whose modules and tests are imported once, ahead; others work too, more slowly.
        preload: what student's processes have imported; default: what these labs import.

    Raises:
        InputError: ``require_sandbox``, and something is missing.
    """

    def __init__(
        self,
        autograder: Path,
        *,
        require_sandbox: bool = False,
        limits: Limits | None = None,
        preload_labs: Sequence[str] = (),
        preload: Sequence[str] | None = None,
    ) -> None:
        self._autograder = Path(autograder).resolve()
        self.limits = limits or Limits()
        self._cgroups = Cgroups.find()
        self._students = ForkServer(recipes.student(self._autograder, preload_labs, preload))
        self._testers = ForkServer(recipes.tester(self._autograder, preload_labs))
        self._layers: list[Layer] | None = None
        self._lock = threading.Lock()
        _remove_abandoned()
        if preload_labs and usable_cores() > 1:  # both servers take seconds to import what they need
            threading.Thread(target=self._warm_testers, name="warm-testers", daemon=True).start()
        if require_sandbox:
            missing = required_missing(self.layers)
            if missing:
                self.close()
                raise InputError(
                    "sandbox",
                    given="without " + ", ".join(layer.name for layer in missing),
                    expected="a host that can shut student code in",
                    fix=" ".join(layer.note for layer in missing) + " Or grade without --require-sandbox.",
                )

    def __enter__(self) -> Bench:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def layers(self) -> list[Layer]:
        """What protects the grader from student code on this host, found by starting a student's process."""
        with self._lock:
            if self._layers is None:
                self._layers = self._probe()
            return self._layers

    def execute(self, notebook: NotebookNode, *, lab: str, student: str, files: Mapping[str, bytes]) -> Execution:
        """Run ``notebook``, write its outputs, and say what went wrong; never raises for what a submission does.

        Args:
            notebook: whose locked cells have been restored from the master.
            files: the submission's further files, by name.
        """
        failure = ""
        for _ in range(_TRIES):
            attempt = copy.deepcopy(notebook)
            run = Executor(self, attempt, lab=lab, student=student, files=files, limits=self.limits)
            try:
                execution = run.run()
            except (Lost, ServerDied, StartError) as error:
                failure = str(error)
                continue
            notebook.cells = execution.notebook.cells
            execution.notebook = notebook
            held = {*execution.layers, "tester", *(["bubblewrap"] if recipes.wrapped(self._students.recipe) else [])}
            execution.layers = [name for name in NAMES if name in held]
            return execution
        why = f"the grader could not run this submission, which is no fault of it; grade it again ({failure})"
        note_not_run(notebook, 0, why)
        for cell in notebook.cells:
            if cell.cell_type == "code":
                make_gradable(cell)
        return Execution(notebook, [why], sound=False)

    def close(self) -> None:
        """End both servers and everything they started; safe to call twice."""
        self._students.close()
        self._testers.close()
        self._cgroups.close()

    def _warm_testers(self) -> None:
        with contextlib.suppress(ServerDied, OSError):  # whoever needs a tester is told
            self._testers.warm_up()

    def start_student(self, limits: Limits, student: str, files: Mapping[str, bytes]) -> StudentProcess:
        """A fresh student's process with the submission's files."""
        private = recipes.wrapped(self._students.recipe)  # then it gets a working directory of its own making
        folder = "" if private else _new_folder()
        process = StudentProcess(
            self._students,
            environment=recipes.student_environment(student, self._students.recipe),
            folder=folder,
            room=Room(limits.memory_bytes, limits.disk_bytes, processes=limits.processes),
            output_bytes=limits.output_bytes,
            cpu_s=2 * limits.wall_s + _CPU_SLACK_S,
            cgroups=self._cgroups,
        )
        if folder:
            process.on_close(lambda: shutil.rmtree(folder, ignore_errors=True))
        for name, data in files.items():
            process.put_file(name, data)
        return process

    def start_tester(
        self, lab: str, student: str, files: Mapping[str, bytes], sources: Sequence[Mapping[str, Any]]
    ) -> TesterProcess:
        """A fresh tester, with the submission's files in a folder of its own."""
        folder = _new_folder() if files else ""
        for name, data in files.items():
            path = Path(folder, name)
            if path.is_relative_to(folder) and ".." not in Path(name).parts:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(data)
        job = {
            "lab": lab,
            "student": student,
            "autograder": str(self._autograder),
            "files": folder or None,
            "sources": [dict(s) for s in sources],
            "limits": {"graded_s": self.limits.graded_s, "grace_s": self.limits.grace_s},
        }
        tester = TesterProcess(self._testers, job)
        if folder:
            tester.on_close(lambda: shutil.rmtree(folder, ignore_errors=True))
        return tester

    def _probe(self) -> list[Layer]:
        held: list[str] = []
        why = ""
        for _ in range(_TRIES):  # a busy machine's first try must not decide what holds for the whole class
            try:
                with contextlib.closing(self.start_student(self.limits, "", {})) as process:
                    held, why = process.layers, ""
                    break
            except (ServerDied, StartError) as error:
                why = str(error)
        return layers_of(held, wrapped=recipes.wrapped(self._students.recipe), cgroups=self._cgroups, failure=why)


def _new_folder() -> str:
    """A folder for the files of a submission, named after this process."""
    return tempfile.mkdtemp(prefix=f"robotbrain-{os.getpid()}-")


def _remove_abandoned() -> None:
    """Remove the folders of graders that were killed before they could."""
    for path in Path(tempfile.gettempdir()).glob("robotbrain-*-*"):
        with contextlib.suppress(OSError):
            number = path.name.split("-")[1]
            old = time.time() - path.lstat().st_mtime > _ABANDONED_S
            if old and number.isdigit() and not psutil.pid_exists(int(number)):
                shutil.rmtree(path, ignore_errors=True)


def host_layers() -> list[Layer]:
    """The layers that this host has, found with a sandbox that holds nothing."""
    with Bench(Path.cwd(), preload=()) as bench:
        return bench.layers


_shared: dict[tuple[Path, Limits, bool], Bench] = {}
_shared_lock = threading.Lock()


def shared_bench(autograder: Path, limits: Limits, *, require_sandbox: bool, lab: str) -> Bench:
    """A bench that stays warm for the next caller in this process, and ends with it.

    Args:
        lab: preloaded if this is the first call.
    """
    key = autograder.resolve(), limits, require_sandbox
    with _shared_lock:
        if key not in _shared:
            labs = [lab] if lab else []
            bench = Bench(autograder, require_sandbox=require_sandbox, limits=limits, preload_labs=labs)
            atexit.register(bench.close)
            _shared[key] = bench
        return _shared[key]
