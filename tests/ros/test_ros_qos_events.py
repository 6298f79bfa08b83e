"""Deadline, lifespan, liveliness, matched and incompatible events against what DDS says of them."""

from __future__ import annotations

import itertools
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import (
    DurabilityPolicy,
    LivelinessPolicy,
    QoSCompatibility,
    QoSPolicyKind,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
    qos_policy_name_from_kind,
    qos_profile_best_available,
)
from rclpy.qos_overriding_options import InvalidQosOverridesError, QoSOverridingOptions
from std_msgs.msg import Int64

from robotbrain.errors import InputError
from robotbrain.ros import MessageRecord, SimContext, charge
from robotbrain.ros.qos import best_available, mismatches

MS = 1_000_000
RELIABLE, BEST_EFFORT = ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT
MANUAL = LivelinessPolicy.MANUAL_BY_TOPIC
LATCHED = DurabilityPolicy.TRANSIENT_LOCAL


def ms(value: int) -> Duration:
    return Duration(nanoseconds=value * MS)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(1, 300), min_size=1, max_size=12), st.integers(20, 120), st.booleans())
def test_missed_deadlines_are_the_periods_without_a_message(gaps: list[int], period: int, listens: bool) -> None:
    """A gap of g ms misses (g - 1) // period deadlines; one that ends exactly at a deadline may count as one more. Both
    ends count, with a callback or without."""
    simulation = SimContext()
    with simulation.as_default():
        node = Node("n")
        profile = QoSProfile(depth=10, deadline=ms(period))
        offered: list[Any] = []
        requested: list[Any] = []
        publisher = node.create_publisher(
            Int64, "t", profile, event_callbacks=PublisherEventCallbacks(deadline=offered.append) if listens else None
        )
        subscription = node.create_subscription(
            Int64, "t", lambda message: None, profile,
            event_callbacks=SubscriptionEventCallbacks(deadline=requested.append) if listens else None,
        )  # fmt: skip
        simulation.run_for(5.0)
        assert publisher.deadline_missed == 0, "it begins with the first message"
        times = [0, *itertools.accumulate(gaps)]
        start = simulation.now_ns
        for time in times:
            simulation.schedule(start + time * MS, lambda _: publisher.publish(Int64()))
        simulation.run_until(start + times[-1] * MS)
    at_the_limit = sum(gap % period == 0 for gap in gaps)
    expected = sum((gap - 1) // period for gap in gaps)
    assert expected <= publisher.deadline_missed <= expected + at_the_limit
    assert expected <= subscription.deadline_missed <= expected + at_the_limit
    for infos, end in ((offered, publisher), (requested, subscription)):
        if listens:
            assert sum(info.total_count_change for info in infos) == end.deadline_missed
            assert [info.total_count for info in infos] == list(range(1, end.deadline_missed + 1))


def test_events_that_wait_are_told_at_once(context: SimContext) -> None:
    """The subscriber is busy for 350 ms while deadlines of 100 ms pass."""
    node, other, infos = Node("n"), Node("other"), []
    profile = QoSProfile(depth=1, deadline=ms(100))
    publisher = other.create_publisher(Int64, "t", profile)
    events = SubscriptionEventCallbacks(deadline=lambda info: infos.append((info.total_count, info.total_count_change)))
    node.create_subscription(Int64, "t", lambda m: charge(350 * MS), profile, event_callbacks=events)
    publisher.publish(Int64())
    context.run_until(450 * MS)
    assert infos == [(3, 3), (4, 1)]


@pytest.mark.parametrize(("lifespan", "seen", "expired"), [(0, [0, 1, 2, 3], 0), (25, [0, 3], 2), (15, [0], 3)])
def test_what_waited_too_long_is_not_delivered(
    context: SimContext, lifespan: int, seen: list[int], expired: int
) -> None:
    """Messages at 10, 20, 30, 40 ms; the subscriber is busy from 10 to 60, when 1 and 2 are 40 and 30 ms old."""
    sender, receiver, got = Node("sender"), Node("receiver"), []
    publisher = sender.create_publisher(Int64, "t", QoSProfile(depth=10, lifespan=ms(lifespan)))
    numbers = iter(range(4))
    timer = sender.create_timer(0.01, lambda: publisher.publish(Int64(data=next(numbers))))

    def take(message: Int64) -> None:
        got.append(message.data)
        if message.data == 0:
            charge(50 * MS)

    subscription = receiver.create_subscription(Int64, "t", take, 10)
    context.run_until(45 * MS)
    timer.cancel()
    context.run_for(1.0)
    assert (got, subscription.expired, subscription.dropped) == (seen, expired, 0)
    assert subscription.received == 4 and subscription.queue_depth() == 0


def test_what_is_too_old_on_arrival_or_for_a_late_subscriber_is_not_delivered(context: SimContext) -> None:
    context.latency_ns = 20 * MS
    node = Node("n")
    seen: list[Any] = []
    publisher = node.create_publisher(Int64, "t", QoSProfile(depth=5, lifespan=ms(20), durability=LATCHED))
    early = node.create_subscription(Int64, "t", seen.append, 10)
    publisher.publish(Int64(data=1))
    context.run_for(0.1)
    assert seen == [] and early.expired == 1
    context.latency_ns = 0
    node.create_subscription(Int64, "t", lambda m: seen.append(m.data), QoSProfile(depth=5, durability=LATCHED))
    publisher.publish(Int64(data=2))
    context.run_for(0.1)
    assert [m if isinstance(m, int) else m.data for m in seen] == [2, 2]


def test_manual_liveliness(context: SimContext) -> None:
    sender, receiver = Node("sender"), Node("receiver")
    profile = QoSProfile(depth=1, liveliness=MANUAL, liveliness_lease_duration=ms(100))
    lost: list[tuple[int, int]] = []
    changes: list[tuple[int, int, int, int, int]] = []
    publisher = sender.create_publisher(
        Int64, "t", profile, event_callbacks=PublisherEventCallbacks(
            liveliness=lambda info: lost.append((context.now_ns // MS, info.total_count)))
    )  # fmt: skip
    receiver.create_subscription(
        Int64, "t", lambda m: None, profile,
        event_callbacks=SubscriptionEventCallbacks(liveliness=lambda i: changes.append((
            context.now_ns // MS, i.alive_count, i.not_alive_count, i.alive_count_change, i.not_alive_count_change)))
    )  # fmt: skip
    context.run_until(500 * MS)
    assert changes == []
    for time in (500, 590, 680):
        context.schedule(time * MS, lambda _: publisher.assert_liveliness())
    context.schedule(1000 * MS, lambda _: publisher.publish(Int64()))
    context.run_until(1050 * MS)
    assert changes == [(500, 1, 0, 1, 0), (780, 0, 1, -1, 1), (1000, 1, 0, 1, -1)]
    assert lost == [(780, 1)]
    publisher.destroy()
    context.run_until(2000 * MS)
    assert changes[3:] == [(1050, 0, 0, -1, 0)]


def test_automatic_liveliness_is_existing(context: SimContext) -> None:
    node, counts = Node("n"), []
    node.create_subscription(
        Int64, "t", lambda m: None, 1,
        event_callbacks=SubscriptionEventCallbacks(liveliness=lambda info: counts.append(info.alive_count)),
    )  # fmt: skip
    publishers = [node.create_publisher(Int64, "t", 1) for _ in range(2)]
    context.run_for(10.0)
    publishers[0].destroy()
    context.run_for(10.0)
    assert counts == [2, 1]


def test_matched_events_on_both_sides(context: SimContext) -> None:
    node, told = Node("n"), []

    def note(side: str) -> Any:
        return lambda i: told.append(
            (side, i.total_count, i.total_count_change, i.current_count, i.current_count_change)
        )

    publisher = node.create_publisher(Int64, "t", 1, event_callbacks=PublisherEventCallbacks(matched=note("p")))
    first = node.create_subscription(
        Int64, "t", lambda m: None, 1, event_callbacks=SubscriptionEventCallbacks(matched=note("s"))
    )
    assert told == [], "callbacks run when the executor does"
    context.run_for(0.0)
    assert told == [("p", 1, 1, 1, 1), ("s", 1, 1, 1, 1)]
    node.create_subscription(Int64, "t", lambda m: None, 1)
    node.destroy_subscription(first)
    context.run_for(0.0)
    assert told[2:] == [("p", 2, 1, 1, 0)], "one came and one went: told at once"
    publisher.destroy()
    context.run_for(0.0)
    assert len(told) == 3


def test_incompatible_qos_is_told_or_logged(context: SimContext) -> None:
    node, told = Node("n"), []
    events = SubscriptionEventCallbacks(
        incompatible_qos=lambda i: told.append((i.total_count, qos_policy_name_from_kind(i.last_policy_kind)))
    )
    node.create_publisher(Int64, "t", QoSProfile(depth=1, reliability=BEST_EFFORT))
    node.create_subscription(Int64, "t", lambda m: None, 1, event_callbacks=events)
    node.create_publisher(Int64, "t", QoSProfile(depth=1, deadline=ms(5)))
    context.run_for(0.1)
    assert told == [(1, "RELIABILITY")] and context.log_lines == []  # type: ignore[attr-defined]
    silent = SubscriptionEventCallbacks(use_default_callbacks=False)
    node.create_subscription(Int64, "t", lambda m: None, 1, event_callbacks=silent)
    assert context.log_lines == []  # type: ignore[attr-defined]
    node.create_subscription(Int64, "t", lambda m: None, 1)
    assert len(context.log_lines) == 1  # type: ignore[attr-defined]
    at_publisher: list[int] = []
    node.create_publisher(
        Int64, "t", QoSProfile(depth=1, reliability=BEST_EFFORT),
        event_callbacks=PublisherEventCallbacks(incompatible_qos=lambda i: at_publisher.append(i.total_count)),
    )  # fmt: skip
    context.run_for(0.1)
    assert at_publisher == [3]


def test_lost_messages_are_told(context: SimContext) -> None:
    node, told = Node("n"), []
    publisher = node.create_publisher(Int64, "t", 10)
    subscription = node.create_subscription(
        Int64, "t", lambda m: None, 10,
        event_callbacks=SubscriptionEventCallbacks(message_lost=lambda info: told.append(info.total_count)),
    )  # fmt: skip
    drops = iter([True, False, True])

    def fault(record: MessageRecord, data: bytes) -> list[tuple[bytes, int]]:
        return [] if next(drops) else [(data, 0)]

    context.add_filter("/t", fault)
    for _ in range(3):
        publisher.publish(Int64())
        context.run_for(0.1)
    assert told == [1, 2] and subscription.lost == 2 and subscription.received == 1


POLICIES = st.builds(
    QoSProfile,
    depth=st.just(1),
    reliability=st.sampled_from([RELIABLE, BEST_EFFORT]),
    durability=st.sampled_from([DurabilityPolicy.VOLATILE, LATCHED]),
    deadline=st.sampled_from([Duration(), ms(1), ms(2)]),
    liveliness=st.sampled_from([LivelinessPolicy.AUTOMATIC, MANUAL]),
    liveliness_lease_duration=st.sampled_from([Duration(), ms(1), ms(2)]),
)


@given(POLICIES, POLICIES)
def test_requested_versus_offered(offered: QoSProfile, requested: QoSProfile) -> None:
    """OMG DDS 1.4, 2.2.3: each offered value must be at least as strong as the requested one."""

    def strength(qos: QoSProfile) -> tuple[float, ...]:
        limits = (qos.deadline, qos.liveliness_lease_duration)
        return (
            qos.reliability == RELIABLE,
            qos.durability == LATCHED,
            qos.liveliness == MANUAL,
            *(-(limit.nanoseconds or float("inf")) for limit in limits),
        )

    fits = all(ours >= theirs for ours, theirs in zip(strength(offered), strength(requested), strict=True))
    verdict, reason = qos_check_compatible(offered, requested)
    assert (not mismatches(offered, requested)) == fits == (verdict == QoSCompatibility.OK)
    assert bool(reason) != fits
    simulation = SimContext()
    simulation.log_sink = lambda line: None
    node = Node("n", context=simulation)
    publisher = node.create_publisher(Int64, "t", offered)
    node.create_subscription(Int64, "t", lambda m: None, requested)
    assert publisher.get_subscription_count() == fits


def test_policies_left_to_the_middleware_give_a_warning() -> None:
    """The texts are those of genuine Kilted."""
    plain = QoSProfile(depth=1)
    verdict, reason = qos_check_compatible(plain, plain)
    assert verdict == QoSCompatibility.WARNING
    assert reason == ("WARNING: Publisher liveliness is system_default and subscription liveliness is system_default;")
    effort = QoSProfile(depth=1, reliability=BEST_EFFORT)
    assert qos_check_compatible(effort, QoSProfile(depth=1, durability=LATCHED)) == (
        QoSCompatibility.ERROR,
        "ERROR: Best effort publisher and reliable subscription;"
        "ERROR: Volatile publisher and transient local subscription;",
    )


@given(st.lists(POLICIES, max_size=4))
def test_best_available_reaches_everybody(others: list[QoSProfile]) -> None:
    request = best_available(qos_profile_best_available, others, offers=False)
    assert all(not mismatches(other, request) for other in others)
    offer = best_available(qos_profile_best_available, others, offers=True)
    assert all(not mismatches(offer, other) for other in others)


def test_profiles_can_be_overridden_by_parameters(context: SimContext) -> None:
    overrides = [
        Parameter("qos_overrides./t.publisher.depth", value=3),
        Parameter("qos_overrides./t.publisher.reliability", value="best_effort"),
        Parameter("qos_overrides./t.subscription_mine.depth", value=-1),
    ]
    node = Node("n", parameter_overrides=overrides)
    profile = QoSProfile(depth=10)
    publisher = node.create_publisher(
        Int64, "t", profile, qos_overriding_options=QoSOverridingOptions.with_default_policies()
    )
    assert (publisher.qos_profile.depth, publisher.qos_profile.reliability) == (3, BEST_EFFORT)
    assert profile == QoSProfile(depth=10) and node.get_parameter("qos_overrides./t.publisher.history").value
    for problem, options in (
        (InputError, QoSOverridingOptions([QoSPolicyKind.DEPTH], entity_id="mine")),
        (InvalidQosOverridesError, QoSOverridingOptions([], callback=lambda qos: RESULT)),
    ):
        with pytest.raises(problem):
            node.create_subscription(Int64, "t", lambda m: None, 1, qos_overriding_options=options)


class RESULT:
    successful, reason = False, "no"
