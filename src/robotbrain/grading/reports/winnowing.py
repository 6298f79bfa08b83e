"""Fingerprints of code by winnowing, and the passages that two codes share.

S. Schleimer, D. S. Wilkerson and A. Aiken, *Winnowing: Local Algorithms for Document Fingerprinting*, SIGMOD 2003. Of
each window of ``t - k + 1`` successive k-grams the one with the smallest hash is kept, the rightmost of equals. Hence a
shared run of at least ``t`` tokens is always found, and none shorter than ``k`` is.

K-grams of the base code (what everybody was given) never count: they are taken out before a window chooses, the same in
both codes, so that the guarantee holds for every window that has anything else in it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from robotbrain.grading.reports.tokens import Code

NOISE = 14
"""k: shared runs of fewer tokens are coincidence."""
GUARANTEE = 22
"""t: shared runs of at least this many tokens are found."""
_FACTOR = 0x9E3779B97F4A7C15  # odd, from the golden ratio: spreads the sums over 64 bits
_NEVER = np.uint64(2**64 - 1)
_MOST_PLACES = 40  # of one fingerprint in one code: beyond, it says nothing about where a passage came from


@dataclass(frozen=True)
class Fingerprints:
    """The fingerprints of one code.

    Attributes:
        places: hash -> positions of the k-gram in the code's tokens.
        novel: for each token, whether a k-gram that is not in the base covers it.
    """

    code: Code
    places: dict[int, list[int]]
    novel: NDArray[np.bool_]


@dataclass(frozen=True)
class Passage:
    """A run of ``length`` tokens that two codes share, from token ``a`` of one and ``b`` of the other."""

    a: int
    b: int
    length: int


@dataclass(frozen=True)
class Match:
    """What two codes share. ``share_a`` is the part of the first code's own tokens that is found in the second."""

    passages: list[Passage] = field(default_factory=list)
    tokens: int = 0
    share_a: float = 0.0
    share_b: float = 0.0

    @property
    def share(self) -> float:
        """The larger of the two shares: padding one's copy with other code does not hide it."""
        return max(self.share_a, self.share_b)


def kgrams(symbols: NDArray[np.uint64], k: int = NOISE) -> NDArray[np.uint64]:
    """A 64-bit hash of each run of ``k`` tokens."""
    if len(symbols) < k:
        return np.empty(0, dtype=np.uint64)
    powers = [np.uint64(pow(_FACTOR, i, 2**64)) for i in range(k)]
    sums = np.zeros(len(symbols) - k + 1, dtype=np.uint64)
    for i in range(k):
        sums += symbols[i : i + len(sums)] * powers[i]
    sums ^= sums >> np.uint64(31)  # the smallest sum must not prefer certain tokens
    sums *= np.uint64(_FACTOR)
    sums ^= sums >> np.uint64(29)
    return sums


def base_of(codes: Iterable[Code], k: int = NOISE) -> NDArray[np.uint64]:
    """All k-grams of what everybody was given, sorted."""
    found = [kgrams(code.symbols, k) for code in codes]
    return np.unique(np.concatenate(found)) if found else np.empty(0, dtype=np.uint64)


def fingerprint(code: Code, base: NDArray[np.uint64] | None = None, k: int = NOISE, t: int = GUARANTEE) -> Fingerprints:
    """Winnow ``code``."""
    grams = kgrams(code.symbols, k)
    own = np.ones(len(grams), dtype=bool) if base is None else ~np.isin(grams, base)
    hashes = np.where(own, np.minimum(grams, _NEVER - np.uint64(1)), _NEVER)
    window = t - k + 1
    places: dict[int, list[int]] = defaultdict(list)
    if len(hashes):
        if len(hashes) < window:
            chosen = np.array([len(hashes) - 1 - int(np.argmin(hashes[::-1]))])
        else:
            offsets = np.argmin(sliding_window_view(hashes, window)[:, ::-1], axis=1)  # reversed: rightmost of equals
            chosen = np.unique(np.arange(len(offsets)) + window - 1 - offsets)
        for place in chosen[hashes[chosen] != _NEVER]:
            places[int(hashes[place])].append(int(place))
    covered = np.zeros(len(code) + 1, dtype=np.int64)
    starts = np.flatnonzero(own)
    np.add.at(covered, starts, 1)
    np.add.at(covered, starts + k, -1)
    return Fingerprints(code, dict(places), np.cumsum(covered)[:-1] > 0)


def compare(a: Fingerprints, b: Fingerprints, k: int = NOISE) -> Match:
    """The passages that two codes share: common fingerprints, checked and extended token by token."""
    seeds = []
    for value in a.places.keys() & b.places.keys():
        seeds += [(i, j) for i in a.places[value][:_MOST_PLACES] for j in b.places[value][:_MOST_PLACES]]
    reached: dict[int, int] = {}  # diagonal -> end of the last run on it
    runs = []
    for i, j in sorted(seeds):
        if i < reached.get(i - j, -1):
            continue
        run = _extended(a.code.symbols, b.code.symbols, i, j)
        reached[i - j] = run.a + run.length
        if run.length >= k:
            runs.append(run)
    return _disjoint(runs, a, b, k)


def _extended(a: NDArray[np.uint64], b: NDArray[np.uint64], i: int, j: int) -> Passage:
    """The longest run around the tokens ``i`` and ``j`` that is equal in both."""
    back = min(i, j)
    unlike = np.flatnonzero(a[i - back : i] != b[j - back : j])
    start = back - (int(unlike[-1]) + 1 if len(unlike) else 0)
    ahead = min(len(a) - i, len(b) - j)
    unlike = np.flatnonzero(a[i : i + ahead] != b[j : j + ahead])
    return Passage(i - start, j - start, start + (int(unlike[0]) if len(unlike) else ahead))


def _disjoint(runs: list[Passage], a: Fingerprints, b: Fingerprints, k: int) -> Match:
    """Choose runs, longest first, so that no token belongs to two of them (greedy tiling, as in JPlag)."""
    used_a, used_b = np.zeros(len(a.code), dtype=bool), np.zeros(len(b.code), dtype=bool)
    chosen = []
    for run in sorted(runs, key=lambda r: (-r.length, r.a, r.b)):
        free = ~(used_a[run.a : run.a + run.length] | used_b[run.b : run.b + run.length])
        for start, stop in _stretches(free):
            if stop - start >= k:
                part = Passage(run.a + start, run.b + start, stop - start)
                used_a[part.a : part.a + part.length] = used_b[part.b : part.b + part.length] = True
                chosen.append(part)
    own_a, own_b = int(a.novel.sum()), int(b.novel.sum())
    both = int((used_a & a.novel).sum())
    return Match(
        sorted(chosen, key=lambda r: r.a),
        both,
        both / own_a if own_a else 0.0,
        int((used_b & b.novel).sum()) / own_b if own_b else 0.0,
    )


def _stretches(free: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Half-open intervals where ``free`` is true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], free, [False]]).astype(np.int8)))
    return [(int(s), int(e)) for s, e in zip(edges[::2], edges[1::2], strict=True)]
