"""Enters executed submissions in the gradebook and leaves behind what ``nbgrader autograde`` leaves behind.

The instructor's own configuration decides, as with nbgrader: its sanitising and autograding preprocessors run in their
order, except those that would run the notebook again. A test compares tables and files with those of nbgrader itself.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Callable, Mapping
from datetime import datetime
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import nbformat
import nbformat.v4
from nbconvert.exporters.exporter import ResourcesDict
from nbgrader.converters import Autograde
from nbgrader.coursedir import CourseDirectory
from nbgrader.preprocessors import CheckCellMetadata, ClearOutput, Execute
from nbgrader.utils import parse_utc

from robotbrain.files import write_bytes
from robotbrain.grading import intake, jobs
from robotbrain.grading.course import Course, nbgrader_config, nbgrader_logger
from robotbrain.grading.gradebook import BatchGradebook, shared
from robotbrain.grading.nbgrader_plugins import ResilientExecute

_RUNS_OR_EMPTIES = (Execute, ResilientExecute, ClearOutput)
_LONGEST_TIMESTAMP = 1000  # bytes
_CHECKED = 100  # kinds of grading metadata kept in mind


class Writer:
    """The one writer of a course's gradebook; close it with :meth:`close`, or use it as a context manager.

    Args:
        log: file for nbgrader's messages.
        on_wait: called with a sentence when somebody else keeps the gradebook locked.
    """

    def __init__(self, course: Course, lab: str, *, log: Path | None, on_wait: Callable[[str], None]) -> None:
        self.course, self.lab = course, lab
        config = nbgrader_config(course)
        self.log, self._handler = nbgrader_logger(log)
        self._directory = CourseDirectory(config=config, log=self.log)
        self._directory.assignment_id = lab
        self._converter = Autograde(coursedir=self._directory, config=config, log=self.log)
        self._converter.exporter = self._converter.exporter_class(parent=self._converter, config=config)
        self._before, self._after = self._preprocessors(sanitizing=True), self._preprocessors(sanitizing=False)
        self._checked: dict[str, None] = {}  # the same for nearly the whole class, and slow to check
        self.gradebook = BatchGradebook(course.gradebook_url, self._directory.course_id, on_wait)

    def __enter__(self) -> Writer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the gradebook and the log."""
        self.gradebook.shut()
        self.log.removeHandler(self._handler)
        self._handler.close()

    def _preprocessors(self, *, sanitizing: bool) -> list[Any]:
        self._converter._sanitizing = sanitizing
        self._converter._init_preprocessors()
        return [p for p in self._converter.exporter._preprocessors if not isinstance(p, _RUNS_OR_EMPTIES)]

    def folder(self, student: str) -> Path:
        """Where the autograded notebooks of ``student`` lie."""
        return Path(self._directory.format_path(self.course.autograded, student, self.lab))

    def enter(self, student: str, submitted: Path | None, executed: Mapping[str, Path]) -> float:
        """Write one student's grades and autograded files, replacing those of an earlier run; all or nothing.

        Args:
            submitted: the submission's folder, or None if nothing was handed in.
            executed: name of a notebook (without ``.ipynb``) -> its executed, healed version.

        Returns:
            Seconds past the due date, as nbgrader counts them now.
        """
        self._directory.student_id = student  # for hooks that look there
        self._converter.notebooks = [str(self.folder(student) / f"{name}.ipynb") for name in executed]
        received = jobs.received(self.course, submitted)

        def step() -> float:
            self._converter.run_pre_convert_hook()
            submission = self.gradebook.begin(self.lab, student, submitted_at(received))
            with shared(self.gradebook, [*self._before, *self._after]):
                made = {f"{name}.ipynb": self._convert(student, name, path) for name, path in executed.items()}
            self._publish(student, received, made)
            self._converter.run_post_convert_hook()
            return float(submission.total_seconds_late)

        return self.gradebook.transact(step)

    def enter_zero(self, student: str, submitted: Path | None) -> None:
        """Give a student whom nbgrader itself cannot grade an explicit zero; what people gave stays."""

        timestamp = submitted_at(jobs.received(self.course, submitted))

        def step() -> None:
            submission = self.gradebook.begin(self.lab, student, timestamp)
            for notebook in submission.notebooks:
                for grade in notebook.grades:
                    grade.auto_score, grade.needs_manual_grade = 0, False

        self.gradebook.transact(step)

    def _convert(self, student: str, name: str, path: Path) -> str:
        notebook = nbformat.v4.reads(path.read_text(encoding="utf-8"))  # ours: valid, and no older format
        notebook.metadata.pop("robotbrain", None)
        names = {"student": student, "assignment": self.lab, "notebook": name, "db_url": self.course.gradebook_url}
        where, resources = ResourcesDict(), ResourcesDict()
        where.update(name=name, path=str(self.folder(student)))
        resources.update(unique_key=name, output_files_dir=f"{name}_files", nbgrader=names, metadata=where)
        for preprocess in (*self._before, *self._after):
            metadata = _grading_metadata(notebook) if isinstance(preprocess, CheckCellMetadata) else ""
            if metadata not in self._checked:
                notebook, resources = preprocess(notebook, resources)
            if metadata:
                self._checked[metadata] = None
        for metadata in list(self._checked)[:-_CHECKED]:
            del self._checked[metadata]
        text: str = nbformat.writes(notebook, version=self._converter.exporter.nbformat_version)
        return text if text.endswith("\n") else text + "\n"

    def _publish(self, student: str, received: intake.Received, made: Mapping[str, str]) -> None:
        """Write the folder file by file, each whole or not at all; what does not belong there goes."""
        target = self.folder(student)
        files = {name: data for name, data in received.further().items() if not self._is_ignored(name)}
        files |= self._source_files() | {name: text.encode() for name, text in made.items()}
        for name, data in files.items():
            path = target / name
            if not (path.is_file() and not path.is_symlink() and path.read_bytes() == data):
                _remove(path)
                write_bytes(path, data)
        for path in sorted(target.rglob("*"), reverse=True):
            if path.is_dir() and not path.is_symlink():
                with contextlib.suppress(OSError):  # not empty
                    path.rmdir()
            elif path.relative_to(target).as_posix() not in files:
                _remove(path)
        self._converter.set_permissions(self.lab, student)

    def _source_files(self) -> dict[str, bytes]:
        """The instructor's files beside the notebook, which take the place of the student's."""
        folder = Path(self._directory.format_path(self.course.source, ".", self.lab))
        kept = self._converter.exclude_overwriting.get(self.lab, [])
        names = [p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file() and p.suffix != ".ipynb"]
        return {n: (folder / n).read_bytes() for n in names if n not in kept and not self._is_ignored(n)}

    def _is_ignored(self, name: str) -> bool:
        return any(fnmatch(part, pattern) for part in name.split("/") for pattern in self._directory.ignore)


def _grading_metadata(notebook: nbformat.NotebookNode) -> str:
    return repr([(c.cell_type, c.metadata["nbgrader"]) for c in notebook.cells if "nbgrader" in c.metadata])


def submitted_at(received: intake.Received) -> datetime | None:
    """The time (UTC) in the ``timestamp.txt`` that nbgrader's exchange puts beside a submission, if it is readable."""
    try:
        text = received.files.get("timestamp.txt", b"")[:_LONGEST_TIMESTAMP].decode().strip()
        return parse_utc(text) if text else None
    except (ValueError, OverflowError):
        return None


def student_ids(gradebook: BatchGradebook) -> list[str]:
    """Everybody in the gradebook."""
    return sorted(gradebook.transact(lambda: [s.id for s in gradebook.students]))


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
        return
    if path.is_file() and not path.is_symlink():
        path.chmod(0o644)  # nbgrader leaves files read-only, which Windows does not replace
    path.unlink(missing_ok=True)
