"""Whom was waited for? Who held an executor's threads or a device's resources, and when."""

from __future__ import annotations

import bisect
import itertools
from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from robotbrain.ros.context import CallbackRecord


class Place(NamedTuple):
    """One callback of one node: ``name`` is its topic or service, for a timer its function's name."""

    node: str
    kind: str
    name: str

    def __str__(self) -> str:
        return f"{self.node} {self.kind} {self.name}"


def place_of(record: CallbackRecord) -> Place:
    """Return which callback of which node a record is of."""
    return Place(record.node, record.kind, record.name)


class Occupancy:
    """Who held an executor's threads or a resource, and when."""

    def __init__(self, entries: Iterable[tuple[object, int, int, Place]]) -> None:
        self._entries: dict[object, list[tuple[int, int, Place]]] = {}
        for key, begin, end, place in entries:
            if end > begin:
                self._entries.setdefault(key, []).append((begin, end, place))
        self._longest: dict[object, int] = {}
        for key, rows in self._entries.items():
            rows.sort()
            self._longest[key] = max(end - begin for begin, end, _ in rows)

    def _present(self, key: object, begin: int, end: int) -> list[tuple[int, int, Place]]:
        rows = self._entries.get(key, [])
        low = bisect.bisect_left(rows, (begin - self._longest.get(key, 0),))
        high = bisect.bisect_left(rows, (end,))
        return [row for row in rows[low:high] if row[1] > begin]

    def between(self, key: object, begin: int, end: int, node: str) -> list[tuple[int, int, Place | None]]:
        """Cut [begin, end] into parts, each blamed on one occupant, or on None.

        Of several at a time the blame goes to one of ``node`` (callbacks of one node exclude each other), then to the
        one that stays longest.
        """
        if end <= begin:
            return []
        present = self._present(key, begin, end)
        cuts = sorted({begin, end, *(t for row in present for t in row[:2] if begin < t < end)})
        parts: list[tuple[int, int, Place | None]] = []
        for first, last in itertools.pairwise(cuts):
            here = [row for row in present if row[0] <= first and row[1] >= last]
            chosen = max(here, key=lambda row: (row[2].node == node, row[1]), default=None)
            by = chosen[2] if chosen is not None else None
            if parts and parts[-1][2] == by:
                parts[-1] = (parts[-1][0], last, by)
            else:
                parts.append((first, last, by))
        return parts

    def shares(self, key: object, begin: int, end: int, but: Place) -> list[tuple[Place, int]]:
        """Return how long other nodes were there in [begin, end], ns, each with its longest callback; longest first."""
        time: dict[str, dict[Place, int]] = {}
        for first, last, place in self._present(key, begin, end):
            if place != but:
                mine = time.setdefault(place.node, {})
                mine[place] = mine.get(place, 0) + min(last, end) - max(first, begin)
        found = [(max(places, key=lambda p: (places[p], p)), sum(places.values())) for places in time.values()]
        return sorted(found, key=lambda item: (-item[1], item[0]))
