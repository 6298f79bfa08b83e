"""Item analysis: how hard each exercise and test was, whether it tells strong work from weak, which mistakes occur."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from robotbrain.grading.marks import Mark, Marks
from robotbrain.grading.reports import statistics
from robotbrain.grading.reports.model import outcomes_of, ran
from robotbrain.grading.results import TestResult, Verdict

SMALL_CLASS = 30
"""Below this many submissions the report says that its numbers mean little."""
_LEAST = 5  # submissions from which on a number is worth a flag

Key = tuple[str, str]  # exercise and test; the test is "" for an exercise as a whole


@dataclass(frozen=True)
class Mistake:
    """A hint or likely mistake, and how many students it was shown to."""

    text: str
    students: int


@dataclass(frozen=True)
class Item:
    """One exercise or test over the whole class.

    Attributes:
        difficulty: mean share of the points (p).
        discrimination: corrected item-total correlation; NaN where there is none.
        upper_lower: difference between the upper and lower 27 %.
        verdicts: how many students got each verdict (tests only).
        mistakes: the hints shown, most frequent first.
        flags: what an instructor should look at, in words.
    """

    exercise: str
    test: str
    points: float
    hidden: bool
    difficulty: float
    discrimination: float
    upper_lower: float
    verdicts: dict[str, int] = field(default_factory=dict)
    mistakes: tuple[Mistake, ...] = ()
    flags: tuple[str, ...] = ()


@dataclass(frozen=True)
class Analysis:
    """The item analysis of a class.

    Attributes:
        students: submissions that count; ``left_out`` more held nothing to test.
        alpha: Cronbach's alpha over exercises and over tests; NaN where it does not exist.
        dichotomous: whether all tests gave all or nothing (alpha over tests is then KR-20).
        notable: the smallest discrimination that differs from 0 with 95 % confidence.
    """

    students: int
    left_out: int
    exercises: tuple[Item, ...]
    tests: tuple[Item, ...]
    alpha_exercises: float
    alpha_tests: float
    dichotomous: bool
    notable: float

    @property
    def small(self) -> bool:
        """Whether the class is too small for the numbers to mean much."""
        return self.students < SMALL_CLASS


def analyse(rows: Sequence[Marks]) -> Analysis:
    """Analyse what the tests gave; exercises that a person has yet to grade for somebody are left out."""
    taken = [row for row in rows if ran(row)]
    by_hand = {m.exercise for row in rows for m in row.marks if m.earned is None}
    exercises: list[Item] = []
    tests: list[Item] = []
    if taken:
        tests, test_scores = _items(taken, _tests_of, by_hand)
        exercises, exercise_scores = _items(taken, _exercises_of, by_hand)
    return Analysis(
        students=len(taken),
        left_out=len(rows) - len(taken),
        exercises=tuple(exercises),
        tests=tuple(tests),
        alpha_exercises=statistics.cronbach_alpha(exercise_scores) if taken else math.nan,
        alpha_tests=statistics.cronbach_alpha(test_scores) if taken else math.nan,
        dichotomous=bool(taken) and statistics.is_dichotomous(test_scores, np.array([t.points for t in tests])),
        notable=statistics.least_notable(len(taken)),
    )


@dataclass(frozen=True)
class _Answer:
    """What one student did on one item."""

    points: float
    earned: float
    outcomes: list[TestResult]


def _tests_of(mark: Mark) -> dict[Key, _Answer]:
    return {(mark.exercise, t.name): _Answer(t.points, t.earned, [t]) for t in outcomes_of(mark) if t.points > 0}


def _exercises_of(mark: Mark) -> dict[Key, _Answer]:
    return {(mark.exercise, ""): _Answer(mark.points, mark.earned or 0.0, outcomes_of(mark))} if mark.points > 0 else {}


def _items(
    rows: Sequence[Marks], answers_of: Callable[[Mark], dict[Key, _Answer]], leave_out: set[str]
) -> tuple[list[Item], statistics.Scores]:
    """The items, and the matrix of scores behind them; an item that did not run for a student scored 0."""
    answers = [
        {k: a for mark in row.marks if mark.exercise not in leave_out for k, a in answers_of(mark).items()}
        for row in rows
    ]
    keys = list(dict.fromkeys(key for given in answers for key in given))
    order = list(dict.fromkeys(mark.exercise for row in rows for mark in row.marks))
    keys.sort(key=lambda key: order.index(key[0]))  # stable: tests stay in their order
    most = {k: a.points for given in answers for k, a in given.items()}
    scores = np.array([[given[k].earned if k in given else 0.0 for k in keys] for given in answers]).reshape(
        len(rows), len(keys)
    )
    totals = scores.sum(axis=1)
    items = []
    for column, key in enumerate(keys):
        met = [given[key].outcomes for given in answers if key in given]
        item = Item(
            exercise=key[0],
            test=key[1],
            points=most[key],
            hidden=bool(key[1]) and any(o.hidden for outcomes in met for o in outcomes),
            difficulty=statistics.difficulty(scores[:, column], most[key]),
            discrimination=statistics.discrimination(scores, column) if len(keys) > 1 else math.nan,
            upper_lower=statistics.upper_lower(scores[:, column], totals, most[key]),
            verdicts=_verdicts(met, len(rows)) if key[1] else {},
            mistakes=_mistakes(met),
        )
        items.append(_flagged(item, len(rows)))
    return items, scores


def _verdicts(met: Sequence[Sequence[TestResult]], students: int) -> dict[str, int]:
    counted = Counter(o.verdict.label for outcomes in met for o in outcomes)
    if students > len(met):
        counted["did not run"] = students - len(met)
    return dict(counted.most_common())


def _mistakes(met: Sequence[Sequence[TestResult]]) -> tuple[Mistake, ...]:
    """What was told to how many; a student who was told the same twice counts once."""
    counted: Counter[str] = Counter()
    for outcomes in met:
        told = [o.misconception or o.hint for o in outcomes if not o.passed and o.verdict is not Verdict.NOT_WRITTEN]
        counted.update({text for text in told if text})
    ranked = sorted(counted.items(), key=lambda pair: (-pair[1], pair[0]))
    return tuple(Mistake(text, students) for text, students in ranked)


def _flagged(item: Item, students: int) -> Item:
    flags = []
    if item.difficulty <= 1e-9:
        flags.append("nobody passes")
    elif item.difficulty >= 1 - 1e-9:
        flags.append("everybody passes")
    if students >= _LEAST and item.discrimination < 0:
        sure = item.discrimination <= -statistics.least_notable(students)
        flags.append("negative discrimination" + ("" if sure else " (may be chance)"))
    return item if not flags else Item(**{**item.__dict__, "flags": tuple(flags)})
