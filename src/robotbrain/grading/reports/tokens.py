"""Python code as tokens that say what it does and not how it is written.

Gone are comments, docstrings, annotations, layout, brackets that only group, and the end of a statement; names that the
author chose become one token, as do numbers and strings. Kept are keywords, operators, builtins, and attributes that
the code uses but does not define: nobody can rename ``np.argsort``. Code that does not parse still gives tokens.
"""

from __future__ import annotations

import builtins
import io
import keyword
import tokenize
import zlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_KEPT_NAMES = frozenset(keyword.kwlist) | (frozenset(dir(builtins)) - {"_"})
_LAYOUT = {tokenize.NL, tokenize.COMMENT, tokenize.ENCODING, tokenize.ENDMARKER}
_OPENING, _CLOSING = "([{", ")]}"
LONGEST_CODE = 400_000  # characters of one author's code that are read


@dataclass(frozen=True)
class Code:
    """The code of one author: its tokens, and where in ``text`` each of them stands.

    Attributes:
        symbols: an integer for each token; equal tokens are equal integers.
        lines: line of each token in ``text``, from 1.
    """

    name: str
    text: str
    symbols: NDArray[np.uint64]
    lines: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.symbols)


@dataclass(frozen=True)
class _Token:
    kind: int
    text: str
    line: int


def read_code(name: str, sources: list[str]) -> Code:
    """Tokens of an author's cells, in order. Cells are read one by one: a broken one spoils no other."""
    words: list[str] = []
    lines: list[int] = []
    text, first = "", 1
    for source in sources:
        if len(text) > LONGEST_CODE:
            break
        source = _runnable(source[:LONGEST_CODE])
        for word, line in normalised(source):
            words.append(word)
            lines.append(first + line - 1)
        text += source + "\n"
        first += source.count("\n") + 1
    return Code(name, text, symbols_of(words), np.array(lines, dtype=np.int64))


def symbols_of(words: list[str]) -> NDArray[np.uint64]:
    """An integer for each word, the same in every process."""
    known: dict[str, int] = {}
    return np.array([known.setdefault(w, zlib.crc32(w.encode()) + 1) for w in words], dtype=np.uint64)


def _runnable(source: str) -> str:
    """``source`` with IPython's own lines as comments, so that Python's tokenizer can read it."""
    lines = source.replace("\r\n", "\n").replace("\r", "\n").replace("\x0c", " ").split("\n")
    return "\n".join("#" + line if line.lstrip()[:1] in ("%", "!", "?") else line for line in lines)


def normalised(source: str) -> list[tuple[str, int]]:
    """The normalised tokens of ``source`` with their lines."""
    tokens = list(_significant(_raw(source)))
    defined = _own_attributes(tokens)
    result: list[tuple[str, int]] = []
    brackets: list[bool] = []  # whether each open bracket is kept
    for i, token in enumerate(tokens):
        text = token.text
        before = tokens[i - 1].text if i else ""
        after = tokens[i + 1].text if i + 1 < len(tokens) else ""
        if token.kind == tokenize.NEWLINE or text == ";":
            continue
        if text in _OPENING:
            calls = i > 0 and (before in _CLOSING or (tokens[i - 1].kind == tokenize.NAME and not _keyword(before)))
            brackets.append(text != "(" or calls)
            if not brackets[-1]:
                continue
        elif text in _CLOSING:
            if brackets and not brackets.pop():
                continue
        elif text == "," and after[:1] in _CLOSING and after:
            continue
        result.append((_word(token, before, defined), token.line))
    return result


def _word(token: _Token, before: str, defined: set[str]) -> str:
    if token.kind == tokenize.NUMBER:
        return "0"
    if token.kind == tokenize.STRING:
        return "''"
    if token.kind != tokenize.NAME:
        return token.text
    if before == ".":
        return "name" if token.text in defined else token.text
    return token.text if token.text in _KEPT_NAMES else "name"


def _keyword(text: str) -> bool:
    return keyword.iskeyword(text)


def _raw(source: str) -> Iterator[_Token]:
    """Python's tokens; an f-string is one string, and after an error the lines that follow are read on their own."""
    lines = source.splitlines(keepends=True)
    start = 0
    while start < len(lines):
        depth, opened = 0, 0
        reached = start + 1
        try:
            for token in tokenize.generate_tokens(io.StringIO("".join(lines[start:])).readline):
                line = token.start[0] + start
                reached = max(reached, line)
                name = tokenize.tok_name[token.type]
                if name in ("FSTRING_START", "TSTRING_START"):
                    depth, opened = depth + 1, opened or line
                elif name in ("FSTRING_END", "TSTRING_END"):
                    depth -= 1
                    if depth == 0:
                        yield _Token(tokenize.STRING, "''", opened)
                        opened = 0
                elif depth == 0 and name != "ERRORTOKEN":
                    yield _Token(token.type, token.string, line)
            return
        except (tokenize.TokenError, SyntaxError):
            start = reached  # skip the line it stumbled over


def _significant(raw: Iterator[_Token]) -> Iterator[_Token]:
    """Without layout, docstrings and annotations; indentation is gone too."""
    statement: list[_Token] = []
    for token in raw:
        if token.kind in _LAYOUT or token.kind in (tokenize.INDENT, tokenize.DEDENT):
            continue
        statement.append(token)
        if token.kind == tokenize.NEWLINE:
            yield from _statement(statement)
            statement = []
    yield from _statement(statement)


def _statement(tokens: list[_Token]) -> list[_Token]:
    if all(t.kind in (tokenize.STRING, tokenize.NEWLINE) for t in tokens):
        return []  # a docstring, or text that does nothing
    if tokens[0].text in ("def", "async", "class"):
        return _without_signature_annotations(tokens)
    return _without_annotation(tokens)


def _without_signature_annotations(tokens: list[_Token]) -> list[_Token]:
    """``def f(a: int = 0) -> str:`` as ``def f(a = 0):``."""
    kept: list[_Token] = []
    depth, skipping = 0, 0  # skipping: the depth at which the annotation began, or 0
    for token in tokens:
        text = token.text
        if text and text in _CLOSING:
            depth -= 1
            if skipping and depth < skipping:
                skipping = 0
        if skipping and depth == skipping and text in (",", "="):
            skipping = 0
        if not skipping and depth == 0 and text == "->":
            skipping = -1
        if skipping == -1 and depth == 0 and text == ":":
            skipping = 0
        elif not skipping and depth == 1 and text == ":":
            skipping = 1
        if not skipping:
            kept.append(token)
        if text and text in _OPENING:
            depth += 1
    return kept


def _without_annotation(tokens: list[_Token]) -> list[_Token]:
    """``x: int = 0`` as ``x = 0``."""
    end = 0
    while end < len(tokens) and (
        (tokens[end].kind == tokenize.NAME and not _keyword(tokens[end].text)) or tokens[end].text == "."
    ):
        end += 1
    if not 0 < end < len(tokens) or tokens[end].text != ":":
        return tokens
    depth = 0
    for i in range(end, len(tokens)):
        depth += (tokens[i].text in tuple(_OPENING)) - (tokens[i].text in tuple(_CLOSING))
        if depth == 0 and tokens[i].text == "=":
            return tokens[:end] + tokens[i:]
    return []  # a declaration without a value


def _own_attributes(tokens: list[_Token]) -> set[str]:
    """Attribute and method names that this code itself defines, and so could have named otherwise."""
    own = set()
    for i, token in enumerate(tokens):
        if token.kind != tokenize.NAME or i == 0:
            continue
        before = tokens[i - 1].text
        after = tokens[i + 1].text if i + 1 < len(tokens) else ""
        if before in ("def", "class") or (before == "." and after in ("=", "+=", "-=", "*=", "/=")):
            own.add(token.text)
    return own
