"""Marking an answer against the key.

The rules, which the notebook tells its readers:

* *single*: right or wrong.
* *multiple*: the share of right options that were chosen, less the share of wrong ones; never below zero. So whoever
  chooses all, none, or by tossing a coin earns nothing to speak of.
* *numeric*: right within the tolerance, in whichever unit.
* *order*: one, less two times the share of pairs that stand the wrong way round (Kendall's tau); never below zero.
* *code*: right if all cases are.
"""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from robotbrain.assessment.draw import Drawn
from robotbrain.assessment.formulas import evaluate
from robotbrain.assessment.paper import TOPICS
from robotbrain.assessment.questions import Question


@dataclass(frozen=True)
class Marked:
    """What became of an answer.

    Attributes:
        credit: from 0 to 1.
        reason: why it is right, or which mistake it is.
        key: of the mistake, e.g. ``"arch-latched-wrong-2"``, by which a class can be counted; ``""`` if right.
    """

    credit: float
    reason: str
    key: str = ""

    @property
    def right(self) -> bool:
        """Whether the answer earns all."""
        return self.credit >= 1.0


_PREFIX = "The digits are right and the size is not: look at the unit's prefix (milli, kilo, mega)."
_SIGN = "The size is right and the sign is not."
_RAISED = "Your function raised an error for at least one of the values that it was tried with."


def mark(drawn: Drawn, answer: object) -> Marked:
    """Mark ``answer``, in whatever form :meth:`~robotbrain.assessment.paper.Item.read` takes.

    Raises:
        InputError: it cannot be read.
    """
    value = drawn.item.read(answer)
    return _MARKERS[drawn.question.kind](drawn, value)


def right_answer(drawn: Drawn) -> Any:
    """The right answer in the form in which it is written; for ``code`` the text of a function."""
    q = drawn.question
    if q.kind == "numeric":
        return f"{evaluate(q.answer, drawn.values):.6g} {q.unit}".strip()
    if q.kind == "code":
        return q.reference.replace("def answer(", f"def {drawn.item.name}(", 1)
    if q.kind == "order":
        return list(drawn.letters_of(range(len(q.steps))))
    letters = sorted(drawn.letters_of([i for i, o in enumerate(q.options) if o.right]))
    return letters[0] if q.kind == "single" else letters


def reasons(question: Question) -> dict[str, str]:
    """Every mistake that marking can name for a question: its text by its key."""
    found = {f"{question.id}-option-{i}": o.why for i, o in enumerate(question.options)}
    found |= {f"{question.id}-slip-{i}": s.why for i, s in enumerate(question.slips)}
    found |= {f"{question.id}-step-{i}": why for i, why in enumerate(question.because)}
    if question.kind == "numeric":
        found |= {f"{question.id}-prefix": _PREFIX, f"{question.id}-sign": _SIGN}
    if question.kind == "code":
        found[f"{question.id}-raised"] = _RAISED
    return found | {f"{question.id}-other": question.explain}


def advice(question: Question, key: str) -> str:
    """What a student is told of a mistake: the reason, the explanation, and where to reread."""
    reason = reasons(question)[key]
    lesson = list(TOPICS).index(question.topic) + 1
    parts = [reason] + ([question.explain] if question.explain != reason else [])
    return f"{' '.join(parts)} Reread lesson {lesson}, {question.reread}."


def _wrong(question: Question, key: str, credit: float = 0.0, more: Sequence[str] = ()) -> Marked:
    key = f"{question.id}-{key}"
    return Marked(credit, " ".join([reasons(question)[key], *more]), key)


def _mark_single(drawn: Drawn, letter: str) -> Marked:
    index = drawn.order[drawn.item.letters.index(letter)]
    if drawn.question.options[index].right:
        return Marked(1.0, drawn.question.explain)
    return _wrong(drawn.question, f"option-{index}")


def _mark_multiple(drawn: Drawn, letters: tuple[str, ...]) -> Marked:
    options = drawn.question.options
    chosen = {drawn.order[drawn.item.letters.index(letter)] for letter in letters}
    right = {i for i, o in enumerate(options) if o.right}
    wrong = set(range(len(options))) - right
    if chosen == right:
        return Marked(1.0, drawn.question.explain)
    credit = max(0.0, len(chosen & right) / len(right) - len(chosen & wrong) / len(wrong))
    mistakes = [*sorted(chosen - right), *sorted(right - chosen)]
    others = [options[i].why for i in mistakes[1:]]
    return _wrong(drawn.question, f"option-{mistakes[0]}", credit, others)


def _mark_numeric(drawn: Drawn, number: float) -> Marked:
    q = drawn.question
    wanted = evaluate(q.answer, drawn.values)

    def near(value: float) -> bool:
        return math.isclose(number, value, rel_tol=q.tolerance, abs_tol=0.0)

    if abs(number - wanted) <= q.tolerance * abs(wanted):
        return Marked(1.0, q.explain)
    for index, slip in enumerate(q.slips):
        if near(evaluate(slip.wrong, drawn.values)):
            return _wrong(q, f"slip-{index}")
    if near(-wanted):
        return _wrong(q, "sign")
    if any(near(wanted * 10.0**power) for power in (-9, -6, -3, -2, 2, 3, 6, 9)):
        return _wrong(q, "prefix")
    return _wrong(q, "other")


def _mark_order(drawn: Drawn, letters: tuple[str, ...]) -> Marked:
    q = drawn.question
    places = {drawn.order[drawn.item.letters.index(letter)]: place for place, letter in enumerate(letters)}
    pairs = list(itertools.combinations(range(len(q.steps)), 2))
    turned = sum(places[a] > places[b] for a, b in pairs)
    if not turned:
        return Marked(1.0, q.explain)
    first = next(i for i in range(len(q.steps) - 1) if places[i] > places[i + 1])
    return _wrong(q, f"step-{first}", max(0.0, 1 - 2 * turned / len(pairs)))


def _mark_code(drawn: Drawn, function: Callable[..., Any]) -> Marked:
    q = drawn.question
    found = [_called(function, case) for case in q.cases]
    if _alike(found, _outputs(q.reference, q.cases)):
        return Marked(1.0, q.explain)
    for index, slip in enumerate(q.slips):
        if _alike(found, _outputs(slip.wrong, q.cases)):
            return _wrong(q, f"slip-{index}")
    return _wrong(q, "raised" if any(isinstance(outcome, _Failed) for outcome in found) else "other")


_MARKERS: dict[str, Callable[[Drawn, Any], Marked]] = {
    "single": _mark_single,
    "multiple": _mark_multiple,
    "numeric": _mark_numeric,
    "order": _mark_order,
    "code": _mark_code,
}


def _outputs(source: str, cases: Sequence[tuple[Any, ...]]) -> list[Any]:
    """What a function of the BANK answers; its code is the course's own."""
    namespace: dict[str, Any] = {"math": math}
    exec(compile(source, "<bank>", "exec"), namespace)
    return [_called(namespace["answer"], case) for case in cases]


class _Failed:
    """Stands for the outcome of a call that raised."""


def _called(function: Callable[..., Any], case: tuple[Any, ...]) -> Any:
    try:
        return function(*copy.deepcopy(case))
    except NotImplementedError:
        raise
    except Exception:
        return _Failed()


def _alike(found: Sequence[Any], wanted: Sequence[Any]) -> bool:
    return all(same(f, w) for f, w in zip(found, wanted, strict=True))


def same(found: Any, wanted: Any) -> bool:
    """Whether two outcomes are equal: numbers to a millionth, sequences element by element, NaN equal to NaN."""
    if isinstance(wanted, _Failed):
        return isinstance(found, _Failed)
    if isinstance(wanted, (list, tuple)):
        if hasattr(found, "tolist") and not isinstance(found, (list, tuple)):
            found = found.tolist()
        if not isinstance(found, (list, tuple)) or len(found) != len(wanted):
            return False
        return all(same(f, w) for f, w in zip(found, wanted, strict=True))
    if isinstance(wanted, (bool, str)) or wanted is None:
        return type(found) is type(wanted) and bool(found == wanted)
    try:
        number = float(found)
    except (TypeError, ValueError):
        return False
    if isinstance(found, (bool, str)):
        return False
    return math.isclose(number, float(wanted), rel_tol=1e-6, abs_tol=1e-9) or (
        math.isnan(number) and math.isnan(wanted)
    )
