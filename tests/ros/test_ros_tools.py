"""Tasks, rates, guard conditions, waiting for a message, the graph, message info, clocks and loggers."""

from __future__ import annotations

import threading
import time
from typing import Any

import pytest
import rclpy
from rcl_interfaces.msg import Log
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType, JumpThreshold, ROSClock
from rclpy.duration import Duration
from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.experimental import EventsExecutor
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.task import Future
from rclpy.timer import TimerInfo
from rclpy.utilities import remove_ros_args
from rclpy.wait_for_message import wait_for_message
from std_msgs.msg import Int64, String
from std_srvs.srv import Trigger

from robotbrain.errors import InputError
from robotbrain.ros import CallbackError, ReentrancyError, SimContext, SimulationDeadlockError, charge, sleep

MS = 1_000_000


def test_tasks_are_run_once_and_return_their_result(context: SimContext) -> None:
    executor = SingleThreadedExecutor()
    task = executor.create_task(lambda a, b: a + b, 2, b=3)
    assert not task.done()
    executor.spin_until_future_complete(task)
    assert task.result() == 5

    async def outer() -> int:
        return 1 + int(await executor.create_task(inner))

    async def inner() -> int:
        await sleep(node, 0.2)
        return 41

    node = Node("n")
    executor.add_node(node)
    task = executor.create_task(outer)
    executor.spin_until_future_complete(task)
    assert task.result() == 42 and context.now_ns == 200 * MS
    nothing: dict[str, int] = {}
    failing = executor.create_task(lambda: nothing["missing"])
    with pytest.raises(KeyError, match="missing") as caught:
        executor.spin_until_future_complete(failing)
    assert isinstance(caught.value, CallbackError) and isinstance(failing.exception(), KeyError)


def test_a_cancelled_task_goes_no_further(context: SimContext) -> None:
    node, trace = Node("n"), []

    async def run() -> None:
        trace.append("begun")
        await sleep(node, 0.1)
        trace.append("never")

    assert node.executor is not None
    task = node.executor.create_task(run)
    context.run_for(0.05)
    assert task.executing()
    task.cancel()
    context.run_for(1.0)
    assert trace == ["begun"] and task.cancelled() and not task.done()


def test_a_task_of_a_callback_starts_when_its_cost_is_over(context: SimContext) -> None:
    records: list[Any] = []
    context.add_callback_tap(records.append)
    node = Node("n")
    MultiThreadedExecutor(4).add_node(node)

    def tick() -> None:
        timer.cancel()
        assert node.executor is not None
        node.executor.create_task(work)
        charge(30 * MS)

    def work() -> None:
        charge(5 * MS)

    timer = node.create_timer(0.01, tick)
    context.run_for(0.1)
    assert [(r.kind, r.name, r.node, r.start_ns // MS, r.end_ns // MS) for r in records] == [
        ("timer", "tick", "/n", 10, 40),
        ("task", "work", "/n", 40, 45),
    ]


def test_spin_once_takes_one_callback_and_returns_when_it_is_over(context: SimContext) -> None:
    node = Node("n")
    seen: list[int] = []

    def take(message: Int64) -> None:
        seen.append(message.data)
        charge(20 * MS)

    node.create_subscription(Int64, "t", take, 10)
    publisher = node.create_publisher(Int64, "t", 10)
    for number in range(3):
        publisher.publish(Int64(data=number))
    for count in (1, 2, 3):
        rclpy.spin_once(node, timeout_sec=0.001)
        assert seen == list(range(count)) and context.now_ns == 20 * MS * count


@pytest.mark.parametrize("executor", [SingleThreadedExecutor, MultiThreadedExecutor, EventsExecutor])
def test_executors_are_context_managers_and_end(context: SimContext, executor: Any) -> None:
    with executor() as running:
        node = Node("n")
        running.add_node(node)
        node.create_timer(0.1, running.shutdown)
        running.spin()
        assert context.now_ns == 100 * MS and running.get_nodes() == []


def test_rates_keep_their_grid(context: SimContext) -> None:
    """2 ms of work in each round of 10 ms, once 25 ms: the grid is kept and what was missed is skipped."""
    node, times = Node("n"), []
    rate = node.create_rate(100.0)
    for work_ms in (2, 2, 25, 2, 2):
        context.run_for(work_ms * 1e-3)
        rate.sleep()
        times.append(context.now_ns // MS)
    assert times == [10, 20, 50, 60, 70]
    node.create_timer(0.001, rate.sleep)
    with pytest.raises(CallbackError, match="create_timer") as caught:
        context.run_for(0.1)
    assert isinstance(caught.value.__cause__, ReentrancyError)
    assert node.destroy_rate(rate)
    with pytest.raises(RuntimeError, match="destroyed"):
        rate.sleep()
    with pytest.raises(ValueError, match="frequency"):
        node.create_rate(0.0)


def test_guard_conditions(context: SimContext) -> None:
    node, calls = Node("n"), []
    guard = node.create_guard_condition(lambda: calls.append(context.now_ns))
    guard.trigger()
    guard.trigger()
    assert calls == []
    context.run_for(0.1)
    assert calls == [0]
    guard.trigger()
    assert node.destroy_guard_condition(guard) and not node.destroy_guard_condition(guard)
    context.run_for(0.1)
    assert len(calls) == 1


def test_waiting_for_a_message(context: SimContext) -> None:
    node, other = Node("n"), Node("other")
    publisher = other.create_publisher(Int64, "t", 10)
    timer = other.create_timer(0.3, lambda: publisher.publish(Int64(data=context.now_ns)))
    found, message = wait_for_message(Int64, node, "t", time_to_wait=1.0)
    assert found and message.data == context.now_ns == 300 * MS
    timer.cancel()
    assert wait_for_message(Int64, node, "t", time_to_wait=0.5) == (False, None)
    assert context.now_ns == 800 * MS and node.count_subscribers("t") == 0
    with pytest.raises(SimulationDeadlockError, match="wait_for_message"):
        wait_for_message(Int64, node, "t")


def test_message_info_says_when_it_left_and_came(context: SimContext) -> None:
    context.latency_ns = 3 * MS
    node, infos = Node("n"), []

    def on_message(message: Int64, info: dict[str, Any]) -> None:
        infos.append((info["source_timestamp"], info["received_timestamp"], info["publication_sequence_number"]))

    node.create_subscription(Int64, "t", on_message, 10)
    publisher = node.create_publisher(Int64, "t", 10)
    node.create_timer(0.1, lambda: (charge(5 * MS), publisher.publish(Int64())))
    context.run_for(0.25)
    assert infos == [(105 * MS, 108 * MS, 1), (205 * MS, 208 * MS, 2)]
    node.create_subscription(Int64, "t", lambda message, info=None: None, 1)
    with pytest.raises(InputError, match="one argument"):
        node.create_subscription(Int64, "t", lambda: None, 1)


def test_timers_can_tell_when_they_were_due(context: SimContext) -> None:
    node, infos = Node("n"), []

    def tick(info: Any) -> None:
        infos.append((info.expected_call_time.nanoseconds // MS, info.actual_call_time.nanoseconds // MS))
        charge(15 * MS)

    tick.__annotations__["info"] = TimerInfo
    with node.create_timer(0.01, tick, clock=Clock(clock_type=ClockType.STEADY_TIME)) as timer:
        assert timer.clock.clock_type == ClockType.STEADY_TIME
        context.run_for(0.05)
        timer.timer_period_ns = 20 * MS
        with pytest.raises(InputError, match="period"):
            timer.timer_period_ns = 0
    assert infos == [(10, 10), (20, 25), (30, 40)]


def test_sleeping_in_an_async_callback_hands_the_thread_back(context: SimContext) -> None:
    node, trace = Node("n"), []

    async def slow() -> None:
        timer.cancel()
        for _ in range(2):
            trace.append(("slow", context.now_ns // MS))
            await sleep(node, 0.025)

    timer = node.create_timer(0.01, slow, MutuallyExclusiveCallbackGroup())
    node.create_timer(0.02, lambda: trace.append(("fast", context.now_ns // MS)))
    context.run_until(50 * MS)
    assert trace == [("slow", 10), ("fast", 20), ("slow", 35), ("fast", 40)]


def test_the_graph(context: SimContext) -> None:
    robot, brain = Node("robot", namespace="/r1"), Node("brain")
    robot.create_publisher(String, "scan", qos_profile_sensor_data)
    brain.create_subscription(String, "/r1/scan", lambda m: None, qos_profile_sensor_data)
    robot.create_service(Trigger, "stop", lambda request, response: response)
    brain.create_client(Trigger, "/r1/stop")
    assert brain.get_publisher_names_and_types_by_node("robot", "/r1") == [("/r1/scan", ["std_msgs/msg/String"])]
    assert brain.get_subscriber_names_and_types_by_node("brain", "/") == [("/r1/scan", ["std_msgs/msg/String"])]
    assert ("/r1/stop", ["std_srvs/srv/Trigger"]) in brain.get_service_names_and_types_by_node("robot", "/r1")
    assert robot.get_client_names_and_types_by_node("brain", "/") == [("/r1/stop", ["std_srvs/srv/Trigger"])]
    assert (brain.count_services("/r1/stop"), robot.count_clients("stop"), brain.count_clients("none")) == (1, 1, 0)
    (info,) = brain.get_publishers_info_by_topic("/r1/scan")
    assert (info.node_name, info.node_namespace, info.topic_type) == ("robot", "/r1", "std_msgs/msg/String")
    assert info.endpoint_type.name == "PUBLISHER" and len(info.endpoint_gid) == 16
    (other,) = robot.get_subscriptions_info_by_topic("scan")
    assert other.endpoint_gid != info.endpoint_gid and other.qos_profile.depth == 5
    with pytest.raises(RuntimeError, match="/ghost"):
        brain.get_publisher_names_and_types_by_node("ghost", "/")
    assert brain.wait_for_node("r1/robot", 1.0) and not brain.wait_for_node("/ghost", 0.5)
    assert context.now_ns == 500 * MS
    brain.create_timer(0.2, lambda: "late" in brain.get_node_names() or Node("late"))
    assert brain.wait_for_node("late", -1) and context.now_ns == 700 * MS
    assert brain.get_fully_qualified_node_names() == ["/r1/robot", "/brain", "/late"]


def test_what_is_logged_can_be_heard(context: SimContext) -> None:
    node, quiet, lines = Node("n", namespace="/r"), Node("quiet", enable_rosout=False), []
    listener = Node("listener")
    listener.create_subscription(Log, "/rosout", lambda m: lines.append((m.name, m.level, m.msg, m.line > 0)), 10)
    node.get_logger().warning("one")
    node.get_logger().get_child("part").info("two")
    quiet.get_logger().error("three")
    get_logger("nobody").error("four")
    context.run_for(0.1)
    assert lines == [("r.n", 30, "one", True), ("r.n.part", 20, "two", True)]
    node.destroy_node()
    node.get_logger().warning("five")
    context.run_for(0.1)
    assert len(lines) == 2


def test_levels_hold_for_loggers_below(context: SimContext) -> None:
    logger = Node("n").get_logger()
    child = logger.get_child("part")
    logger.set_level(rclpy.logging.LoggingSeverity.ERROR)
    assert not child.warning("no") and not get_logger("n.part.more").info("no")
    child.set_level(rclpy.logging.LoggingSeverity.DEBUG)
    assert child.debug("yes") and not logger.warning("no")
    child.set_level(rclpy.logging.LoggingSeverity.UNSET)
    assert not child.warning("no") and get_logger("name").info("other loggers are as before")
    with pytest.raises(TypeError, match="text"):
        logger.error([1, 2])
    results = []
    for severity in (40, 50):
        try:
            results.append(logger.log("one place", severity))
        except ValueError:
            results.append("refused")
    assert results == [True, "refused"]


def test_clocks(context: SimContext) -> None:
    clock = Clock(clock_type=ClockType.ROS_TIME)
    assert isinstance(clock, ROSClock) and clock.ros_time_is_active
    context.run_for(1.5)
    steady = Clock(clock_type=ClockType.STEADY_TIME)
    assert steady.now().nanoseconds == clock.now().nanoseconds == 1500 * MS
    with pytest.raises(ValueError, match="clock type"):
        steady.sleep_until(clock.now())
    assert steady.sleep_for(Duration(seconds=0.5)) and context.now_ns == 2000 * MS
    clock.set_ros_time_override(clock.now() + Duration(seconds=5))
    assert clock.now().nanoseconds == 2000 * MS
    jumps: list[Any] = []
    threshold = JumpThreshold(min_forward=Duration(nanoseconds=1), min_backward=None)
    with clock.create_jump_callback(threshold, post_callback=jumps.append):
        context.run_for(10.0)
    assert jumps == [], "simulated time passes and does not jump"
    with pytest.raises(ValueError, match="min_backward"):
        JumpThreshold(min_forward=None, min_backward=Duration(seconds=1))


def test_an_uninitialised_context_is_not_ok() -> None:
    context = rclpy.Context()
    assert not context.ok()
    with pytest.raises(Exception, match="init"):
        Node("early", context=context)
    rclpy.init(context=context)
    assert context.ok() and Node("n", context=context).context is context
    assert rclpy.get_rmw_implementation_identifier() == "rmw_robotbrain_simulation"


def test_removing_a_pending_request_leaves_its_future(context: SimContext) -> None:
    node = Node("n")
    node.create_service(Trigger, "s", lambda request, response: response)
    client = node.create_client(Trigger, "s")
    future: Future = client.call_async(Trigger.Request())
    client.remove_pending_request(future)
    context.run_for(0.1)
    assert not future.done() and not future.cancelled()


def test_ros_arguments_are_removed() -> None:
    assert remove_ros_args(["prog", "a", "--ros-args", "-r", "x:=y", "--", "b", "--ros-args", "-p", "c:=1"]) == [
        "prog", "a", "b"
    ]  # fmt: skip


class Threads:
    """A service and a timer whose node is spun in a second thread."""

    def __init__(self) -> None:
        self.node, self.user = Node("server"), Node("user")
        self.node.create_service(Trigger, "s", lambda request, response: response)
        self.ticks: list[int] = []
        self.node.create_timer(0.05, lambda: self.ticks.append(threading.get_ident()))
        self.thread = threading.Thread(target=rclpy.spin, args=(self.node,), daemon=True)
        self.thread.start()


def test_a_spin_in_a_second_thread_goes_on_while_the_first_waits(context: SimContext) -> None:
    """Time passes only where the first thread waits in rclpy, so every run is the same."""
    threads = Threads()
    time.sleep(0.05)
    assert context.now_ns == 0 and threads.ticks == []
    client, rate = threads.user.create_client(Trigger, "s"), threads.user.create_rate(10.0)
    for round_ in range(1, 6):
        client.call(Trigger.Request())
        rate.sleep()
        assert context.now_ns == round_ * 100 * MS and len(threads.ticks) in (2 * round_ - 1, 2 * round_)
    assert set(threads.ticks) == {threading.get_ident()}
    rclpy.shutdown()
    threads.thread.join(10.0)
    assert not threads.thread.is_alive()


def test_a_spin_in_a_second_thread_runs_while_the_first_waits_for_it(context: SimContext) -> None:
    threads, done = Threads(), threading.Event()
    threads.node.create_timer(1.0, done.set)
    assert done.wait(10.0) and context.now_ns >= 1000 * MS
    threads.node.create_timer(1.0, rclpy.shutdown)
    threads.thread.join(10.0)
    assert not threads.thread.is_alive() and not rclpy.ok()
    assert threading.get_ident() not in threads.ticks
