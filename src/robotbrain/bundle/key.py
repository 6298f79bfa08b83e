"""Looks for the key in what is about to be given away, whatever it hides in.

The key is: the bank of the assessment and its draws, the hidden tests, the instructor's solutions, the mutants and
styles, and the reference files. It is compared as runs of words, so layout, markup and quoting do not matter, and
looked for in the text of each file, also as JSON and notebooks quote it, and in whatever is packed into them: zip and
gzip, zlib, base64 and hexadecimal, printable text in binary files (the metadata of a network, for instance).

Some of the course's solutions students may read, because the library has them: :data:`PUBLIC` names each with the
reason. A run of words that is shorter than a sentence, or a few lines of code, is not found.
"""

from __future__ import annotations

import ast
import base64
import binascii
import contextlib
import gzip
import hashlib
import io
import json
import re
import tomllib
import zipfile
import zlib
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robotbrain.bundle.contents import Item
from robotbrain.grading.course import Course
from robotbrain.grading.reports.tokens import symbols_of
from robotbrain.grading.reports.winnowing import kgrams

_PROSE_WORDS, _PROSE_SHARE = 8, 0.25  # of a question with its options and reasons: lessons share a phrase with some
_CODE_WORDS, _CODE_SHARE = 12, 0.3
_FEWEST = 6  # runs that must be there, unless the whole is shorter: some twenty words
_SAID_ANYWAY = ("id", "topic", "kind", "objective", "reread", "unit")  # "reread" names a heading of a lesson
_DEEPEST = 4  # a zip in base64 in a notebook in a zip
_LARGEST = 64 << 20
_WORD = re.compile(r"[^\W_]+")
_PRINTABLE = re.compile(rb"[\t\n\r\x20-\x7e]{16,}")
_BASE64 = re.compile(r"[A-Za-z0-9+/_-]{32,}={0,2}")
_ESCAPE = re.compile(r"\\(?:u([0-9a-fA-F]{4})|[\\nrt\"'])")
_HEX = re.compile(r"(?:[0-9a-fA-F]{2}){40,}")
_BETWEEN = re.compile(r"""(?:[\s"',()+]|\\n){0,40}""")
_REGION = re.compile(r"### BEGIN (?:SOLUTION|HIDDEN TESTS)[^\n]*\n(.*?)### END", re.DOTALL)


@dataclass(frozen=True, slots=True)
class Public:
    """A part of the key that students may find in some files, and why."""

    secret: str
    file: str
    why: str


PUBLIC = (
    Public(
        "solutions/assessment/*",
        "src/robotbrain/assessment/practice.toml",
        "the notebook's solutions answer the practice paper, whose key is there to practise with",
    ),
    Public(
        "solutions/*",
        "src/robotbrain/grading/suites/*_tools.py",
        "an instant check needs the right answer beside it; importing it is refused, and a copy is seen by `report`",
    ),
    Public(
        "solutions/capstone/planner",
        "labs/lab_integration/lab_integration.ipynb",
        "the lab gives the frame of this node, which the capstone asks for without it",
    ),
)


@dataclass(frozen=True, slots=True)
class Secret:
    """A part of the key: where it stands, its runs of words, and which share of them gives it away."""

    name: str
    runs: frozenset[int]
    length: int
    share: float


@dataclass(frozen=True, slots=True)
class Leak:
    """A part of the key in a file."""

    file: str
    secret: str
    share: float

    def __str__(self) -> str:
        return f"{self.file} holds {self.share:.0%} of {self.secret}"


class Key:
    """The key of a course, and how to find it again."""

    def __init__(self, course: Course) -> None:
        self._secrets = [*_bank(course.autograder), *_code(course.autograder), *_solutions(course)]
        self._holders: dict[int, dict[int, list[int]]] = defaultdict(lambda: defaultdict(list))
        for number, secret in enumerate(self._secrets):
            for run in secret.runs:
                self._holders[secret.length][run].append(number)
        self._known = {length: np.sort(np.fromiter(runs, np.uint64)) for length, runs in self._holders.items()}
        self._files = dict(_artefacts(course.autograder))

    def __len__(self) -> int:
        return len(self._secrets) + len(self._files)

    def leaks(self, items: Iterable[Item], *, public: Iterable[Public] = PUBLIC) -> list[Leak]:
        """Parts of the key in ``items`` that ``public`` does not allow."""
        allowed = list(public)
        found = []
        for item in items:
            for secret, share in self._in(item):
                if not any(fnmatchcase(secret, p.secret) and fnmatchcase(item.name, p.file) for p in allowed):
                    found.append(Leak(item.name, secret, share))
        return found

    def _in(self, item: Item) -> Iterator[tuple[str, float]]:
        seen: set[tuple[int, int]] = set()
        for data, text in _views(item.data):
            name = self._files.get(hashlib.sha256(data).hexdigest())
            if name:
                yield name, 1.0
            symbols = _symbols(text)
            for length, known in self._known.items():
                runs = kgrams(symbols, length)
                for run in runs[known[np.searchsorted(known[:-1], runs)] == runs].tolist():
                    seen.update((number, run) for number in self._holders[length][run])
        for number, count in Counter(number for number, _ in seen).items():
            secret = self._secrets[number]
            share = count / len(secret.runs)
            if share >= secret.share and count >= min(_FEWEST, len(secret.runs)):
                yield secret.name, share


def _secret(name: str, texts: list[str], length: int, share: float) -> Iterator[Secret]:
    runs = frozenset(run for text in texts for run in kgrams(_symbols(text), length).tolist())
    if runs:
        yield Secret(name, runs, length, share)


def _bank(autograder: Path) -> Iterator[Secret]:
    for path in sorted((autograder / "assessment").glob("*.toml")):
        for question in tomllib.loads(path.read_text(encoding="utf-8")).get("question", []):
            texts = list(_strings({k: v for k, v in question.items() if k not in _SAID_ANYWAY}))
            yield from _secret(f"autograder/assessment, {question['id']}", texts, _PROSE_WORDS, _PROSE_SHARE)
    record = autograder / "assessment" / "draws.json"
    if record.is_file():
        for text in _strings(json.loads(record.read_text(encoding="utf-8"))):
            if len(text) >= 16 and _WORD.fullmatch(text):
                yield from _secret("autograder/assessment, a recorded draw", [text], 1, 1.0)


def _code(autograder: Path) -> Iterator[Secret]:
    for folder in ("hidden", "mutants", "sample_class"):
        for path in sorted((autograder / folder).rglob("*.py")):
            source = path.read_text(encoding="utf-8")
            lines = source.splitlines()
            for node in ast.parse(source).body:
                if not isinstance(node, ast.Import | ast.ImportFrom):
                    name = f"{path.relative_to(autograder.parent).as_posix()}:{node.lineno}"
                    text = "\n".join(lines[node.lineno - 1 : node.end_lineno])
                    yield from _secret(name, [text], _CODE_WORDS, _CODE_SHARE)


def _solutions(course: Course) -> Iterator[Secret]:
    for lab in course.labs():
        for path in course.sources(lab):
            for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
                name = f"solutions/{lab}/{cell['metadata'].get('nbgrader', {}).get('grade_id', cell.get('id', ''))}"
                for text in _REGION.findall("".join(cell["source"])):
                    yield from _secret(name, [text], _CODE_WORDS, _CODE_SHARE)


def _artefacts(autograder: Path) -> Iterator[tuple[str, str]]:
    for folder in ("assessment", "hidden", "mutants", "reference"):
        for path in sorted(p for p in (autograder / folder).rglob("*") if p.is_file()):
            yield hashlib.sha256(path.read_bytes()).hexdigest(), path.relative_to(autograder.parent).as_posix()


def _symbols(text: str) -> NDArray[np.uint64]:
    return symbols_of([word.lower() for word in _WORD.findall(text)])


def _strings(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, list | dict):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _strings(part)


def _views(data: bytes, depth: int = 0) -> Iterator[tuple[bytes, str]]:
    """Everything that ``data`` says: itself, and what is packed into it; as bytes and as text."""
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError:
        text = "\n".join(part.decode("ascii") for part in _PRINTABLE.findall(data))
    yield data, text
    if "\\" in text:  # quoted, as in JSON: notebooks
        yield b"", _ESCAPE.sub(lambda m: chr(int(m[1], 16)) if m[1] else " ", text)
    if depth < _DEEPEST:
        for inner in (*_unpacked(data), *_decoded(text)):
            yield from _views(inner, depth + 1)


def _unpacked(data: bytes) -> Iterator[bytes]:
    if b"PK\x05\x06" in data:
        try:
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                for entry in archive.infolist():
                    if entry.file_size <= _LARGEST:
                        yield archive.read(entry)
        except (zipfile.BadZipFile, RuntimeError, NotImplementedError, OSError, zlib.error, EOFError):
            pass
    try:
        if data[:2] == b"\x1f\x8b":
            yield gzip.GzipFile(fileobj=io.BytesIO(data)).read(_LARGEST)
        elif data[:1] == b"\x78":
            yield zlib.decompressobj().decompress(data, _LARGEST)
    except (OSError, EOFError, zlib.error):
        pass


def _decoded(text: str) -> Iterator[bytes]:
    """What stands in base64 or hexadecimal, over any number of lines or pieces of a string."""
    for run in _HEX.findall(text):
        yield bytes.fromhex(run)
    pieces: list[str] = []
    end = 0
    for match in _BASE64.finditer(text):
        if pieces and not _BETWEEN.fullmatch(text, end, match.start()):
            yield from _from_base64(pieces)
            pieces = []
        pieces.append(match[0])
        end = match.end()
    yield from _from_base64(pieces)


def _from_base64(pieces: list[str]) -> Iterator[bytes]:
    run = "".join(pieces).rstrip("=").replace("-", "+").replace("_", "/")
    run = run[: len(run) - (len(run) % 4 == 1)]
    if len(run) >= 64:
        with contextlib.suppress(binascii.Error, ValueError):
            yield base64.b64decode(run + "=" * (-len(run) % 4))
