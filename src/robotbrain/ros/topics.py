"""Both ends of topics, under one name."""

from __future__ import annotations

from robotbrain.ros.packet import Packet
from robotbrain.ros.publisher import Publisher
from robotbrain.ros.subscription import Subscription

__all__ = ["Packet", "Publisher", "Subscription"]
