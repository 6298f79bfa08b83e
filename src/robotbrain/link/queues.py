"""Bounded queues between the graph and the wire: old images are dropped, commands overtake them."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable

from robotbrain.link.frames import Frame, FrameError, Message

DEFAULT_DEPTH = 10
"""Messages of a topic kept when nobody has said how many."""

MOST_DEPTH = 1000
"""Messages of a topic kept at most, whatever its QoS says (KEEP_ALL is no licence to fill the memory)."""

MOST_CONTROL = 4096
"""Frames other than messages kept at most; a peer that lets so many pile up does not read."""

SIZE_CLASSES = (4096, 65536)
"""Message sizes (bytes) that separate commands from scans from images."""


def urgency(frame: Message) -> int:
    """Return 0 for a message of a command's size, 1 for one of a scan's, 2 for one of an image's."""
    return sum(len(frame.data) > size for size in SIZE_CLASSES)


class FrameQueue:
    """Frames that wait, safe to use from two threads.

    Frames other than messages come first, in order. Each topic keeps its last ``depth`` messages (KEEP_LAST), in order;
    what that pushes out is counted in ``dropped``. Between topics, the next message is the oldest of the most urgent
    class if ``by_urgency`` is set, the oldest of all otherwise.

    Args:
        by_urgency: let small messages overtake large ones of other topics.

    Attributes:
        dropped: messages lost here, by topic.
    """

    def __init__(self, by_urgency: bool = False) -> None:
        self._by_urgency = by_urgency
        self._control: deque[Frame] = deque()
        self._topics: dict[str, deque[tuple[int, Message]]] = {}
        self._depths: dict[str, int] = {}
        self._sequence = 0
        self._changed = threading.Condition()
        self._closed = False
        self.dropped: Counter[str] = Counter()

    def set_depth(self, topic: str, depth: int | None) -> None:
        """Keep the last ``depth`` messages of ``topic``; None for as many as possible."""
        with self._changed:
            self._depths[topic] = MOST_DEPTH if depth is None else min(max(depth, 1), MOST_DEPTH)

    def put(self, frame: Frame) -> None:
        """Add a frame; never waits.

        Raises:
            FrameError: thousands of control frames wait already.
        """
        with self._changed:
            if self._closed:
                return
            if isinstance(frame, Message):
                waiting = self._topics.setdefault(frame.topic, deque())
                if len(waiting) >= self._depths.get(frame.topic, DEFAULT_DEPTH):
                    waiting.popleft()
                    self.dropped[frame.topic] += 1
                self._sequence += 1
                waiting.append((self._sequence, frame))
            elif len(self._control) >= MOST_CONTROL:
                raise FrameError(f"{MOST_CONTROL} frames wait; the other end does not read")
            else:
                self._control.append(frame)
            self._changed.notify()

    def get(self, timeout_s: float | None = 0.0) -> Frame | None:
        """Return the next frame, or None when there is none within ``timeout_s`` or the queue was closed."""
        with self._changed:
            if not self._changed.wait_for(self._available, timeout_s) or self._closed:
                return None
            if self._control:
                return self._control.popleft()
            key: Callable[[str], tuple[int, int]] = self._order if self._by_urgency else self._arrival
            topic = min(self._topics, key=key)
            waiting = self._topics[topic]
            _, frame = waiting.popleft()
            if not waiting:
                del self._topics[topic]
            return frame

    def _available(self) -> bool:
        return bool(self._closed or self._control or self._topics)

    def _arrival(self, topic: str) -> tuple[int, int]:
        return (0, self._topics[topic][0][0])

    def _order(self, topic: str) -> tuple[int, int]:
        sequence, frame = self._topics[topic][0]
        return (urgency(frame), sequence)

    def close(self) -> None:
        """Wake whoever waits; nothing goes in or out any more."""
        with self._changed:
            self._closed = True
            self._control.clear()
            self._topics.clear()
            self._changed.notify_all()

    def __len__(self) -> int:
        with self._changed:
            return len(self._control) + sum(len(waiting) for waiting in self._topics.values())
