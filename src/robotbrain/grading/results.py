"""What one test said about one exercise."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Any


class Verdict(enum.StrEnum):
    """How a test ended. ``memory`` is reserved for the sandboxed runner."""

    PASSED = "passed"
    FAILED = "failed"
    ERROR = "error"
    TIMEOUT = "timeout"
    NOT_WRITTEN = "not_written"
    FORBIDDEN = "forbidden"
    CRASHED = "crashed"
    MEMORY = "memory"

    @property
    def label(self) -> str:
        """The verdict as a reader sees it, e.g. ``"not written yet"``."""
        return _LABELS[self]

    @property
    def symbol(self) -> str:
        """One character that tells verdicts apart without colour."""
        return "✓" if self is Verdict.PASSED else "…" if self is Verdict.NOT_WRITTEN else "✗"


_LABELS = {
    Verdict.PASSED: "passed",
    Verdict.FAILED: "failed",
    Verdict.ERROR: "raised an error",
    Verdict.TIMEOUT: "did not finish",
    Verdict.NOT_WRITTEN: "not written yet",
    Verdict.FORBIDDEN: "not allowed",
    Verdict.CRASHED: "ended the kernel",
    Verdict.MEMORY: "ran out of memory",
}


@dataclass(frozen=True)
class TestResult:
    """The outcome of one test.

    Attributes:
        points: what the test is worth.
        earned: what it gave, in ``[0, points]``.
        message: one sentence on what happened; for a hidden test, nothing that reveals the test.
        given, expected, got: already formatted for reading, or ``""``.
        hint_key: the key in :attr:`Suite.hints` (or the hint itself where it was written inline).
        seconds: wall time of the test (s); informative only, never part of a grade.
    """

    __test__ = False  # the name begins with "Test", but this is no pytest class

    exercise: str
    name: str
    points: float
    earned: float
    verdict: Verdict
    message: str = ""
    given: str = ""
    expected: str = ""
    got: str = ""
    misconception: str = ""
    hint_key: str = ""
    hint: str = ""
    reread: str = ""
    printed: str = ""
    hidden: bool = False
    seconds: float = 0.0

    @property
    def passed(self) -> bool:
        """Whether the test gave all its points."""
        return self.verdict is Verdict.PASSED

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready form. A hidden test keeps its name, verdict, points and hint, and nothing else."""
        shown: dict[str, Any] = {
            "exercise": self.exercise,
            "name": self.name,
            "points": self.points,
            "earned": round(self.earned, 6),
            "verdict": str(self.verdict),
            "message": self.message,
            "hint_key": self.hint_key,
            "hint": self.hint,
            "reread": self.reread,
            "hidden": self.hidden,
            "seconds": 0.0 if self.hidden else round(self.seconds, 3),  # a sleep could tell what was passed in
        }
        if not self.hidden:
            shown |= {
                "given": self.given,
                "expected": self.expected,
                "got": self.got,
                "misconception": self.misconception,
                "printed": self.printed,
            }
        return shown
