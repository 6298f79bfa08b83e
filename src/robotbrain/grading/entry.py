"""From outcomes to the gradebook: what would change, who needs to be written, and a note of what was written.

A note per student lies beside the journal. It says which outcomes are in the gradebook, so that a run over a class of
which nothing has changed leaves everybody alone: entering a mark anew would ask for every manual grade to be reviewed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robotbrain.files import write_text
from robotbrain.grading.changes import Change, change, expected
from robotbrain.grading.gradebook import Standing
from robotbrain.grading.jobs import Done, Journal
from robotbrain.grading.writer import Writer

FAILED = "nbgrader could not enter this submission (see nbgrader.log)"


@dataclass(frozen=True, slots=True)
class Person:
    """A student and the outcomes of their notebooks; ``folder`` is None if nothing was handed in."""

    student: str
    folder: Path | None
    done: Sequence[Done]


class Entry:
    """Enters outcomes through a :class:`Writer`.

    Args:
        notes: folder of the notes.
    """

    def __init__(self, writer: Writer, journal: Journal, notes: Path) -> None:
        self.writer, self.journal, self.notes = writer, journal, notes

    def standing(self, student: str) -> Standing:
        """What the gradebook holds on a student."""
        gradebook = self.writer.gradebook
        return gradebook.transact(lambda: gradebook.standing(self.writer.lab, student))

    def was_missing(self, student: str) -> bool:
        """Whether the marks in the gradebook are those of a submission that was not there."""
        return bool(self._note(student).get("missing"))

    def change(self, person: Person, before: Standing) -> Change | None:
        """What entering ``person`` would change, who stands as ``before``."""
        return change(person.student, before, expected(before, _scores(person)), self._why(person))

    def enter(self, person: Person, standing: Standing) -> bool:
        """Write the marks of a student who has this standing, unless they are there; return whether that went well."""
        note = self._note(person.student)
        keys = [d.key for d in person.done]
        there = standing == expected(standing, _scores(person)) and standing.late_s == note.get("late_s")
        files = all((self.writer.folder(person.student) / f"{d.notebook}.ipynb").is_file() for d in person.done)
        if there and files and note.get("keys") == keys:
            return True
        self._path(person.student).unlink(missing_ok=True)
        try:
            executed = {d.notebook: self.journal.executed(d.key) for d in person.done}
            late_s = self.writer.enter(person.student, person.folder, executed)
        except Exception:  # whatever nbgrader stumbles over costs this student's marks, not the class
            self.writer.log.exception("%s could not be entered", person.student)
            self.writer.enter_zero(person.student, person.folder)
            return False
        note = {
            "keys": keys,
            "submissions": [d.submission for d in person.done],
            "environment": self.journal.environment,
            "missing": person.folder is None,
            "late_s": late_s,
        }
        self._keep(person.student, note)
        return True

    def feedback_digest(self, person: Person) -> str:
        """A digest of what a student's feedback is made of: outcomes, grades and comments."""
        facts = repr((self.standing(person.student), [d.key for d in person.done], self.journal.environment))
        return hashlib.sha256(facts.encode()).hexdigest()

    def noted_feedback(self, student: str) -> str:
        """The digest of the feedback that was written last, or ``""``."""
        return str(self._note(student).get("feedback", ""))

    def note_feedback(self, student: str, digest: str) -> None:
        """Note that the feedback is up to date."""
        self._keep(student, {**self._note(student), "feedback": digest})

    def _why(self, person: Person) -> str:
        note = self._note(person.student)
        causes = []
        if note and note.get("submissions") != [d.submission for d in person.done]:
            causes.append("the submission has changed")
        if note and note.get("environment") != self.journal.environment:
            causes.append("the tests or the environment have changed")
        rows = [self.journal.marks(person.student, d.key) for d in person.done]
        return "; ".join([*causes, *(reason for row in rows if (reason := row.reason()))])

    def _path(self, student: str) -> Path:
        return self.notes / f"{student}.json"

    def _note(self, student: str) -> dict[str, Any]:
        try:
            note = json.loads(self._path(student).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}
        return note if isinstance(note, dict) else {}

    def _keep(self, student: str, note: dict[str, Any]) -> None:
        write_text(self._path(student), json.dumps(note))


def _scores(person: Person) -> dict[tuple[str, str], float | None]:
    return {(d.notebook, cell): score for d in person.done for cell, score in d.scores.items()}
