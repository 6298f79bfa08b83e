"""QoS profiles and their compatibility (``rclpy.qos``).

The kit acts on history, depth, reliability and durability. Deadline, lifespan and liveliness are stored.
"""

from __future__ import annotations

import enum
from typing import Any

from robotbrain.ros.exceptions import InvalidQoSProfileException
from robotbrain.ros.time import Duration


class HistoryPolicy(enum.IntEnum):
    """How many messages wait for a busy reader."""

    SYSTEM_DEFAULT = 0
    KEEP_LAST = 1
    KEEP_ALL = 2
    UNKNOWN = 3


class ReliabilityPolicy(enum.IntEnum):
    """Whether delivery is guaranteed."""

    SYSTEM_DEFAULT = 0
    RELIABLE = 1
    BEST_EFFORT = 2
    UNKNOWN = 3
    BEST_AVAILABLE = 4


class DurabilityPolicy(enum.IntEnum):
    """Whether late subscribers get earlier messages."""

    SYSTEM_DEFAULT = 0
    TRANSIENT_LOCAL = 1
    VOLATILE = 2
    UNKNOWN = 3
    BEST_AVAILABLE = 4


class LivelinessPolicy(enum.IntEnum):
    """How a publisher shows that it is alive (stored only)."""

    SYSTEM_DEFAULT = 0
    AUTOMATIC = 1
    MANUAL_BY_TOPIC = 3
    UNKNOWN = 4
    BEST_AVAILABLE = 5


QoSHistoryPolicy = HistoryPolicy
QoSReliabilityPolicy = ReliabilityPolicy
QoSDurabilityPolicy = DurabilityPolicy
QoSLivelinessPolicy = LivelinessPolicy


class QoSProfile:
    """Quality of service of one publisher or subscription.

    Args:
        history: KEEP_LAST (default when ``depth`` is given) or KEEP_ALL.
        depth: messages kept, >= 1 with KEEP_LAST.
        reliability: RELIABLE (default) or BEST_EFFORT.
        durability: VOLATILE (default) or TRANSIENT_LOCAL.
        deadline: stored.
        lifespan: stored.
        liveliness: stored.
        liveliness_lease_duration: stored.
        avoid_ros_namespace_conventions: stored.

    Raises:
        InvalidQoSProfileException: KEEP_LAST without a depth, or a negative depth.
    """

    def __init__(
        self,
        *,
        history: HistoryPolicy | None = None,
        depth: int | None = None,
        reliability: ReliabilityPolicy = ReliabilityPolicy.RELIABLE,
        durability: DurabilityPolicy = DurabilityPolicy.VOLATILE,
        deadline: Duration | None = None,
        lifespan: Duration | None = None,
        liveliness: LivelinessPolicy = LivelinessPolicy.SYSTEM_DEFAULT,
        liveliness_lease_duration: Duration | None = None,
        avoid_ros_namespace_conventions: bool = False,
    ) -> None:
        if history is None and depth is None:
            raise InvalidQoSProfileException(
                "QoSProfile", given=None, expected="history and/or depth", fix="Write QoSProfile(depth=10)."
            )
        history = HistoryPolicy.KEEP_LAST if history is None else HistoryPolicy(history)
        if depth is None and history == HistoryPolicy.KEEP_LAST:
            raise InvalidQoSProfileException(
                "QoSProfile",
                given="KEEP_LAST without depth",
                expected="a depth >= 1",
                fix="Write QoSProfile(history=KEEP_LAST, depth=10).",
            )
        if depth is not None and (not isinstance(depth, int) or isinstance(depth, bool) or depth < 0):
            raise InvalidQoSProfileException(
                "QoSProfile.depth", given=depth, expected="an integer >= 0", fix="10 is the usual depth."
            )
        self.history, self.depth = history, 0 if depth is None else depth
        self.reliability, self.durability = ReliabilityPolicy(reliability), DurabilityPolicy(durability)
        self.deadline, self.lifespan = deadline or Duration(), lifespan or Duration()
        self.liveliness = LivelinessPolicy(liveliness)
        self.liveliness_lease_duration = liveliness_lease_duration or Duration()
        self.avoid_ros_namespace_conventions = avoid_ros_namespace_conventions

    @property
    def queue_limit(self) -> int | None:
        """Messages a queue of this profile holds; None is unlimited. Depth 0 means the middleware's 1."""
        return None if self.history == HistoryPolicy.KEEP_ALL else max(1, self.depth)

    def __eq__(self, other: object) -> bool:
        return self.__dict__ == other.__dict__ if isinstance(other, QoSProfile) else NotImplemented

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return (
            f"QoSProfile(history={self.history.name}, depth={self.depth}, reliability={self.reliability.name}, "
            f"durability={self.durability.name})"
        )


qos_profile_default = QoSProfile(depth=10)
qos_profile_system_default = QoSProfile(
    history=HistoryPolicy.SYSTEM_DEFAULT,
    depth=0,
    reliability=ReliabilityPolicy.SYSTEM_DEFAULT,
    durability=DurabilityPolicy.SYSTEM_DEFAULT,
)
qos_profile_sensor_data = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
qos_profile_services_default = QoSProfile(depth=10)
qos_profile_parameters = QoSProfile(depth=1000)
qos_profile_parameter_events = QoSProfile(depth=1000)
qos_profile_best_available = QoSProfile(
    depth=10,
    reliability=ReliabilityPolicy.BEST_AVAILABLE,
    durability=DurabilityPolicy.BEST_AVAILABLE,
    liveliness=LivelinessPolicy.BEST_AVAILABLE,
)


class QoSPresetProfiles(enum.Enum):
    """The presets by name."""

    SYSTEM_DEFAULT = "system_default"
    SENSOR_DATA = "sensor_data"
    SERVICES_DEFAULT = "services_default"
    PARAMETERS = "parameters"
    DEFAULT = "default"

    @property
    def value(self) -> Any:
        """The :class:`QoSProfile` of this preset."""
        return {
            "system_default": qos_profile_system_default,
            "sensor_data": qos_profile_sensor_data,
            "services_default": qos_profile_services_default,
            "parameters": qos_profile_parameters,
            "default": qos_profile_default,
        }[self._value_]

    @classmethod
    def get_from_short_key(cls, name: str) -> Any:
        """Return the profile of a short key such as ``"sensor_data"``."""
        return cls(name.lower()).value


def as_profile(qos: Any) -> QoSProfile:
    """Return ``qos`` as a profile; an int is a KEEP_LAST depth.

    Raises:
        InvalidQoSProfileException: neither a profile nor an int >= 0.
    """
    if isinstance(qos, QoSProfile):
        return qos
    if isinstance(qos, int) and not isinstance(qos, bool):
        return QoSProfile(depth=qos)
    raise InvalidQoSProfileException(
        "QoS profile", given=qos, expected="a QoSProfile or an integer depth", fix="10 is the usual depth."
    )


def incompatibility(offered: QoSProfile, requested: QoSProfile) -> str:
    """Return why a publisher's offer does not satisfy a subscription's request, or ``""`` when it does.

    Rule of DDS "requested versus offered" (OMG DDS 1.4, 2.2.3).
    """
    if offered.reliability == ReliabilityPolicy.BEST_EFFORT and requested.reliability == ReliabilityPolicy.RELIABLE:
        return "reliability: the publisher is BEST_EFFORT, the subscription asks for RELIABLE"
    if offered.durability == DurabilityPolicy.VOLATILE and requested.durability == DurabilityPolicy.TRANSIENT_LOCAL:
        return "durability: the publisher is VOLATILE, the subscription asks for TRANSIENT_LOCAL"
    return ""
