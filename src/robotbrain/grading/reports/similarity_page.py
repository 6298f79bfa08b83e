"""The similarity report as pages: a ranked list, and for each pair the two codes side by side."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup

from robotbrain.files import write_text
from robotbrain.grading.reports.page import clean, render
from robotbrain.grading.reports.similarity import NOTABLE_SHARE, Pair, Similarity
from robotbrain.grading.reports.tokens import Code

PAIR_PAGES = 40
_LONGEST = 120_000  # characters of a code on a page


@dataclass(frozen=True)
class Row:
    """A line of the ranked list; ``page`` is the file with the passages, or ""."""

    a: str
    b: str
    share_a: float
    share_b: float
    tokens: int
    passages: int
    page: str
    notable: bool


def write_similarity(folder: Path, lab: str, found: Similarity) -> Path:
    """Write ``index.html`` and a page for each of the first pairs into ``folder``; return the index."""
    for old in [*folder.glob("pair-*.html"), *folder.glob("reference-*.html")]:
        old.unlink()  # of an earlier run: the ranks have changed
    pairs = [_written(folder, lab, "pair", i, pair) for i, pair in enumerate(found.pairs, 1)]
    references = [_written(folder, lab, "reference", i, pair) for i, pair in enumerate(found.with_reference, 1)]
    page = render(
        "similarity.html", lab=lab, found=found, pairs=pairs, references=references, notable_share=NOTABLE_SHARE
    )
    return write_text(folder / "index.html", page)


def _written(folder: Path, lab: str, kind: str, rank: int, pair: Pair) -> Row:
    name = f"{kind}-{rank:03}.html" if rank <= PAIR_PAGES else ""
    if name:
        write_text(folder / name, pair_page(lab, pair))
    match = pair.match
    return Row(
        pair.a.name,
        pair.b.name,
        match.share_a,
        match.share_b,
        match.tokens,
        len(match.passages),
        name,
        pair.notable,
    )


def pair_page(lab: str, pair: Pair) -> str:
    """The two codes with their common passages numbered and marked."""
    ordered = sorted(pair.match.passages, key=lambda p: -p.length)
    spans_a = [(_lines(pair.a, p.a, p.length), number) for number, p in enumerate(ordered, 1)]
    spans_b = [(_lines(pair.b, p.b, p.length), number) for number, p in enumerate(ordered, 1)]
    return render(
        "pair.html",
        lab=lab,
        pair=pair,
        passages=[
            (n, p.length, a, b) for n, (p, (a, _), (b, _)) in enumerate(zip(ordered, spans_a, spans_b, strict=True), 1)
        ],
        left=_marked(pair.a, spans_a, "a"),
        right=_marked(pair.b, spans_b, "b"),
    )


def _lines(code: Code, start: int, length: int) -> tuple[int, int]:
    """First and last line of a run of tokens."""
    return int(code.lines[start]), int(code.lines[start + length - 1])


def _marked(code: Code, spans: list[tuple[tuple[int, int], int]], side: str) -> Markup:
    """Escaped code; lines of a passage are marked, and its first line carries its number, to which links lead."""
    belongs: dict[int, int] = {}
    for (first, last), number in reversed(spans):  # the longest passage, with the smallest number, has the last word
        belongs.update(dict.fromkeys(range(first, last + 1), number))
    shown: list[Markup] = []
    told: set[int] = set()
    for number, line in enumerate(clean(code.text, _LONGEST).split("\n"), 1):
        passage = belongs.get(number)
        if passage is None:
            shown.append(Markup("    {}").format(line))
            continue
        other = "b" if side == "a" else "a"
        label = Markup("{:>3} ").format(passage) if passage in told else Markup(
            '<a class="no" id="{0}{1}" href="#{2}{1}" aria-label="Passage {1} on the other side">{3}</a> '
        ).format(side, passage, other, f"{passage:>3}")  # fmt: skip
        told.add(passage)
        shown.append(Markup('<span class="match">{}{}</span>').format(label, line))
    return Markup("\n").join(shown)


def similarity_text(found: Similarity, most: int = 15) -> str:
    """The head of the ranked list as plain text."""
    lines = [
        f"{found.students} submissions compared; a typical pair shares {found.typical:.0%}, one in twenty more than "
        f"{found.high:.0%} (estimates).",
        "A likeness is no verdict: read the passages.",
    ]
    for title, pairs in (("Pairs", found.pairs), ("With the course's own code", found.with_reference)):
        lines += ["", f"{title}:"] + [
            f"  {'!' if p.notable else ' '} {clean(p.a.name, 24):<24} {clean(p.b.name, 32):<32} {p.match.share_a:>4.0%}"
            f" {p.match.share_b:>4.0%}  {p.match.tokens} tokens"
            for p in pairs[:most]
        ]
        lines += [] if pairs else ["  none"]
    return "\n".join(lines)
