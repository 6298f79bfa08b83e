"""What is in a bag, topic by topic: counts, rates, gaps, and whether everything can be decoded."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from robotbrain.errors import InputError
from robotbrain.ros.bag.reader import BagReader


@dataclass(slots=True)
class TopicSurvey:
    """One topic: messages, bytes, first and last stamp (ns), the longest gap (ns) and when it began.

    Attributes:
        undecodable: messages that are not what their type says; 0 where they were not looked at.
        problem: the first reason why.
    """

    name: str
    typename: str
    count: int = 0
    size: int = 0
    first_ns: int = 0
    last_ns: int = 0
    gap_ns: int = 0
    gap_at_ns: int = 0
    undecodable: int = 0
    problem: str = ""

    @property
    def rate_hz(self) -> float | None:
        """Mean rate between the first and the last message; None with fewer than two stamps."""
        span = self.last_ns - self.first_ns
        return (self.count - 1) * 1e9 / span if span > 0 else None


def survey(reader: BagReader, *, decode: bool = False) -> list[TopicSurvey]:
    """Read a whole bag and return a :class:`TopicSurvey` for each topic, by name.

    Args:
        reader: an open bag.
        decode: decode every message too.
    """
    found = {name: TopicSurvey(name, topic.typename) for name, topic in reader.topics.items()}
    for message in reader:
        one, stamp = found[message.topic], message.stamp_ns
        if not one.count:
            one.first_ns = stamp
        elif stamp - one.last_ns > one.gap_ns:
            one.gap_ns, one.gap_at_ns = stamp - one.last_ns, one.last_ns
        one.last_ns = stamp
        one.count += 1
        one.size += len(message.data)
        if decode:
            try:
                reader.decode(message)
            except InputError as error:
                one.undecodable += 1
                one.problem = one.problem or str(error)
    return list(found.values())


def rows(reader: BagReader, topic: str) -> Iterator[dict[str, Any]]:
    """Yield the messages of a topic as flat rows: ``stamp_ns`` and a column per number, text and array element.

    Nested fields are joined by dots (``pose.position.x``); elements of an array are numbered (``ranges.0``).
    """
    for message in reader.messages([topic]):
        row: dict[str, Any] = {"stamp_ns": message.stamp_ns}
        _flatten("", reader.decode(message), row)
        yield row


def _flatten(prefix: str, value: Any, row: dict[str, Any]) -> None:
    fields = getattr(type(value), "_fields_and_field_types", None) or getattr(value, "__dataclass_fields__", None)
    if fields is not None:
        for name in fields:
            if name != "__msgtype__":
                _flatten(f"{prefix}.{name}" if prefix else name, getattr(value, name), row)
    elif isinstance(value, (str, int, float, bool, np.generic)):
        row[prefix] = value
    elif isinstance(value, bytes):
        row[prefix] = value.hex()
    else:
        for index, item in enumerate(value):
            _flatten(f"{prefix}.{index}", item, row)
