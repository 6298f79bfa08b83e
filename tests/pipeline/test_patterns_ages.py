"""Old data: braking by integration, arcs by integration, guards, and synchronizers against brute force."""

from __future__ import annotations

import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robotbrain.errors import InputError
from robotbrain.pipeline.patterns.ages import (
    Freshest,
    StaleGuard,
    extrapolate,
    safe_speed,
    stopping_distance,
    time_ns,
)
from robotbrain.ros import SimContext
from robotbrain.ros.conversions import msg_class
from robotbrain.ros.message_filters import (
    ApproximateTimeSynchronizer,
    Cache,
    SimpleFilter,
    Subscriber,
    TimeSynchronizer,
)
from robotbrain.ros.node import Node
from robotbrain.ros.time import Time

positive = st.floats(0.01, 20)


def stamped(ns, tag=0):
    return SimpleNamespace(header=SimpleNamespace(stamp=SimpleNamespace(sec=ns // 10**9, nanosec=ns % 10**9)), tag=tag)


# ------------------------------------------------------------ speed and distance


@given(st.floats(0, 3), positive, st.floats(0.1, 10))
def test_a_robot_at_the_safe_speed_stops_just_in_time(age, distance, a_max):
    """Oracle: integrate, blind at first, then braking."""
    v = float(safe_speed(age, distance, a_max))
    x, dt = v * age, v / a_max / 2000
    for _ in range(2000):
        x += v * dt - a_max * dt * dt / 2
        v -= a_max * dt
    assert x == pytest.approx(distance, rel=1e-6)


@given(st.floats(0, 3), st.floats(0, 20), st.floats(0.1, 10))
def test_safe_speed_is_the_inverse_of_the_stopping_distance(age, distance, a_max):
    assert stopping_distance(safe_speed(age, distance, a_max), age, a_max) == pytest.approx(distance, abs=1e-9)
    assert safe_speed(0.0, distance, a_max) == pytest.approx(math.sqrt(2 * a_max * distance))
    assert safe_speed(age + 0.1, distance + 0.1, a_max) < safe_speed(age, distance + 0.1, a_max)


def test_safe_speed_takes_arrays_and_zero():
    assert safe_speed(np.zeros(3), 0.0, 1.0).tolist() == [0, 0, 0]
    # With almost unlimited brakes only the reaction counts: v = d / t, where the textbook's root would cancel.
    assert safe_speed(10.0, 1e-6, 1e12) == pytest.approx(1e-7, rel=1e-9)
    for arguments in ((-0.1, 1, 1), (0.1, -1, 1), (0.1, 1, 0), (math.nan, 1, 1)):
        with pytest.raises(InputError):
            safe_speed(*arguments)


@given(st.floats(-2, 2), st.floats(-3, 3), st.floats(0, 1), st.floats(-3, 3))
def test_extrapolation_follows_the_arc(v, w, seconds, yaw):
    x = y = 0.0
    heading, steps = yaw, 400
    for _ in range(steps):  # midpoint rule
        middle = heading + w * seconds / steps / 2
        x += v * math.cos(middle) * seconds / steps
        y += v * math.sin(middle) * seconds / steps
        heading += w * seconds / steps
    found = extrapolate((0.0, 0.0, yaw), v, w, seconds)
    assert found[:2] == pytest.approx((x, y), abs=1e-4)
    assert math.cos(found[2] - heading) == pytest.approx(1)


# ------------------------------------------------------------ guards


@given(st.sampled_from(["stop", "slow", "extrapolate"]), st.floats(0.01, 2), st.floats(0, 1), st.floats(-1, 4))
def test_a_guard_never_lets_a_robot_drive_on_old_data(policy, max_age, share, age):
    guard = StaleGuard(max_age, fresh_age=share * max_age, policy=policy)
    now = 10 * 10**9
    verdict = guard.judge(now - round(age * 1e9), now)
    if age > max_age + 1e-6 or age < -guard.future - 1e-6:
        assert not verdict
        assert verdict.speed_scale == 0
        assert verdict.reason
    elif -guard.future + 1e-6 < age < max_age - 1e-6:
        assert verdict
        assert 0 < verdict.speed_scale <= 1
        assert verdict.predict_s == pytest.approx(max(0, age) if policy == "extrapolate" else 0, abs=1e-8)
    older = guard.judge(now - round(age * 1e9) - 10**7, now)
    assert older.speed_scale <= verdict.speed_scale or verdict.state == "future"


def test_slowing_down_is_linear():
    guard = StaleGuard(0.4, fresh_age=0.2, policy="slow")
    scales = [guard.judge(0, round(age * 1e9)).speed_scale for age in (0.1, 0.2, 0.25, 0.3, 0.4, 0.41)]
    assert scales == pytest.approx([1, 1, 0.75, 0.5, 0, 0])
    assert guard.counts == {"fresh": 2, "ageing": 3, "stale": 1, "future": 0, "missing": 0}


def test_freshest_in_a_node_notices_that_a_sensor_has_died():
    context = SimContext()
    scan = msg_class("sensor_msgs/msg/LaserScan")
    sensor, controller = Node("sensor", context=context), Node("controller", context=context)
    publisher = sensor.create_publisher(scan, "scan", 1)

    def publish():
        if context.now_ns < 1e9:
            message = scan()
            message.header.stamp = sensor.get_clock().now().to_msg()
            publisher.publish(message)

    sensor.create_timer(0.1, publish)
    freshest, log = Freshest(StaleGuard(0.25)), []
    controller.create_subscription(scan, "scan", freshest.put, 1)
    controller.create_timer(0.05, lambda: log.append(freshest.get(controller.get_clock().now())))
    context.run_for(2.0)
    states = [verdict.state for _, verdict in log]
    assert states[0] == "missing"
    assert set(states[2:23]) == {"fresh"}
    # The last scan is of 0.9 s; it is 0.25 s old at 1.15 s, so stale from 1.20 s on.
    assert states.index("stale") == 23
    assert set(states[23:]) == {"stale"}
    assert log[-1][0] is None


def test_freshest_refuses_what_was_overtaken():
    freshest = Freshest()
    assert freshest.get(0)[1].state == "missing"
    assert [freshest.put(stamped(ns, k)) for k, ns in enumerate((5, 9, 7, 9))] == [True, True, False, True]
    message, verdict = freshest.get(10**9 + 9)
    assert (message.tag, verdict.age_s, freshest.overtaken) == (3, 1.0, 1)
    freshest.clear()
    assert freshest.put(stamped(1))


def test_times_come_in_many_forms():
    assert {time_ns(t) for t in (2_000_000_005, np.int64(2_000_000_005), Time(seconds=2, nanoseconds=5))} == {
        2000000005
    }
    assert time_ns(stamped(2_000_000_005)) == time_ns(stamped(2_000_000_005).header.stamp) == 2_000_000_005
    with pytest.raises(InputError, match="stamp"):
        time_ns("now")


@pytest.mark.parametrize(
    "arguments", [{"max_age": 0}, {"max_age": 1, "fresh_age": 2}, {"max_age": 1, "policy": "hope"}]
)
def test_bad_guards_are_explained(arguments):
    with pytest.raises(InputError):
        StaleGuard(arguments.pop("max_age"), **arguments)


# ------------------------------------------------------------ synchronizers

arrivals = st.lists(st.tuples(st.integers(0, 2), st.integers(0, 60)), max_size=40)


def synchronise(kind, messages, count, *arguments):
    sources, sets = [SimpleFilter() for _ in range(count)], []
    kind(sources, *arguments).registerCallback(lambda *found: sets.append([m.tag for m in found]))
    for place, (source, ns) in enumerate(messages):
        sources[source % count].signalMessage(stamped(ns, (source % count, ns, place)))
    return sets


@given(arrivals, st.integers(2, 3))
def test_exact_sets_share_a_stamp_and_none_is_missed(messages, count):
    sets = synchronise(TimeSynchronizer, messages, count, 100)
    for found in sets:
        assert [source for source, _, _ in found] == list(range(count))
        assert len({ns for _, ns, _ in found}) == 1
    # A stamp is complete as often as the rarest source has it, if repeated stamps wait for the others in turn.
    pending: list[set[int]] = [set() for _ in range(count)]
    expected = []
    for source, ns in messages:
        pending[source % count].add(ns)
        if all(ns in waiting for waiting in pending):
            expected.append(ns)
            for waiting in pending:
                waiting.remove(ns)
    assert [found[0][1] for found in sets] == expected


@given(arrivals, st.integers(2, 3), st.integers(1, 15), st.integers(1, 5))
def test_approximate_sets_are_the_nearest_ones_that_wait(messages, count, slop, size):
    """Brute force: at each arrival all combinations of what waits, in the order of nearness to the newcomer."""
    waiting = [{} for _ in range(count)]
    expected = []
    for place, (raw, ns) in enumerate(messages):
        source = raw % count
        waiting[source][ns] = (source, ns, place)
        if len(waiting[source]) > size:
            del waiting[source][min(waiting[source])]
        if ns not in waiting[source]:
            continue
        pools = [sorted(pool.values(), key=lambda m, ns=ns: abs(m[1] - ns)) for pool in waiting]
        pools[source] = [waiting[source][ns]]
        for combination in itertools.product(*pools):
            stamps = [m[1] for m in combination]
            if max(stamps) - min(stamps) < slop:
                expected.append(list(combination))
                for pool, stamp in zip(waiting, stamps, strict=True):
                    del pool[stamp]
                break
    assert synchronise(ApproximateTimeSynchronizer, messages, count, size, (slop + 0.4) / 1e9) == expected


@given(arrivals, st.integers(1, 15))
def test_approximate_sets_keep_their_promises(messages, slop):
    sets = synchronise(ApproximateTimeSynchronizer, messages, 3, 10, (slop + 0.4) / 1e9)
    used = [tag for found in sets for tag in found]
    assert len(used) == len(set(used))
    for found in sets:
        stamps = [ns for _, ns, _ in found]
        assert max(stamps) - min(stamps) < slop


def test_camera_and_lidar_in_a_node():
    """10 Hz and 7 Hz: every set is within the slop, and a headerless message is not taken."""
    context = SimContext()
    node, sets, logged = Node("fusion", context=context), [], []
    context.log_sink = lambda record: logged.append(record)
    kinds = {"image": ("sensor_msgs/msg/Image", 0.1), "scan": ("sensor_msgs/msg/LaserScan", 1 / 7)}
    for topic, (type_name, period) in kinds.items():
        cls = msg_class(type_name)
        publisher = node.create_publisher(cls, topic, 10)

        def publish(cls=cls, publisher=publisher):
            message = cls()
            message.header.stamp = node.get_clock().now().to_msg()
            publisher.publish(message)

        node.create_timer(period, publish)
    sources = [Subscriber(node, msg_class(kinds[topic][0]), topic) for topic in kinds]
    assert sources[0].getTopic() == "image"
    assert sources[0].topic_name == "/image"
    both = ApproximateTimeSynchronizer(sources, 10, 0.03)
    both.registerCallback(lambda image, scan: sets.append((time_ns(image), time_ns(scan))))
    context.run_for(3.0)
    assert len(sets) > 10
    assert all(abs(a - b) < 30_000_000 for a, b in sets)
    before = len(sets)
    with context.as_default():
        sources[0].signalMessage(SimpleNamespace(data=1))
    assert len(sets) == before
    assert logged


def test_headerless_messages_may_count_from_their_arrival():
    context = SimContext()
    node, sets = Node("fusion", context=context), []
    text = msg_class("std_msgs/msg/String")
    for topic, period in (("a", 0.1), ("b", 0.25)):
        publisher = node.create_publisher(text, topic, 10)
        node.create_timer(period, lambda publisher=publisher: publisher.publish(text(data="x")))
    sources = [Subscriber(node, text, topic) for topic in ("a", "b")]
    both = ApproximateTimeSynchronizer(sources, 10, 0.06, allow_headerless=True)
    both.registerCallback(lambda *found: sets.append(context.now_ns))
    cache = Cache(sources[1], 2, allow_headerless=True)
    context.run_for(1.01)
    # Each b at 250, 500, 750 and 1000 ms has an a within 60 ms; the set is complete when the later of the two comes.
    assert [ns // 1_000_000 for ns in sets] == [250, 500, 750, 1000]
    assert [cache.getOldestTime().nanoseconds, cache.getLastestTime().nanoseconds] == [750_000_000, 1_000_000_000]


def test_cache_looks_up_by_time():
    source = SimpleFilter()
    cache = Cache(source, 3)
    assert cache.getLast() is None
    for ns in (10, 20, 30, 40):
        source.signalMessage(stamped(ns, ns))
    assert [m.tag for m in cache.getInterval(Time(nanoseconds=20), Time(nanoseconds=30))] == [20, 30]
    assert cache.getElemAfterTime(Time(nanoseconds=21)).tag == 30
    assert cache.getElemBeforeTime(Time(nanoseconds=39)).tag == 30
    assert cache.getElemBeforeTime(Time(nanoseconds=19)) is None
    assert (cache.getOldestTime().nanoseconds, cache.getLastestTime().nanoseconds, cache.getLast().tag) == (20, 40, 40)


def test_bad_synchronizers_are_explained():
    with pytest.raises(InputError, match="synchronizer"):
        TimeSynchronizer([], 10)
