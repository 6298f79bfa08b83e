"""Questions with their key, as a bank holds them."""

from __future__ import annotations

import ast
import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from robotbrain.assessment import units
from robotbrain.assessment.formulas import evaluate
from robotbrain.assessment.paper import KINDS, TOPICS
from robotbrain.errors import InputError

OBJECTIVES: dict[str, str] = {
    "deploy": "Deploy deep learning models on edge computing platforms",
    "learn": "Implement reinforcement learning for robot control and navigation",
    "transfer": "Train models in simulation and transfer them to robots",
    "integrate": "Integrate perception and planning with robot execution",
    "optimise": "Optimise models for real-time performance",
}
"""The learning objectives of the course outline."""

DIFFICULTIES = {1: "recall", 2: "apply", 3: "analyse"}
MANY = 20_000  # combinations of parameters that are still all looked at
_ID = re.compile(r"[a-z0-9]+(-[a-z0-9]+)*")
_PLACE = re.compile(r"\{([a-z_][a-z0-9_]*)\}")


@dataclass(frozen=True)
class Option:
    """Something to choose; ``why`` says why it is right, or which misconception it is."""

    text: str
    right: bool
    why: str


@dataclass(frozen=True)
class Slip:
    """A mistake that leads to a wrong answer: a formula for its value, or the code of a wrong function."""

    wrong: str
    why: str


@dataclass(frozen=True)
class Question:
    """One question with its key; which fields are filled depends on ``kind``.

    Attributes:
        text: Markdown; ``{name}`` stands for a parameter.
        explain: why the right answer is right.
        reread: where.
        options: of ``single`` and ``multiple``.
        parameters: of ``numeric``, by name the values that may be drawn.
        rows: of ``numeric``, sets of parameters that are drawn together.
        answer: of ``numeric``, a formula.
        tolerance: of ``numeric``, relative to the answer.
        steps: of ``order``, first to last.
        because: of ``order``, why each step comes before the next.
        function: of ``code``, the first line of a function called ``answer``.
        reference: of ``code``, such a function.
        cases: of ``code``, arguments to try it with.
        slips: of ``numeric`` and ``code``.
    """

    id: str
    topic: str
    kind: str
    objective: str
    difficulty: int
    text: str
    explain: str
    reread: str
    options: tuple[Option, ...] = ()
    parameters: Mapping[str, tuple[Any, ...]] = field(default_factory=dict)
    rows: tuple[Mapping[str, Any], ...] = ()
    answer: str = ""
    unit: str = ""
    tolerance: float = 0.02
    steps: tuple[str, ...] = ()
    because: tuple[str, ...] = ()
    function: str = ""
    reference: str = ""
    cases: tuple[tuple[Any, ...], ...] = ()
    slips: tuple[Slip, ...] = ()

    def combinations(self) -> Iterator[dict[str, Any]]:
        """Every set of parameters that can be drawn."""
        names = list(self.parameters)
        for row in self.rows or ({},):
            for values in itertools.product(*(self.parameters[n] for n in names)):
                yield {**row, **dict(zip(names, values, strict=True))}

    def filled(self, values: Mapping[str, Any]) -> str:
        """The text with parameters put in."""
        return _PLACE.sub(lambda m: _shown(values[m[1]]), self.text) if values else self.text


def _shown(value: Any) -> str:
    return value if isinstance(value, str) else f"{value:.10g}"


def question_from(entry: Mapping[str, Any], topic: str = "") -> Question:
    """Make a question from a table of a bank, and check it.

    Args:
        topic: where the table names none.

    Raises:
        InputError: something is missing, unknown or contradictory; the message names question and field.
    """
    entry = {"topic": topic, **entry}
    where = str(entry.get("id", "a question without id"))
    try:
        question = _parsed(entry)
    except KeyError as error:
        raise _error(where, str(error.args[0]), "nothing", "this field") from None
    except (TypeError, ValueError, AttributeError) as error:
        raise _error(where, "layout", f"{type(error).__name__}: {error}", "the fields of its kind") from None
    _check(question)
    return question


def _parsed(entry: Mapping[str, Any]) -> Question:
    kind = entry["kind"]
    known = {"id", "topic", "kind", "objective", "difficulty", "text", "explain", "reread", *_FIELDS.get(kind, ())}
    for name in entry:
        if name not in known:
            raise _error(str(entry.get("id")), name, entry[name], f"the fields of {kind}: {', '.join(sorted(known))}")
    common: dict[str, Any] = {
        k: str(entry[k]).strip() for k in ("id", "topic", "kind", "objective", "text", "explain", "reread")
    }
    body: dict[str, Any] = {}
    if kind in ("single", "multiple"):
        right = [(entry["right"], entry["explain"])] if kind == "single" else entry["right"]
        body["options"] = (
            *(Option(str(text), True, str(why)) for text, why in right),
            *(Option(str(text), False, str(why)) for text, why in entry["wrong"]),
        )
    elif kind == "numeric":
        body["parameters"] = {name: tuple(values) for name, values in entry.get("parameters", {}).items()}
        body["rows"] = tuple(entry.get("rows", ()))
        body |= {"answer": str(entry["answer"]), "unit": str(entry["unit"])}
        body["tolerance"] = float(entry.get("tolerance", 0.02))
    elif kind == "order":
        body |= {"steps": tuple(entry["steps"]), "because": tuple(entry["because"])}
    elif kind == "code":
        body |= {"function": str(entry["function"]), "reference": str(entry["reference"])}
        body["cases"] = tuple(tuple(case) for case in entry["cases"])
    if kind in ("numeric", "code"):
        body["slips"] = tuple(Slip(str(wrong), str(why)) for wrong, why in entry["slips"])
    return Question(**common, difficulty=int(entry["difficulty"]), **body)


_FIELDS: dict[str, tuple[str, ...]] = {
    "single": ("right", "wrong"),
    "multiple": ("right", "wrong"),
    "numeric": ("parameters", "rows", "answer", "unit", "tolerance", "slips"),
    "order": ("steps", "because"),
    "code": ("function", "reference", "cases", "slips"),
}


def _check(q: Question) -> None:
    def must(condition: bool, field_: str, given: object, expected: str) -> None:
        if not condition:
            raise _error(q.id, field_, given, expected)

    must(bool(_ID.fullmatch(q.id)), "id", q.id, "words-joined-by-hyphens")
    must(q.topic in TOPICS, "topic", q.topic, f"one of {', '.join(TOPICS)}")
    must(q.kind in KINDS, "kind", q.kind, f"one of {', '.join(KINDS)}")
    must(q.objective in OBJECTIVES, "objective", q.objective, f"one of {', '.join(OBJECTIVES)}")
    must(q.difficulty in DIFFICULTIES, "difficulty", q.difficulty, "1, 2 or 3")
    for name in ("text", "explain", "reread"):
        must(bool(getattr(q, name)), name, "nothing", "a sentence")
    reasons = [*(o.why for o in q.options), *(s.why for s in q.slips), *q.because]
    must(all(r.strip() for r in reasons), "reasons", reasons, "a reason for every option, slip and step")
    if q.options:
        texts = [o.text for o in q.options]
        must(3 <= len(texts) <= 6, "options", len(texts), "3 to 6 options")
        must(len(set(texts)) == len(texts), "options", texts, "different ones")
        must(any(not o.right for o in q.options), "wrong", "nothing", "at least one wrong option")
        must(any(o.right for o in q.options), "right", "nothing", "at least one right option")
    if q.kind == "numeric":
        _check_numeric(q, must)
    if q.kind == "order":
        must(4 <= len(set(q.steps)) == len(q.steps) <= 7, "steps", q.steps, "4 to 7 different steps")
        must(len(q.because) == len(q.steps) - 1, "because", len(q.because), "one reason between two steps")
    if q.kind == "code":
        for name, source in (("reference", q.reference), *(("slips", s.wrong) for s in q.slips)):
            must(_defines_answer(source), name, source, "the definition of a function `answer`")
        must(len(q.cases) >= 3, "cases", len(q.cases), "at least three")
        must(q.function.startswith("def answer("), "function", q.function, "def answer(...):")


def _check_numeric(q: Question, must: Any) -> None:
    units.quantity_of(q.unit)
    must(0 < q.tolerance <= 0.1, "tolerance", q.tolerance, "more than 0, at most 0.1 (relative)")
    must(bool(q.slips), "slips", "nothing", "at least one likely mistake")
    count = 0
    for values in q.combinations():
        count += 1
        must(count <= MANY, "parameters", f"more than {MANY} combinations", "fewer values")
        missing = [name for name in _PLACE.findall(q.text) if name not in values]
        must(not missing, "text", missing, f"parameters among {', '.join(values)}")
        if count > 64 and count % 37:  # a sample is enough when a bank is read; tests look at all
            continue
        check_values(q, values)


def check_values(q: Question, values: Mapping[str, Any]) -> None:
    """Check that a numeric question has an answer for these parameters, and that its slips lead elsewhere."""
    answer = evaluate(q.answer, values)
    if answer == 0:
        raise _error(
            q.id, "answer", f"0 for {dict(values)}", "something else: a relative tolerance has no meaning at 0"
        )
    for slip in q.slips:
        wrong = evaluate(slip.wrong, values)
        if abs(wrong - answer) <= 2.5 * q.tolerance * abs(answer):
            given = f"{slip.wrong} = {wrong:g} for {dict(values)}"
            raise _error(q.id, "slips", given, f"a value that is not nearly the answer, {answer:g}")


def _defines_answer(source: str) -> bool:
    try:
        body = ast.parse(source).body
    except SyntaxError:
        return False
    return any(isinstance(node, ast.FunctionDef) and node.name == "answer" for node in body)


def _error(question: str, what: str, given: object, expected: str) -> InputError:
    return InputError(f"{question}: {what}", given=given, expected=expected, fix="Correct the bank.")


def by_topic(questions: Sequence[Question]) -> dict[str, list[Question]]:
    """Questions by topic, in the order of the lessons."""
    return {topic: [q for q in questions if q.topic == topic] for topic in TOPICS}
