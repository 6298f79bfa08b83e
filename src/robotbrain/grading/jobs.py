"""From a submission to its outcome, once: what has run with the same tests in the same environment is not run again.

An outcome is journaled in two files, the executed notebook and then the record that makes it count, each written
atomically the moment the submission ends. Their name is a digest of everything the outcome may depend on.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import os
import sys
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from nbformat.notebooknode import NotebookNode

import robotbrain
from robotbrain.errors import RobotBrainError
from robotbrain.files import write_text
from robotbrain.grading import intake
from robotbrain.grading import suite as suites
from robotbrain.grading.execute import Execution, Limits, make_gradable, note_not_run
from robotbrain.grading.intake import Healed
from robotbrain.grading.marks import Marks, marks_of

if TYPE_CHECKING:
    from robotbrain.grading.course import Course
    from robotbrain.grading.sandbox.layers import Layer

_COUNTED = {".py", ".ipynb", ".json", ".csv", ".onnx", ".npz", ".toml", ".html", ".css", ".js"}
_PACKAGE = Path(robotbrain.__file__).parent
VERSION = 2  # of the journal's format: an older one is not read


class Bench(Protocol):
    """What runs notebooks: :class:`robotbrain.grading.bench.Bench`, or a cluster of them."""

    @property
    def layers(self) -> list[Layer]:
        """The sandbox's layers."""

    def execute(self, notebook: NotebookNode, *, lab: str, student: str, files: Mapping[str, bytes]) -> Execution:
        """Run a healed notebook."""

    def close(self) -> None:
        """End whatever runs."""


@dataclass(frozen=True, slots=True)
class Task:
    """One notebook of one student.

    Attributes:
        source: the instructor's notebook.
        folder: the submission, or None where nothing was handed in.
    """

    student: str
    lab: str
    source: Path
    folder: Path | None

    @property
    def notebook(self) -> str:
        """The notebook's name, as nbgrader has it."""
        return self.source.stem


@dataclass(frozen=True, slots=True)
class Done:
    """What is kept in memory of a finished task; the rest is in the journal.

    Attributes:
        key: the journal's name for the outcome.
        submission: digest of what was handed in.
        scores: grade id -> points, None where a person has to grade.
        sound: False if the machine failed and the task should run again next time.
    """

    student: str
    notebook: str
    key: str
    submission: str
    scores: dict[str, float | None]
    cached: bool = False
    sound: bool = True


@dataclass(frozen=True)
class Executed:
    """An executed submission; ``seconds`` is the wall time it took (s)."""

    notebook: NotebookNode
    incidents: list[str]
    seconds: float
    layers: list[str] = field(default_factory=list)
    sound: bool = True


def received(course: Course, folder: Path | None) -> intake.Received:
    """The files in a submission's folder, as far as they may come in."""
    if folder is None:
        return intake.Received()
    return intake.receive(folder, protected=(course.autograder, course.home / "solutions"))


def read_submission(course: Course, task: Task) -> tuple[Healed, dict[str, bytes]]:
    """The gradable notebook of a task and the files that go beside it."""
    files = received(course, task.folder)
    return intake.choose(files, task.source.name, intake.master_of(task.source)), files.further()


def submission_digest(healed: Healed, files: Mapping[str, bytes]) -> str:
    """A digest of what a student handed in, as it is run."""
    digest = hashlib.sha256(json.dumps(healed.notebook, sort_keys=True).encode())
    for name, data in sorted(files.items()):
        digest.update(f"\0{name}\0{len(data)}\0".encode())
        digest.update(data)
    return digest.hexdigest()


def tests_digest(folders: Iterable[Path]) -> str:
    """A digest of this package and of the tests in ``folders``, which may be files."""
    digest = hashlib.sha256()
    roots = [_PACKAGE, *folders, *map(Path, os.environ.get(suites.SUITES_VARIABLE, "").split(os.pathsep))]
    for root in roots:
        for path in sorted(root.rglob("*")) if root.is_dir() and root != Path() else [root]:
            if path.is_file() and path.suffix in _COUNTED:
                digest.update(path.relative_to(root).as_posix().encode())
                digest.update(path.read_bytes())
    return digest.hexdigest()


def environment_digest(folders: Iterable[Path], limits: Limits, layers: Iterable[str]) -> str:
    """A digest of what all submissions of a run share: packages, the tests, the lab's files, Python, limits, layers."""
    packages = {p.name for entry in sys.path for p in Path(entry).glob("*.dist-info")}
    facts = [sys.version, json.dumps(dataclasses.asdict(limits)), *sorted(layers), *sorted(packages)]
    return hashlib.sha256("\0".join([*facts, tests_digest(folders)]).encode()).hexdigest()


def run_job(healed: Healed, files: Mapping[str, bytes], *, lab: str, student: str, bench: Bench) -> Executed:
    """Execute a submission; whatever happens, a gradable notebook comes back."""
    start = time.monotonic()
    try:
        run = bench.execute(healed.notebook, lab=lab, student=student, files=files)
    except RobotBrainError:  # nothing can be run at all
        raise
    except Exception as error:  # the grader's own failure costs one submission, not the class
        why = f"the grader failed ({type(error).__name__}: {error}); this is no fault of the submission"
        return Executed(not_run(healed.notebook, why), [why], time.monotonic() - start, sound=False)
    return Executed(run.notebook, list(run.incidents), run.seconds, list(run.layers), run.sound)


def not_run(notebook: NotebookNode, why: str) -> NotebookNode:
    """``notebook`` with an error that says ``why`` wherever it has no result."""
    note_not_run(notebook, 0, why)
    for cell in notebook.cells:
        if cell.cell_type == "code":
            make_gradable(cell)
    return notebook


class Journal:
    """The outcomes in a folder.

    Args:
        environment: see :func:`environment_digest`.
    """

    def __init__(self, folder: Path, environment: str) -> None:
        self.folder, self.environment = folder, environment

    def executed(self, key: str) -> Path:
        """The file of the executed notebook of an outcome."""
        return self.folder / f"{key}.ipynb"

    def _record(self, key: str) -> Path:
        return self.folder / f"{key}.json"

    def key(self, task: Task, submission: str) -> str:
        """The name of an outcome. Tests may draw numbers per student, but nothing depends on who hands in nothing."""
        who = "" if task.folder is None else task.student
        return hashlib.sha256("\0".join((self.environment, task.lab, who, submission)).encode()).hexdigest()

    def find(self, task: Task, key: str, submission: str) -> Done | None:
        """The sound outcome of an earlier run, if there is one."""
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):  # damaged: it is simply not used
            marks = self.marks(task.student, key)
            if self.executed(key).is_file():
                return Done(task.student, task.notebook, key, submission, _scores(marks), cached=True)
        return None

    def keep(self, task: Task, key: str, submission: str, healed: Healed, executed: Executed) -> Done:
        """Write an outcome down."""
        if not executed.sound:
            key += "-unsound"  # nothing looks for it
        incidents = list(dict.fromkeys([*healed.repairs, *executed.incidents]))
        marks = Marks(task.student, marks_of(executed.notebook), incidents, executed.seconds, layers=executed.layers)
        write_text(
            self.executed(key), json.dumps(executed.notebook)
        )  # indented, as for people, it takes ten times as long
        write_text(self._record(key), json.dumps({"version": VERSION, "marks": marks.to_dict()}, ensure_ascii=False))
        return Done(task.student, task.notebook, key, submission, _scores(marks), sound=executed.sound)

    def marks(self, student: str, key: str) -> Marks:
        """The marks in a record, for ``student``."""
        record: dict[str, Any] = json.loads(self._record(key).read_text(encoding="utf-8"))
        if record["version"] != VERSION:
            raise ValueError("a record of another version")
        return dataclasses.replace(Marks.from_dict(record["marks"]), student=student)


def _scores(marks: Marks) -> dict[str, float | None]:
    return {m.grade_id: m.earned for m in marks.marks}


def grade(course: Course, task: Task, journal: Journal, bench: Bench, *, fresh: bool = False) -> Done:
    """Run a task, or find that it has run."""
    healed, files = read_submission(course, task)
    submission = submission_digest(healed, files)
    key = journal.key(task, submission)
    if not fresh and (done := journal.find(task, key, submission)):
        return done
    executed = run_job(healed, files, lab=task.lab, student=task.student, bench=bench)
    return journal.keep(task, key, submission, healed, executed)
