"""Simulated time against closed forms: timers, costs, queues, executors, callback groups, determinism."""

from __future__ import annotations

import hashlib
import itertools
import random
import struct

import pytest
from geometry_msgs.msg import Twist
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from std_msgs.msg import Float32, Int64, String

from robotbrain.errors import InputError
from robotbrain.ros import CallbackError, ReentrancyError, SimContext, charge
from robotbrain.ros.record import DecisionLog

MS = 1_000_000


def now_ms(node):
    return node.get_clock().now().nanoseconds / MS


def timer_starts(period_ms, cost_ms, until_ms):
    context, starts = SimContext(), []
    node = Node("n", context=context)
    node.create_timer(period_ms / 1e3, lambda: (starts.append(now_ms(node)), charge(cost_ms * MS)))
    context.run_until(until_ms * MS)
    return starts


def test_timer_on_time_has_no_drift():
    assert timer_starts(10, 0, 1000) == [10.0 * k for k in range(1, 101)]
    assert timer_starts(10, 9, 1000) == [10.0 * k for k in range(1, 101)]


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 20), st.integers(21, 60))
def test_overloaded_timer_runs_back_to_back(period, cost):
    starts = timer_starts(period, cost, 1000)
    assert starts == [float(period + cost * k) for k in range(len(starts))]
    assert len(starts) == 1 + (1000 - period) // cost


def test_missed_periods_are_coalesced_on_the_original_grid(context):
    """One slow call of 35 ms at t = 10: fires once when free at 45, then at 50, 60, ... (rcl_timer_call)."""
    starts, node = [], Node("n")

    def tick():
        starts.append(now_ms(node))
        if len(starts) == 1:
            charge(35 * MS)

    timer = node.create_timer(0.01, tick)
    context.run_until(80 * MS)
    assert starts == [10.0, 45.0, 50.0, 60.0, 70.0, 80.0]
    timer.cancel()
    context.run_until(200 * MS)
    assert timer.is_canceled() and len(starts) == 6
    timer.reset()
    assert timer.time_until_next_call() == 10 * MS
    context.run_until(215 * MS)
    assert starts[6:] == [210.0]


def test_publications_and_clock_of_a_costly_callback(context):
    """It reads its start time; what it sends is released at start + cost, then takes the transport latency."""
    context.latency_ns = 2 * MS
    sender, receiver, seen = Node("sender"), Node("receiver"), []
    publisher = sender.create_publisher(Int64, "t", 10)

    def tick():
        charge(3 * MS)
        publisher.publish(Int64(data=sender.get_clock().now().nanoseconds))
        charge(4 * MS)

    sender.create_timer(0.01, tick)
    receiver.create_subscription(Int64, "t", lambda m: seen.append((m.data / MS, now_ms(receiver))), 10)
    context.run_until(35 * MS)
    assert seen == [(10.0, 19.0), (20.0, 29.0)]


@pytest.mark.parametrize(("depth", "expected", "dropped"), [
    (1, [0, 2, 5, 8, 9], 5),
    (10, list(range(10)), 0),
])  # fmt: skip
def test_queue_depth_of_a_busy_subscriber(context, depth, expected, dropped):
    """Ten messages, 10 ms apart; each costs 27 ms: free at 37, 64, 91 and 118 ms, when the newest is 2, 5, 8 and 9."""
    sender, receiver, seen = Node("sender"), Node("receiver"), []
    publisher = sender.create_publisher(Int64, "t", 10)
    sent = iter(range(10))
    timer = sender.create_timer(0.01, lambda: send())

    def send():
        n = next(sent, None)
        timer.cancel() if n is None else publisher.publish(Int64(data=n))

    def callback(message):
        seen.append(message.data)
        charge(27 * MS)

    subscription = receiver.create_subscription(Int64, "t", callback, depth)
    context.run_until(1000 * MS)
    assert seen == expected
    assert (subscription.received, subscription.dropped) == (10, dropped)


def test_keep_all_drops_nothing(context):
    node, seen = Node("n"), []
    publisher = node.create_publisher(Int64, "t", 1)
    node.create_subscription(
        Int64, "t", lambda m: (seen.append(m.data), charge(MS)), QoSProfile(history=HistoryPolicy.KEEP_ALL)
    )
    for n in range(50):
        publisher.publish(Int64(data=n))
    context.run_until(100 * MS)
    assert seen == list(range(50))


def pipeline_latencies(stage_ms, period_ms, shared, count=40, depth=10):
    """Ages at the end of a chain of stages fed every ``period_ms``; one executor per stage or one for all."""
    context = SimContext()
    executor = SingleThreadedExecutor(context=context) if shared else None
    source, ages, ends = Node("source", context=context), [], []
    first = source.create_publisher(Int64, "s0", depth)
    left = [count]

    def tick():
        if left[0]:
            left[0] -= 1
            first.publish(Int64(data=context.now_ns))

    source.create_timer(period_ms / 1e3, tick)
    for index, cost in enumerate(stage_ms):
        node = Node(f"stage{index}", context=context)
        output = node.create_publisher(Int64, f"s{index + 1}", depth)

        def work(message, cost=cost, output=output):
            charge(cost * MS)
            output.publish(message)

        node.create_subscription(Int64, f"s{index}", work, depth)
        if executor:
            executor.add_node(node)
    sink = Node("sink", context=context)
    sink.create_subscription(
        Int64,
        f"s{len(stage_ms)}",
        lambda m: (ages.append((context.now_ns - m.data) / MS), ends.append(context.now_ns / MS)),
        depth,
    )
    context.run_until(100_000 * MS)
    return ages, ends


@pytest.mark.parametrize("stages", [[8, 6], [5, 5, 5], [2, 9, 4]])
def test_pipeline_runs_at_the_rate_of_its_slowest_stage(stages):
    """Period >= slowest stage: latency is the sum of the stages. One shared thread: the sum limits the rate."""
    ages, ends = pipeline_latencies(stages, period_ms=max(stages), shared=False)
    assert ages == [float(sum(stages))] * 40
    assert [b - a for a, b in itertools.pairwise(ends)] == [float(max(stages))] * 39
    ages, ends = pipeline_latencies(stages, period_ms=sum(stages), shared=True)
    assert ages == [float(sum(stages))] * 40


def test_shared_executor_saturates_where_the_pipeline_does_not():
    """Stages of 8 and 6 ms fed every 10 ms: 100 Hz when pipelined, 1 / 14 ms on one thread."""
    pipelined = pipeline_latencies([8, 6], 10, shared=False, depth=1000)[1]
    sequential = pipeline_latencies([8, 6], 10, shared=True, depth=1000)[1]
    assert pipelined[-1] == 40 * 10 + 14
    assert sequential[-1] == 10 + 40 * 14  # the thread is never idle


@pytest.mark.parametrize(("threads", "group", "expected"), [
    (1, "reentrant", [0, 10, 20, 30]),
    (2, "reentrant", [0, 0, 10, 10]),
    (4, "reentrant", [0, 0, 0, 0]),
    (4, "exclusive", [0, 10, 20, 30]),
    (4, "one each", [0, 0, 0, 0]),
])  # fmt: skip
def test_workers_and_callback_groups(context, threads, group, expected):
    """Four messages at t = 0 for four subscriptions, each 10 ms of work."""
    executor = MultiThreadedExecutor(threads)
    node, starts = Node("n"), []
    executor.add_node(node)
    shared = {"reentrant": ReentrantCallbackGroup(), "exclusive": MutuallyExclusiveCallbackGroup()}.get(group)
    for _ in range(4):
        node.create_subscription(
            String, "t", lambda m: (starts.append(now_ms(node)), charge(10 * MS)), 10,
            callback_group=shared or MutuallyExclusiveCallbackGroup(),
        )  # fmt: skip
    node.create_publisher(String, "t", 10).publish(String())
    context.run_until(100 * MS)
    assert starts == expected


def test_cost_model_adds_to_charges(context):
    class Costs:
        def cost(self, node_name, kind, name):
            return {("/a", "timer", "tick"): 5 * MS, ("/b", "subscription", "/t"): 7 * MS}.get(
                (node_name, kind, name), 0
            )

    context.cost_model = Costs()
    a, b, records = Node("a"), Node("b"), []
    context.add_callback_tap(records.append)
    publisher = a.create_publisher(String, "t", 10)

    def tick():
        charge(MS)
        publisher.publish(String())

    a.create_timer(0.1, tick)
    b.create_subscription(String, "t", lambda m: None, 10)
    context.run_until(150 * MS)
    assert [(r.node, r.kind, r.name, r.start_ns // MS, r.end_ns // MS) for r in records] == [
        ("/a", "timer", "tick", 100, 106),
        ("/b", "subscription", "/t", 106, 113),
    ]
    context.cost_model = None
    a.create_timer(0.01, lambda: charge(-1))
    with pytest.raises(CallbackError) as caught:
        context.run_until(200 * MS)
    assert isinstance(caught.value.__cause__, InputError)


def test_charge_outside_a_callback_does_nothing(context):
    assert charge(5) is False and context.now_ns == 0


def test_messages_do_not_alias(context):
    node, seen = Node("n"), []
    publisher = node.create_publisher(Twist, "t", 10)
    for _ in range(2):
        node.create_subscription(Twist, "t", seen.append, 10)
    message = Twist()
    publisher.publish(message)
    message.linear.x = 9.0
    context.run_for(0.0)
    assert seen[0] == Twist() and seen[0] is not seen[1] and seen[0].linear is not seen[1].linear
    floats, values = node.create_publisher(Float32, "f", 1), []
    node.create_subscription(Float32, "f", lambda m: values.append(m.data), 1)
    floats.publish(Float32(data=0.1))
    context.run_for(0.0)
    assert values == [0.10000000149011612]


def test_latency_by_size_never_reorders_one_publisher(context):
    context.latency_ns = lambda topic, size: size * MS
    node, seen = Node("n"), []
    publisher = node.create_publisher(String, "t", 10)
    node.create_subscription(String, "t", lambda m: seen.append((len(m.data), now_ms(node))), 10)
    for length in (100, 1):
        publisher.publish(String(data="x" * length))
    context.run_until(1000 * MS)
    assert seen == [(100, 109.0), (1, 109.0)]  # 4 header + 4 length + 100 + 1 terminator


def test_late_joiner_gets_latched_messages(context):
    latched = QoSProfile(depth=2, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    node, early, late, volatile = Node("n"), [], [], []
    publisher = node.create_publisher(Int64, "t", latched)
    node.create_subscription(Int64, "t", lambda m: early.append(m.data), latched)
    for n in range(3):
        publisher.publish(Int64(data=n))
    context.run_for(1.0)
    node.create_subscription(Int64, "t", lambda m: late.append(m.data), latched)
    node.create_subscription(Int64, "t", lambda m: volatile.append(m.data), 2)
    context.run_for(1.0)
    publisher.publish(Int64(data=3))
    context.run_for(1.0)
    # The first three were published between two spins: they arrive together, and a queue of two loses the oldest.
    assert (early, late, volatile) == ([1, 2, 3], [1, 2, 3], [3])


def test_incompatible_qos_delivers_nothing_and_says_so(context):
    node, seen = Node("n"), []
    publisher = node.create_publisher(String, "t", QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
    subscription = node.create_subscription(String, "t", seen.append, 1)
    publisher.publish(String())
    context.run_for(1.0)
    assert seen == [] and subscription.get_publisher_count() == 0
    assert any("reliability" in line.message and "/t" in line.message for line in context.log_lines)


def test_one_topic_has_one_type(context):
    node = Node("n")
    node.create_publisher(String, "t", 1)
    with pytest.raises(InputError, match=r"/t.*std_msgs/msg/String, as /n"):
        Node("m").create_subscription(Twist, "t", print, 1)


def test_wrong_message_type_is_refused(context):
    publisher = Node("n").create_publisher(Twist, "t", 1)
    with pytest.raises(TypeError, match="expected geometry_msgs/msg/Twist, got std_msgs/msg/String"):
        publisher.publish(String())
    with pytest.raises(TypeError, match="instance"):
        publisher.publish(Twist)


@pytest.mark.parametrize("period", [0, -1, float("nan"), "fast"])
def test_bad_timer_periods_are_refused(context, period):
    with pytest.raises(InputError, match="period"):
        Node("n").create_timer(period, print)


def test_callback_error_names_node_callback_and_time(context):
    def explode():
        raise ZeroDivisionError("planner met a wall")

    node = Node("planner")
    node.create_timer(0.25, explode)
    with pytest.raises(CallbackError, match=r"(?s)ZeroDivisionError.*explode.*/planner.*0\.25.*met a wall") as caught:
        context.run_until(1000 * MS)
    assert isinstance(caught.value.__cause__, ZeroDivisionError)
    assert caught.value.node is node and context.now_ns == 250 * MS
    with pytest.raises(CallbackError):  # the simulation can go on: the timer fires again
        context.run_until(1000 * MS)


def test_a_failing_receiver_does_not_cost_the_others_their_message(context):
    sender, bad, good, seen = Node("sender"), Node("bad"), Node("good"), []
    bad.create_subscription(Int64, "t", lambda m: 1 / m.data, 10)
    bad.create_subscription(Int64, "t", lambda m: seen.append(("bad", m.data)), 10)
    good.create_subscription(Int64, "t", lambda m: seen.append(("good", m.data)), 10)
    publisher = sender.create_publisher(Int64, "t", 10)
    publisher.publish(Int64(data=0))
    publisher.publish(Int64(data=1))
    with pytest.raises(CallbackError, match="division by zero"):
        context.run_for(1.0)
    context.run_for(1.0)
    assert sorted(seen) == [("bad", 0), ("bad", 1), ("good", 0), ("good", 1)]


def test_error_hook_can_isolate_a_node(context):
    bad, good, ticks, errors = Node("bad"), Node("good"), [], []

    def isolate(error):
        errors.append(error)
        error.node.destroy_node()
        return True

    context.on_callback_error = isolate
    bad.create_timer(0.1, lambda: 1 / 0)
    good.create_timer(0.1, lambda: ticks.append(context.now_ns))
    context.run_for(1.0)
    assert len(errors) == 1 and len(ticks) == 10 and bad not in context.nodes


def test_blocking_inside_a_callback_is_refused(context):
    node = Node("n")
    for blocking in (lambda: context.run_for(1.0), lambda: context.step(), lambda: node.executor.spin_once()):
        timer = node.create_timer(0.1, blocking)
        with pytest.raises(CallbackError) as caught:
            context.run_for(0.15)
        assert isinstance(caught.value.__cause__, ReentrancyError)
        node.destroy_timer(timer)


def test_destroyed_things_stop(context):
    node, seen = Node("n"), []
    publisher = node.create_publisher(String, "t", 1)
    subscription = node.create_subscription(String, "t", seen.append, 1)
    publisher.publish(String())
    assert node.destroy_subscription(subscription) and not node.destroy_subscription(subscription)
    context.run_for(0.1)
    assert seen == [] and node.count_subscribers("t") == 0 and node.count_publishers("t") == 1
    node.destroy_node()
    assert context.nodes == [] and context.topics == {}
    with pytest.raises(Exception, match="destroyed"):
        publisher.publish(String())


def test_time_does_not_run_backwards(context):
    context.run_for(1.0)
    with pytest.raises(InputError):
        context.run_until(0)


def random_graph(seed):
    """A random net of nodes that talk at equal times, with random costs, latencies and queue depths."""
    rng = random.Random(seed)
    context = SimContext(latency_ns=rng.choice([0, 1, MS]))
    log = DecisionLog(context)
    for index in range(6):
        node = Node(f"n{index}", context=context)
        publisher = node.create_publisher(Int64, f"t{rng.randrange(3)}", 10)
        cost = rng.choice([0, 0, MS, 7 * MS])

        def tick(publisher=publisher, node=node, cost=cost):
            charge(cost)
            publisher.publish(Int64(data=node.get_clock().now().nanoseconds))

        def relay(message, publisher=publisher, cost=cost, index=index):
            charge(cost)
            if message.data % 3 == index % 3:
                publisher.publish(Int64(data=message.data + 1))

        node.create_timer(rng.choice([0.005, 0.01, 0.01]), tick)
        node.create_subscription(Int64, f"t{rng.randrange(3)}", relay, rng.choice([1, 5]))
    context.run_until(200 * MS)
    return log


def test_a_run_is_a_function_of_its_seed(tmp_path):
    digests = set()
    for seed in range(5):
        first, second = random_graph(seed), random_graph(seed)
        assert first.to_bytes() == second.to_bytes() and len(first) > 50
        assert first.sha256() == second.sha256()
        digests.add(first.sha256())
    assert len(digests) == 5
    assert first.save(tmp_path / "log").read_bytes() == first.to_bytes()


def test_log_entries_hold_all_that_distinguishes_a_publication(context):
    node = Node("n")
    publisher = node.create_publisher(Int64, "t", 1)
    with DecisionLog(context) as log, DecisionLog(context, topics={"/other"}) as other:
        node.create_timer(0.01, lambda: publisher.publish(Int64(data=5)))
        context.run_until(10 * MS)
    context.run_until(20 * MS)  # closed: not recorded
    parts = [b"/t", b"std_msgs/msg/Int64", b"/n", serialize_message(Int64(data=5))]
    expected = struct.pack("<Q", 10 * MS) + b"".join(struct.pack("<I", len(part)) + part for part in parts)
    assert log.to_bytes() == expected and len(log) == 1 and log.counts == {"/t": 1}
    assert log.sha256() == hashlib.sha256(expected).hexdigest()
    assert len(other) == 0


def test_tap_sees_release_times_in_order(context):
    taps, node = [], Node("n")
    remove = context.add_tap(lambda *entry: taps.append(entry))
    publisher = node.create_publisher(String, "t", 1)
    node.create_timer(0.01, lambda: (charge(4 * MS), publisher.publish(String(data="a"))))
    context.run_until(25 * MS)
    assert [(time // MS, topic, kind, who) for time, topic, kind, who, _ in taps] == [
        (14, "/t", "std_msgs/msg/String", "/n"),
        (24, "/t", "std_msgs/msg/String", "/n"),
    ]
    remove()
    context.run_until(100 * MS)
    assert len(taps) == 2


def test_ties_are_resolved_by_creation_order(context):
    order, nodes = [], [Node(f"n{k}") for k in range(5)]
    for node in nodes:
        node.create_timer(0.01, lambda node=node: order.append(node.get_name()))
    context.run_until(20 * MS)
    assert order == [f"n{k}" for k in range(5)] * 2


def test_node_without_executor_keeps_its_work(context):
    node, seen = Node("n"), []
    node.executor.remove_node(node)
    node.create_subscription(String, "t", lambda m: seen.append(now_ms(node)), 10)
    node.create_publisher(String, "t", 1).publish(String())
    context.run_until(10 * MS)
    assert seen == []
    SingleThreadedExecutor().add_node(node)
    context.run_until(20 * MS)
    assert seen == [10.0]
