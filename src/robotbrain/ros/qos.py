"""QoS profiles (``rclpy.qos``).

The kit acts on all policies: history and depth, reliability, durability, deadline, lifespan and liveliness.
"""

from __future__ import annotations

import enum
from collections.abc import Sequence
from typing import Any

from robotbrain.ros.exceptions import InvalidQoSProfileException
from robotbrain.ros.qos_compatibility import QoSCompatibility, incompatibility, mismatches, qos_check_compatible
from robotbrain.ros.qos_policies import (
    BEST_AVAILABLE_NS,
    DeadlineBestAvailable,
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessLeaseDurationeBestAvailable,
    LivelinessPolicy,
    QoSDurabilityPolicy,
    QoSHistoryPolicy,
    QoSLivelinessPolicy,
    QoSPolicyEnum,
    QoSPolicyKind,
    QoSReliabilityPolicy,
    ReliabilityPolicy,
    limit_ns,
    qos_policy_name_from_kind,
)
from robotbrain.ros.time import Duration

__all__ = [
    "DeadlineBestAvailable",
    "DurabilityPolicy",
    "Duration",
    "HistoryPolicy",
    "InvalidQoSProfileException",
    "LivelinessLeaseDurationeBestAvailable",
    "LivelinessPolicy",
    "QoSCompatibility",
    "QoSDurabilityPolicy",
    "QoSHistoryPolicy",
    "QoSLivelinessPolicy",
    "QoSPolicyEnum",
    "QoSPolicyKind",
    "QoSPresetProfiles",
    "QoSProfile",
    "QoSReliabilityPolicy",
    "ReliabilityPolicy",
    "as_profile",
    "best_available",
    "incompatibility",
    "limit_ns",
    "mismatches",
    "qos_check_compatible",
    "qos_policy_name_from_kind",
    "qos_profile_action_status_default",
    "qos_profile_best_available",
    "qos_profile_default",
    "qos_profile_parameter_events",
    "qos_profile_parameters",
    "qos_profile_rosout_default",
    "qos_profile_sensor_data",
    "qos_profile_services_default",
    "qos_profile_system_default",
    "qos_profile_unknown",
]

_POLICIES: dict[str, type[enum.IntEnum]] = {
    "history": HistoryPolicy,
    "reliability": ReliabilityPolicy,
    "durability": DurabilityPolicy,
    "liveliness": LivelinessPolicy,
}


class QoSProfile:
    """Quality of service of one publisher or subscription.

    Args:
        history: KEEP_LAST (default when ``depth`` is given) or KEEP_ALL.
        depth: messages kept, >= 1 with KEEP_LAST.
        reliability: RELIABLE (default) or BEST_EFFORT.
        durability: VOLATILE (default) or TRANSIENT_LOCAL.
        lifespan: after which a message is no longer delivered; zero: no limit.
        deadline: longest time between two messages; zero: no limit.
        liveliness: AUTOMATIC (default) or MANUAL_BY_TOPIC.
        liveliness_lease_duration: longest time without a sign of life; zero: no limit.
        avoid_ros_namespace_conventions: stored.

    Raises:
        InvalidQoSProfileException: KEEP_LAST without a depth, a negative depth, or a value of another type.
    """

    history: HistoryPolicy
    depth: int
    reliability: ReliabilityPolicy
    durability: DurabilityPolicy
    lifespan: Duration
    deadline: Duration
    liveliness: LivelinessPolicy
    liveliness_lease_duration: Duration
    avoid_ros_namespace_conventions: bool

    def __init__(
        self,
        history: HistoryPolicy | int | None = None,
        depth: int | None = None,
        reliability: ReliabilityPolicy | int | None = None,
        durability: DurabilityPolicy | int | None = None,
        lifespan: Duration | None = None,
        deadline: Duration | None = None,
        liveliness: LivelinessPolicy | int | None = None,
        liveliness_lease_duration: Duration | None = None,
        avoid_ros_namespace_conventions: bool | None = None,
    ) -> None:
        if history is None and depth is None:
            raise InvalidQoSProfileException(
                "QoSProfile", given=None, expected="history and/or depth", fix="Write QoSProfile(depth=10)."
            )
        self.history = HistoryPolicy.KEEP_LAST if history is None else history  # type: ignore[assignment]
        if depth is None and self.history == HistoryPolicy.KEEP_LAST:
            raise InvalidQoSProfileException(
                "QoSProfile",
                given="KEEP_LAST without depth",
                expected="a depth >= 1",
                fix="Write QoSProfile(history=KEEP_LAST, depth=10).",
            )
        self.depth = 10 if depth is None else depth
        self.reliability = ReliabilityPolicy.RELIABLE if reliability is None else reliability  # type: ignore[assignment]
        self.durability = DurabilityPolicy.VOLATILE if durability is None else durability  # type: ignore[assignment]
        self.lifespan = Duration() if lifespan is None else lifespan
        self.deadline = Duration() if deadline is None else deadline
        self.liveliness = LivelinessPolicy.SYSTEM_DEFAULT if liveliness is None else liveliness  # type: ignore[assignment]
        self.liveliness_lease_duration = Duration() if liveliness_lease_duration is None else liveliness_lease_duration
        self.avoid_ros_namespace_conventions = bool(avoid_ros_namespace_conventions)

    def __setattr__(self, name: str, value: Any) -> None:
        policy = _POLICIES.get(name)
        problem = ""
        if policy is not None:
            try:
                value = policy(value)
            except (ValueError, TypeError):
                problem = "one of " + ", ".join(policy.__members__)
        elif name == "depth":
            if not isinstance(value, int) or isinstance(value, bool) or value < 0:
                problem = "an integer >= 0"
        elif name in ("lifespan", "deadline", "liveliness_lease_duration"):
            if not isinstance(value, Duration):
                problem = "a Duration"
        elif name not in QoSProfile.__annotations__:
            raise AttributeError(f"QoSProfile has no {name!r}; it has: {', '.join(QoSProfile.__annotations__)}")
        if problem:
            raise InvalidQoSProfileException(
                f"QoSProfile.{name}", given=value, expected=problem, fix="Import the policies from rclpy.qos."
            )
        object.__setattr__(self, name, value)

    @property
    def queue_limit(self) -> int | None:
        """Messages a queue of this profile holds; None is unlimited. Depth 0 means the middleware's 1."""
        return None if self.history == HistoryPolicy.KEEP_ALL else max(1, self.depth)

    def __eq__(self, other: object) -> bool:
        return self.__dict__ == other.__dict__ if isinstance(other, QoSProfile) else NotImplemented

    __hash__ = None  # type: ignore[assignment]

    def __str__(self) -> str:
        shown = {name: getattr(self, name) for name in QoSProfile.__annotations__}
        return (
            "QoSProfile("
            + ", ".join(f"{name}={int(v) if isinstance(v, enum.IntEnum) else v}" for name, v in shown.items())
            + ")"
        )

    def __repr__(self) -> str:
        limits = [
            f"{name}={getattr(self, name).nanoseconds * 1e-9:g} s"
            for name in ("lifespan", "deadline", "liveliness_lease_duration")
            if limit_ns(getattr(self, name)) is not None
        ]
        return ", ".join(
            [
                f"QoSProfile(history={self.history.name}",
                f"depth={self.depth}",
                f"reliability={self.reliability.name}",
                f"durability={self.durability.name}",
                *limits,
            ]
        ) + (")" if self.liveliness != LivelinessPolicy.MANUAL_BY_TOPIC else ", liveliness=MANUAL_BY_TOPIC)")


qos_profile_unknown = QoSProfile(
    history=HistoryPolicy.UNKNOWN,
    depth=0,
    reliability=ReliabilityPolicy.UNKNOWN,
    durability=DurabilityPolicy.UNKNOWN,
    liveliness=LivelinessPolicy.UNKNOWN,
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
qos_profile_action_status_default = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
qos_profile_rosout_default = QoSProfile(
    depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL, lifespan=Duration(seconds=10)
)
qos_profile_best_available = QoSProfile(
    depth=10,
    reliability=ReliabilityPolicy.BEST_AVAILABLE,
    durability=DurabilityPolicy.BEST_AVAILABLE,
    deadline=DeadlineBestAvailable,
    liveliness=LivelinessPolicy.BEST_AVAILABLE,
    liveliness_lease_duration=LivelinessLeaseDurationeBestAvailable,
)


class QoSPresetProfiles(enum.Enum):
    """The presets by name; ``.value`` is the :class:`QoSProfile`."""

    UNKNOWN = qos_profile_unknown
    DEFAULT = qos_profile_default
    SYSTEM_DEFAULT = qos_profile_system_default
    SENSOR_DATA = qos_profile_sensor_data
    SERVICES_DEFAULT = qos_profile_services_default
    PARAMETERS = qos_profile_parameters
    PARAMETER_EVENTS = qos_profile_parameter_events
    ACTION_STATUS_DEFAULT = qos_profile_action_status_default
    BEST_AVAILABLE = qos_profile_best_available
    ROSOUT_DEFAULT = qos_profile_rosout_default

    @classmethod
    def short_keys(cls) -> list[str]:
        """Return the names in lower case."""
        return [name.lower() for name in cls.__members__]

    @classmethod
    def get_from_short_key(cls, name: str) -> QoSProfile:
        """Return the profile of a short key such as ``"sensor_data"``."""
        return cls[name.upper()].value


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


def best_available(qos: QoSProfile, others: Sequence[QoSProfile], *, offers: bool) -> QoSProfile:
    """Return ``qos`` with every BEST_AVAILABLE replaced by what goes with the endpoints that are there now.

    A subscription asks for the most that all publishers offer; a publisher offers the most there is.

    Args:
        qos: of the endpoint that is being made; left as it is.
        others: of the endpoints on the other side of the topic.
        offers: whether a publisher is being made.
    """
    result = QoSProfile(**qos.__dict__)
    if qos.reliability == ReliabilityPolicy.BEST_AVAILABLE:
        reliable = offers or all(other.reliability == ReliabilityPolicy.RELIABLE for other in others)
        result.reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
    if qos.durability == DurabilityPolicy.BEST_AVAILABLE:
        lasting = offers or all(other.durability == DurabilityPolicy.TRANSIENT_LOCAL for other in others)
        result.durability = DurabilityPolicy.TRANSIENT_LOCAL if lasting else DurabilityPolicy.VOLATILE
    if qos.liveliness == LivelinessPolicy.BEST_AVAILABLE:
        manual = [other.liveliness == LivelinessPolicy.MANUAL_BY_TOPIC for other in others]
        chosen = any(manual) if offers else bool(manual) and all(manual)
        result.liveliness = LivelinessPolicy.MANUAL_BY_TOPIC if chosen else LivelinessPolicy.AUTOMATIC
    for name in ("deadline", "liveliness_lease_duration"):
        if getattr(qos, name).nanoseconds == BEST_AVAILABLE_NS:
            limits = [limit_ns(getattr(other, name)) for other in others]
            known = [limit for limit in limits if limit is not None]
            shared = max(known) if known and len(known) == len(limits) else None
            best = min(known, default=None) if offers else shared
            setattr(result, name, Duration(nanoseconds=best or 0))
    return result
