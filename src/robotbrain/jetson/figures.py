"""A number about a Jetson with its origin, and checked reading of the TOML files that hold such numbers.

Provenance, best first:

- ``datasheet``: the maker prints it (data sheet, developer guide, board support package), or it follows from what the
  maker prints by arithmetic alone; then the note begins with ``derived:``.
- ``measured``: this kit, or whoever runs it, measured it on the thing itself.
- ``published``: somebody else reports it, or it follows from such reports by arithmetic alone (``derived:``).
- ``predicted``: a model of this kit computed it.
- ``assumed``: a rule of ours or a guess; the note says which.

Sources are ``https://...``, ``github:owner/repo@commit:path``, ``document:...`` for a document without a stable
address, or ``kit:...`` for this project's own rules and measurements. The first two and ``document:`` alone can back
``datasheet`` and ``published``.
"""

from __future__ import annotations

import difflib
import math
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robotbrain.errors import InputError

PROVENANCES = ("datasheet", "published", "predicted", "measured", "assumed")
"""Where a number about a Jetson may come from."""

SOURCE_FORMS = ("https://", "github:", "document:", "kit:")
"""How a source may begin."""


def check_origin(what: str, provenance: object, source: object) -> None:
    """Check the origin of a figure.

    Args:
        what: the figure, in the reader's words.
        provenance: one of PROVENANCES.
        source: text in one of SOURCE_FORMS.

    Raises:
        InputError: for an unknown provenance, or a source that is empty, unclear or cannot back the provenance.
    """
    if provenance not in PROVENANCES:
        raise InputError(
            f"{what}: provenance",
            given=provenance,
            expected="one of " + ", ".join(PROVENANCES),
            fix="Say where the number comes from.",
        )
    if not isinstance(source, str) or not source.startswith(SOURCE_FORMS) or source.strip() in SOURCE_FORMS:
        raise InputError(
            f"{what}: source",
            given=source,
            expected="text that begins with " + " or ".join(SOURCE_FORMS),
            fix="Give the address of the document, or kit:... for a rule of our own.",
        )
    if source.startswith("kit:") and provenance in ("datasheet", "published"):
        raise InputError(
            f"{what}: provenance",
            given=provenance,
            expected="predicted, measured or assumed for a source of our own (kit:)",
            fix="Give the document, or admit that it is assumed.",
        )


@dataclass(frozen=True, slots=True)
class Figure:
    """A number with its unit and its origin.

    Attributes:
        value: finite.
        unit: e.g. ``"MHz"``; ``"count"`` for whole numbers of things.
        provenance: one of PROVENANCES.
        source: in one of SOURCE_FORMS.
        note: how it was derived, what to beware of; may be empty.
    """

    value: float
    unit: str
    provenance: str
    source: str
    note: str = ""

    def __post_init__(self) -> None:
        if isinstance(self.value, bool) or not isinstance(self.value, int | float) or not math.isfinite(self.value):
            raise InputError("figure", given=self.value, expected="a finite number", fix="Leave unknown figures out.")
        if not self.unit:
            raise InputError("figure: unit", given=self.unit, expected="a unit", fix="Write count for a pure number.")
        check_origin("figure", self.provenance, self.source)

    def __str__(self) -> str:
        return f"{self.value:g} {self.unit} ({self.provenance})"


@dataclass(frozen=True, slots=True)
class Statement:
    """A fact in words with its origin (see Figure)."""

    text: str
    provenance: str
    source: str
    note: str = ""

    def __str__(self) -> str:
        return self.text


class Table:
    """One table of a TOML file, read key by key with checks that name the file, the table and the key.

    Args:
        file: name of the file, for messages.
        data: content of the table.
        path: dotted name of the table within the file, empty for the top level.
        sources: sources by short key; a figure may name a key instead of writing its source out.
    """

    def __init__(
        self, file: str, data: Mapping[str, Any], path: str = "", sources: Mapping[str, str] | None = None
    ) -> None:
        self.file, self.data, self.path, self.sources = file, data, path, sources or {}

    def where(self, key: str = "") -> str:
        """Return the place of a key in words, for messages."""
        table = f" [{self.path}]" if self.path else ""
        return f"{self.file}:{table} {key}".rstrip()

    def fail(self, key: str, expected: str, fix: str, given: object = None) -> InputError:
        """Return the error for a key (None as ``given`` shows what the file holds)."""
        shown = self.data.get(key, "nothing") if given is None else given
        return InputError(self.where(key), given=shown, expected=expected, fix=fix)

    def only(self, allowed: Iterable[str]) -> None:
        """Refuse keys that are not allowed: they are usually misspelt."""
        known = list(allowed)
        for key in self.data:
            if key not in known:
                near = difflib.get_close_matches(key, known, n=1)
                fix = f"Did you mean {near[0]!r}?" if near else "Remove it."
                raise self.fail(key, "one of " + ", ".join(known), fix, given=f"unknown key {key!r}")

    def has(self, key: str) -> bool:
        """Return whether the key is there."""
        return key in self.data

    def text(self, key: str, default: str | None = None) -> str:
        """Return a text that is not empty (or the default if the key is missing)."""
        if key not in self.data and default is not None:
            return default
        value = self.data.get(key)
        if not isinstance(value, str) or not value.strip():
            raise self.fail(key, "text", "Compare with the other files.")
        return value

    def texts(self, key: str, default: tuple[str, ...] | None = None) -> tuple[str, ...]:
        """Return a list of texts (or the default if the key is missing)."""
        if key not in self.data and default is not None:
            return default
        value = self.data.get(key)
        if not isinstance(value, list) or not value or not all(isinstance(item, str) and item for item in value):
            raise self.fail(key, "a list of texts", "Compare with the other files.")
        return tuple(value)

    def flag(self, key: str, default: bool = False) -> bool:
        """Return true or false."""
        value = self.data.get(key, default)
        if not isinstance(value, bool):
            raise self.fail(key, "true or false", "Write it without quotation marks.")
        return value

    def number(self, key: str, low: float, high: float, unit: str = "", whole: bool = False) -> float:
        """Return a finite number from ``low`` to ``high``."""
        value = self.data.get(key)
        kind = "a whole number" if whole else "a number"
        expected = f"{kind} from {low:g} to {high:g} {unit}".rstrip()
        if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
            raise self.fail(key, expected, "Compare with the other files.")
        if whole and value != int(value):
            raise self.fail(key, expected, "Compare with the other files.")
        return value

    def whole(self, key: str, low: int, high: int) -> int:
        """Return a whole number from ``low`` to ``high``."""
        return int(self.number(key, low, high, whole=True))

    def table(self, key: str) -> Table:
        """Return a table within this one."""
        value = self.data.get(key)
        path = f"{self.path}.{key}" if self.path else key
        if not isinstance(value, dict):
            raise self.fail(key, f"a table [{path}]", f"Begin it with a line [{path}].")
        return Table(self.file, value, path, self.sources)

    def tables(self, key: str) -> dict[str, Table]:
        """Return the tables within the table ``key``, by name, at least one."""
        outer = self.table(key)
        if not outer.data:
            raise self.fail(key, "at least one table in it", "Compare with the other files.")
        return {name: outer.table(name) for name in outer.data}

    def origin(self, what: str = "") -> tuple[str, str]:
        """Return provenance and source; the source may be given by its short key."""
        provenance, source = self.text("provenance"), self.text("source")
        source = self.sources.get(source, source)
        check_origin(self.where(what), provenance, source)
        return provenance, source

    def figure(self, key: str, unit: str, low: float, high: float, whole: bool = False) -> Figure:
        """Return the figure ``{ value, unit, provenance, source, note? }`` after checking all of it."""
        inner = self.table(key)
        inner.only(("value", "unit", "provenance", "source", "note"))
        if inner.text("unit") != unit:
            raise inner.fail("unit", repr(unit), f"Convert the value to {unit}.")
        value = inner.number("value", low, high, unit, whole)
        provenance, source = inner.origin()
        return Figure(value, unit, provenance, source, inner.text("note", ""))

    def statement(self, key: str) -> Statement:
        """Return the statement ``{ text, provenance, source, note? }`` after checking all of it."""
        inner = self.table(key)
        inner.only(("text", "provenance", "source", "note"))
        provenance, source = inner.origin()
        return Statement(inner.text("text"), provenance, source, inner.text("note", ""))


def read_text(path: Path, kind: str = "TOML") -> str:
    """Return the text of a file of some kind, with ``\\n`` line ends.

    Raises:
        InputError: if it cannot be read, or is no text.
    """
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            str(path), given=str(error), expected=f"a readable {kind} file", fix="Restore it from git."
        ) from error


def parse_table(path: Path, text: str) -> Table:
    """Parse the text of a TOML file and the short keys of its ``[sources]`` table.

    Raises:
        InputError: if it is no TOML, or lists a source that is none.
    """
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(str(path), given=str(error), expected="a TOML file", fix="Restore it from git.") from error
    listed = Table(path.name, data).table("sources") if "sources" in data else Table(path.name, {}, "sources")
    for key in listed.data:
        if not listed.text(key).startswith(SOURCE_FORMS):
            raise listed.fail(key, "text that begins with " + " or ".join(SOURCE_FORMS), "Give the address.")
    return Table(path.name, data, "", listed.data)


def read_table(path: Path) -> Table:
    """Read a TOML file (see read_text and parse_table)."""
    return parse_table(path, read_text(path))
