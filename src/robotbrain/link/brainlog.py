"""The decision log of a brain apart from its robot: what its nodes published, and nothing else."""

from __future__ import annotations

import hashlib
from collections import Counter

from robotbrain.link.bridge import is_link
from robotbrain.ros.context import SimContext


class BrainLog:
    """Digest of all that the brain's nodes publish, in order: release time, topic, type, node and CDR.

    It ends when the brain says that it has arrived: what follows depends on when the processes learn of it.

    Args:
        context: the simulation.
        others: fully qualified names of nodes that are not the brain's; bridges never are.

    Attributes:
        counts: messages by topic.
        reached: whether the brain said that it had arrived.
    """

    def __init__(self, context: SimContext, others: frozenset[str] = frozenset()) -> None:
        self._others = others
        self._hash = hashlib.sha256()
        self.counts: Counter[str] = Counter()
        self.reached = False
        context.add_tap(self._take)

    def _take(self, time_ns: int, topic: str, type_name: str, node: str, data: bytes) -> None:
        if self.reached or node in self._others or is_link(node):
            return
        for part in (str(time_ns).encode(), topic.encode(), type_name.encode(), node.encode(), data):
            self._hash.update(len(part).to_bytes(4, "little") + part)
        self.counts[topic] += 1
        # CDR of std_msgs/msg/Bool: four bytes of encapsulation, then the value.
        self.reached = self.reached or (topic == "/goal_reached" and data[4] == 1)

    def sha256(self) -> str:
        """Return the digest so far as hexadecimal text."""
        return self._hash.hexdigest()
