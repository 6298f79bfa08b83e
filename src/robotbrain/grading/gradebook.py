"""Nbgrader's gradebook for a whole class: one session, one transaction per student, patience where it is locked.

Nbgrader's preprocessors each open the gradebook and commit after every cell. :func:`shared` hands them a
:class:`BatchGradebook` instead, so that the stock classes (and an instructor's own) do the work, on rows that were
fetched together.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from datetime import datetime
from types import SimpleNamespace
from typing import Any, TypeVar

from nbgrader.api import (
    BaseCell,
    Comment,
    Grade,
    Gradebook,
    MissingEntry,
    Notebook,
    SubmittedAssignment,
    SubmittedNotebook,
)
from sqlalchemy import Engine, create_engine, event
from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session

from robotbrain.grading.course import patient_url

_T = TypeVar("_T")
_RETRY_S = 0.5
_RECONNECTS = 5
_LOCKED = "The gradebook is locked by another program (formgrader?); waiting for it."


@dataclass(frozen=True)
class CellScore:
    """What the gradebook holds on one graded cell."""

    auto: float | None
    manual: float | None
    extra: float | None

    @property
    def effective(self) -> float:
        """The score that counts: a person's, else the tests', plus extra credit."""
        given = self.auto if self.manual is None else self.manual
        return (given or 0.0) + (self.extra or 0.0)


@dataclass(frozen=True)
class Standing:
    """What the gradebook holds on one student's submission.

    Attributes:
        scores: (notebook, grade id) -> score.
        comments: (notebook, grade id) -> comment that a person wrote.
        late_s: seconds past the due date, as nbgrader counts them now.
    """

    scores: dict[tuple[str, str], CellScore] = field(default_factory=dict)
    comments: dict[tuple[str, str], str | None] = field(default_factory=dict)
    late_s: float = 0.0

    @property
    def marked(self) -> bool:
        """Whether there are marks that could be written over."""
        return any(s.auto is not None or s.manual is not None for s in self.scores.values())


class _StudentSession(Session):
    """A session whose ``commit`` waits for :meth:`finish`, as nbgrader commits after each cell."""

    def commit(self) -> None:
        """Do nothing: queries and :meth:`finish` write what has changed, all together."""

    def finish(self) -> None:
        super().commit()


def _open(url: str) -> Engine:
    if not url.startswith("sqlite"):
        return create_engine(url, pool_pre_ping=True)
    engine = create_engine(url, connect_args={"timeout": _RETRY_S})

    @event.listens_for(engine, "connect")
    def _no_driver_transactions(connection: Any, record: Any) -> None:
        connection.isolation_level = None

    @event.listens_for(engine, "begin")
    def _lock_at_once(connection: Any) -> None:
        # A transaction that reads first and locks later fails without waiting if somebody wrote in between.
        connection.exec_driver_sql("BEGIN IMMEDIATE")

    return engine


class BatchGradebook(Gradebook):  # type: ignore[misc]
    """A gradebook that stays open.

    Args:
        on_wait: called with a sentence when somebody else keeps the gradebook locked.
    """

    def __init__(self, url: str, course_id: str, on_wait: Callable[[str], None]) -> None:
        with Gradebook(patient_url(url), course_id):
            pass  # creates the tables of a new gradebook
        self.engine = _open(url)
        self.db = _StudentSession(self.engine, expire_on_commit=False)
        self.course_id, self.authenticator = course_id, None
        self._on_wait = on_wait
        self._masters: dict[tuple[str, str], SimpleNamespace] = {}
        self._submission: SubmittedAssignment | None = None
        self._notebooks: dict[str, SubmittedNotebook] = {}
        self._grades: dict[tuple[str, str], Grade] = {}
        self._comments: dict[tuple[str, str], Comment] = {}

    def close(self) -> None:
        """Do nothing: preprocessors close what they opened; see :meth:`shut`."""

    def shut(self) -> None:
        """Close the session and the connections."""
        self.db.close()
        self.engine.dispose()

    def transact(self, step: Callable[[], _T]) -> _T:
        """Run ``step`` in one transaction; again from its start where the database was locked or went away."""
        told, lost = False, 0
        while True:
            try:
                done = step()
                self.db.finish()
                return done
            except DBAPIError as error:
                if _is_locked(error):
                    if not told:
                        self._on_wait(_LOCKED)
                    told = True
                elif error.connection_invalidated and lost < _RECONNECTS:
                    self._on_wait("The connection to the gradebook was lost; trying again.")
                    lost += 1
                else:
                    raise
                self.db.rollback()
                time.sleep(_RETRY_S)
            finally:
                self.db.rollback()
                self.db.expunge_all()
                self._submission = None

    def standing(self, assignment: str, student: str) -> Standing:
        """What is there now; call it in :meth:`transact`."""
        try:
            self._load(super().find_submission(assignment, student))
        except MissingEntry:
            return Standing()
        scores = {k: CellScore(g.auto_score, g.manual_score, g.extra_credit) for k, g in self._grades.items()}
        comments = {k: c.manual_comment for k, c in self._comments.items()}
        return Standing(scores, comments, float(self._submission.total_seconds_late))  # type: ignore[union-attr]

    def begin(self, assignment: str, student: str, timestamp: datetime | None) -> SubmittedAssignment:
        """Find or make a student's submission; afterwards its grades and comments are found without queries."""
        self.update_or_create_student(student)
        when = {} if timestamp is None else {"timestamp": timestamp}
        submission = self.update_or_create_submission(assignment, student, **when)
        self.db.flush()
        self._load(submission)
        return submission

    def _load(self, submission: SubmittedAssignment) -> None:
        self._submission = submission
        ours = SubmittedNotebook.assignment_id == submission.id
        pairs = self.db.query(SubmittedNotebook, Notebook.name).join(Notebook).filter(ours)
        self._notebooks = {name: notebook for notebook, name in pairs}
        self._grades = self._by_cell(Grade, ours)
        self._comments = self._by_cell(Comment, ours)

    def _by_cell(self, table: Any, ours: Any) -> dict[tuple[str, str], Any]:
        rows = (
            self.db.query(table, Notebook.name, BaseCell.__table__.c.name)
            .join(SubmittedNotebook, SubmittedNotebook.id == table.notebook_id)
            .join(Notebook, Notebook.id == SubmittedNotebook.notebook_id)
            .join(BaseCell.__table__, BaseCell.__table__.c.id == table.cell_id)
            .filter(ours)
        )
        return {(notebook, cell): row for row, notebook, cell in rows}

    def add_submission(self, assignment: str, student: str, **kwargs: Any) -> Any:
        """Make a submission with all its grades and comments."""
        with self.db.no_autoflush:  # it is not in the session while nbgrader puts it together
            return super().add_submission(assignment, student, **kwargs)

    # What nbgrader's preprocessors ask for, answered from memory.

    def find_submission(self, assignment: str, student: str) -> Any:
        """The submission begun last, or what the database has."""
        found = self._submission
        if found is not None and found.student_id == student and found.assignment.name == assignment:
            return found
        return super().find_submission(assignment, student)

    def find_submission_notebook(self, notebook: str, assignment: str, student: str) -> Any:
        """A notebook of the submission begun last."""
        return _known(self._notebooks, notebook, notebook)

    def find_grade(self, grade_cell: str, notebook: str, assignment: str, student: str) -> Any:
        """A grade in the submission begun last."""
        return _known(self._grades, (notebook, grade_cell), grade_cell)

    def find_comment(self, solution_cell: str, notebook: str, assignment: str, student: str) -> Any:
        """A comment in the submission begun last."""
        return _known(self._comments, (notebook, solution_cell), solution_cell)

    def find_notebook(self, notebook: str, assignment: str) -> Any:
        """The instructor's version of a notebook, read once."""
        key = (notebook, assignment)
        if key not in self._masters:
            self._masters[key] = _detached(super().find_notebook(notebook, assignment))
        return self._masters[key]

    def find_source_cell(self, name: str, notebook: str, assignment: str) -> Any:
        """The instructor's version of a cell."""
        return _known({c.name: c for c in self.find_notebook(notebook, assignment).source_cells}, name, name)

    def find_graded_cell(self, name: str, notebook: str, assignment: str) -> Any:
        """The instructor's version of a cell that has points."""
        master = self.find_notebook(notebook, assignment)
        return _known({c.name: c for c in [*master.task_cells, *master.grade_cells]}, name, name)


def _known(found: dict[Any, Any], key: Any, name: str) -> Any:
    if key not in found:
        raise MissingEntry(f"No such cell or notebook: {name}")
    return found[key]


def _detached(notebook: Notebook) -> SimpleNamespace:
    """A copy that outlives the session's objects."""

    def copies(rows: Iterable[Any], *names: str) -> list[SimpleNamespace]:
        return [SimpleNamespace(**{n: getattr(row, n) for n in ("name", *names)}) for row in rows]

    return SimpleNamespace(
        name=notebook.name,
        kernelspec=notebook.kernelspec,
        source_cells=copies(notebook.source_cells, "cell_type", "locked", "source", "checksum"),
        grade_cells=copies(notebook.grade_cells, "max_score", "cell_type"),
        solution_cells=copies(notebook.solution_cells),
        task_cells=copies(notebook.task_cells, "max_score", "cell_type"),
    )


def _is_locked(error: DBAPIError) -> bool:
    return any(word in str(error.orig) for word in ("database is locked", "database table is locked"))


def wait_until_free(url: str, on_wait: Callable[[str], None]) -> None:
    """Return once nobody has an SQLite gradebook locked: before nbgrader's own steps, which wait without a word."""
    if not url.startswith("sqlite"):
        return
    engine, told = _open(url), False
    try:
        while True:
            try:
                with engine.begin():
                    return
            except DBAPIError as error:
                if not _is_locked(error):
                    raise
                if not told:
                    on_wait(_LOCKED)
                told = True
    finally:
        engine.dispose()


@contextlib.contextmanager
def shared(gradebook: BatchGradebook, preprocessors: Iterable[object]) -> Iterator[None]:
    """Within the block, whatever these preprocessors open as a gradebook is ``gradebook``."""
    modules = {sys.modules[c.__module__] for p in preprocessors for c in type(p).__mro__ if c is not object}
    users = [m for m in modules if getattr(m, "Gradebook", None) is Gradebook]
    for module in users:
        module.Gradebook = lambda *_args, **_kwargs: gradebook  # type: ignore[attr-defined]
    try:
        yield
    finally:
        for module in users:
            module.Gradebook = Gradebook  # type: ignore[attr-defined]
