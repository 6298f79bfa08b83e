"""Message ids, callback records, filters and slowdown: what monitoring is built on."""

from __future__ import annotations

import itertools

import pytest
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import Int32
from std_srvs.srv import Trigger

from robotbrain.ros import CallbackRecord, MessageRecord, SimContext, charge
from robotbrain.ros.callback_groups import ReentrantCallbackGroup

MS = 1_000_000


@pytest.fixture
def seen(context: SimContext) -> tuple[list[CallbackRecord], list[MessageRecord]]:
    callbacks: list[CallbackRecord] = []
    messages: list[MessageRecord] = []
    context.add_callback_tap(callbacks.append)
    context.add_message_tap(lambda record, data: messages.append(record))
    return callbacks, messages


def relay(context: SimContext) -> list[tuple[int, int]]:
    """Timer -> /a -> relay -> /b -> sink; returns what the sink saw, as (time ns, number)."""
    seen: list[tuple[int, int]] = []
    source, middle, sink = Node("source"), Node("middle"), Node("sink")
    out, onward = source.create_publisher(Int32, "a", 10), middle.create_publisher(Int32, "b", 10)
    numbers = iter(range(1000))

    def tick() -> None:
        charge(2 * MS)
        out.publish(Int32(data=next(numbers)))

    def pass_on(msg: Int32) -> None:
        charge(3 * MS)
        onward.publish(msg)

    source.create_timer(0.01, tick)
    middle.create_subscription(Int32, "a", pass_on, 10)
    sink.create_subscription(Int32, "b", lambda msg: seen.append((context.now_ns, msg.data)), 10)
    return seen


def test_the_chain_from_timer_to_sink_can_be_followed_by_ids(context: SimContext, seen: tuple[list, list]) -> None:
    callbacks, messages = seen
    relay(context)
    context.run_for(0.05)
    by_message = {c.message: c for c in callbacks if c.message}
    sender = {m: c for c in callbacks for m in c.published}
    assert len({m.id for m in messages}) == len(messages) and {m.id for m in messages} <= set(sender)
    for message in messages:
        assert sender[message.id].node == message.node and sender[message.id].end_ns == message.released_ns
    ends = [c for c in callbacks if c.node == "/sink"]
    assert len(ends) == 4
    for end in ends:
        middle = sender[end.message]
        source = sender[middle.message]
        assert (middle.node, source.node, source.message) == ("/middle", "/source", 0)
        assert by_message[end.message] is end
        assert end.start_ns - source.ready_ns == 5 * MS


def test_service_calls_are_followed_there_and_back(context: SimContext, seen: tuple[list, list]) -> None:
    callbacks, messages = seen
    server, caller = Node("server"), Node("caller")

    def answer(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        charge(7 * MS)
        response.message = "done"
        return response

    server.create_service(Trigger, "work", answer)
    client = caller.create_client(Trigger, "work")
    timer = caller.create_timer(0.01, lambda: (timer.cancel(), client.call_async(Trigger.Request())))
    context.run_for(0.05)
    assert [(m.kind, m.name, m.node) for m in messages] == [
        ("request", "/work", "/caller"),
        ("response", "/work", "/server"),
    ]
    ticked, served, answered = callbacks
    assert (ticked.published, served.message) == ((messages[0].id,), messages[0].id)
    assert (served.published, answered.message, answered.kind) == ((messages[1].id,), messages[1].id, "client")
    assert messages[1].released_ns - messages[0].released_ns == 7 * MS


def test_a_coroutine_that_goes_on_is_traced_to_what_it_waited_for(context: SimContext, seen: tuple[list, list]) -> None:
    callbacks, messages = seen
    server, caller = Node("server"), Node("caller")
    server.create_service(Trigger, "work", lambda request, response: response)
    client = caller.create_client(Trigger, "work", callback_group=ReentrantCallbackGroup())
    publisher = caller.create_publisher(Int32, "out", 10)

    async def tick() -> None:
        timer.cancel()
        await client.call_async(Trigger.Request())
        publisher.publish(Int32())

    timer = caller.create_timer(0.01, tick)
    context.run_for(0.05)
    response = next(m for m in messages if m.kind == "response")
    out = next(m for m in messages if m.name == "/out")
    sender = next(c for c in callbacks if out.id in c.published)
    assert sender.message == response.id


def test_workers_are_numbered_and_never_do_two_things_at_once(context: SimContext, seen: tuple[list, list]) -> None:
    callbacks, _ = seen
    node = Node("n")
    executor = MultiThreadedExecutor(3)
    executor.add_node(node)
    group = ReentrantCallbackGroup()
    for k in range(4):
        node.create_timer(0.01, lambda k=k: charge((k + 4) * MS), group)
    context.run_for(0.2)
    assert {c.worker for c in callbacks} == {0, 1, 2} and len({c.executor for c in callbacks}) == 1
    for worker in range(3):
        mine = sorted((c.start_ns, c.end_ns) for c in callbacks if c.worker == worker)
        assert all(end <= start for (_, end), (start, _) in itertools.pairwise(mine))


def test_filters_drop_double_delay_and_change_messages(context: SimContext) -> None:
    seen = relay(context)
    from rclpy.serialization import deserialize_message, serialize_message

    def fault(record: MessageRecord, data: bytes) -> list[tuple[bytes, int]]:
        number = deserialize_message(data, Int32).data
        if number == 0:
            return []
        if number == 1:
            return [(data, 0), (data, 4 * MS)]
        if number == 2:
            return [(serialize_message(Int32(data=-2)), 20 * MS)]
        return [(data, 0)]

    published = []
    context.add_tap(lambda time, topic, *_: published.append(topic))
    remove = context.add_filter("/a", fault)
    context.run_for(0.055)
    # Published at 12, 22, 32, 42 and 52 ms; relayed 3 ms later. The second copy of 1 comes 4 ms late, and 2, changed
    # and 20 ms late, is overtaken by 3.
    assert seen == [(25 * MS, 1), (29 * MS, 1), (45 * MS, 3), (55 * MS, -2)]
    assert published.count("/a") == 5, "taps see what was published"
    remove()
    before = len(seen)
    context.run_for(0.1)
    assert len(seen) >= before + 9


def test_a_throttled_resource_takes_longer_from_now_on(context: SimContext, seen: tuple[list, list]) -> None:
    callbacks, _ = seen
    relay(context)
    context.run_for(0.031)
    context.slowdown["cpu"] = 1.5
    context.run_for(0.031)
    costs = [c.demand_ns for c in callbacks if c.node == "/source"]
    assert costs == [2 * MS] * 3 + [3 * MS] * 3
