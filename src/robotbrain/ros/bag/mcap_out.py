"""One MCAP file being written: bytes leave in whole records, so that what is on disk can always be read.

Format: https://mcap.dev/spec. Encoding is left to the ``mcap`` package; this module decides when bytes go to the disk.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from robotbrain.errors import InputError
from robotbrain.ros.bag.metadata import FileRecord, TopicRecord, qos_yaml, serialized_metadata
from robotbrain.ros.qos import QoSProfile

MAX_STAMP_NS = 2**63 - 1
COMPRESSIONS = ("none", "lz4", "zstd")


def check_compression(name: str) -> None:
    """Raise InputError unless ``name`` is a compression of chunks."""
    if name not in COMPRESSIONS:
        raise InputError(
            "compression", given=name, expected="one of " + ", ".join(COMPRESSIONS), fix="none is fastest."
        )


class _Stage:
    """The stream that the encoder writes to: memory, until it is handed over to the file."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.size = 0
        self.handed_over = 0

    def write(self, data: bytes) -> int:
        self.parts.append(bytes(data))
        self.size += len(data)
        return len(data)

    def tell(self) -> int:
        return self.handed_over + self.size

    def flush(self) -> None:
        """Nothing: the file is written by :meth:`McapOut.store`."""

    def take(self) -> bytes:
        data = b"".join(self.parts)
        self.parts.clear()
        self.handed_over += self.size
        self.size = 0
        return data


class McapOut:
    """A file that is written in three steps: add (encoder memory), stage (whole chunks), store (disk).

    Not thread-safe by itself: ``add``, ``stage`` and ``finish`` belong under one lock, ``store`` under another, which
    lets messages be added while the disk is busy.

    Args:
        path: must not exist.
        compression: of chunks: ``none``, ``lz4`` or ``zstd``.
        chunk_bytes: a chunk ends when it has reached this size.

    Attributes:
        count: messages added.
        staged_count: messages in whole chunks: those that are safe once everything handed over is stored.
    """

    def __init__(self, path: Path, *, compression: str = "none", chunk_bytes: int = 1 << 20) -> None:
        from mcap.writer import CompressionType, Writer

        check_compression(compression)
        self.path = path
        self.stage_file = _Stage()
        self._file = path.open("xb", buffering=0)
        self._stored = 0
        self._writer: Any = Writer(
            self.stage_file,
            chunk_size=chunk_bytes,
            compression=CompressionType[compression.upper()],
        )
        self._writer.start(profile="ros2", library="robotbrain")
        self._schemas: dict[tuple[str, str], int] = {}
        self._topics: dict[int, list[Any]] = {}
        self.start_ns, self.end_ns, self.count = MAX_STAMP_NS, 0, 0
        self.staged_count = 0

    # ------------------------------------------------------------ encoding

    def add_topic(
        self,
        name: str,
        typename: str,
        definition: str,
        *,
        encoding: str = "ros2msg",
        type_hash: str = "",
        qos: Sequence[QoSProfile] = (),
    ) -> int:
        """Declare a topic; return its channel number."""
        key = (typename, definition)
        if key not in self._schemas:
            self._schemas[key] = self._writer.register_schema(
                name=typename, encoding=encoding if definition else "", data=definition.encode()
            )
        channel: int = self._writer.register_channel(
            topic=name,
            message_encoding="cdr",
            schema_id=self._schemas[key],
            metadata={"offered_qos_profiles": qos_yaml(qos), "topic_type_hash": type_hash},
        )
        self._topics[channel] = [name, typename, tuple(qos), type_hash, 0]
        return channel

    def add(self, channel: int, stamp_ns: int, data: bytes) -> None:
        """Add a message; it stays in memory until it is staged and stored."""
        topic, before = self._topics[channel], self.stage_file.size
        self._writer.add_message(channel, stamp_ns, data, stamp_ns, topic[4] & 0xFFFFFFFF)
        topic[4] += 1
        self.count += 1
        if stamp_ns < self.start_ns:
            self.start_ns = stamp_ns
        if stamp_ns > self.end_ns:
            self.end_ns = stamp_ns
        if self.stage_file.size != before:
            self.staged_count = self.count

    @property
    def staged_bytes(self) -> int:
        """Bytes of whole chunks that wait to be stored."""
        return self.stage_file.size

    def stage(self) -> bytes:
        """End the chunk in progress and return every byte not yet handed over."""
        self._writer.flush()
        self.staged_count = self.count
        return self.stage_file.take()

    def take(self) -> bytes:
        """Return the bytes of the chunks that are already whole."""
        return self.stage_file.take()

    def finish(self) -> bytes:
        """End the file: return its remaining bytes, index and footer included."""
        # The chunk first, so that the metadata record stands behind all messages, as rosbag2 puts it.
        self._writer.flush()
        description = serialized_metadata([self.record()], self.topics())
        self._writer.add_metadata("rosbag2", {"serialized_metadata": description})
        self._writer.finish()
        self.staged_count = self.count
        return self.stage_file.take()

    # ------------------------------------------------------------ disk

    def store(self, data: bytes, *, sync: bool) -> None:
        """Append bytes to the file; if that fails the file ends where it ended before.

        Raises:
            OSError: disk full, or gone.
        """
        view = memoryview(data)
        try:
            while view:
                view = view[self._file.write(view) or 0 :]
        except OSError:
            self._file.truncate(self._stored)
            self._file.seek(self._stored)
            raise
        self._stored += len(data)
        if sync and data:
            os.fsync(self._file.fileno())

    def close(self) -> None:
        """Close the file as it is."""
        self._file.close()

    # ------------------------------------------------------------ what is in it

    def record(self) -> FileRecord:
        """Return name, times and number of messages, for the metadata."""
        start = self.start_ns if self.count else 0
        return FileRecord(self.path.name, start, self.end_ns, self.count)

    def topics(self) -> list[TopicRecord]:
        """Return the topics with their numbers of messages, for the metadata."""
        return [TopicRecord(*topic) for topic in self._topics.values()]
