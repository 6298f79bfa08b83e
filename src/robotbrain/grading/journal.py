"""Which test was running when the kernel ended, so that the next kernel can leave it out.

The executor names a file in ``ROBOTBRAIN_JOURNAL``; the runner appends one line before and one after each test. After
a kernel death the executor reads which test had begun and not ended, and passes it to the next kernel in
``ROBOTBRAIN_CRASHED``: that test is then not run again and gets the verdict "crashed". Without these variables (a
student's own notebook) nothing is written or read.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

JOURNAL_VARIABLE = "ROBOTBRAIN_JOURNAL"
CRASHED_VARIABLE = "ROBOTBRAIN_CRASHED"
ALL_TESTS = "*"


def begun(exercise: str, test: str) -> None:
    """Note that a test starts."""
    _append("begun", exercise, test)


def ended(exercise: str, test: str) -> None:
    """Note that a test ended, in whatever way."""
    _append("ended", exercise, test)


def unfinished(path: Path) -> tuple[str, str] | None:
    """The (exercise, test) begun last and not ended, or None."""
    if not path.exists():
        return None
    pending: list[tuple[str, str]] = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            what, exercise, test = json.loads(line)
        except ValueError:  # the kernel died while writing this line
            continue
        if what == "begun":
            pending.append((exercise, test))
        elif (exercise, test) in pending:
            pending.remove((exercise, test))
    return pending[-1] if pending else None


def crashed_before(exercise: str, test: str) -> bool:
    """Whether this test ended an earlier kernel of the same grading run."""
    crashed = json.loads(os.environ.get(CRASHED_VARIABLE, "[]"))
    return [exercise, test] in crashed or [exercise, ALL_TESTS] in crashed


def _append(what: str, exercise: str, test: str) -> None:
    path = os.environ.get(JOURNAL_VARIABLE)
    if path:
        with Path(path).open("a", encoding="utf-8") as file:
            file.write(json.dumps([what, exercise, test]) + "\n")
