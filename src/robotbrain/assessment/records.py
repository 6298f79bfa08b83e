"""Which student got which paper: the record that grading goes by."""

from __future__ import annotations

import json
import re
import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robotbrain.assessment.bank import FOLDER, Bank, load_bank, practice_bank
from robotbrain.assessment.draw import PRACTICE, Draw, arrange, draw
from robotbrain.assessment.paper import Paper
from robotbrain.errors import InputError
from robotbrain.files import write_text

RECORD = "draws.json"
PAPER = "paper.json"
PRACTICE_SEED = "practice"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._@+-]{0,99}")


@dataclass(frozen=True)
class Record:
    """One student's draw: enough to make it again, also after questions were added to the bank."""

    seed: str
    ids: tuple[str, ...]
    code: str


def open_paper(path: str | Path = PAPER) -> Paper:
    """The paper in a file; the practice paper if there is no such file."""
    return Paper.load(path) if Path(path).is_file() else practice_draw().paper


def practice_draw(seed: str = PRACTICE_SEED) -> Draw:
    """A paper from the public questions, with its key."""
    return draw(practice_bank(), seed, PRACTICE)


def read_students(path: str | Path) -> list[str]:
    """Names of students, one a line or in the first column of a CSV file; ``#`` begins a comment."""
    lines = (
        line.split("#")[0].split(",")[0].strip().strip('"') for line in Path(path).read_text("utf-8-sig").splitlines()
    )
    names = [name for name in lines if name and name.lower() not in ("id", "student", "student_id", "username")]
    for name in names:
        if not _NAME.fullmatch(name):
            raise InputError("student", given=name, expected="letters, digits and . _ @ + -", fix=f"Correct {path}.")
    if not names or len(set(names)) != len(names):
        raise InputError(str(path), given=names[:5], expected="different names, one a line", fix="Correct the list.")
    return names


def read_records(autograder: str | Path) -> dict[str, Record]:
    """The recorded draws by student; empty if none were made."""
    path = Path(autograder) / FOLDER / RECORD
    if not path.is_file():
        return {}
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        entries: dict[str, Any] = content["students"]
        return {s: Record(str(e["seed"]), tuple(map(str, e["questions"])), str(e["code"])) for s, e in entries.items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            path.name, given=f"{type(error).__name__}: {error}", expected="recorded draws", fix="Restore it."
        ) from None


def draw_class(autograder: str | Path, students: Sequence[str], master_seed: str = "") -> dict[str, Draw]:
    """Draw a paper for each student who has none yet, record it, and return the papers of all of ``students``.

    Args:
        master_seed: from which each student's seed follows; default: seeds by chance, which nobody can guess.
    """
    bank, records = load_bank(Path(autograder) / FOLDER), read_records(autograder)
    draws = {}
    for student in students:
        if student not in records:
            seed = f"{master_seed}/{student}" if master_seed else secrets.token_hex(16)
            made = draw(bank, seed, student=student)
            records[student] = Record(seed, made.ids, made.paper.code)
        draws[student] = redraw(bank, records[student], student)
    entries = {s: {"seed": r.seed, "code": r.code, "questions": list(r.ids)} for s, r in sorted(records.items())}
    text = json.dumps({"format": 1, "students": entries}, indent=1) + "\n"
    write_text(Path(autograder) / FOLDER / RECORD, text)
    return draws


def redraw(bank: Bank, record: Record, student: str) -> Draw:
    """Make a recorded paper again; raises :class:`InputError` if the bank's text has changed since."""
    made = arrange([bank[name] for name in record.ids], record.seed, student=student, practice=bank.practice)
    if made.paper.code != record.code:
        raise InputError(
            f"paper of {student}",
            given=made.paper.code,
            expected=record.code,
            fix="A question, an option or the numbers of one have changed since the papers were drawn: undo that.",
        )
    return made


def recorded_draw(autograder: str | Path, student: str) -> Draw:
    """The paper, with its key, that a student's answers are marked by.

    Where no papers were drawn for anybody it is the practice paper, so that the assessment can be tried out.
    """
    records = read_records(autograder)
    if not records:
        return practice_draw()
    if student not in records:
        raise InputError(
            "student", given=student, expected="one for whom a paper was drawn", fix="Run `robotbrain assessment draw`."
        )
    return redraw(load_bank(Path(autograder) / FOLDER), records[student], student)
