"""One MCAP file being read, by its index or, when it was not finished, by what is there.

Format: https://mcap.dev/spec. A finished file ends with a summary and a footer. A file whose writer was killed ends
anywhere: every record before that point is found by stepping from record to record, and a chunk counts when it is there
whole and its checksum holds.
"""

from __future__ import annotations

import heapq
import io
import struct
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from robotbrain.errors import InputError

MAGIC = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL, MESSAGE, CHUNK, DATA_END = 0x03, 0x04, 0x05, 0x06, 0x0F

_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")


class Channel(NamedTuple):
    """A topic in a file, with the definition of its type."""

    id: int
    topic: str
    typename: str
    definition: str
    encoding: str
    metadata: dict[str, str]


class Span(NamedTuple):
    """Where messages are: their first and last stamp (ns), the offset and length of the bytes, and whether a chunk."""

    start_ns: int
    end_ns: int
    offset: int
    length: int
    is_chunk: bool


class McapIn:
    """An MCAP file.

    Attributes:
        channels: by number.
        counts: messages by channel number.
        spans: where messages are, in file order.
        whole: it has its index and footer.
        good_bytes: up to here everything could be read.
        notes: what is wrong with it.

    Raises:
        InputError: it cannot be opened, or is not an MCAP file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._file: Any = path.open("rb")
        except OSError as error:
            raise InputError(
                "bag file", given=str(path), expected="a readable file", fix=f"{error.strerror or error}."
            ) from None
        self.size = path.stat().st_size
        self.channels: dict[int, Channel] = {}
        self.counts: Counter[int] = Counter()
        self.spans: list[Span] = []
        self.notes: list[str] = []
        self._schemas: dict[int, Any] = {}
        self.good_bytes = self.size
        try:
            self._check_magic()
            indexed, damaged = self._read_summary() if self._ends_well() else (False, False)
            self.whole = indexed or (self._scan() and not damaged)
        except BaseException:
            self._file.close()
            raise

    def _check_magic(self) -> None:
        start = self._file.read(len(MAGIC))
        if start != MAGIC[: len(start)]:
            raise InputError("bag file", given=str(self.path), expected="an MCAP file", fix="Its first bytes differ.")

    def _ends_well(self) -> bool:
        if self.size < 2 * len(MAGIC):
            return False
        self._file.seek(-len(MAGIC), io.SEEK_END)
        return bool(self._file.read() == MAGIC)

    @property
    def span_ns(self) -> tuple[int, int]:
        """Stamps of the first and the last message; zeros when there is none."""
        if not self.spans:
            return 0, 0
        return min(span.start_ns for span in self.spans), max(span.end_ns for span in self.spans)

    # ------------------------------------------------------------ index

    def _read_summary(self) -> tuple[bool, bool]:
        """Take the index; return whether there is one that can be used, and whether there is one that cannot."""
        from mcap.exceptions import McapError
        from mcap.reader import SeekingReader

        self._file.seek(0)
        try:
            summary = SeekingReader(self._file).get_summary()
        except (McapError, ValueError, struct.error, EOFError):
            self.notes.append(f"{self.path.name}: the index is damaged; the file was read without it")
            return False, True
        statistics = summary.statistics if summary is not None else None
        if summary is None or statistics is None:
            return False, False
        if statistics.message_count and not summary.chunk_indexes:
            return False, False  # written without chunks: its messages have to be looked for
        for schema in summary.schemas.values():
            self._schemas[schema.id] = schema
        for channel in summary.channels.values():
            self._add_channel(channel)
        self.counts.update(statistics.channel_message_counts)
        self.spans = [
            Span(one.message_start_time, one.message_end_time, one.chunk_start_offset, one.chunk_length, True)
            for one in sorted(summary.chunk_indexes, key=lambda one: one.chunk_start_offset)
        ]
        return True, False

    def _add_channel(self, channel: Any) -> None:
        schema = self._schemas.get(channel.schema_id)
        self.channels[channel.id] = Channel(
            channel.id,
            channel.topic,
            schema.name if schema is not None else "",
            schema.data.decode("utf-8", "replace") if schema is not None else "",
            schema.encoding if schema is not None else "",
            dict(channel.metadata),
        )

    # ------------------------------------------------------------ without an index

    def _scan(self) -> bool:
        """Find all that can be read, stepping from record to record; tell whether the file has an end."""
        position = self.good_bytes = min(len(MAGIC), self.size)
        ended = False
        while position + _HEAD.size <= self.size:
            self._file.seek(position)
            opcode, length = _HEAD.unpack(self._file.read(_HEAD.size))
            end = position + _HEAD.size + length
            if opcode == 0 or end > self.size:
                break
            ended = ended or opcode == DATA_END
            if opcode == CHUNK:
                self._scan_chunk(position, end)
            elif opcode in (SCHEMA, CHANNEL, MESSAGE):
                found = self._take(opcode, memoryview(self._file.read(length)))
                if found is not None:
                    self.spans.append(Span(found, found, position, end - position, False))
            position = self.good_bytes = end
        whole = ended and self._ends_well()
        if not whole:
            self.notes.append(
                f"{self.path.name}: not finished (its writer was stopped); "
                f"{sum(self.counts.values())} messages are whole, the last {self.size - self.good_bytes} bytes are not"
            )
        return whole

    def _scan_chunk(self, position: int, end: int) -> None:
        try:
            content = self._chunk(Span(0, 0, position, end - position, True))
        except ValueError as error:
            self.notes.append(f"{self.path.name}: a chunk of {end - position} bytes at {position} is damaged ({error})")
            return
        stamps = []
        for opcode, record in _records(content):
            stamp = self._take(opcode, record)
            if stamp is not None:
                stamps.append(stamp)
        if stamps:
            self.spans.append(Span(min(stamps), max(stamps), position, end - position, True))

    def _take(self, opcode: int, record: memoryview) -> int | None:
        """Note a schema or channel; count a message and return its stamp."""
        from mcap.data_stream import ReadDataStream
        from mcap.records import Channel as ChannelRecord
        from mcap.records import Schema

        if opcode == MESSAGE:
            channel, _, stamp, _ = _MESSAGE.unpack_from(record)
            self.counts[channel] += 1
            return int(stamp)
        if opcode == SCHEMA:
            schema = Schema.read(ReadDataStream(io.BytesIO(record)))
            self._schemas[schema.id] = schema
        elif opcode == CHANNEL:
            self._add_channel(ChannelRecord.read(ReadDataStream(io.BytesIO(record))))
        return None

    # ------------------------------------------------------------ content

    def _chunk(self, span: Span) -> memoryview:
        """Return the records of a chunk.

        Raises:
            ValueError: it is damaged.
        """
        from mcap.data_stream import ReadDataStream
        from mcap.exceptions import McapError
        from mcap.records import Chunk
        from mcap.stream_reader import get_chunk_data_stream

        self._file.seek(span.offset + _HEAD.size)
        raw = self._file.read(span.length - _HEAD.size)
        try:
            stream, length = get_chunk_data_stream(Chunk.read(ReadDataStream(io.BytesIO(raw))), validate_crc=True)
            return memoryview(stream.read(length))
        except (McapError, ValueError, EOFError, struct.error, RuntimeError, MemoryError) as error:
            raise ValueError(str(error) or type(error).__name__) from error
        except Exception as error:
            if type(error).__module__.startswith("zstandard"):  # ZstdError is a plain Exception
                raise ValueError(str(error)) from error
            raise

    def _load(self, span: Span, wanted: set[int], start_ns: int, stop_ns: int) -> list[tuple[Any, ...]]:
        if span.is_chunk:
            records = _records(self._chunk(span))
        else:
            self._file.seek(span.offset)
            records = _records(memoryview(self._file.read(span.length)))
        found = []
        for order, (opcode, record) in enumerate(records):
            if opcode == MESSAGE:
                channel, _, stamp, _ = _MESSAGE.unpack_from(record)
                if channel in wanted and start_ns <= stamp < stop_ns:
                    found.append((stamp, span.offset, order, channel, bytes(record[_MESSAGE.size :])))
        return found

    def messages(self, wanted: set[int], start_ns: int, stop_ns: int) -> Iterator[tuple[int, Channel, bytes]]:
        """Yield (stamp, channel, data) in order of stamps, then of the file; memory holds overlapping chunks only.

        Raises:
            InputError: a chunk is damaged.
        """
        spans = sorted(
            (span for span in self.spans if span.end_ns >= start_ns and span.start_ns < stop_ns),
            key=lambda span: (span.start_ns, span.offset),
        )
        pending: list[tuple[Any, ...]] = []
        for span in spans:
            while pending and pending[0][0] < span.start_ns:
                stamp, _, _, channel, data = heapq.heappop(pending)
                yield stamp, self.channels[channel], data
            try:
                loaded = self._load(span, wanted, start_ns, stop_ns)
            except ValueError as error:
                raise InputError(
                    "bag file",
                    given=f"{self.path.name}, chunk at byte {span.offset}",
                    expected="an undamaged chunk",
                    fix=f"{error}. `robotbrain bag recover` keeps what can be read.",
                ) from error
            for item in loaded:
                heapq.heappush(pending, item)
        while pending:
            stamp, _, _, channel, data = heapq.heappop(pending)
            yield stamp, self.channels[channel], data

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _records(content: memoryview) -> Iterator[tuple[int, memoryview]]:
    position, size = 0, len(content)
    while position + _HEAD.size <= size:
        opcode, length = _HEAD.unpack_from(content, position)
        position += _HEAD.size
        yield opcode, content[position : position + length]
        position += length
