"""Reading bags."""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

from robotbrain.errors import InputError
from robotbrain.ros.bag.source import BagMessage, BagTopic, McapSource, RosbagsSource, Source
from robotbrain.ros.bag.writer import METADATA
from robotbrain.ros.qos import QoSProfile

__all__ = ["BagMessage", "BagReader", "BagTopic", "open_bag"]

END_OF_TIME_NS = 2**63 - 1


class BagReader:
    """A bag: iterate over it, or over :meth:`messages` of some topics and times.

    Reads folders and single files of genuine rosbag2 (MCAP and sqlite3, compressed or not) and bags of the kit; a bag
    that was not finished shows what is whole in it, and says so in :attr:`notes`.

    Args:
        path: the folder, or a storage file.

    Attributes:
        topics: :class:`BagTopic` by name.
        start_ns: stamp of the first message.
        end_ns: stamp of the last message.
        message_count: of all topics.
        unfinished: it was not closed; :func:`~robotbrain.ros.bag.recover` makes it whole.
        notes: what is not as it should be, each in one sentence.

    Raises:
        InputError: there is no bag, or it cannot be read.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._source = _open(self.path)
        self.topics = dict(sorted(self._source.topics.items()))
        self.start_ns, self.end_ns = self._source.span_ns
        self.message_count = sum(topic.count for topic in self.topics.values())
        self.unfinished, self.notes = self._source.unfinished, list(self._source.notes)
        self._decoders: dict[str, Callable[[bytes], Any]] = {}

    @property
    def duration_ns(self) -> int:
        """Time from the first to the last message."""
        return self.end_ns - self.start_ns

    def qos(self, topic: str) -> tuple[QoSProfile, ...]:
        """Return the profiles that the publishers of a topic offered; empty when the bag does not say."""
        return self._topic(topic).qos

    def _topic(self, name: str) -> BagTopic:
        if name not in self.topics:
            raise InputError(
                "topic",
                given=name,
                expected=f"one of: {', '.join(self.topics) or 'none'}",
                fix="Check the name.",
            )
        return self.topics[name]

    # ------------------------------------------------------------ messages

    def messages(
        self, topics: Iterable[str] | None = None, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[BagMessage]:
        """Yield messages in order of their stamps; with equal stamps in the order they were recorded.

        Args:
            topics: of these topics only.
            start_ns: from this stamp on.
            stop_ns: before this stamp.

        Raises:
            InputError: an unknown topic.
        """
        names = set(self.topics) if topics is None else {self._topic(name).name for name in topics}
        return self._source.messages(
            names, 0 if start_ns is None else start_ns, END_OF_TIME_NS if stop_ns is None else stop_ns
        )

    def __iter__(self) -> Iterator[BagMessage]:
        return self.messages()

    def decode(self, message: BagMessage) -> Any:
        """Return the message itself: of the kit's class, or for other types as rosbags makes it from the bag.

        Raises:
            InputError: the bytes are not of the type, or the bag does not define it.
        """
        decoder = self._decoders.get(message.topic)
        if decoder is None:
            decoder = self._decoders[message.topic] = _decoder(self._topic(message.topic))
        return decoder(message.data)

    def digest(self) -> str:
        """Return a SHA-256 of topics, types, stamps and data: equal for equal recordings, however they are stored."""
        total = hashlib.sha256()
        for topic, typename, stamp, data in self:
            for part in (topic.encode(), typename.encode(), struct.pack("<Q", stamp), data):
                total.update(struct.pack("<I", len(part)) + part)
        return total.hexdigest()

    # ------------------------------------------------------------ end

    def close(self) -> None:
        """Release the files."""
        self._source.close()

    def __enter__(self) -> BagReader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def open_bag(path: str | Path) -> BagReader:
    """Open a bag, finished or not; see :class:`BagReader`."""
    return BagReader(path)


def storage_files(path: Path) -> list[Path]:
    """Return the MCAP files of a bag (a folder or one file), in the order of their numbers."""
    if path.is_file():
        return [path] if path.suffix == ".mcap" else []
    found = [entry for entry in path.glob("*.mcap") if not entry.name.startswith(".")]
    return sorted(found, key=lambda entry: (len(entry.name), entry.name))


def _open(path: Path) -> Source:
    if not path.exists():
        raise InputError("bag", given=str(path), expected="a bag folder or file", fix="There is nothing at that path.")
    files = storage_files(path)
    if files and not _needs_rosbags(path / METADATA):
        return McapSource(files)
    if path.is_dir() and not (path / METADATA).exists():
        stored = sorted(path.glob("*.db3"))
        if len(stored) != 1:
            raise InputError(
                "bag", given=str(path), expected="metadata.yaml and storage files", fix="The folder is not a bag."
            )
        path = stored[0]
    return RosbagsSource(path)


def _needs_rosbags(metadata: Path) -> bool:
    """Tell whether rosbag2 compressed the files or messages (MCAP compresses its chunks itself)."""
    try:
        text = metadata.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return False
    for line in text.splitlines():
        key, _, value = line.strip().partition(":")
        if key == "compression_mode" and value.strip().strip("\"'").lower() not in ("", "none"):
            return True
    return False


def _decoder(topic: BagTopic) -> Callable[[bytes], Any]:
    from robotbrain.ros.cdr import from_cdr
    from robotbrain.ros.messages import message_class
    from robotbrain.ros.typedefs import typenames, typestore

    if topic.typename in typenames() and topic.type_hash in ("", typestore().hash_rihs01(topic.typename)):
        cls = message_class(topic.typename)
        return lambda data: from_cdr(data, cls)
    if not topic.definition:
        raise InputError(
            f"type of topic {topic.name}",
            given=topic.typename,
            expected="a type the kit knows, or a bag that defines it",
            fix="Record it again with MCAP storage, which keeps definitions.",
        )
    store = _foreign_store(topic)

    def decode(data: bytes) -> Any:
        try:
            return store.deserialize_cdr(data, topic.typename)
        except Exception as error:
            raise InputError(
                f"message on {topic.name}",
                given=data[:32],
                expected=topic.typename,
                fix=f"Undecodable: {error}",
            ) from error

    return decode


def _foreign_store(topic: BagTopic) -> Any:
    """Return a rosbags store with the bag's own definition of a type."""
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    if topic.encoding == "ros2idl":
        store.register(get_types_from_idl(topic.definition))
    else:
        store.register(get_types_from_msg(topic.definition, topic.typename))
    return store
