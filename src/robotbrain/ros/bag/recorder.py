"""Recording what is published."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import Any

from robotbrain.errors import InputError
from robotbrain.ros.bag.writer import BagWriter
from robotbrain.ros.context import SimContext
from robotbrain.ros.qos import QoSProfile


class BagRecorder:
    """Records the publications of a simulation into a bag, stamped with the simulated time of their release.

    Transient-local messages published before (a map, static transforms) are recorded first, stamped now. When the disk
    is full the recorder stops with one error in the log, and the simulation goes on.

    Args:
        path: the bag folder to make.
        source: the simulation, or one of its nodes.
        topics: absolute names; all when omitted.
        exclude: topics to leave out.
        writer_options: as :class:`BagWriter`: ``overwrite``, ``compression``, ``flush_interval_s`` …

    Attributes:
        writer: the :class:`BagWriter`.

    Usable as a context manager; :meth:`close` makes the bag whole.

    Raises:
        InputError: the path exists; the source is no simulation; a topic name is not absolute.
    """

    def __init__(
        self,
        path: str | Path,
        source: Any,
        topics: Iterable[str] | None = None,
        *,
        exclude: Iterable[str] = (),
        **writer_options: Any,
    ) -> None:
        context = getattr(source, "context", source)
        if not isinstance(context, SimContext):
            raise InputError(
                "BagRecorder source",
                given=source,
                expected="a SimContext or a node of one",
                fix="On genuine rclpy use a BagWriter in raw subscriptions, or `ros2 bag record`.",
            )
        self._topics = None if topics is None else _absolute(topics)
        self._exclude = _absolute(exclude)
        self._context = context
        self._qos: dict[str, tuple[QoSProfile, ...]] = {}
        writer_options.setdefault("on_failure", context.get_logger().error)
        self.writer = BagWriter(path, **writer_options)
        self._remove = context.add_tap(self._take)
        for topic in list(context.topics.values()):
            for publisher in topic.publishers:
                for packet in publisher.latched:
                    node = publisher.node.get_fully_qualified_name()
                    self._take(context.now_ns, topic.name, topic.typename, node, packet[0])

    def _take(self, time_ns: int, topic: str, typename: str, node: str, data: bytes) -> None:
        if topic in self._exclude or (self._topics is not None and topic not in self._topics):
            return
        qos = self._qos.get(topic)
        if qos is None:
            qos = self._qos[topic] = self._offered(topic)
        self.writer.write(topic, typename, data, time_ns, qos)

    def _offered(self, topic: str) -> tuple[QoSProfile, ...]:
        profiles: list[QoSProfile] = []
        for publisher in self._context.topics[topic].publishers if topic in self._context.topics else ():
            if publisher.qos_profile not in profiles:
                profiles.append(publisher.qos_profile)
        return tuple(profiles)

    @property
    def failure(self) -> str:
        """Why recording stopped, empty while it has not."""
        return self.writer.failure

    def close(self) -> None:
        """Stop recording and make the bag whole."""
        if self._remove is not None:
            self._remove()
            self._remove = None  # type: ignore[assignment]
        self.writer.close()

    def __enter__(self) -> BagRecorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _absolute(names: Iterable[str]) -> set[str]:
    if isinstance(names, str):
        names = [names]
    chosen = set(names)
    for name in chosen:
        if not name.startswith("/"):
            raise InputError("topic", given=name, expected="an absolute name", fix=f"Write /{name}.")
    return chosen
