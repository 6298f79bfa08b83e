"""Services with costs, async callbacks, spinning, init and shutdown."""

from __future__ import annotations

import pytest
import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.srv import GetPlan
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from robotbrain.errors import InputError
from robotbrain.ros import CallbackError, ReentrancyError, SimContext, SimulationDeadlockError, charge
from robotbrain.ros.context import set_default_context
from robotbrain.ros.exceptions import NotInitializedException

MS = 1_000_000


def serve(node, cost_ms=0):
    def callback(request, response):
        charge(cost_ms * MS)
        response.success, response.message = request.data, "done"
        return response

    return node.create_service(SetBool, "set", callback)


def test_round_trip_takes_cost_and_two_latencies(context):
    context.latency_ns = 2 * MS
    server, caller, done = Node("server"), Node("caller"), []
    serve(server, cost_ms=30)
    client = caller.create_client(SetBool, "set")
    for _ in range(2):
        client.call_async(SetBool.Request(data=True)).add_done_callback(
            lambda f: done.append((context.now_ns // MS, f.result().success))
        )
    context.run_until(200 * MS)
    assert done == [(34, True), (64, True)]  # the second waits for the server's thread


def test_service_busy_with_a_topic(context):
    """One thread: the request waits until the 50 ms subscription callback is over."""
    server, caller, done = Node("server"), Node("caller"), []
    serve(server)
    server.create_subscription(String, "t", lambda m: charge(50 * MS), 10)
    caller.create_publisher(String, "t", 10).publish(String())
    future = caller.create_client(SetBool, "set").call_async(SetBool.Request())
    future.add_done_callback(lambda f: done.append(context.now_ns // MS))
    context.run_until(100 * MS)
    assert done == [50]


def test_get_plan_carries_messages(context):
    server, caller = Node("server"), Node("caller")

    def plan(request, response):
        response.plan.poses = [request.start, request.goal]
        return response

    server.create_service(GetPlan, "plan", plan)
    request = GetPlan.Request(goal=PoseStamped(), tolerance=0.1)
    request.goal.pose.position.x = 3.0
    result = caller.create_client(GetPlan, "plan").call(request)
    assert [pose.pose.position.x for pose in result.plan.poses] == [0.0, 3.0]
    assert result.plan.poses[1] == request.goal and result.plan.poses[1] is not request.goal


def test_async_callbacks_wait_without_holding_their_thread(context):
    server, brain, log = Node("server"), Node("brain"), []
    serve(server, cost_ms=30)
    client = brain.create_client(SetBool, "set", callback_group=ReentrantCallbackGroup())

    async def ask():
        timer.cancel()
        log.append(("asked", context.now_ns // MS))
        response = await client.call_async(SetBool.Request(data=True))
        log.append((response.message, context.now_ns // MS))

    async def relay(request, response):
        inner = await client.call_async(SetBool.Request(data=True))
        response.success, response.message = inner.success, "relayed"
        return response

    timer = brain.create_timer(0.01, ask)
    context.run_until(100 * MS)
    assert log == [("asked", 10), ("done", 40)]
    brain.create_service(Trigger, "relay", relay)
    future = server.create_client(Trigger, "relay").call_async(Trigger.Request())
    context.run_until(200 * MS)
    assert future.result().message == "relayed"


def test_awaiting_a_client_of_the_own_group_is_refused(context):
    """Genuine rclpy hangs: the group is busy until the coroutine returns, which waits for the group."""
    node = Node("n")
    serve(node)
    client = node.create_client(SetBool, "set")

    async def ask():
        await client.call_async(SetBool.Request())

    node.create_timer(0.1, ask)
    with pytest.raises(CallbackError, match="ReentrantCallbackGroup"):
        context.run_for(1.0)


def test_synchronous_call_in_a_callback_names_the_cure(context):
    node = Node("n")
    serve(node)
    client = node.create_client(SetBool, "set")
    node.create_timer(0.1, lambda: client.call(SetBool.Request()))
    with pytest.raises(CallbackError, match="call_async") as caught:
        context.run_for(1.0)
    assert isinstance(caught.value.__cause__, ReentrancyError)


def test_forgotten_return_and_wrong_types(context):
    node = Node("n")
    node.create_service(Trigger, "s", lambda request, response: None)
    client = node.create_client(Trigger, "s")
    client.call_async(Trigger.Request())
    with pytest.raises(CallbackError, match="return response"):
        context.run_for(1.0)
    with pytest.raises(TypeError, match=r"Trigger\.Request"):
        client.call_async(SetBool.Request())
    with pytest.raises(InputError, match="service type"):
        node.create_client(String, "x")
    with pytest.raises(InputError, match="second server"):
        node.create_service(Trigger, "s", lambda request, response: response)
    with pytest.raises(InputError, match=r"std_srvs/srv/Trigger, as /n"):
        node.create_client(SetBool, "s").service_is_ready()


def test_absent_service(context):
    node = Node("n")
    client = node.create_client(Trigger, "nowhere")
    assert not client.service_is_ready()
    assert not client.wait_for_service(timeout_sec=0.5) and context.now_ns == 500 * MS
    future = client.call_async(Trigger.Request())
    rclpy.spin_until_future_complete(node, future, timeout_sec=1.0)
    assert not future.done() and context.now_ns == 1500 * MS
    assert any("lost" in line.message for line in context.log_lines)
    with pytest.raises(SimulationDeadlockError):
        rclpy.spin_until_future_complete(node, future)
    with pytest.raises(SimulationDeadlockError, match="/nowhere"):
        while not client.wait_for_service(timeout_sec=1.0):
            pass
    with pytest.raises(TimeoutError):
        client.call(Trigger.Request(), timeout_sec=1.0)


def test_wait_for_service_lets_time_pass(context):
    node, late = Node("n"), Node("late")
    timer = late.create_timer(0.3, lambda: (timer.cancel(), late.create_service(Trigger, "s", lambda q, r: r)))
    assert node.create_client(Trigger, "s").wait_for_service(timeout_sec=1.0)
    assert context.now_ns == 300 * MS


def test_spin_once_runs_one_callback_of_the_node(context):
    a, b, log = Node("a"), Node("b"), []
    a.create_timer(0.1, lambda: log.append("a"))
    b.create_timer(0.03, lambda: log.append("b"))
    rclpy.spin_once(a)
    assert log == ["b", "b", "b", "a"] and context.now_ns == 100 * MS
    rclpy.spin_once(a, timeout_sec=0.05)
    assert log.count("a") == 1 and context.now_ns == 150 * MS


def test_spin_ends_at_shutdown_and_at_the_horizon(context):
    node, ticks = Node("n"), []

    def tick():
        ticks.append(context.now_ns)
        if len(ticks) == 3:
            rclpy.shutdown()

    node.create_timer(0.1, tick)
    rclpy.spin(node)
    assert len(ticks) == 3 and not rclpy.ok()
    with pytest.raises(NotInitializedException):
        Node("late")
    limited = SimContext()
    limited.horizon_ns = 250 * MS
    other = Node("n", context=limited)
    other.create_timer(0.1, lambda: None)
    with pytest.raises(ExternalShutdownException):
        rclpy.spin(other)
    assert limited.now_ns == 250 * MS and not limited.ok()


def test_shutdown_in_a_callback_stops_the_clock(context):
    Node("n").create_timer(0.1, context.shutdown)
    context.run_for(1.0)
    assert context.now_ns == 100 * MS and not context.ok() and not context.step()
    last = SimContext()
    last.schedule(100 * MS, lambda _: last.shutdown())
    last.run_for(1.0)
    assert last.now_ns == 100 * MS


def test_spin_with_nothing_to_do_returns(context):
    rclpy.spin(Node("n"))
    assert not rclpy.ok()


def test_init_and_shutdown():
    previous = set_default_context(None)
    try:
        assert not rclpy.ok()
        with pytest.raises(NotInitializedException, match="init"):
            Node("n")
        rclpy.init(args=["--ros-args", "-r", "a:=b"])
        with pytest.raises(RuntimeError, match="once"):
            rclpy.init()
        assert rclpy.create_node("n").resolve_topic_name("a") == "/b"
        rclpy.shutdown()
        with pytest.raises(RuntimeError):
            rclpy.shutdown()
        rclpy.init()
        assert rclpy.create_node("n").get_clock().now().nanoseconds == 0
        rclpy.try_shutdown()
        rclpy.try_shutdown()
    finally:
        set_default_context(previous)


def test_init_inside_a_harness_uses_its_context(context):
    rclpy.init()
    assert Node("n").context is context


def test_destroyed_client_hears_nothing(context):
    node = Node("n")
    serve(node)
    client = node.create_client(SetBool, "set")
    future = client.call_async(SetBool.Request())
    node.destroy_client(client)
    context.run_for(1.0)
    assert not future.done()
