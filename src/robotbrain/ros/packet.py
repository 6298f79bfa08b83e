"""A message between its publisher and its subscriptions."""

from __future__ import annotations

from typing import NamedTuple


class Packet(NamedTuple):
    """A message on its way.

    Attributes:
        data: CDR.
        id: of the message, see :class:`~robotbrain.ros.context.MessageRecord`.
        source_ns: when it left; 0 before.
        expires_ns: when its lifespan ends; 0: never.
        number: counted from 1 by its publisher.
    """

    data: bytes
    id: int
    source_ns: int = 0
    expires_ns: int = 0
    number: int = 0
