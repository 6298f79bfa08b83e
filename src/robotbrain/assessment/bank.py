"""Reading a bank of questions from TOML files."""

from __future__ import annotations

import functools
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from robotbrain.assessment.questions import Question, question_from
from robotbrain.errors import InputError

FOLDER = "assessment"
"""Where the bank lies in the autograder's folder."""


@dataclass(frozen=True)
class Bank:
    """Questions with different ids.

    Attributes:
        practice: whether the key is public.
    """

    questions: tuple[Question, ...]
    practice: bool = False

    def __getitem__(self, name: str) -> Question:
        for question in self.questions:
            if question.id == name:
                return question
        raise InputError("question", given=name, expected="an id of the bank", fix="Was the question removed?")


def load_bank(folder: str | Path) -> Bank:
    """Read all ``*.toml`` files of ``folder``; raises :class:`InputError` for whatever is wrong in them."""
    paths = sorted(Path(folder).glob("*.toml"))
    if not paths:
        raise InputError("bank", given=str(folder), expected="a folder with *.toml files", fix="Check the path.")
    return _read(tuple((path, path.stat().st_mtime_ns) for path in paths))


@functools.lru_cache(maxsize=4)
def _read(files: tuple[tuple[Path, int], ...]) -> Bank:
    """Read files as they were at these times: while a class is graded, they are read once."""
    return _bank([q for path, _ in files for q in parse_bank(path.read_text(encoding="utf-8"), path.name)])


def practice_bank() -> Bank:
    """The questions whose key ships, to practise with."""
    text = resources.files("robotbrain.assessment").joinpath("practice.toml").read_text(encoding="utf-8")
    return Bank(_bank(parse_bank(text, "practice.toml")).questions, practice=True)


def parse_bank(text: str, name: str) -> list[Question]:
    """Return the questions of one file's ``text``; ``name`` is for messages."""
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(name, given=str(error), expected="TOML", fix="Correct the file.") from None
    entries = content.get("question")
    if not isinstance(entries, list) or not entries or not all(isinstance(e, dict) for e in entries):
        raise InputError(name, given=list(content), expected="[[question]] tables", fix="Add questions.")
    return [question_from(entry, str(content.get("topic", ""))) for entry in entries]


def _bank(questions: Sequence[Question]) -> Bank:
    seen: set[str] = set()
    for question in questions:
        if question.id in seen:
            raise InputError("id", given=question.id, expected="an id that no other question has", fix="Rename one.")
        seen.add(question.id)
    return Bank(tuple(questions))
