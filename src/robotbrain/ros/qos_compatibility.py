"""Which publishers reach which subscriptions: "requested versus offered" (OMG DDS 1.4, 2.2.3)."""

from __future__ import annotations

import enum
from typing import TYPE_CHECKING, NamedTuple

from robotbrain.ros.qos_policies import (
    DurabilityPolicy,
    LivelinessPolicy,
    QoSPolicyKind,
    ReliabilityPolicy,
    limit_ns,
)

if TYPE_CHECKING:
    from robotbrain.ros.qos import QoSProfile


class QoSCompatibility(enum.IntEnum):
    """What :func:`qos_check_compatible` says; WARNING: it depends on the middleware's defaults."""

    OK = 0
    WARNING = 1
    ERROR = 2


class Mismatch(NamedTuple):
    """A policy whose offer does not satisfy the request, and why."""

    kind: QoSPolicyKind
    reason: str


def mismatches(offered: QoSProfile, requested: QoSProfile) -> list[Mismatch]:
    """Return the policies that keep a publisher's messages from a subscription, in the order of their DDS ids."""
    found = []
    if offered.durability == DurabilityPolicy.VOLATILE and requested.durability == DurabilityPolicy.TRANSIENT_LOCAL:
        found.append(Mismatch(QoSPolicyKind.DURABILITY, "Volatile publisher and transient local subscription"))
    ours, theirs = limit_ns(offered.deadline), limit_ns(requested.deadline)
    if theirs is not None and ours is None:
        found.append(Mismatch(QoSPolicyKind.DEADLINE, "Subscription has a deadline, but publisher does not"))
    elif theirs is not None and ours is not None and ours > theirs:
        found.append(Mismatch(QoSPolicyKind.DEADLINE, "Subscription deadline is less than publisher deadline"))
    automatic = (LivelinessPolicy.AUTOMATIC, LivelinessPolicy.SYSTEM_DEFAULT)
    if offered.liveliness in automatic and requested.liveliness == LivelinessPolicy.MANUAL_BY_TOPIC:
        reason = "Publisher's liveliness is automatic and subscription's is manual by topic"
        found.append(Mismatch(QoSPolicyKind.LIVELINESS, reason))
    ours, theirs = limit_ns(offered.liveliness_lease_duration), limit_ns(requested.liveliness_lease_duration)
    if theirs is not None and ours is None:
        reason = "Subscription has a liveliness lease duration, but publisher does not"
        found.append(Mismatch(QoSPolicyKind.LIVELINESS, reason))
    elif theirs is not None and ours is not None and ours > theirs:
        reason = "Subscription liveliness lease duration is less than publisher"
        found.append(Mismatch(QoSPolicyKind.LIVELINESS, reason))
    if offered.reliability == ReliabilityPolicy.BEST_EFFORT and requested.reliability == ReliabilityPolicy.RELIABLE:
        found.append(Mismatch(QoSPolicyKind.RELIABILITY, "Best effort publisher and reliable subscription"))
    return found


def incompatibility(offered: QoSProfile, requested: QoSProfile) -> str:
    """Return why a publisher's offer does not satisfy a subscription's request, or ``""`` when it does."""
    return "; ".join(f"{kind.name.lower()}: {reason}" for kind, reason in mismatches(offered, requested))


def qos_check_compatible(publisher_qos: QoSProfile, subscription_qos: QoSProfile) -> tuple[QoSCompatibility, str]:
    """Tell whether a publisher and a subscription of these profiles can communicate, and why not.

    Profiles that leave a policy to the middleware (``SYSTEM_DEFAULT``, ``UNKNOWN``) give WARNING where that decides.
    """
    found = mismatches(publisher_qos, subscription_qos)
    order = (QoSPolicyKind.RELIABILITY, QoSPolicyKind.DURABILITY, QoSPolicyKind.DEADLINE, QoSPolicyKind.LIVELINESS)
    vague = publisher_qos.liveliness == LivelinessPolicy.SYSTEM_DEFAULT
    reasons = [
        f"ERROR: {reason};"
        for kind, reason in sorted(found, key=lambda mismatch: order.index(mismatch.kind))
        if not (vague and "manual by topic" in reason)
    ]
    if reasons:
        return QoSCompatibility.ERROR, "".join(reasons)
    warnings = _warnings(publisher_qos, subscription_qos)
    return (QoSCompatibility.WARNING if warnings else QoSCompatibility.OK), "".join(warnings)


def _warnings(offered: QoSProfile, requested: QoSProfile) -> list[str]:
    found = []
    rows: tuple[tuple[str, str, enum.IntEnum, str, enum.IntEnum, str], ...] = (
        (
            "reliability",
            "reliability",
            ReliabilityPolicy.RELIABLE,
            "Reliable subscription, but publisher is {}",
            ReliabilityPolicy.BEST_EFFORT,
            "Best effort publisher, but subscription is {}",
        ),
        (
            "durability",
            "durabilty",  # misspelt so in ROS 2
            DurabilityPolicy.TRANSIENT_LOCAL,
            "Transient local subscription, but publisher is {}",
            DurabilityPolicy.VOLATILE,
            "Volatile publisher, but subscription is {}",
        ),
        (
            "liveliness",
            "liveliness",
            LivelinessPolicy.MANUAL_BY_TOPIC,
            "Subscription's liveliness is manual by topic, but publisher's is {}",
            LivelinessPolicy.AUTOMATIC,
            "Publisher's liveliness is automatic, but subscription's is {}",
        ),
    )
    for attribute, label, strict, strict_text, weak, weak_text in rows:
        ours, theirs = getattr(offered, attribute), getattr(requested, attribute)
        ours_vague, theirs_vague = (value.name in ("SYSTEM_DEFAULT", "UNKNOWN") for value in (ours, theirs))
        if ours_vague and theirs_vague:
            text = f"Publisher {label} is {ours.name.lower()} and subscription {attribute} is {theirs.name.lower()}"
            found.append(f"WARNING: {text};")
        elif ours_vague and theirs == strict:
            found.append(f"WARNING: {strict_text.format(ours.name.lower())};")
        elif theirs_vague and ours == weak:
            found.append(f"WARNING: {weak_text.format(theirs.name.lower())};")
    return found
