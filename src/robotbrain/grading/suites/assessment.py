"""Visible tests of the assessment: are the answers there, and can they be read?

On the practice paper, whose key is public, they also say what is right and why.
"""

from __future__ import annotations

import os
from collections.abc import Callable

from robotbrain.assessment.draw import PER_TOPIC, Draw
from robotbrain.assessment.paper import TOPICS, Item, Paper
from robotbrain.errors import InputError
from robotbrain.grading import Student, Suite, fail
from robotbrain.grading.expect import CheckFailure
from robotbrain.grading.student import STUDENT_VARIABLE
from robotbrain.grading.suite import AUTOGRADER_VARIABLE

suite = Suite("assessment")
suite.crosses(Paper, Item)

POINTS, FORM_POINTS = 10.0, 0.5
NAMES: dict[str, tuple[str, ...]] = {
    topic: tuple(f"q{PER_TOPIC * place + k + 1:02d}" for k in range(PER_TOPIC)) for place, topic in enumerate(TOPICS)
}
"""The questions of each topic: their names are the same on every paper."""

for _topic, _title in TOPICS.items():
    suite.exercise(_topic, title=_title, points=POINTS, provides=NAMES[_topic])

suite.hint("answer-form", "Below the question stands the form of the answer: letters in quotation marks, a number "
           "with its unit as text, or a function with the name of the question.")  # fmt: skip


def recorded() -> Draw | None:
    """The draw that counts, where the autograder is and papers were drawn for a class; else None."""
    from robotbrain.assessment.records import read_records, recorded_draw

    autograder = os.environ.get(AUTOGRADER_VARIABLE, "")
    if not autograder or not read_records(autograder):
        return None
    student = os.environ.get(STUDENT_VARIABLE, "")
    try:
        return recorded_draw(autograder, student)
    except InputError as error:
        raise CheckFailure(f"no paper is recorded for you, please tell the course staff ({error.what})") from error


def _in_the_right_form(names: tuple[str, ...]) -> Callable[[Student], float]:
    def answers_can_be_read(student: Student) -> float:
        made = recorded()
        paper: Paper = made.paper if made is not None else student["paper"]
        answers = {name: student[name] for name in names if student.has(name)}
        if all(answer is ... for answer in answers.values()):
            raise NotImplementedError
        problems, credit = [], 0.0
        for name in names:
            answer = answers.get(name, ...)
            try:
                paper[name].read(answer)
            except InputError as error:
                problems.append(f"{name} is not answered yet" if answer is ... else str(error))
                continue
            found, said = _practised(paper, name, answer)
            credit += found
            if found < 1:
                problems.append(f"{name}: {said}")
        if problems:
            fail("\n".join(problems), hint="answer-form" if not paper.practice else "", credit=credit / len(names))
        return credit / len(names)

    return answers_can_be_read


def _practised(paper: Paper, name: str, answer: object) -> tuple[float, str]:
    """On the practice paper: the credit of an answer, and what is to be said of it. Elsewhere nothing is told."""
    if not paper.practice:
        return 1.0, ""
    from robotbrain.assessment.marking import advice, mark
    from robotbrain.assessment.records import practice_draw

    drawn = practice_draw()[name]
    marked = mark(drawn, answer)
    return marked.credit, "" if marked.right else advice(drawn.question, marked.key)


for _topic, _names in NAMES.items():
    suite.test(_topic, points=FORM_POINTS, name="answers can be read", reread="How to answer")(
        _in_the_right_form(_names)
    )
