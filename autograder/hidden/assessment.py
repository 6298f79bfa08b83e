"""Hidden tests of the assessment: they mark each answer against the key of the student's recorded draw.

Where no papers were drawn (`robotbrain assessment draw`) the practice paper counts, so that grading can be tried out.
"""

from __future__ import annotations

import functools
from pathlib import Path

from robotbrain.assessment.bank import FOLDER, load_bank, practice_bank
from robotbrain.assessment.marking import advice, mark, reasons
from robotbrain.assessment.records import practice_draw
from robotbrain.errors import InputError
from robotbrain.grading import Suite, fail
from robotbrain.grading.suites.assessment import FORM_POINTS, NAMES, POINTS, recorded

suite = Suite.extending("assessment")

for _bank in (load_bank(Path(__file__).parents[1] / FOLDER), practice_bank()):
    for _question in _bank.questions:  # so that reports can count misconceptions over a class
        for _key in reasons(_question):
            suite.hint(_key, advice(_question, _key))

_practice = functools.cache(practice_draw)


def _marks(name):
    def answer_is_right(student):
        drawn = (recorded() or _practice())[name]
        answer = student[name] if student.has(name) else ...
        if answer is ...:
            raise NotImplementedError
        try:
            marked = mark(drawn, answer)
        except InputError as error:
            return fail(str(error), hint="answer-form")
        if not marked.right:
            return fail(marked.reason, hint=marked.key, credit=marked.credit)
        return None

    return answer_is_right


for _topic, _names in NAMES.items():
    for _name in _names:
        suite.test(_topic, points=(POINTS - FORM_POINTS) / len(_names), name=f"{_name} is right")(_marks(_name))
