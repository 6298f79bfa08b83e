"""What a run would change in marks that are in the gradebook already: who, from what, to what, and why."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from robotbrain.grading.gradebook import CellScore, Standing

_SAME = 1e-9


@dataclass(frozen=True)
class Change:
    """One student whose total changes.

    Attributes:
        before, after: points that count, with what people gave.
        why: what brought it about, and what is lost now.
    """

    student: str
    before: float
    after: float
    why: str

    @property
    def lower(self) -> bool:
        """Whether the student loses points."""
        return self.after < self.before - _SAME


def expected(standing: Standing, scores: Mapping[tuple[str, str], float | None]) -> Standing:
    """``standing`` once the tests' ``scores`` are entered; what people gave stays."""
    empty = CellScore(None, None, None)
    after = {cell: replace(standing.scores.get(cell, empty), auto=auto) for cell, auto in scores.items()}
    return replace(standing, scores={**standing.scores, **after})


def change(student: str, before: Standing, after: Standing, why: str) -> Change | None:
    """The change of a student's total, or None if there were no marks or they stay as they are."""
    totals = [sum(s.effective for s in standing.scores.values()) for standing in (before, after)]
    if not before.marked or abs(totals[0] - totals[1]) <= _SAME:
        return None
    return Change(student, totals[0], totals[1], why)


def changes_text(changes: Sequence[Change], *, widest: int = 100) -> str:
    """The changes as a table, losses first."""
    head = ("student", "from", "to", "why")
    ordered = sorted(changes, key=lambda c: (not c.lower, c.student))
    body = [(c.student, f"{c.before:g}", f"{c.after:g}", _short(c.why, widest)) for c in ordered]
    widths = [max(len(line[i]) for line in (head, *body)) for i in range(3)]
    lines = [
        f"{who:<{widths[0]}}  {old:>{widths[1]}}  {new:>{widths[2]}}  {why}" for who, old, new, why in (head, *body)
    ]
    return "\n".join(line.rstrip() for line in lines)


def _short(text: str, widest: int) -> str:
    text = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return text if len(text) <= widest else text[: widest - 1] + "…"
