"""Actions: the state machine, feedback and results in simulated time, cancelling, and what is on the wire."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import rclpy
from action_msgs.msg import GoalStatus, GoalStatusArray
from action_msgs.srv import CancelGoal
from example_interfaces.action import Fibonacci
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.action import (
    ActionClient,
    ActionServer,
    CancelResponse,
    GoalResponse,
    get_action_client_names_and_types_by_node,
    get_action_names_and_types,
    get_action_server_names_and_types_by_node,
)
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String

from robotbrain.errors import InputError
from robotbrain.ros import CallbackError, SimContext, SimulationDeadlockError, charge, sleep
from robotbrain.ros.action.goals import ACTIVE, TRANSITIONS, GoalEvent, GoalState, next_state
from robotbrain.ros.exceptions import RCLError
from robotbrain.ros.record import DecisionLog
from robotbrain.ros.typedefs import struct_def

MS = 1_000_000
STEP = 0.1


def fibonacci(order: int) -> list[int]:
    sequence = [0, 1]
    while len(sequence) < order:
        sequence.append(sequence[-1] + sequence[-2])
    return sequence


class Pair:
    """A server whose goals take ``STEP`` seconds a number, and a client."""

    def __init__(self, execute: Callable[[Any], Any] | None = None, **options: Any) -> None:
        self.server_node, self.client_node = Node("server"), Node("client")
        self.handles: list[Any] = []
        self.server = ActionServer(self.server_node, Fibonacci, "fib", execute or self.stages, **options)
        self.client = ActionClient(self.client_node, Fibonacci, "fib")
        self.feedback: list[tuple[int, list[int]]] = []

    async def stages(self, handle: Any) -> Any:
        self.handles.append(handle)
        sequence: list[int] = []
        for number in fibonacci(handle.request.order):
            if handle.is_cancel_requested:
                handle.canceled()
                return Fibonacci.Result(sequence=sequence)
            sequence.append(number)
            handle.publish_feedback(Fibonacci.Feedback(sequence=sequence))
            await sleep(self.server_node, STEP)
        handle.succeed()
        return Fibonacci.Result(sequence=sequence)

    def send(self, order: int) -> Any:
        context = self.client_node.context

        def on_feedback(message: Any) -> None:
            self.feedback.append((context.now_ns // MS, list(message.feedback.sequence)))

        future = self.client.send_goal_async(Fibonacci.Goal(order=order), feedback_callback=on_feedback)
        rclpy.spin_until_future_complete(self.client_node, future, timeout_sec=1.0)
        return future.result()


def test_stages_take_their_time_and_feedback_arrives_as_they_go(context: SimContext) -> None:
    pair = Pair()
    handle = pair.send(5)
    assert handle.accepted and context.now_ns == 0
    answer = handle.get_result()
    numbers = fibonacci(5)
    assert list(answer.result.sequence) == numbers and answer.status == GoalStatus.STATUS_SUCCEEDED
    assert context.now_ns == 5 * 100 * MS
    assert pair.feedback == [(100 * k, numbers[: k + 1]) for k in range(5)]
    assert handle.status == GoalStatus.STATUS_SUCCEEDED == pair.handles[0].status


@pytest.mark.parametrize("after_ms", [50, 150, 250])
def test_a_cancel_request_arrives_between_the_stages(context: SimContext, after_ms: int) -> None:
    """It is noticed at the next stage: the goal ends at the next multiple of 100 ms."""
    pair = Pair(cancel_callback=lambda goal: CancelResponse.ACCEPT)
    handle = pair.send(10)
    result = handle.get_result_async()
    context.run_until(after_ms * MS)
    assert pair.handles[0].status == GoalStatus.STATUS_EXECUTING
    answer = handle.cancel_goal()
    assert answer.return_code == CancelGoal.Response.ERROR_NONE and len(answer.goals_canceling) == 1
    assert answer.goals_canceling[0].goal_id == handle.goal_id
    assert pair.handles[0].is_cancel_requested and pair.handles[0].is_active
    rclpy.spin_until_future_complete(pair.client_node, result)
    assert context.now_ns == (after_ms // 100 + 1) * 100 * MS
    assert result.result().status == GoalStatus.STATUS_CANCELED
    assert list(result.result().result.sequence) == fibonacci(10)[: after_ms // 100 + 1]
    again = handle.cancel_goal()
    assert again.return_code == CancelGoal.Response.ERROR_GOAL_TERMINATED and again.goals_canceling == []


def test_cancelling_is_refused_by_default(context: SimContext) -> None:
    pair = Pair()
    handle = pair.send(3)
    assert handle.cancel_goal().goals_canceling == []
    assert handle.get_result().status == GoalStatus.STATUS_SUCCEEDED


def test_cancel_requests_by_time_and_of_all(context: SimContext) -> None:
    """A request with a stamp is about goals accepted by then; an empty one about all."""
    pair = Pair(cancel_callback=lambda goal: CancelResponse.ACCEPT)
    client = pair.client_node.create_client(CancelGoal, "fib/_action/cancel_goal")
    handles = []
    for _ in range(3):
        handles.append(pair.send(50))
        context.run_for(0.3)
    request = CancelGoal.Request()
    request.goal_info.stamp = handles[1].stamp
    assert len(client.call(request).goals_canceling) == 2
    assert [goal.is_cancel_requested for goal in pair.handles] == [True, True, False]
    assert len(client.call(CancelGoal.Request()).goals_canceling) == 1  # the other two are being cancelled already
    unknown = CancelGoal.Request()
    unknown.goal_info.goal_id.uuid[:] = 7
    assert client.call(unknown).return_code == CancelGoal.Response.ERROR_UNKNOWN_GOAL_ID


def test_a_plain_callback_costs_what_it_charges_and_its_feedback_leaves_at_its_end(context: SimContext) -> None:
    seen: list[bool] = []

    def execute(handle: Any) -> Any:
        for _ in range(3):
            handle.publish_feedback(Fibonacci.Feedback(sequence=[1]))
            charge(100 * MS)
            seen.append(handle.is_cancel_requested)
        handle.succeed()
        return Fibonacci.Result(sequence=[1, 1])

    pair = Pair(execute, cancel_callback=lambda goal: CancelResponse.ACCEPT)
    handle = pair.send(3)
    result = handle.get_result_async()
    context.run_until(150 * MS)
    handle.cancel_goal()
    rclpy.spin_until_future_complete(pair.client_node, result)
    assert context.now_ns == 300 * MS and result.result().status == GoalStatus.STATUS_SUCCEEDED
    assert [time for time, _ in pair.feedback] == [300] * 3 and seen == [False] * 3


def test_one_thread_does_one_goal_at_a_time_and_two_do_two(context: SimContext) -> None:
    def ends(threads: int) -> list[int]:
        simulation = SimContext()
        with simulation.as_default():
            pair = Pair(lambda handle: (charge(100 * MS), handle.succeed(), Fibonacci.Result())[-1])
            MultiThreadedExecutor(threads).add_node(pair.server_node)
            times: list[int] = []
            for _ in range(2):
                sent = pair.client.send_goal_async(Fibonacci.Goal())
                sent.add_done_callback(
                    lambda future: (
                        future.result()
                        .get_result_async()
                        .add_done_callback(lambda _: times.append(simulation.now_ns // MS))
                    )
                )
            simulation.run_for(1.0)
        return times

    assert ends(1) == [200, 200]  # the requests for results wait for the thread, too
    assert ends(4) == [100, 100]


def test_goals_can_be_rejected_deferred_and_executed_otherwise(context: SimContext) -> None:
    accepted: list[Any] = []
    pair = Pair(
        goal_callback=lambda goal: GoalResponse.ACCEPT if goal.order > 0 else GoalResponse.REJECT,
        handle_accepted_callback=accepted.append,
    )
    assert not pair.send(-1).accepted and accepted == []
    handle = pair.send(2)
    context.run_for(5.0)
    assert handle.accepted and [goal.status for goal in accepted] == [GoalStatus.STATUS_ACCEPTED]

    def other(goal: Any) -> Any:
        goal.abort()
        return Fibonacci.Result(sequence=[9])

    accepted[0].execute(other)
    answer = handle.get_result()
    assert answer.status == GoalStatus.STATUS_ABORTED and list(answer.result.sequence) == [9]


@pytest.mark.parametrize("asynchronous", [False, True])
def test_a_failing_or_forgetful_callback_aborts_and_the_server_survives(
    context: SimContext, asynchronous: bool
) -> None:
    def act(handle: Any) -> Any:
        if handle.request.order == 1:
            raise ZeroDivisionError("on purpose")
        return Fibonacci.Result(sequence=[5])

    async def act_later(handle: Any) -> Any:
        await sleep(pair.server_node, STEP)
        return act(handle)

    pair = Pair(act_later if asynchronous else act)
    failed, forgot = pair.send(1).get_result(), pair.send(2).get_result()
    assert (failed.status, list(failed.result.sequence)) == (GoalStatus.STATUS_ABORTED, [])
    assert (forgot.status, list(forgot.result.sequence)) == (GoalStatus.STATUS_ABORTED, [5])
    texts = [line.message for line in context.log_lines]  # type: ignore[attr-defined]
    assert any("ZeroDivisionError: on purpose" in text for text in texts)
    assert any("state not set" in text for text in texts)


def test_a_callback_that_returns_no_result_is_told(context: SimContext) -> None:
    pair = Pair(lambda handle: handle.succeed())
    with pytest.raises(CallbackError, match="return result"):
        pair.send(1)


def test_results_are_kept_for_a_while(context: SimContext) -> None:
    pair = Pair(result_timeout=2)
    handle = pair.send(1)
    for _ in range(2):
        assert handle.get_result().status == GoalStatus.STATUS_SUCCEEDED
    assert context.now_ns == 200 * MS
    context.run_until(2199 * MS)
    assert handle.get_result().status == GoalStatus.STATUS_SUCCEEDED
    context.run_until(2200 * MS)
    assert handle.get_result().status == GoalStatus.STATUS_UNKNOWN == pair.handles[0].status


def test_blocking_calls_in_a_callback_name_the_cure(context: SimContext) -> None:
    pair = Pair()
    timer = pair.client_node.create_timer(0.1, lambda: pair.client.send_goal(Fibonacci.Goal()))
    with pytest.raises(CallbackError, match=r"\.\.\._async"):
        context.run_for(0.1)
    timer.destroy()
    # Inside an execute callback the error is logged, as rclpy does, with the cure.
    rate = pair.server_node.create_rate(10.0)
    pair.server.register_execute_callback(lambda handle: rate.sleep())
    assert pair.send(1).get_result().status == GoalStatus.STATUS_ABORTED
    assert any("await robotbrain.ros.sleep" in line.message for line in context.log_lines)  # type: ignore[attr-defined]


def test_a_goal_sent_by_an_async_callback_of_the_same_group_is_refused(context: SimContext) -> None:
    pair = Pair()

    async def ask() -> None:
        timer.cancel()
        await pair.client.send_goal_async(Fibonacci.Goal(order=1))

    timer = pair.client_node.create_timer(0.1, ask)
    with pytest.raises(CallbackError, match="ReentrantCallbackGroup"):
        context.run_for(1.0)


def test_waiting_for_a_server(context: SimContext) -> None:
    node = Node("client")
    client = ActionClient(node, Fibonacci, "fib")
    assert not client.wait_for_server(timeout_sec=0.5) and context.now_ns == 500 * MS
    with pytest.raises(SimulationDeadlockError, match="/fib"):
        client.wait_for_server()
    other = Node("other")
    servers: list[ActionServer] = []

    def begin() -> None:
        if not servers:
            servers.append(ActionServer(other, Fibonacci, "fib", lambda goal: Fibonacci.Result()))

    other.create_timer(0.3, begin)
    assert client.wait_for_server(timeout_sec=1.0) and context.now_ns == 800 * MS
    other.destroy_node()
    assert not client.server_is_ready()


def test_the_wire_has_ros_names_and_types_and_late_listeners_get_the_status(context: SimContext) -> None:
    log = DecisionLog(context)
    pair = Pair()
    pair.send(2).get_result()
    base = "example_interfaces/action/Fibonacci"
    assert get_action_names_and_types(pair.client_node) == [("/fib", [base])]
    assert get_action_server_names_and_types_by_node(pair.client_node, "server", "/") == [("/fib", [base])]
    assert get_action_client_names_and_types_by_node(pair.client_node, "client", "/") == [("/fib", [base])]
    services = dict(pair.client_node.get_service_names_and_types())
    assert services["/fib/_action/send_goal"] == [f"{base}_SendGoal"]
    assert services["/fib/_action/get_result"] == [f"{base}_GetResult"]
    assert services["/fib/_action/cancel_goal"] == ["action_msgs/srv/CancelGoal"]
    assert log.counts == {"/fib/_action/feedback": 2, "/fib/_action/status": 3}
    seen: list[list[int]] = []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    pair.client_node.create_subscription(
        GoalStatusArray, "fib/_action/status", lambda m: seen.append([s.status for s in m.status_list]), latched
    )
    context.run_for(0.1)
    assert seen == [[GoalStatus.STATUS_SUCCEEDED]]


def test_two_runs_have_the_same_goal_ids(context: SimContext) -> None:
    def run() -> tuple[str, list[bytes]]:
        simulation = SimContext()
        with simulation.as_default():
            log = DecisionLog(simulation)
            pair = Pair()
            ids = [pair.send(2).goal_id.uuid.tobytes() for _ in range(3)]
            simulation.run_for(1.0)
            return log.sha256(), ids

    first, second = run(), run()
    assert first == second and len(set(first[1])) == 3


def test_a_goal_id_is_taken_once(context: SimContext) -> None:
    pair = Pair()
    known = pair.send(3).goal_id
    future = pair.client.send_goal_async(Fibonacci.Goal(order=3), goal_uuid=known)
    rclpy.spin_until_future_complete(pair.client_node, future)
    assert not future.result().accepted


def test_wrong_types_are_refused(context: SimContext) -> None:
    pair = Pair()
    with pytest.raises(TypeError, match=r"Fibonacci\.Goal"):
        pair.client.send_goal_async(Fibonacci.Result())
    with pytest.raises(InputError, match="action class"):
        ActionClient(pair.client_node, String, "x")
    with pytest.raises(TypeError, match="callable"):
        ActionServer(pair.server_node, Fibonacci, "other", None)
    with pytest.raises(InputError, match="second server"):
        ActionServer(pair.client_node, Fibonacci, "fib", lambda goal: None)
    pair.send(1)
    context.run_for(1.0)
    with pytest.raises(TypeError, match="Feedback"):
        pair.handles[0].publish_feedback(Fibonacci.Goal())
    with pytest.raises(RCLError, match="SUCCEEDED has no transition ABORT"):
        pair.handles[0].abort()


def test_destroying_removes_all_parts(context: SimContext) -> None:
    pair = Pair()
    pair.server.destroy()
    pair.client.destroy()
    assert not [name for name in (*context.services, *context.topics) if "_action" in name]
    other = Pair.__new__(Pair)
    assert isinstance(other, Pair) and pair.server_node.destroy_node() is None


@settings(max_examples=50, deadline=None)
@given(st.lists(st.sampled_from(list(GoalEvent)), max_size=8))
def test_a_goal_that_is_over_stays_so(events: list[GoalEvent]) -> None:
    state = GoalState.ACCEPTED
    for event in events:
        if (state, event) in TRANSITIONS:
            assert state in ACTIVE
            state = next_state(state, event)
        else:
            with pytest.raises(RCLError, match=state.name):
                next_state(state, event)
    assert (state in ACTIVE) == any(source == state for source, _ in TRANSITIONS)


@pytest.mark.parametrize(
    "path",
    ["nav2_msgs.action.NavigateToPose", "nav2_msgs.action.FollowPath", "nav2_msgs.action.ComputePathToPose",
     "nav2_msgs.action.Wait", "control_msgs.action.FollowJointTrajectory", "control_msgs.action.GripperCommand",
     "tf2_msgs.action.LookupTransform", "test_msgs.action.Fibonacci"],
)  # fmt: skip
def test_the_actions_that_come_with_the_kit(path: str) -> None:
    module, _, name = path.rpartition(".")
    action = getattr(__import__(module, fromlist=[name]), name)
    for part in ("Goal", "Result", "Feedback"):
        message = getattr(action, part)()
        assert type(message).__name__ == f"{name}_{part}"
    assert action.Impl.SendGoalService.Request(goal=action.Goal()).goal == action.Goal()
    assert [field for field, _ in struct_def(f"{module.replace('.', '/')}/{name}_GetResult_Response").fields] == [
        "status",
        "result",
    ]
    with pytest.raises(NotImplementedError, match=r"Goal\(\)"):
        action()
