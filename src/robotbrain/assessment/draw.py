"""Drawing a paper from a bank."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from robotbrain.assessment.bank import Bank
from robotbrain.assessment.dice import Dice
from robotbrain.assessment.paper import TOPICS, Item, Paper
from robotbrain.assessment.questions import DIFFICULTIES, OBJECTIVES, Question, by_topic
from robotbrain.errors import InputError

LETTERS = "abcdefgh"
Range = tuple[int, int]


@dataclass(frozen=True)
class Blueprint:
    """What every paper has in common.

    Attributes:
        per_topic: questions on each topic.
        kinds: how many questions of each kind, at least and at most; likewise the rest.
    """

    per_topic: int
    kinds: Mapping[str, Range] = field(default_factory=dict)
    difficulties: Mapping[int, Range] = field(default_factory=dict)
    objectives: Mapping[str, Range] = field(default_factory=dict)

    def distance(self, questions: Sequence[Question]) -> int:
        """By how many questions a choice misses the blueprint; 0: it keeps it."""
        pairs: list[tuple[Mapping[Any, Range], Counter[Any]]] = [
            (self.kinds, Counter(q.kind for q in questions)),
            (self.difficulties, Counter(q.difficulty for q in questions)),
            (self.objectives, Counter(q.objective for q in questions)),
        ]
        limits = ((count[key], limit) for wanted, count in pairs for key, limit in wanted.items())
        return sum(max(0, low - number, number - high) for number, (low, high) in limits)


PER_TOPIC = 2
GRADED = Blueprint(
    per_topic=PER_TOPIC,
    kinds={"single": (7, 8), "multiple": (4, 4), "numeric": (4, 5), "order": (2, 2), "code": (2, 2)},
    difficulties=dict(zip(DIFFICULTIES, ((4, 7), (9, 13), (2, 4)), strict=True)),
    objectives=dict.fromkeys(OBJECTIVES, (2, 7)),
)
PRACTICE = Blueprint(per_topic=PER_TOPIC)


@dataclass(frozen=True)
class Drawn:
    """A question as it stands on one paper.

    Attributes:
        order: which option, or which step, stands at each letter.
        values: its parameters.
    """

    question: Question
    item: Item
    order: tuple[int, ...] = ()
    values: Mapping[str, Any] = field(default_factory=dict)

    def letters_of(self, indices: Sequence[int]) -> tuple[str, ...]:
        """The letters at which these options or steps stand."""
        return tuple(LETTERS[self.order.index(i)] for i in indices)


@dataclass(frozen=True)
class Draw:
    """A paper together with its key."""

    questions: tuple[Drawn, ...]
    paper: Paper

    def __getitem__(self, name: str) -> Drawn:
        return next(d for d in self.questions if d.item.name == name)

    @property
    def ids(self) -> tuple[str, ...]:
        """Which questions of the bank these are."""
        return tuple(d.question.id for d in self.questions)


def draw(bank: Bank, seed: str, blueprint: Blueprint = GRADED, *, student: str = "") -> Draw:
    """Draw a paper; the same bank, seed and blueprint give the same one on every machine."""
    return arrange(choose(bank, seed, blueprint), seed, student=student, practice=bank.practice)


def choose(bank: Bank, seed: str, blueprint: Blueprint) -> list[Question]:
    """Choose questions that keep the blueprint: at random, then exchanging some until it fits."""
    dice, pools = Dice(seed, "questions"), by_topic(bank.questions)
    for topic, pool in pools.items():
        if len(pool) < blueprint.per_topic:
            raise _error(f"{len(pool)} on {topic}", f"at least {blueprint.per_topic} on each topic")
    for _ in range(50):
        chosen = {topic: dice.shuffled(pool)[: blueprint.per_topic] for topic, pool in pools.items()}
        distance = blueprint.distance(_flat(chosen))
        for _ in range(400):
            if distance == 0:
                return _flat(chosen)
            topic = dice.choice(list(TOPICS))
            rest = [q for q in pools[topic] if q not in chosen[topic]]
            if not rest:
                continue
            place = dice.below(blueprint.per_topic)
            before = chosen[topic][place]
            chosen[topic][place] = dice.choice(rest)
            after = blueprint.distance(_flat(chosen))
            if after <= distance:
                distance = after
            else:
                chosen[topic][place] = before
    raise _error("no choice that fits was found", "questions of all kinds, difficulties and objectives")


def _flat(chosen: Mapping[str, Sequence[Question]]) -> list[Question]:
    return [q for topic in TOPICS for q in chosen[topic]]


def arrange(questions: Sequence[Question], seed: str, *, student: str = "", practice: bool = False) -> Draw:
    """Make a paper of chosen questions: shuffle their options and draw their numbers."""
    drawn = tuple(_drawn(question, f"q{number:02d}", seed) for number, question in enumerate(questions, 1))
    return Draw(drawn, Paper(tuple(d.item for d in drawn), student=student, practice=practice))


def _drawn(question: Question, name: str, seed: str) -> Drawn:
    dice = Dice(seed, question.id)
    texts = [o.text for o in question.options] or list(question.steps)
    order = dice.shuffled(range(len(texts)))
    while question.kind == "order" and list(order) == sorted(order):  # no answer for those who change nothing
        order = dice.shuffled(order)
    values: dict[str, Any] = {}
    if question.kind == "numeric":
        if question.rows:
            values |= dice.choice(question.rows)
        values |= {parameter: dice.choice(choices) for parameter, choices in question.parameters.items()}
    item = Item(
        name=name,
        topic=question.topic,
        kind=question.kind,
        text=question.filled(values),
        options=tuple((LETTERS[k], texts[i]) for k, i in enumerate(order)),
        unit=question.unit,
        function=question.function,
    )
    return Drawn(question, item, tuple(order), values)


def _error(given: str, expected: str) -> InputError:
    return InputError("bank", given=given, expected=expected, fix="Add questions, or relax the blueprint.")
