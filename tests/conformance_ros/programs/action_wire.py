"""The topics and services behind an action, status messages, deferred goals, and a goal by the bare service."""

from action_msgs.msg import GoalStatusArray
from conformance import executor_of, log, ros, spin_until
from rclpy.action import (
    ActionClient,
    ActionServer,
    get_action_client_names_and_types_by_node,
    get_action_names_and_types,
    get_action_server_names_and_types_by_node,
)
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from test_msgs.action import Fibonacci


def main() -> None:
    server, user = Node("server", namespace="/arm"), Node("user")
    executor = executor_of(server, user)
    handles = []

    def execute(handle) -> Fibonacci.Result:
        handle.succeed()
        return Fibonacci.Result(sequence=[1, 2, 3])

    ActionServer(server, Fibonacci, "reach", execute_callback=execute, handle_accepted_callback=handles.append)
    client = ActionClient(user, Fibonacci, "/arm/reach")
    assert client.wait_for_server(timeout_sec=10.0)

    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    statuses: list[list[int]] = []
    user.create_subscription(
        GoalStatusArray,
        "/arm/reach/_action/status",
        lambda message: statuses.append([status.status for status in message.status_list]),
        latched,
    )
    assert spin_until(executor, lambda: user.count_subscribers("/arm/reach/_action/status") == 2)

    future = client.send_goal_async(Fibonacci.Goal(order=3))
    executor.spin_until_future_complete(future, timeout_sec=10.0)
    assert spin_until(executor, lambda: statuses)
    log("deferred", accepted=future.result().accepted, handles=len(handles), statuses=statuses)
    result = future.result().get_result_async()
    handles[0].execute()
    executor.spin_until_future_complete(result, timeout_sec=10.0)
    assert spin_until(executor, lambda: statuses[-1] == [4])
    log("executed", status=result.result().status, last=statuses[-1])

    send = user.create_client(Fibonacci.Impl.SendGoalService, "/arm/reach/_action/send_goal")
    assert send.wait_for_service(timeout_sec=10.0)
    request = Fibonacci.Impl.SendGoalService.Request()
    request.goal_id.uuid[:] = range(16)
    request.goal.order = 9
    answers = []
    for _ in range(2):
        answer = send.call_async(request)
        executor.spin_until_future_complete(answer, timeout_sec=10.0)
        answers.append(answer.result().accepted)
    log("bare service, then the same id again", accepted=answers, orders=[handle.request.order for handle in handles])

    hidden = [(name, types) for name, types in user.get_topic_names_and_types() if "reach" in name]
    log("topics", shown=sorted(hidden))
    services = [(name, types) for name, types in user.get_service_names_and_types() if "reach" in name]
    log("services", shown=sorted(services))
    log("actions", found=get_action_names_and_types(user))
    log("by server", found=get_action_server_names_and_types_by_node(user, "server", "/arm"))
    log("by client", found=get_action_client_names_and_types_by_node(user, "user", "/"))


if __name__ == "__main__":
    with ros():
        main()
