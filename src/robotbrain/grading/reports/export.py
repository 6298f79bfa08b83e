"""Points in the forms that learning management systems import.

* Canvas: ``Student, ID, SIS User ID, SIS Login ID, Section, <assignment>`` and a row of possible points; a column that
  is named ``Title (123)`` goes to the assignment with that id. https://community.canvaslms.com (How do I import grades)
* Moodle: any columns that the import form maps; ``ID number`` or ``Email address`` find the student.
  https://docs.moodle.org/en/Grade_import
* Blackboard: ``Username`` finds the student, ``Title [Total Pts: 100 Score] |123`` the column, tab-separated.
  https://help.blackboard.com (Work offline with grade data)

Who is who stands in a roster: a CSV with a column ``student`` (the name of the submission's folder) and any of
``name``, ``email``, ``id``, ``sis_id``, ``login``, ``section``. Without one, the folder's name is everything.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from robotbrain.errors import InputError
from robotbrain.grading.marks import Marks
from robotbrain.grading.reports.page import clean

FORMATS = ("csv", "canvas", "moodle", "blackboard", "gradescope")
_ROSTER = ("name", "email", "id", "sis_id", "login", "section")
_FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n", "＝", "＋", "－", "＠")


@dataclass(frozen=True)
class Person:
    """A student as an LMS knows one; an empty field is not known."""

    student: str
    name: str = ""
    email: str = ""
    id: str = ""
    sis_id: str = ""
    login: str = ""
    section: str = ""


def read_roster(path: Path) -> dict[str, Person]:
    """Read who is who; raises :class:`InputError` for a file without a column ``student`` or with a doublet."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError("roster", given=f"{path}: {error}", expected="a CSV file", fix="Check the path.") from None
    people: dict[str, Person] = {}
    for row in rows:
        known = {(key or "").strip().lower(): (value or "").strip() for key, value in row.items() if key is not None}
        student = known.get("student", "")
        if not student or student in people:
            raise InputError(
                "roster",
                given=dict(row),
                expected="each student once, in a column `student`",
                fix=f"The first line is e.g. student,{','.join(_ROSTER)}.",
            )
        people[student] = Person(student, **{field: known.get(field, "") for field in _ROSTER})
    return people


def person(student: str, roster: Mapping[str, Person] | None) -> Person:
    """The student's entry; without a roster the folder's name stands for login, id and name."""
    if roster is None:
        return Person(student, name=student, sis_id=student, login=student)
    if student not in roster:
        raise InputError("roster", given=student, expected="a line for every student", fix="Add one for this student.")
    return roster[student]


def harmless(text: str) -> str:
    """``text`` as a cell that no spreadsheet takes for a formula (OWASP, *CSV Injection*), on one line."""
    text = " ".join(clean(text, 2000).split())
    return f"'{text}" if text.startswith(_FORMULA) else text


def exact(text: str, what: str) -> str:
    """An identifier, unchanged: it must match the LMS's. One that a spreadsheet would run as a formula is refused."""
    if text.startswith(_FORMULA) or any(ord(c) < 32 for c in text):
        raise InputError(what, given=text, expected="no =, +, -, @ or control character", fix="Correct the roster.")
    return text


def canvas(rows: Sequence[Marks], title: str, assignment: str = "", roster: Mapping[str, Person] | None = None) -> str:
    """Canvas' gradebook import. ``assignment`` is the assignment's number in Canvas; without it a new one is made."""
    column = f"{title} ({assignment})" if assignment else title
    table: list[list[str]] = [["Student", "ID", "SIS User ID", "SIS Login ID", "Section", harmless(column)]]
    table.append(["    Points Possible", "", "", "", "", f"{_most(rows):g}"])
    for row in rows:
        who = person(row.student, roster)
        table.append(
            [
                harmless(who.name),
                exact(who.id, "Canvas id"),
                exact(who.sis_id, "SIS user id"),
                exact(who.login, "SIS login id"),
                harmless(who.section),
                _grade(row),
            ]
        )
    return _csv(table)


def moodle(rows: Sequence[Marks], title: str, roster: Mapping[str, Person] | None = None) -> str:
    """Moodle's grade import. Grade and feedback belong together: Moodle drops the grade of a feedback alone."""
    table = [["ID number", "Email address", "Full name", harmless(title), harmless(f"{title} feedback")]]
    for row in rows:
        who = person(row.student, roster)
        identity = [exact(who.sis_id or who.id, "Moodle id number"), exact(who.email, "email"), harmless(who.name)]
        table.append([*identity, _grade(row), harmless(row.reason())])
    return _csv(table)


def blackboard(rows: Sequence[Marks], title: str, column: str = "", roster: Mapping[str, Person] | None = None) -> str:
    """Blackboard's upload, tab-separated. ``column`` is the column's id; without it a new text column is made."""
    head = f"{title} [Total Pts: {_most(rows):g} Score] |{column}" if column else title
    table = [["Last Name", "First Name", "Username", "Student ID", harmless(head)]]
    for row in rows:
        who = person(row.student, roster)
        first, _, last = who.name.rpartition(" ")
        if "," in who.name:
            last, _, first = who.name.partition(",")
        identity = [exact(who.login or who.student, "username"), exact(who.sis_id or who.id, "student id")]
        table.append([harmless(last), harmless(first), *identity, _grade(row)])
    return _csv(table, delimiter="\t")


def _grade(row: Marks) -> str:
    """The total; empty while a person has yet to grade, so that no half grade is published."""
    return "" if row.pending else f"{row.earned:g}"


def _most(rows: Sequence[Marks]) -> float:
    return max((row.points for row in rows), default=0.0)


def _csv(table: Sequence[Sequence[str]], delimiter: str = ",") -> str:
    out = io.StringIO()
    csv.writer(out, delimiter=delimiter, lineterminator="\r\n").writerows(table)
    return out.getvalue()
