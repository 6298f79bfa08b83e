"""What grading a class gives: the rows, read as they are needed, and the files they are written to."""

from __future__ import annotations

import json
from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, overload

from robotbrain.files import atomic_path, write_text
from robotbrain.grading.changes import Change
from robotbrain.grading.entry import FAILED, Person
from robotbrain.grading.jobs import Journal
from robotbrain.grading.marks import Marks, csv_text


class Rows(Sequence[Marks]):
    """The marks of a class, read from the journal as they are asked for, so that a large class needs no memory.

    Args:
        failed: students whose marks could not be entered.
    """

    def __init__(self, journal: Journal, people: Sequence[Person], failed: Iterable[str] = ()) -> None:
        self._journal, self._people, self._failed = journal, people, frozenset(failed)

    def __len__(self) -> int:
        return len(self._people)

    @overload
    def __getitem__(self, index: int) -> Marks: ...
    @overload
    def __getitem__(self, index: slice) -> Rows: ...
    def __getitem__(self, index: int | slice) -> Marks | Rows:
        if isinstance(index, slice):
            return Rows(self._journal, self._people[index], self._failed)
        person = self._people[index]
        whole = Marks(person.student, [], cached=all(d.cached for d in person.done))
        for done in person.done:
            part = self._journal.marks(person.student, done.key)
            whole.marks += part.marks
            whole.incidents += part.incidents
            whole.seconds += part.seconds
            whole.layers = part.layers
        if person.student in self._failed:
            whole.incidents.append(FAILED)
            for mark in whole.marks:
                mark.earned, mark.error = 0.0, "not processed"
        return whole

    def only(self, students: Container[str]) -> Rows:
        """The rows of some students."""
        return Rows(self._journal, [p for p in self._people if p.student in students], self._failed)

    def failed(self, students: Iterable[str]) -> Rows:
        """The same rows, of which those of ``students`` could not be entered."""
        return Rows(self._journal, self._people, students)


@dataclass(frozen=True)
class ClassResult:
    """A graded class: the rows, and where everything was written.

    Attributes:
        changes: marks that were in the gradebook before and are others now.
        entered: whether the gradebook was written.
    """

    lab: str
    rows: Sequence[Marks]
    results: Path
    table: Path
    feedback: Path
    changes: list[Change] = field(default_factory=list)
    entered: bool = True

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready form, as in ``results.json``."""
        return {"version": 1, "lab": self.lab, "students": [r.to_dict() for r in self.rows]}


def write_results(result: ClassResult) -> None:
    """Write the results; one student at a time, as a class may be large."""
    with atomic_path(result.results) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as file:
        file.write(f'{{"version": 1, "lab": {json.dumps(result.lab)}, "students": [')
        for number, row in enumerate(result.rows):
            file.write(",\n" if number else "\n")
            json.dump(row.to_dict(), file, ensure_ascii=False)
        file.write("\n]}\n")
    write_text(result.table, csv_text(result.rows))


def feedback_page(result: ClassResult, student: str) -> Path | None:
    """The first feedback page of ``student``, or None if nbgrader made none."""
    return next(iter(sorted((result.feedback / student / result.lab).glob("*.html"))), None)
