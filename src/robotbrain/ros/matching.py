"""Topics: which publisher reaches which subscription, and who is told about it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from robotbrain.ros.event_handler import default_incompatible_qos
from robotbrain.ros.exceptions import TypeConflictError
from robotbrain.ros.messages import typename_of
from robotbrain.ros.qos_compatibility import Mismatch, mismatches

if TYPE_CHECKING:
    from robotbrain.ros.context import SimContext
    from robotbrain.ros.topics import Publisher, Subscription


class Topic:
    """A topic: its type, publishers and subscriptions, in order of creation."""

    def __init__(self, name: str, typename: str) -> None:
        self.name, self.typename = name, typename
        self.publishers: list[Publisher] = []
        self.subscriptions: list[Subscription] = []

    def add_publisher(self, publisher: Publisher) -> None:
        """Match a new publisher with all subscriptions."""
        self.publishers.append(publisher)
        for subscription in self.subscriptions:
            self._try(publisher, subscription)

    def add_subscription(self, subscription: Subscription) -> None:
        """Match a new subscription with all publishers."""
        self.subscriptions.append(subscription)
        for publisher in self.publishers:
            self._try(publisher, subscription)

    def _try(self, publisher: Publisher, subscription: Subscription) -> None:
        found = mismatches(publisher.qos_profile, subscription.qos_profile)
        if found:
            self._refuse(publisher, subscription, found)
            return
        publisher.matched.append(subscription)
        _tell(publisher, subscription, 1)
        handler = subscription.handlers.get("liveliness")
        if handler is not None and (publisher.lease is None or publisher.lease.alive):
            handler.add(alive_count=1)

    def _refuse(self, publisher: Publisher, subscription: Subscription, found: list[Mismatch]) -> None:
        last = found[-1].kind  # of several, the middleware reports the one with the highest id
        for endpoint in (publisher, subscription):
            if (handler := endpoint.handlers.get("incompatible_qos")) is not None:
                handler.add(last_policy_kind=int(last))
        if default_incompatible_qos(subscription.event_callbacks):
            reason = "; ".join(f"{kind.name.lower()}: {reason}" for kind, reason in found)
            subscription.node.get_logger().warning(
                f"topic {self.name}: nothing from {publisher.node.get_fully_qualified_name()} reaches "
                f"{subscription.node.get_fully_qualified_name()}, QoS is incompatible ({reason})"
            )

    def remove_publisher(self, publisher: Publisher) -> None:
        """Forget a publisher; its subscriptions are told."""
        self.publishers.remove(publisher)
        for subscription in publisher.matched:
            _tell(publisher, subscription, -1)
            if (handler := subscription.handlers.get("liveliness")) is not None:
                if publisher.lease is None or publisher.lease.alive:
                    handler.add(alive_count=-1)
                elif publisher.lease.was_alive:
                    handler.add(not_alive_count=-1)
        publisher.matched = []

    def remove_subscription(self, subscription: Subscription) -> None:
        """Forget a subscription; its publishers are told."""
        self.subscriptions.remove(subscription)
        for publisher in self.publishers:
            if subscription in publisher.matched:
                publisher.matched = [sub for sub in publisher.matched if sub is not subscription]
                _tell(publisher, subscription, -1)


def _tell(publisher: Publisher, subscription: Subscription, change: int) -> None:
    for endpoint in (publisher, subscription):
        if not endpoint.destroyed and (handler := endpoint.handlers.get("matched")) is not None:
            handler.add(total_count=max(0, change), current_count=change)


def join_topic(context: SimContext, name: str, msg_type: Any) -> Topic:
    """Return the topic of that name, made if new.

    Raises:
        TypeConflictError: it exists with another type.
    """
    typename = typename_of(msg_type)
    topic = context.topics.get(name)
    if topic is None:
        topic = context.topics[name] = Topic(name, typename)
    if topic.typename != typename:
        nodes = [publisher.node for publisher in topic.publishers] + [sub.node for sub in topic.subscriptions]
        users = sorted({node.get_fully_qualified_name() for node in nodes})
        raise TypeConflictError(
            f"type of topic {name}",
            given=typename,
            expected=f"{topic.typename}, as {', '.join(users)} use it",
            fix="Use one type per topic, or another topic name.",
        )
    return topic


def leave_topic(context: SimContext, topic: Topic) -> None:
    """Forget a topic without ends."""
    if not topic.publishers and not topic.subscriptions:
        context.topics.pop(topic.name, None)
