"""What the graph tells of a publisher or subscription (``rclpy.topic_endpoint_info``)."""

from __future__ import annotations

import enum
import hashlib
from dataclasses import dataclass, field
from typing import Any

from robotbrain.ros.qos import QoSProfile, limit_ns, qos_profile_unknown
from robotbrain.ros.time import Infinite


class TopicEndpointTypeEnum(enum.IntEnum):
    """Kinds of endpoints."""

    INVALID = 0
    PUBLISHER = 1
    SUBSCRIPTION = 2


@dataclass
class TopicEndpointInfo:
    """One end of a topic.

    Attributes:
        node_name, node_namespace: whose it is.
        topic_type: e.g. ``std_msgs/msg/String``.
        topic_type_hash: None: the kit computes none.
        endpoint_type: publisher or subscription.
        endpoint_gid: 16 bytes, the same in each run.
        qos_profile: its QoS.
    """

    node_name: str = ""
    node_namespace: str = ""
    topic_type: str = ""
    topic_type_hash: Any = None
    endpoint_type: TopicEndpointTypeEnum = TopicEndpointTypeEnum.INVALID
    endpoint_gid: list[int] = field(default_factory=list)
    qos_profile: QoSProfile = field(default_factory=lambda: qos_profile_unknown)


def endpoint_info(endpoint: Any, kind: TopicEndpointTypeEnum, index: int) -> TopicEndpointInfo:
    """Return the info of a publisher or subscription, the ``index``-th of its topic."""
    node = endpoint.node
    identity = f"{kind.name} {node.get_fully_qualified_name()} {endpoint.topic} {index}"
    return TopicEndpointInfo(
        node.get_name(),
        node.get_namespace(),
        endpoint._topic.typename,
        None,
        kind,
        list(hashlib.blake2b(identity.encode(), digest_size=16).digest()),
        _explicit(endpoint.qos_profile),
    )


def _explicit(qos: QoSProfile) -> QoSProfile:
    """Return a copy in which "no limit" is written as an infinite duration, as the middleware tells it."""
    copy = QoSProfile(**qos.__dict__)
    for name in ("lifespan", "deadline", "liveliness_lease_duration"):
        if limit_ns(getattr(qos, name)) is None:
            setattr(copy, name, Infinite)
    return copy
