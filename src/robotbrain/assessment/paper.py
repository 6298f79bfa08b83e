"""A paper as a student gets it: questions without their key, kept as JSON."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from robotbrain.assessment import units
from robotbrain.errors import InputError
from robotbrain.files import write_text

FORMAT = 1
LONGEST = 200  # characters or entries of an answer: more is no answer, but work for those who mark it
KINDS = ("single", "multiple", "numeric", "order", "code")
TOPICS: dict[str, str] = {
    "architecture": "What a robot brain is",
    "jetson": "Jetson platforms",
    "tensorrt": "Deploying with TensorRT",
    "rl_tasks": "Tasks for reinforcement learning",
    "ddpg": "Learning to reach with DDPG",
    "sim_to_real": "From simulation to the robot",
    "perception_control": "Perception and control in real time",
    "optimisation": "Model optimisation",
    "monitoring": "Performance monitoring",
    "troubleshooting": "Troubleshooting",
}
"""Topics in the order of their lessons: the first is lesson 1."""

HOW_TO_ANSWER = {
    "single": "one letter",
    "multiple": "all letters that are right (one or more)",
    "numeric": "a number with its unit",
    "order": "the letters, first to last",
    "code": "a function",
}


@dataclass(frozen=True)
class Item:
    """One question of a paper.

    Attributes:
        name: the variable that its answer goes into, e.g. ``"q07"``.
        text: the question in Markdown.
        options: what to choose from or to put in order, as (letter, text).
        unit: in which a plain number is taken, for numeric questions.
        function: first line of the function to write, for code questions.
    """

    name: str
    topic: str
    kind: str
    text: str
    options: tuple[tuple[str, str], ...] = ()
    unit: str = ""
    function: str = ""

    @property
    def letters(self) -> tuple[str, ...]:
        """The letters of the options."""
        return tuple(letter for letter, _ in self.options)

    @property
    def example(self) -> str:
        """A line of the form that an answer has."""
        values = {
            "single": '"b"',
            "multiple": '["a", "c"]',
            "numeric": json.dumps(f"2.5 {self.unit}".strip(), ensure_ascii=False),
        }
        if self.kind == "order":
            return f"{self.name} = {json.dumps(list(self.letters))}  # in another order"
        if self.kind == "code":
            return self.function.replace("answer", self.name, 1)
        return f"{self.name} = {values[self.kind]}"

    def markdown(self) -> str:
        """The question with its options."""
        lines = [f"**{self.name}** ({HOW_TO_ANSWER[self.kind]})", "", self.text.strip(), ""]
        if self.options:
            lines += [*(f"- **{letter}**: {text}" for letter, text in self.options), ""]
        lines += [f"Your answer has this form: `{self.example}`"]
        return "\n".join(lines)

    def _repr_markdown_(self) -> str:
        return self.markdown()

    def read(self, answer: object) -> Any:
        """Return ``answer`` in one form, whichever of several it was written in.

        A letter for ``single``, a sorted tuple of letters for ``multiple``, a tuple for ``order``, a float in
        :attr:`unit` for ``numeric``, and the function itself for ``code``.

        Raises:
            InputError: it cannot be read; the message says what would have been.
        """
        if answer is ... or answer is None:
            raise self._error(answer, self.example, "Answer the question.")
        if isinstance(answer, (str, list, tuple, set, frozenset)) and len(answer) > LONGEST:
            raise self._error(f"{len(answer)} characters or entries", self.example, "Shorten it.")
        if self.kind == "numeric":
            try:
                return units.parse(answer, self.unit)
            except InputError as error:
                raise self._error(answer, error.expected, error.fix) from None
        if self.kind == "code":
            if not callable(answer):
                raise self._error(answer, f"a function: {self.example}", "Define it with def.")
            return answer
        letters = self._letters_of(answer)
        if self.kind == "single":
            if len(letters) != 1:
                raise self._error(answer, f"one of the letters {', '.join(self.letters)}", "Choose one.")
            return letters[0]
        if self.kind == "order":
            if sorted(letters) != sorted(self.letters):
                raise self._error(answer, f"each of {', '.join(self.letters)} once", "List them, first to last.")
            return tuple(letters)
        return tuple(sorted(set(letters)))

    def _letters_of(self, answer: object) -> list[str]:
        if isinstance(answer, str):
            found = re.findall(r"[^\W\d_]", answer)
            if re.search(r"[^\W_]{2}", answer) and len(found) > len(self.letters):  # the text, not its letter
                found = []
        elif isinstance(answer, (list, tuple, set, frozenset)) and all(isinstance(a, str) for a in answer):
            found = [a.strip() for a in (sorted(answer) if isinstance(answer, (set, frozenset)) else answer)]
        else:
            found = []
        letters = [letter.lower() for letter in found]
        if (not letters and answer not in ([], (), set())) or not set(letters) <= set(self.letters):
            raise self._error(answer, f"letters among {', '.join(self.letters)}", f"Write e.g. {self.example}.")
        return letters

    def _error(self, given: object, expected: str, fix: str) -> InputError:
        return InputError(self.name, given=given, expected=expected, fix=fix)


@dataclass(frozen=True)
class Paper:
    """The questions that one student gets.

    Attributes:
        practice: whether the key is public, so that answers can be told at once.
    """

    items: tuple[Item, ...]
    student: str = ""
    practice: bool = False

    @property
    def code(self) -> str:
        """Eight characters that follow from the questions: two different papers have different codes."""
        text = json.dumps([asdict(item) for item in self.items], sort_keys=True, ensure_ascii=True)
        digits = hashlib.sha256(text.encode()).hexdigest().upper()
        return f"{digits[:4]}-{digits[4:8]}"

    def __getitem__(self, name: str) -> Item:
        for item in self.items:
            if item.name == name:
                return item
        raise InputError("question", given=name, expected=f"one of {', '.join(self.names)}", fix="Correct the name.")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all questions, in order."""
        return tuple(item.name for item in self.items)

    def of(self, topic: str) -> tuple[Item, ...]:
        """The questions on one topic."""
        return tuple(item for item in self.items if item.topic == topic)

    def save(self, path: str | Path) -> Path:
        """Write the paper to a file."""
        content = {"format": FORMAT, "code": self.code, "student": self.student, "practice": self.practice}
        content["questions"] = [asdict(item) for item in self.items]
        return write_text(path, json.dumps(content, indent=1, ensure_ascii=False) + "\n")

    @classmethod
    def load(cls, path: str | Path) -> Paper:
        """Read a paper from a file; raises :class:`InputError` if it is damaged or was changed."""
        path = Path(path)
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            if content["format"] != FORMAT:
                raise ValueError(f"format {content['format']}")
            items = tuple(_item(entry) for entry in content["questions"])
            paper = cls(items, str(content["student"]), bool(content["practice"]))
            code = content["code"]
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            problem = f"{type(error).__name__}: {error}"
            raise InputError(
                path.name, given=problem, expected="a paper", fix="Download it again, or ask for it."
            ) from None
        if code != paper.code:
            raise InputError(
                path.name, given=paper.code, expected=f"the code {code}", fix="The file was changed: download it again."
            )
        return paper


def _item(entry: dict[str, Any]) -> Item:
    options = tuple((str(letter), str(text)) for letter, text in entry["options"])
    plain = {k: str(entry[k]) for k in ("name", "topic", "kind", "text", "unit", "function")}
    if plain["kind"] not in KINDS or plain["topic"] not in TOPICS:
        raise ValueError(f"{plain['kind']} on {plain['topic']}")
    return Item(**plain, options=options)
