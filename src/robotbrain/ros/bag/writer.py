"""Writing bags from any process, simulated or not."""

from __future__ import annotations

import atexit
import contextlib
import errno
import shutil
import sys
import threading
import weakref
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType

from robotbrain.errors import InputError, RobotBrainError
from robotbrain.files import write_text
from robotbrain.ros.bag.mcap_out import MAX_STAMP_NS, McapOut, check_compression
from robotbrain.ros.bag.metadata import metadata_yaml
from robotbrain.ros.qos import QoSProfile

METADATA = "metadata.yaml"
STORAGE_SUFFIXES = (".mcap", ".db3", ".zstd", ".db3-wal", ".db3-shm", ".recovering", ".tmp")


class BagWriter:
    """Writes one rosbag2 folder with MCAP storage.

    A message is in the file at the latest ``flush_interval_s`` after :meth:`write` (plus the time of writing): a thread
    stores and syncs what has come. A process that is killed loses no more than that, and the bag can be opened
    (:func:`~robotbrain.ros.bag.open_bag`, :func:`~robotbrain.ros.bag.recover`). Memory is bounded: when the disk is too
    slow, :meth:`write` waits once ``max_pending_bytes`` are waiting to be stored.

    When the disk is full or gone the writer stops with one message and keeps what is stored; :meth:`write` then returns
    False, so that a robot drives on.

    Where chunks end depends on the wall clock, so equal recordings have equal messages but not equal bytes; with
    ``flush_interval_s=None`` chunks end by size alone and files are equal byte by byte (and a kill loses up to
    ``chunk_bytes``).

    Args:
        path: the folder to make.
        overwrite: replace a bag that is there; anything but a bag is refused all the same.
        compression: of chunks: ``none``, ``lz4`` or ``zstd``.
        flush_interval_s: in (0, 0.5]; None to store only when a chunk is full.
        chunk_bytes: largest chunk.
        max_pending_bytes: of whole chunks that wait for the disk.
        on_failure: called once with the reason when writing fails; prints to standard error when omitted.

    Attributes:
        failure: why writing stopped, empty while it has not.
        lost: messages refused, or not stored, since then.

    Raises:
        InputError: the path exists, or an argument is out of range.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        overwrite: bool = False,
        compression: str = "none",
        flush_interval_s: float | None = 0.25,
        chunk_bytes: int = 1 << 20,
        max_pending_bytes: int = 16 << 20,
        on_failure: Callable[[str], None] | None = None,
    ) -> None:
        if flush_interval_s is not None and not 0 < flush_interval_s <= 0.5:
            raise InputError(
                "flush_interval_s", given=flush_interval_s, expected="seconds in (0, 0.5], or None", fix="Use 0.25."
            )
        check_compression(compression)
        self.path = Path(path)
        make_folder(self.path, overwrite=overwrite)
        self._out = McapOut(self.path / f"{self.path.name}_0.mcap", compression=compression, chunk_bytes=chunk_bytes)
        self._max_pending = max_pending_bytes
        self._on_failure = on_failure or _complain
        self.failure = ""
        self.lost = 0
        self._safe = 0  # messages stored
        self._channels: dict[str, tuple[int, str]] = {}
        self._encode, self._disk = threading.Lock(), threading.RLock()
        self._wake, self._closed = threading.Event(), False
        self._store(self._out.take(), 0)  # the file says what it is before the first message comes
        self._thread: threading.Thread | None = None
        if flush_interval_s is not None:
            self._thread = threading.Thread(
                target=_keep_storing, args=(weakref.ref(self), self._wake, flush_interval_s), name="bag", daemon=True
            )
            self._thread.start()
        self._at_exit = _close_at_exit(self)

    # ------------------------------------------------------------ writing

    def add_topic(
        self,
        topic: str,
        typename: str,
        qos: QoSProfile | Sequence[QoSProfile] = (),
        *,
        definition: str | None = None,
        encoding: str = "ros2msg",
        type_hash: str | None = None,
    ) -> None:
        """Declare a topic before its first message; :meth:`write` does it by itself for types the kit knows.

        Args:
            topic: absolute name.
            typename: ``pkg/msg/Name``.
            qos: what its publishers offer.
            definition: the message definition, with those it contains; taken from the kit when omitted.
            encoding: of the definition: ``ros2msg`` or ``ros2idl``.
            type_hash: RIHS01 hash of the type; taken from the kit when omitted.

        Raises:
            InputError: the kit does not know the type, or the topic has another one.
        """
        profiles = (qos,) if isinstance(qos, QoSProfile) else tuple(qos)
        if definition is None:
            definition, known_hash = describe(typename)
            type_hash = known_hash if type_hash is None else type_hash
        with self._encode:
            self._check_type(topic, typename)
            if topic not in self._channels and not self._closed:
                channel = self._out.add_topic(
                    topic, typename, definition, encoding=encoding, type_hash=type_hash or "", qos=profiles
                )
                self._channels[topic] = (channel, typename)

    def _check_type(self, topic: str, typename: str) -> None:
        known = self._channels.get(topic)
        if known is not None and known[1] != typename:
            raise InputError(
                f"type of topic {topic}", given=typename, expected=f"{known[1]}, as before", fix="Use another topic."
            )

    def write(
        self,
        topic: str,
        typename: str,
        data: bytes,
        stamp_ns: int,
        qos: QoSProfile | Sequence[QoSProfile] = (),
    ) -> bool:
        """Write a message.

        Args:
            topic: absolute name, e.g. ``/scan``.
            typename: ``pkg/msg/Name``.
            data: CDR bytes with their header.
            stamp_ns: when it was published, ns, in [0, 2**63 - 1).
            qos: what the publishers offer; counts with the first message of a topic.

        Returns:
            False when writing has failed earlier and the message is lost; see :attr:`failure`.

        Raises:
            InputError: a bad stamp, an unknown type, or another type than before on this topic.
            RobotBrainError: the writer is closed.
        """
        if not 0 <= stamp_ns < MAX_STAMP_NS:
            raise InputError("stamp_ns", given=stamp_ns, expected="0 <= ns < 2**63 - 1", fix="Give the clock's ns.")
        known = self._channels.get(topic)
        if known is None or known[1] != typename:
            self.add_topic(topic, typename, qos)
        with self._encode:
            if self._closed:
                raise RobotBrainError(f"bag {self.path} is closed: nothing more can be written to it")
            if self.failure:
                self.lost += 1
                return False
            self._out.add(self._channels[topic][0], int(stamp_ns), bytes(data))
            pending = self._out.staged_bytes
        if pending > self._max_pending or (pending and self._thread is None):
            with self._disk:
                with self._encode:
                    ready, number = self._out.take(), self._out.staged_count
                self._store(ready, number)
        return not self.failure

    def flush(self, *, sync: bool = True) -> None:
        """Store everything written so far; with ``sync`` also safe from a power cut."""
        with self._disk:
            with self._encode:
                if self._closed or self.failure or self._safe == self._out.count:
                    return
                ready, number = self._out.stage(), self._out.count
            self._store(ready, number, sync=sync)

    def _store(self, data: bytes, number: int, *, sync: bool = False) -> bool:
        """Append to the file; on failure stop for good and say so once."""
        if self.failure:
            return False
        try:
            self._out.store(data, sync=sync)
        except OSError as error:
            self._fail(error)
            return False
        self._safe = number
        return True

    def _fail(self, error: OSError) -> None:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT) if hasattr(errno, "EDQUOT") else error.errno == errno.ENOSPC
        reason = "the disk is full" if full else f"writing failed ({error.strerror or error})"
        self.lost += self._out.count - self._safe
        self.failure = (
            f"bag {self.path}: {reason}; recording stopped, what was stored before is kept. "
            "Make room and record again; `robotbrain bag recover` makes this bag whole"
        )
        self._on_failure(self.failure)

    # ------------------------------------------------------------ end

    @property
    def message_count(self) -> int:
        """Messages written so far."""
        return self._out.count

    def close(self) -> None:
        """Store the rest, the index and ``metadata.yaml``; the bag is then whole. A second call does nothing."""
        with self._disk:
            with self._encode:
                if self._closed:
                    return
                self._closed = True
                ready = b"" if self.failure else self._out.finish()
            if self._store(ready, self._out.count, sync=True):
                try:
                    write_text(self.path / METADATA, metadata_yaml([self._out.record()], self._out.topics()))
                except OSError as error:
                    self._fail(error)
            self._out.close()
        self._wake.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()
        atexit.unregister(self._at_exit)

    def __del__(self) -> None:
        with contextlib.suppress(Exception):  # half-built, or the interpreter is going away
            self.close()

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _keep_storing(owner: weakref.ref[BagWriter], wake: threading.Event, interval_s: float) -> None:
    while not wake.wait(interval_s):
        writer = owner()
        if writer is None:
            return
        writer.flush()
        del writer


def _close_at_exit(writer: BagWriter) -> Callable[[], None]:
    """Close a forgotten bag when the program ends, without keeping the writer alive until then."""
    owner = weakref.ref(writer)

    def close() -> None:
        if (left := owner()) is not None:
            left.close()

    atexit.register(close)
    return close


def _complain(reason: str) -> None:
    print(reason, file=sys.stderr)


def describe(typename: str) -> tuple[str, str]:
    """Return definition (ros2msg) and RIHS01 hash of a type the kit knows.

    Raises:
        InputError: it does not.
    """
    from robotbrain.ros.typedefs import struct_def, typestore

    struct_def(typename)
    definition, _ = typestore().generate_msgdef(typename, ros_version=2)
    return definition, typestore().hash_rihs01(typename)


def make_folder(path: Path, *, overwrite: bool) -> None:
    """Make the folder of a new bag, in place of an old one with ``overwrite``.

    Raises:
        InputError: the path exists, or is not a bag that may be replaced, or cannot be made.
    """
    if path.exists():
        if not overwrite:
            raise InputError(
                "bag path",
                given=str(path),
                expected="a new path",
                fix="Choose another, or overwrite=True.",
            )
        if not is_bag_folder(path):
            raise InputError(
                "bag path",
                given=str(path),
                expected="a bag, to be overwritten",
                fix="It holds other files.",
            )
        shutil.rmtree(path)
    try:
        path.mkdir(parents=True)
    except OSError as error:
        raise InputError(
            "bag path", given=str(path), expected="a folder that can be made", fix=f"{error.strerror or error}."
        ) from None


def is_bag_folder(path: Path) -> bool:
    """Tell whether a folder holds nothing but a bag (or nothing at all)."""
    with contextlib.suppress(OSError):
        return path.is_dir() and all(
            entry.is_file() and (entry.name in (METADATA, ".DS_Store") or entry.suffix in STORAGE_SUFFIXES)
            for entry in path.iterdir()
        )
    return False
