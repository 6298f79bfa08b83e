"""QoS events (``rclpy.event_handler``): what publishers and subscriptions are told of the other side and deadlines."""

from __future__ import annotations

import copy
import enum
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from robotbrain.ros.callback_groups import CallbackGroup
from robotbrain.ros.entity import Entity
from robotbrain.ros.exceptions import RCLError
from robotbrain.ros.executors import Work

if TYPE_CHECKING:
    from robotbrain.ros.node import Node


class UnsupportedEventTypeError(RCLError):
    """A callback was registered for an event that there is not; the kit supports all."""


class QoSSubscriptionEventType(enum.IntEnum):
    """Events of a subscription."""

    RCL_SUBSCRIPTION_REQUESTED_DEADLINE_MISSED = 0
    RCL_SUBSCRIPTION_LIVELINESS_CHANGED = 1
    RCL_SUBSCRIPTION_REQUESTED_INCOMPATIBLE_QOS = 2
    RCL_SUBSCRIPTION_MESSAGE_LOST = 3
    RCL_SUBSCRIPTION_INCOMPATIBLE_TYPE = 4
    RCL_SUBSCRIPTION_MATCHED = 5


class QoSPublisherEventType(enum.IntEnum):
    """Events of a publisher."""

    RCL_PUBLISHER_OFFERED_DEADLINE_MISSED = 0
    RCL_PUBLISHER_LIVELINESS_LOST = 1
    RCL_PUBLISHER_OFFERED_INCOMPATIBLE_QOS = 2
    RCL_PUBLISHER_INCOMPATIBLE_TYPE = 3
    RCL_PUBLISHER_MATCHED = 4


@dataclass
class _Total:
    """Counts since the endpoint was made, and since the callback was last told."""

    total_count: int = 0
    total_count_change: int = 0


class QoSRequestedDeadlineMissedInfo(_Total):
    """A subscription went without a message for longer than its deadline, so many times."""


class QoSOfferedDeadlineMissedInfo(_Total):
    """A publisher was silent for longer than its deadline, so many times."""


class QoSLivelinessLostInfo(_Total):
    """A publisher gave no sign of life within its lease duration, so many times."""


class QoSMessageLostInfo(_Total):
    """Messages that a subscription should have received and did not."""


class IncompatibleTypeInfo(_Total):
    """Endpoints of another type on the topic; the kit raises TypeConflictError instead."""


@dataclass
class QoSRequestedIncompatibleQoSInfo(_Total):
    """Endpoints whose QoS does not go with this one's, and which policy was at fault with the last of them."""

    last_policy_kind: int = 0


QoSOfferedIncompatibleQoSInfo = QoSRequestedIncompatibleQoSInfo


@dataclass
class QoSLivelinessChangedInfo:
    """Publishers that are alive, and that are not, and how these numbers changed since the callback was last told."""

    alive_count: int = 0
    not_alive_count: int = 0
    alive_count_change: int = 0
    not_alive_count_change: int = 0


@dataclass
class QoSPublisherMatchedInfo(_Total):
    """Endpoints that were ever matched, and that are matched now."""

    current_count: int = 0
    current_count_change: int = 0


QoSSubscriptionMatchedInfo = QoSPublisherMatchedInfo

_INFOS: dict[enum.IntEnum, Callable[[], Any]] = {
    QoSSubscriptionEventType.RCL_SUBSCRIPTION_REQUESTED_DEADLINE_MISSED: QoSRequestedDeadlineMissedInfo,
    QoSSubscriptionEventType.RCL_SUBSCRIPTION_LIVELINESS_CHANGED: QoSLivelinessChangedInfo,
    QoSSubscriptionEventType.RCL_SUBSCRIPTION_REQUESTED_INCOMPATIBLE_QOS: QoSRequestedIncompatibleQoSInfo,
    QoSSubscriptionEventType.RCL_SUBSCRIPTION_MESSAGE_LOST: QoSMessageLostInfo,
    QoSSubscriptionEventType.RCL_SUBSCRIPTION_INCOMPATIBLE_TYPE: IncompatibleTypeInfo,
    QoSSubscriptionEventType.RCL_SUBSCRIPTION_MATCHED: QoSSubscriptionMatchedInfo,
}
_PUBLISHER_INFOS: dict[enum.IntEnum, Callable[[], Any]] = {
    QoSPublisherEventType.RCL_PUBLISHER_OFFERED_DEADLINE_MISSED: QoSOfferedDeadlineMissedInfo,
    QoSPublisherEventType.RCL_PUBLISHER_LIVELINESS_LOST: QoSLivelinessLostInfo,
    QoSPublisherEventType.RCL_PUBLISHER_OFFERED_INCOMPATIBLE_QOS: QoSOfferedIncompatibleQoSInfo,
    QoSPublisherEventType.RCL_PUBLISHER_INCOMPATIBLE_TYPE: IncompatibleTypeInfo,
    QoSPublisherEventType.RCL_PUBLISHER_MATCHED: QoSPublisherMatchedInfo,
}


class EventHandler(Entity):
    """Calls back with the state of one event. Events that come while the callback waits are told at once.

    Args:
        node: of the endpoint.
        topic: its name.
        event_type: which event.
        callback: called with the event's info.
        callback_group: in which the callback runs.
    """

    kind = "event"

    def __init__(
        self,
        node: Node,
        topic: str,
        event_type: QoSSubscriptionEventType | QoSPublisherEventType,
        callback: Callable[[Any], Any],
        callback_group: CallbackGroup | None = None,
    ) -> None:
        super().__init__(node, topic, callback, callback_group)
        self.event_type = event_type
        infos = _INFOS if isinstance(event_type, QoSSubscriptionEventType) else _PUBLISHER_INFOS
        self._info = infos[event_type]()
        self._waiting = False

    def add(self, *, last_policy_kind: int | None = None, **changes: int) -> None:
        """Change counts by name, ``total_count`` by one unless the event has none, and see to it that they are told."""
        info = self._info
        if hasattr(info, "total_count"):
            changes.setdefault("total_count", 1)
        for name, change in changes.items():
            setattr(info, name, getattr(info, name) + change)
            setattr(info, f"{name}_change", getattr(info, f"{name}_change") + change)
        if last_policy_kind is not None:
            info.last_policy_kind = last_policy_kind
        if not self._waiting:
            self._waiting = True
            self.node.context.release(self._enqueue, None)

    def _enqueue(self, _: None) -> None:
        if not self.destroyed:
            self.node._enqueue(Work(self, None, self.node.context.now_ns))

    def execute(self, work: Work) -> Any:
        """Call back with the counts."""
        self._waiting = False
        told = copy.copy(self._info)
        for name in vars(told):
            if name.endswith("_change"):
                setattr(self._info, name, 0)
        assert self.callback is not None
        return self.callback(told) if not self.destroyed else None


class SubscriptionEventCallbacks:
    """What a subscription calls on events.

    Args:
        deadline: no message within the deadline.
        incompatible_qos: a publisher whose QoS does not go with the subscription's; a warning by default.
        liveliness: a publisher came alive, or ceased to be.
        message_lost: messages were lost on the way.
        incompatible_type: accepted; the kit raises TypeConflictError where a topic gets two types.
        matched: a publisher was connected or disconnected.
        use_default_callbacks: False: no warning either.
    """

    def __init__(
        self,
        *,
        deadline: Callable[[Any], Any] | None = None,
        incompatible_qos: Callable[[Any], Any] | None = None,
        liveliness: Callable[[Any], Any] | None = None,
        message_lost: Callable[[Any], Any] | None = None,
        incompatible_type: Callable[[Any], Any] | None = None,
        matched: Callable[[Any], Any] | None = None,
        use_default_callbacks: bool = True,
    ) -> None:
        self.deadline, self.incompatible_qos, self.liveliness = deadline, incompatible_qos, liveliness
        self.message_lost, self.incompatible_type, self.matched = message_lost, incompatible_type, matched
        self.use_default_callbacks = use_default_callbacks

    def handlers(self, node: Node, topic: str, group: CallbackGroup | None) -> dict[str, EventHandler]:
        """Return a handler for each callback there is, by its name."""
        types = {
            "deadline": QoSSubscriptionEventType.RCL_SUBSCRIPTION_REQUESTED_DEADLINE_MISSED,
            "incompatible_qos": QoSSubscriptionEventType.RCL_SUBSCRIPTION_REQUESTED_INCOMPATIBLE_QOS,
            "liveliness": QoSSubscriptionEventType.RCL_SUBSCRIPTION_LIVELINESS_CHANGED,
            "message_lost": QoSSubscriptionEventType.RCL_SUBSCRIPTION_MESSAGE_LOST,
            "incompatible_type": QoSSubscriptionEventType.RCL_SUBSCRIPTION_INCOMPATIBLE_TYPE,
            "matched": QoSSubscriptionEventType.RCL_SUBSCRIPTION_MATCHED,
        }
        return {
            name: EventHandler(node, topic, event_type, getattr(self, name), group)
            for name, event_type in types.items()
            if getattr(self, name) is not None
        }


class PublisherEventCallbacks:
    """What a publisher calls on events.

    Args:
        deadline: nothing published within the deadline.
        liveliness: no sign of life within the lease duration.
        incompatible_qos: a subscription whose QoS does not go with the publisher's; a warning by default.
        incompatible_type: accepted; the kit raises TypeConflictError where a topic gets two types.
        matched: a subscription was connected or disconnected.
        use_default_callbacks: False: no warning either.
    """

    def __init__(
        self,
        *,
        deadline: Callable[[Any], Any] | None = None,
        liveliness: Callable[[Any], Any] | None = None,
        incompatible_qos: Callable[[Any], Any] | None = None,
        incompatible_type: Callable[[Any], Any] | None = None,
        matched: Callable[[Any], Any] | None = None,
        use_default_callbacks: bool = True,
    ) -> None:
        self.deadline, self.liveliness, self.incompatible_qos = deadline, liveliness, incompatible_qos
        self.incompatible_type, self.matched = incompatible_type, matched
        self.use_default_callbacks = use_default_callbacks

    def handlers(self, node: Node, topic: str, group: CallbackGroup | None) -> dict[str, EventHandler]:
        """Return a handler for each callback there is, by its name."""
        types = {
            "deadline": QoSPublisherEventType.RCL_PUBLISHER_OFFERED_DEADLINE_MISSED,
            "liveliness": QoSPublisherEventType.RCL_PUBLISHER_LIVELINESS_LOST,
            "incompatible_qos": QoSPublisherEventType.RCL_PUBLISHER_OFFERED_INCOMPATIBLE_QOS,
            "incompatible_type": QoSPublisherEventType.RCL_PUBLISHER_INCOMPATIBLE_TYPE,
            "matched": QoSPublisherEventType.RCL_PUBLISHER_MATCHED,
        }
        return {
            name: EventHandler(node, topic, event_type, getattr(self, name), group)
            for name, event_type in types.items()
            if getattr(self, name) is not None
        }


def default_incompatible_qos(callbacks: SubscriptionEventCallbacks | PublisherEventCallbacks | None) -> bool:
    """Tell whether an endpoint with these callbacks warns of incompatible QoS."""
    return callbacks is None or (callbacks.incompatible_qos is None and callbacks.use_default_callbacks)


def adder(handler: EventHandler | None) -> Callable[[], None] | None:
    """Return what adds one to the count of an event, or None when nobody is told of it."""
    return handler.add if handler is not None else None
