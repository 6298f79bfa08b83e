"""Chance that is the same on every machine and in every release of Python."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import TypeVar

T = TypeVar("T")
_WORD = 1 << 64


class Dice:
    """Draws that follow from ``seed`` alone: SHA-256 of the seed and a counter, 64 bits at a time.

    Python promises the order of ``random.random()`` across releases, but not that of ``shuffle`` or ``sample``; a paper
    must be the same next year.
    """

    def __init__(self, *seed: object) -> None:
        self._seed = "\0".join(map(str, seed)).encode()
        self._count = 0

    def below(self, n: int) -> int:
        """A whole number from 0 to ``n - 1``, each as likely as the other."""
        fair = _WORD - _WORD % n  # what lies above would favour the small numbers
        while True:
            digest = hashlib.sha256(self._seed + b"\0" + self._count.to_bytes(8, "big")).digest()
            self._count += 1
            word = int.from_bytes(digest[:8], "big")
            if word < fair:
                return word % n

    def choice(self, values: Sequence[T]) -> T:
        """One of ``values``."""
        return values[self.below(len(values))]

    def shuffled(self, values: Sequence[T]) -> list[T]:
        """``values`` in an order in which each is as likely as the other (Fisher and Yates)."""
        result = list(values)
        for last in range(len(result) - 1, 0, -1):
            other = self.below(last + 1)
            result[last], result[other] = result[other], result[last]
        return result
