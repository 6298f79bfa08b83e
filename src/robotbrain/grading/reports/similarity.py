"""Which submissions resemble each other, or the course's own solutions, more than the task explains.

The method is winnowing (:mod:`.winnowing`) on normalised tokens (:mod:`.tokens`). What everybody was given is taken out
first, and what much of the class has in common: it is listed on its own, for it may be an idiom, or a common source.
A likeness is no verdict; people read the passages.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robotbrain.grading.marks import SCORED
from robotbrain.grading.reports.tokens import Code, read_code
from robotbrain.grading.reports.winnowing import (
    GUARANTEE,
    NOISE,
    Fingerprints,
    Match,
    base_of,
    compare,
    fingerprint,
    kgrams,
)

COMMON_SHARE, COMMON_LEAST = 0.25, 6
"""A k-gram in more than this share of the class, and in at least so many submissions, begins no passage of a pair."""
NOTABLE_SHARE, NOTABLE_TOKENS = 0.30, 80
"""From here on a pair is marked as worth a look; ``benchmarks/grading_similarity.py`` shows what honest pairs reach."""
_CANDIDATES = 400  # pairs that are compared token by token


@dataclass(frozen=True)
class Pair:
    """Two codes and what they share."""

    a: Code
    b: Code
    match: Match

    @property
    def notable(self) -> bool:
        """Whether it is worth a look."""
        return self.match.share >= NOTABLE_SHARE and self.match.tokens >= NOTABLE_TOKENS


@dataclass(frozen=True)
class Common:
    """A passage that much of the class shares, as one of them wrote it."""

    text: str
    students: int


@dataclass(frozen=True)
class Similarity:
    """The comparison of a class.

    Attributes:
        pairs: submissions, most alike first.
        with_reference: submissions with the course's own code, most alike first.
        common: passages that much of the class shares.
        typical, high: median and 95th percentile of the estimated share over all pairs of the class.
        skipped: students without code of their own.
    """

    pairs: list[Pair]
    with_reference: list[Pair]
    common: list[Common]
    typical: float
    high: float
    students: int
    skipped: list[str]


def own_code(cells: Iterable[Mapping[str, Any]]) -> list[str]:
    """Sources of the code cells that a student could write."""
    found = []
    for cell in cells:
        label = cell["metadata"].get("nbgrader") or {}
        locked = label.get("locked") and not label.get("solution")
        if cell["cell_type"] == "code" and not locked and not SCORED.search(cell["source"]):
            found.append(str(cell["source"]))
    return found


def given_code(cells: Iterable[Mapping[str, Any]]) -> list[str]:
    """Sources of all code cells: of a release or a lesson, which everybody may use."""
    return [str(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


def compare_class(
    students: Mapping[str, Sequence[str]],
    *,
    given: Sequence[Sequence[str]] = (),
    references: Mapping[str, Sequence[str]] | None = None,
    most: int = 50,
) -> Similarity:
    """Compare all submissions with each other and with the course's own code.

    Args:
        students: each student's code cells, in order.
        given: code that everybody was given (release, lessons), as lists of cells.
        references: the course's own solutions by name.
        most: how many pairs to keep.
    """
    codes = [read_code(name, list(sources)) for name, sources in students.items()]
    base = base_of(read_code("", list(sources)) for sources in given)
    skipped = [c.name for c in codes if not np.any(~np.isin(kgrams(c.symbols), base))]
    codes = [c for c in codes if c.name not in skipped]
    common = _common(codes, base)
    known = np.union1d(base, np.fromiter(common, dtype=np.uint64, count=len(common)))
    prints = [fingerprint(code, known) for code in codes]
    estimates = _estimates(prints)
    upper = np.triu_indices(len(prints), 1)
    order = np.argsort(-estimates[upper], kind="stable")[:_CANDIDATES]
    pairs = []
    for place in order:
        i, j = int(upper[0][place]), int(upper[1][place])
        if estimates[i, j] > 0:
            pairs.append(Pair(codes[i], codes[j], compare(prints[i], prints[j])))
    all_shares = estimates[upper]
    return Similarity(
        pairs=_ranked(pairs, most),
        with_reference=_ranked(_against(references or {}, codes, base), most),
        common=_common_passages(codes, base, common),
        typical=float(np.median(all_shares)) if len(all_shares) else 0.0,
        high=float(np.quantile(all_shares, 0.95)) if len(all_shares) else 0.0,
        students=len(codes),
        skipped=skipped,
    )


def _ranked(pairs: Iterable[Pair], most: int) -> list[Pair]:
    worth = [p for p in pairs if p.match.tokens >= GUARANTEE]
    return sorted(worth, key=lambda p: (-p.match.share, -p.match.tokens, p.a.name, p.b.name))[:most]


def _common(codes: Sequence[Code], base: NDArray[np.uint64]) -> dict[int, int]:
    """K-grams that much of the class has, and in how many submissions."""
    if not codes:
        return {}
    values, counts = np.unique(np.concatenate([np.unique(kgrams(c.symbols)) for c in codes]), return_counts=True)
    often = (counts > COMMON_SHARE * len(codes)) & (counts >= COMMON_LEAST) & ~np.isin(values, base)
    return dict(zip(values[often].tolist(), counts[often].tolist(), strict=True))


def _estimates(prints: Sequence[Fingerprints]) -> NDArray[np.float64]:
    """For each pair the shared fingerprints as a share of those of the smaller one."""
    from scipy.sparse import csr_array

    index: dict[int, int] = {}
    columns = [[index.setdefault(value, len(index)) for value in p.places] for p in prints]
    sizes = np.array([len(c) for c in columns], dtype=np.float64)
    if not index:
        return np.zeros((len(prints), len(prints)))
    ends = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    flat = np.array([value for c in columns for value in c], dtype=np.int64)
    matrix = csr_array((np.ones(len(flat)), flat, ends), shape=(len(prints), len(index)))
    shared = (matrix @ matrix.T).toarray()
    smaller = np.maximum(1.0, np.minimum.outer(sizes, sizes))
    # Two or three fingerprints are all that a nearly empty submission has: its shares are no signal.
    return np.where(shared >= 2, shared / np.maximum(smaller, 5.0), 0.0)


def _against(references: Mapping[str, Sequence[str]], codes: Sequence[Code], base: NDArray[np.uint64]) -> list[Pair]:
    """Each student with the reference most like the student's code."""
    own = [fingerprint(read_code(name, list(sources)), base) for name, sources in references.items()]
    best = []
    for code in codes:
        prints = fingerprint(code, base)
        found = [Pair(code, r.code, compare(prints, r)) for r in own]
        if found:
            best.append(max(found, key=lambda pair: pair.match.tokens))
    return best


def _common_passages(
    codes: Sequence[Code], base: NDArray[np.uint64], common: Mapping[int, int], most: int = 10
) -> list[Common]:
    """Runs of common k-grams of at least ``GUARANTEE`` tokens, the longest first, each told once."""
    told: set[int] = set()
    runs: list[tuple[int, Common]] = []
    for code in codes:
        grams = kgrams(code.symbols).tolist()
        start = 0
        while start < len(grams):
            stop = start
            while stop < len(grams) and grams[stop] in common and grams[stop] not in told:
                stop += 1
            if stop - start + NOISE - 1 >= GUARANTEE and stop > start:
                lines = code.text.split("\n")[code.lines[start] - 1 : code.lines[stop - 1 + NOISE - 1]]
                students = min(common[g] for g in grams[start:stop])
                runs.append((stop - start, Common("\n".join(lines), students)))
                told.update(grams[start:stop])
            start = max(stop, start + 1)
    runs.sort(key=lambda run: -run[0])
    return [passage for _, passage in runs[:most]]
