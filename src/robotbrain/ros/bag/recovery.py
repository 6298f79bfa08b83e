"""Making an unfinished bag whole."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from robotbrain.errors import InputError
from robotbrain.files import write_text
from robotbrain.ros.bag.mcap_in import McapIn
from robotbrain.ros.bag.mcap_out import McapOut
from robotbrain.ros.bag.metadata import FileRecord, TopicRecord, metadata_yaml, qos_from_yaml
from robotbrain.ros.bag.reader import END_OF_TIME_NS, storage_files
from robotbrain.ros.bag.writer import METADATA

_COMMIT_BYTES = 8 << 20


class Recovery(NamedTuple):
    """What :func:`recover` did: files written again, messages in the bag, bytes that could not be read, and notes."""

    rewritten: tuple[str, ...]
    messages: int
    lost_bytes: int
    notes: tuple[str, ...]


def recover(path: str | Path) -> Recovery:
    """Make an unfinished bag whole: index, footer and ``metadata.yaml``, so that every tool opens it.

    Each unfinished file is written again beside itself and then put in its place, so that a kill or a full disk in
    between loses nothing. A bag that is whole stays as it is.

    Args:
        path: a bag folder with MCAP storage, or one MCAP file.

    Raises:
        InputError: there is no MCAP file.
        OSError: the disk is full; the bag is as it was.
    """
    path = Path(path)
    files = storage_files(path) if path.exists() else []
    if not files:
        raise InputError(
            "bag",
            given=str(path),
            expected="a folder of .mcap files, or one",
            fix="Only MCAP is recovered.",
        )
    rewritten, notes, lost = [], [], 0
    for file in files:
        found = McapIn(file)
        try:
            if found.whole:
                continue
            notes += found.notes
            lost += found.size - found.good_bytes
            _write_again(found)
            rewritten.append(file.name)
        finally:
            found.close()
    records, topics = _describe(files)
    if path.is_dir() and (rewritten or not (path / METADATA).exists()):
        write_text(path / METADATA, metadata_yaml(records, topics))
    return Recovery(tuple(rewritten), sum(record.messages for record in records), lost, tuple(notes))


def _write_again(found: McapIn) -> None:
    temporary = found.path.with_name(f".{found.path.name}.recovering")
    temporary.unlink(missing_ok=True)  # of an earlier attempt that was stopped
    out = McapOut(temporary)
    try:
        numbers = {
            channel.id: out.add_topic(
                channel.topic,
                channel.typename,
                channel.definition,
                encoding=channel.encoding,
                type_hash=channel.metadata.get("topic_type_hash", ""),
                qos=qos_from_yaml(channel.metadata.get("offered_qos_profiles", "")),
            )
            for channel in found.channels.values()
        }
        for stamp, channel, data in found.messages(set(numbers), 0, END_OF_TIME_NS):
            out.add(numbers[channel.id], stamp, data)
            if out.staged_bytes > _COMMIT_BYTES:
                out.store(out.take(), sync=False)
        out.store(out.finish(), sync=True)
        out.close()
        found.close()  # Windows does not replace a file that is open
        temporary.replace(found.path)
    finally:
        out.close()
        temporary.unlink(missing_ok=True)


def _describe(files: list[Path]) -> tuple[list[FileRecord], list[TopicRecord]]:
    records: list[FileRecord] = []
    topics: dict[tuple[str, str], TopicRecord] = {}
    for file in files:
        whole = McapIn(file)
        records.append(FileRecord(file.name, *whole.span_ns, sum(whole.counts.values())))
        for topic in _topics(whole):
            before = topics.get(topic[:2])
            topics[topic[:2]] = topic if before is None else topic._replace(messages=before.messages + topic.messages)
        whole.close()
    return records, list(topics.values())


def _topics(file: McapIn) -> Iterator[TopicRecord]:
    for channel in file.channels.values():
        yield TopicRecord(
            channel.topic,
            channel.typename,
            qos_from_yaml(channel.metadata.get("offered_qos_profiles", "")),
            channel.metadata.get("topic_type_hash", ""),
            file.counts.get(channel.id, 0),
        )
