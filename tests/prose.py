"""The prose of notebooks and Markdown files, and what a reader may stumble over in it."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

LONGEST = 45  # words up to a full stop, colon or semicolon
TALKS_DOWN = (
    "simply", "obviously", "clearly", "trivial", "trivially", "basically", "easily", "of course", "needless to say",
    "everybody knows", "everyone knows", "as you know,", "easy to see", "no-brainer",
    "just (?:add|call|change|click|do|install|run|set|type|use|write)",
)  # fmt: skip
"""Words that tell readers who do not find it easy that it is their fault."""
LATIN_AND_IDIOM = (
    r"e\.g\.?", r"i\.e\.?", r"etc\.?", r"(?-i:vs)\.?", r"viz\.?", "via", "per se", "ad hoc", "de facto", "a priori",
    "under the hood", "out of the box", "rule of thumb", "low-hanging fruit", "silver bullet", "in a nutshell",
    "piece of cake", "boils? down", "ballpark", "from scratch", "on the fly", "hands-on", "bells and whistles",
    "a no-op", "rocket science",
)  # fmt: skip
"""What people who read English as their second language have to look up."""
PERSONS = (
    "he",
    "she",
    "him",
    "her",
    "hers",
    "his",
    "himself",
    "herself",
    "guys",
    "he/she",
    "s/he",
    "manpower",
    "mankind",
)
UNKIND = (
    "sanity check",
    "dummy",
    "crazy",
    "insane",
    "whitelist",
    "blacklist",
    "grandfathered",
    "cripple[sd]?",
    "idiot",
)
AMERICAN = (
    "colors?", r"\w*behavior\w*", "centers?", "centered", r"neighbor\w*", "gray", "(?:centi|milli|kilo)?met(?:er)s?",
    r"(?:optim|quant|normal|initial|general|minim|maxim|synchron|random)iz\w+",
    r"(?:organ|recogn|real|regular|visual|summar|serial|parallel)iz\w+",
    r"analyz\w+", r"model(?:ing|ed|er)", r"label(?:ing|ed)", r"cancel(?:ing|ed)", r"travel(?:ing|ed|er)", "fulfill",
    "artifacts?", "defense", "catalog", "math", "toward", "gotten", "license[sd]? under",
)  # fmt: skip
"""American spellings; the course keeps to British ones."""
EMPTY_LINKS = ("here", "this", "link", "click here", "read more", "more", "this page", "this link", "see")


@dataclass(frozen=True)
class Passage:
    """A cell of prose, or a whole file."""

    place: str
    text: str


def passages(path: Path) -> list[Passage]:
    """Return the prose of a notebook, cell by cell, or of a Markdown file."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".md":
        return [Passage(path.name, text)]
    cells = json.loads(text)["cells"]
    return [Passage(f"{path.name}#{c['id']}", "".join(c["source"])) for c in cells if c["cell_type"] == "markdown"]


def plain(text: str) -> str:
    """Return Markdown without what is not prose: code, formulas, addresses, titles of other people's works."""
    text = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    text = re.sub(r"\*\*Further reading.*?(?=\n\n|\Z)", "", text, flags=re.DOTALL)
    text = re.sub(r"^> .*$", "", text, flags=re.MULTILINE)  # somebody else's words
    text = re.sub(r"\$\$.*?\$\$|\$[^$\n]+\$", "Formula", text, flags=re.DOTALL)
    text = re.sub(r"`[^`]*`", "Code", text)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    return re.sub(r"<[^>]+>|https?://\S+", "", text)


def sentences(text: str) -> Iterator[str]:
    """Yield the sentences of paragraphs and list items; tables and headings have none."""
    for block in re.split(r"\n\s*\n|\n(?=\s*(?:[*-]|\d+\.) |\|)", plain(text)):
        if block.strip() and not block.lstrip().startswith(("|", "#")):
            joined = " ".join(re.sub(r"[*_]+", "", re.sub(r"^\s*([*-]|\d+\.) ", "", block)).split())
            yield from filter(None, re.split(r"(?<=[.!?:;])\s+", joined))


def readability(text: str) -> float:
    """Return the Automated Readability Index (Smith and Senter, 1967): about the school year that a text asks for.

    It counts characters, words and sentences, so that it needs no dictionary of syllables.
    """
    joined = re.split(r"(?<=[.!?])\s+(?=[A-Z\"“(])", " ".join(sentences(text)))
    words = [word for sentence in joined for word in re.findall(r"[\w’'-]+", sentence)]
    return 4.71 * sum(map(len, words)) / len(words) + 0.5 * len(words) / len(joined) - 21.43


def mean_length(text: str) -> float:
    """Return the mean number of words of a sentence."""
    joined = re.split(r"(?<=[.!?])\s+(?=[A-Z\"“(])", " ".join(sentences(text)))
    return sum(len(sentence.split()) for sentence in joined) / len(joined)


def words_found(text: str, patterns: tuple[str, ...]) -> list[str]:
    """Return which words or phrases of a list stand in a text, with what stands around them."""
    prose = plain(text)
    found = []
    for match in re.finditer(rf"(?<![\w/-])(?:{'|'.join(patterns)})(?![\w-])", prose, flags=re.IGNORECASE):
        around = prose[max(0, match.start() - 25) : match.end() + 25]
        found.append(f"{match.group()!r} in {' '.join(around.split())!r}")
    return found


def headings(text: str) -> list[tuple[int, str]]:
    """Return the level and the words of each heading."""
    text = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    return [(len(marks), words) for marks, words in re.findall(r"^(#{1,6}) (.+)$", text, flags=re.MULTILINE)]


def tables_without_head(text: str) -> list[str]:
    """Return the first lines of tables that have no header row: no line of dashes as the second."""
    found = []
    for block in re.findall(r"(?:^\|.*\|[ ]*$\n?)+", text, flags=re.MULTILINE):
        lines = block.strip().splitlines()
        if len(lines) < 2 or not re.fullmatch(r"\|(?:\s*:?-+:?\s*\|)+", lines[1].strip()):
            found.append(lines[0])
    return found
