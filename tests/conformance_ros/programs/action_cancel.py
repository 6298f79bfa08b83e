"""Cancelling: accepted, rejected, of a finished goal, of one among two; deferred execution; goals side by side."""

from action_msgs.msg import GoalStatus
from action_msgs.srv import CancelGoal
from conformance import executor_of, log, ros, spin_until
from rclpy.action import ActionClient, ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.task import Future
from test_msgs.action import Fibonacci

CODES = {
    getattr(CancelGoal.Response, name): name
    for name in ("ERROR_NONE", "ERROR_REJECTED", "ERROR_UNKNOWN_GOAL_ID", "ERROR_GOAL_TERMINATED")
}


class Server(Node):
    """Executes until it is released or cancelled; an odd order cannot be cancelled."""

    def __init__(self) -> None:
        super().__init__("server")
        self.trace: list[str] = []
        self.gates: dict[int, Future] = {}
        self.server = ActionServer(
            self,
            Fibonacci,
            "work",
            execute_callback=self.execute,
            goal_callback=lambda request: GoalResponse.ACCEPT,
            cancel_callback=self.on_cancel,
            callback_group=ReentrantCallbackGroup(),
        )

    def on_cancel(self, handle) -> CancelResponse:
        order = handle.request.order
        self.trace.append(f"cancel {order}?")
        if order % 2:
            return CancelResponse.REJECT
        self.gates[order].set_result("cancel")
        return CancelResponse.ACCEPT

    async def execute(self, handle) -> Fibonacci.Result:
        order = handle.request.order
        self.gates[order] = Future()
        self.trace.append(f"start {order} status={handle.status}")
        why = await self.gates[order]
        if why == "cancel":
            # The state changes to CANCELING after the cancel callback has returned.
            while not handle.is_cancel_requested:
                await pause(self)
            self.trace.append(f"canceling {order} status={handle.status}")
            handle.canceled()
        else:
            handle.succeed()
        self.trace.append(f"end {order} status={handle.status}")
        return Fibonacci.Result(sequence=[order])


def pause(node: Node) -> Future:
    """Return a future that is done a little later."""
    future = Future()

    def wake() -> None:
        timer.cancel()
        future.set_result(None)

    timer = node.create_timer(0.005, wake, callback_group=ReentrantCallbackGroup())
    return future


def main() -> None:
    server, user = Server(), Node("user")
    executor = executor_of(server, user)
    client = ActionClient(user, Fibonacci, "work")
    assert client.wait_for_server(timeout_sec=10.0)

    def wait(future):
        executor.spin_until_future_complete(future, timeout_sec=10.0)
        return future.result()

    def start(order: int):
        handle = wait(client.send_goal_async(Fibonacci.Goal(order=order)))
        assert spin_until(executor, lambda: order in server.gates)
        return handle, handle.get_result_async()

    handle, result = start(2)
    answer = wait(handle.cancel_goal_async())
    log("accepted", code=CODES[answer.return_code], canceling=len(answer.goals_canceling))
    log("accepted result", status=wait(result).status, sequence=wait(result).result.sequence, trace=server.trace)
    log("canceled", is_canceled=wait(result).status == GoalStatus.STATUS_CANCELED)
    answer = wait(handle.cancel_goal_async())
    log("again", code=CODES[answer.return_code], canceling=len(answer.goals_canceling))

    server.trace.clear()
    handle, result = start(3)
    answer = wait(handle.cancel_goal_async())
    log("rejected", code=CODES[answer.return_code], canceling=len(answer.goals_canceling))
    server.gates[3].set_result("go")
    log("rejected result", status=wait(result).status, sequence=wait(result).result.sequence, trace=server.trace)

    server.trace.clear()
    (first, first_result), (second, second_result) = start(4), start(6)
    answer = wait(second.cancel_goal_async())
    log("one of two", code=CODES[answer.return_code], same_goal=answer.goals_canceling[0].goal_id == second.goal_id)
    status = wait(second_result).status
    log("second ends first", second=status, first_done=first_result.done())
    server.gates[4].set_result("go")
    log("first", status=wait(first_result).status, trace=server.trace)
    log("different goals", same=first.goal_id == second.goal_id)

    # Unknown to a server that never saw it: a goal id of another client's making.
    cancel = user.create_client(CancelGoal, "work/_action/cancel_goal")
    assert cancel.wait_for_service(timeout_sec=10.0)
    request = CancelGoal.Request()
    request.goal_info.goal_id.uuid[:] = 7
    log("unknown goal", code=CODES[wait(cancel.call_async(request)).return_code])
    (_, third_result), (_, fourth_result) = start(8), start(10)
    answer = wait(cancel.call_async(CancelGoal.Request()))
    log("cancel all", code=CODES[answer.return_code], canceling=len(answer.goals_canceling))
    log("all canceled", status=[wait(third_result).status, wait(fourth_result).status])


if __name__ == "__main__":
    with ros():
        main()
