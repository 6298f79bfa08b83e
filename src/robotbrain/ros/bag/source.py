"""Where the messages of a bag come from: MCAP files read here, everything else through rosbags."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from robotbrain.errors import InputError
from robotbrain.ros.bag.mcap_in import Channel, McapIn
from robotbrain.ros.bag.metadata import qos_from_rosbags, qos_from_yaml
from robotbrain.ros.qos import QoSProfile


class BagMessage(NamedTuple):
    """A recorded message: topic, type, when it was recorded (ns), and its CDR bytes."""

    topic: str
    typename: str
    stamp_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class BagTopic:
    """A topic of a bag.

    Attributes:
        name: absolute name.
        typename: ``pkg/msg/Name``.
        count: its messages.
        qos: profiles its publishers offered, as far as known.
        definition: of the type, with those it contains; empty when the bag has none.
        encoding: of the definition: ``ros2msg`` or ``ros2idl``.
        type_hash: RIHS01 hash of the type, empty when the bag has none.
    """

    name: str
    typename: str
    count: int
    qos: tuple[QoSProfile, ...] = ()
    definition: str = ""
    encoding: str = "ros2msg"
    type_hash: str = ""


class Source(Protocol):
    """Messages of a bag in order of their stamps; those with one stamp in the order they were recorded.

    Attributes:
        topics: by name.
        span_ns: stamps of the first and the last message; zeros when there is none.
        notes: what is not as it should be, each in one sentence.
        unfinished: it was not closed: :func:`~robotbrain.ros.bag.recover` makes it whole.
    """

    topics: dict[str, BagTopic]
    span_ns: tuple[int, int]
    notes: list[str]
    unfinished: bool

    def messages(self, topics: set[str], start_ns: int, stop_ns: int) -> Iterator[BagMessage]:
        """Yield the messages of ``topics`` with ``start_ns <= stamp < stop_ns``."""
        ...

    def close(self) -> None:
        """Release the files."""
        ...


class McapSource:
    """One or more MCAP files, whole or not."""

    def __init__(self, paths: list[Path]) -> None:
        self._files = [McapIn(path) for path in paths]
        self.notes = [note for file in self._files for note in file.notes]
        self.unfinished = any(not file.whole for file in self._files)
        filled = [file.span_ns for file in self._files if sum(file.counts.values())]
        self.span_ns = (min(start for start, _ in filled), max(end for _, end in filled)) if filled else (0, 0)
        self.topics: dict[str, BagTopic] = {}
        for file in self._files:
            for channel in file.channels.values():
                self._add(channel, file.counts.get(channel.id, 0))

    def _add(self, channel: Channel, count: int) -> None:
        known = self.topics.get(channel.topic)
        qos = qos_from_yaml(channel.metadata.get("offered_qos_profiles", ""))
        if known is None:
            self.topics[channel.topic] = BagTopic(
                channel.topic,
                channel.typename,
                count,
                qos,
                channel.definition,
                channel.encoding,
                channel.metadata.get("topic_type_hash", ""),
            )
            return
        if known.typename != channel.typename:
            self.notes.append(f"topic {known.name} has two types: {known.typename} and {channel.typename}")
        merged = known.qos + tuple(one for one in qos if one not in known.qos)
        self.topics[known.name] = BagTopic(
            known.name, known.typename, known.count + count, merged, known.definition, known.encoding, known.type_hash
        )

    def messages(self, topics: set[str], start_ns: int, stop_ns: int) -> Iterator[BagMessage]:
        """Yield messages in order of time."""
        streams = [self._one(number, file, topics, start_ns, stop_ns) for number, file in enumerate(self._files)]
        merged = streams[0] if len(streams) == 1 else heapq.merge(*streams)
        for stamp, _, _, channel, data in merged:
            yield BagMessage(channel.topic, channel.typename, stamp, data)

    @staticmethod
    def _one(number: int, file: McapIn, topics: set[str], start_ns: int, stop_ns: int) -> Iterator[Any]:
        wanted = {channel.id for channel in file.channels.values() if channel.topic in topics}
        for order, (stamp, channel, data) in enumerate(file.messages(wanted, start_ns, stop_ns)):
            yield stamp, number, order, channel, data

    def close(self) -> None:
        """Close the files."""
        for file in self._files:
            file.close()


class RosbagsSource:
    """A bag that rosbags reads: sqlite3 storage, or compressed by rosbag2."""

    unfinished = False

    def __init__(self, path: Path) -> None:
        from rosbags.rosbag2 import Reader

        try:
            self._reader: Any = Reader(path)
            self._reader.open()
        except Exception as error:  # rosbags, its YAML parser, sqlite3 or the decompressor: whatever they raise
            raise InputError(
                "bag", given=str(path), expected="a rosbag2 bag", fix=f"rosbags cannot open it: {error}"
            ) from error
        self.notes: list[str] = []
        some = self._reader.message_count > 0
        self.span_ns = (self._reader.start_time, self._reader.end_time - 1) if some else (0, 0)
        self.topics = {
            name: BagTopic(
                name,
                found.msgtype or found.connections[0].msgtype,
                found.msgcount,
                tuple(one for link in found.connections for one in qos_from_rosbags(link.ext.offered_qos_profiles)),
                found.msgdef.data,
                "ros2idl" if found.msgdef.format.name == "IDL" else "ros2msg",
                found.connections[0].digest,
            )
            for name, found in self._reader.topics.items()
        }

    def messages(self, topics: set[str], start_ns: int, stop_ns: int) -> Iterator[BagMessage]:
        """Yield messages in order of time."""
        links = [link for link in self._reader.connections if link.topic in topics]
        if links:
            for link, stamp, data in self._reader.messages(links, start_ns, stop_ns):
                yield BagMessage(link.topic, link.msgtype, stamp, bytes(data))

    def close(self) -> None:
        """Close the files."""
        if self._reader.is_open:
            self._reader.close()
