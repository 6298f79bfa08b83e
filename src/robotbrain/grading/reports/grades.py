"""What the gradebook adds to the tests: grades given by hand, extra credit, comments, late penalties."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Given:
    """The gradebook's entry for one cell.

    Attributes:
        points: what counts, manual grade and extra credit included; None while a person has yet to grade.
        most: what the cell is worth.
        manual: the grade a person gave, or None.
    """

    points: float | None
    most: float
    manual: float | None = None
    extra: float = 0.0


@dataclass(frozen=True)
class GradedNotebook:
    """The gradebook's entries for one notebook of one student, by grade id."""

    grades: Mapping[str, Given] = field(default_factory=dict)
    comments: Mapping[str, str] = field(default_factory=dict)
    penalty: float = 0.0

    @property
    def points(self) -> float:
        """Total, less the penalty for lateness."""
        return max(0.0, sum(g.points or 0.0 for g in self.grades.values()) - self.penalty)

    @property
    def most(self) -> float:
        """What the notebook is worth."""
        return sum(g.most for g in self.grades.values())


@contextlib.contextmanager
def open_gradebook(url: str) -> Iterator[Any]:
    """nbgrader's gradebook at a SQLAlchemy address, closed afterwards."""
    from nbgrader.api import Gradebook

    gradebook = Gradebook(url)
    try:
        yield gradebook
    finally:
        gradebook.close()


def graded_notebook(gradebook: Any, lab: str, student: str, notebook: str) -> GradedNotebook | None:
    """The entries of one notebook, or None where the gradebook has none."""
    from nbgrader.api import MissingEntry

    try:
        entry = gradebook.find_submission_notebook(notebook, lab, student)
    except MissingEntry:
        return None
    grades = {}
    for grade in entry.grades:
        waiting = grade.needs_manual_grade and grade.manual_score is None
        grades[grade.name] = Given(
            None if waiting else grade.score, grade.max_score, grade.manual_score, grade.extra_credit or 0.0
        )
    comments = {c.name: c.comment for c in entry.comments if c.comment and c.comment.strip()}
    return GradedNotebook(grades, comments, entry.late_submission_penalty or 0.0)
