"""Canonical records of a run, for "two runs with one seed are byte-identical"."""

from __future__ import annotations

import hashlib
import struct
from collections import Counter
from pathlib import Path
from types import TracebackType

from robotbrain.files import write_bytes
from robotbrain.ros.context import SimContext

SYSTEM = frozenset({"/parameter_events", "/rosout"})
"""Topics on which nodes publish of themselves, when somebody listens."""


class DecisionLog:
    """Everything published on a context, in order: time, topic, type, publisher and CDR bytes.

    One entry is the release time as unsigned 64-bit little endian, then topic, type, publisher node and CDR,
    each preceded by its length as unsigned 32-bit. Two logs are equal exactly when their bytes are.

    Args:
        context: the simulation to record.
        topics: record these only (absolute names); all when omitted, but those in ``SYSTEM``: they depend on who
            listens.

    Usable as a context manager; recording ends with :meth:`close`.
    """

    def __init__(self, context: SimContext, topics: set[str] | None = None) -> None:
        self._topics = topics
        self._entries: list[bytes] = []
        self._hash = hashlib.sha256()
        self.counts: Counter[str] = Counter()
        self._remove = context.add_tap(self._take)
        self._open = True

    def _take(self, time_ns: int, topic: str, typename: str, node: str, data: bytes) -> None:
        if topic in SYSTEM if self._topics is None else topic not in self._topics:
            return
        parts = [struct.pack("<Q", time_ns)]
        for part in (topic.encode(), typename.encode(), node.encode(), data):
            parts += (struct.pack("<I", len(part)), part)
        entry = b"".join(parts)
        self._entries.append(entry)
        self._hash.update(entry)
        self.counts[topic] += 1

    def close(self) -> None:
        """Stop recording; what was recorded stays."""
        if self._open:
            self._open = False
            self._remove()

    def to_bytes(self) -> bytes:
        """Return the canonical bytes."""
        return b"".join(self._entries)

    def sha256(self) -> str:
        """Return the SHA-256 of :meth:`to_bytes` as hexadecimal text."""
        return self._hash.hexdigest()

    def save(self, path: str | Path) -> Path:
        """Write :meth:`to_bytes` to a file, atomically; return its path."""
        return write_bytes(path, self.to_bytes())

    def __len__(self) -> int:
        return len(self._entries)

    def __enter__(self) -> DecisionLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
