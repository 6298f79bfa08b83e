"""QoS that parameters override (``rclpy.qos_overriding_options``)."""

from __future__ import annotations

import enum
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

from robotbrain.errors import InputError
from robotbrain.ros.exceptions import ParameterAlreadyDeclaredException
from robotbrain.ros.messages import message_class
from robotbrain.ros.qos import QoSPolicyKind, QoSProfile
from robotbrain.ros.time import Duration

if TYPE_CHECKING:
    from robotbrain.ros.node import Node


class InvalidQosOverridesError(InputError):
    """The callback refused the overridden profile."""


class QoSOverridingOptions:
    """Which policies of a publisher or subscription parameters may override.

    Args:
        policy_kinds: the policies; each becomes a parameter ``qos_overrides.<topic>.<publisher or
            subscription>[_<entity_id>].<policy>``.
        callback: says with a ``SetParametersResult`` whether the resulting profile will do.
        entity_id: tells several endpoints of one topic apart.
    """

    def __init__(
        self,
        policy_kinds: Iterable[QoSPolicyKind],
        *,
        callback: Callable[[QoSProfile], Any] | None = None,
        entity_id: str | None = None,
    ) -> None:
        self.policy_kinds, self.callback, self.entity_id = tuple(policy_kinds), callback, entity_id

    @classmethod
    def with_default_policies(
        cls, *, callback: Callable[[QoSProfile], Any] | None = None, entity_id: str | None = None
    ) -> QoSOverridingOptions:
        """Return options for history, depth and reliability."""
        kinds = (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY)
        return cls(kinds, callback=callback, entity_id=entity_id)


def override_qos(node: Node, kind: str, topic: str, qos: QoSProfile, options: QoSOverridingOptions) -> None:
    """Declare the parameters of ``options`` with the values of ``qos``, and change it to what they say.

    Args:
        node: that declares them.
        kind: ``publisher`` or ``subscription``.
        topic: absolute name.
        qos: changed in place.
        options: which policies.

    Raises:
        InvalidQosOverridesError: the callback of ``options`` refused the result.
    """
    suffix = "" if options.entity_id is None else f"_{options.entity_id}"
    for policy in options.policy_kinds:
        if kind == "subscription" and policy == QoSPolicyKind.LIFESPAN:
            continue
        field = policy.name.lower()
        name = f"qos_overrides.{topic}.{kind}{suffix}.{field}"
        default = getattr(qos, field)
        if isinstance(default, enum.IntEnum):
            value: Any = default.name.lower()
        else:
            value = default.nanoseconds if isinstance(default, Duration) else default
        descriptor = message_class("rcl_interfaces/msg/ParameterDescriptor")(
            description=f"{field} for {kind} `{topic}` with id `{options.entity_id}`", read_only=True
        )
        try:
            chosen = node.declare_parameter(name, value, descriptor).value
        except ParameterAlreadyDeclaredException:
            chosen = node.get_parameter(name).value
        if isinstance(default, enum.IntEnum):
            try:
                chosen = type(default)[chosen.upper()]
            except KeyError:
                raise InvalidQosOverridesError(
                    f"parameter {name}",
                    given=chosen,
                    expected="one of " + ", ".join(type(default).__members__).lower(),
                    fix="Correct the parameter.",
                ) from None
        setattr(qos, field, Duration(nanoseconds=chosen) if isinstance(default, Duration) else chosen)
    if options.callback is not None and not (result := options.callback(qos)).successful:
        raise InvalidQosOverridesError(
            f"QoS overrides of {kind} {topic}", given=qos, expected=result.reason, fix="Correct the parameters."
        )
