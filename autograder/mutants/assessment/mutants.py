"""Wrong answers to the practice paper: one for each question, named after the misconception that it is."""

from __future__ import annotations

from robotbrain.assessment.formulas import evaluate
from robotbrain.assessment.marking import right_answer
from robotbrain.assessment.records import practice_draw
from robotbrain.grading.sample import Mutant, Style


def _line(name, value):
    return f"{name} = {value!r}"


def _mistake(drawn):
    """Return the cell and the key of the first mistake that the question knows."""
    q, name = drawn.question, drawn.item.name
    if q.kind == "code":
        return q.slips[0].wrong.replace("def answer(", f"def {name}(", 1), f"{q.id}-slip-0"
    if q.kind == "numeric":
        return _line(name, f"{evaluate(q.slips[0].wrong, drawn.values)!r} {q.unit}"), f"{q.id}-slip-0"
    if q.kind == "order":
        first, second, *rest = right_answer(drawn)
        return _line(name, [second, first, *rest]), f"{q.id}-step-0"
    wrong = next(i for i, o in enumerate(q.options) if not o.right)
    letter = drawn.letters_of([wrong])[0]
    chosen = letter if q.kind == "single" else [*right_answer(drawn), letter]
    return _line(name, chosen), f"{q.id}-option-{wrong}"


def _mutant(drawn):
    source, key = _mistake(drawn)
    q, name = drawn.question, drawn.item.name
    return Mutant(name=key, exercise=q.topic, hint=key, describe=f"{name}: a known mistake", replace={name: source})


_DRAW = practice_draw()

MUTANTS = [_mutant(drawn) for drawn in _DRAW.questions]


def _differently(drawn):
    """The right answer, written in another way."""
    q, name, right = drawn.question, drawn.item.name, right_answer(drawn)
    match q.kind:
        case "single":
            return _line(name, [right.upper()])
        case "multiple":
            return _line(name, ", ".join(reversed(right)))
        case "order":
            return _line(name, " > ".join(right).upper())
        case "numeric":
            return _line(name, evaluate(q.answer, drawn.values) * (1 + q.tolerance / 2))
    return right.replace(f"def {name}(", "def function(", 1) + f"\n\n{name} = lambda *values: function(*values)"


STYLES = [
    Style(
        name="otherwise",
        describe="letters in capitals, as text or as lists; numbers without their unit; functions as lambdas",
        replace={drawn.item.name: _differently(drawn) for drawn in _DRAW.questions},
    )
]
