"""An action: goal, feedback, result; succeed, abort, reject, an exception, and forgetting to set a state."""

from action_msgs.msg import GoalStatus
from conformance import attempt, executor_of, log, ros, spin_until
from rclpy.action import ActionClient, ActionServer, GoalResponse
from rclpy.node import Node
from test_msgs.action import Fibonacci

STATUS = {
    value: name.removeprefix("STATUS_")
    for name, value in (
        (name, getattr(GoalStatus, name))
        for name in (
            "STATUS_UNKNOWN",
            "STATUS_ACCEPTED",
            "STATUS_EXECUTING",
            "STATUS_CANCELING",
            "STATUS_SUCCEEDED",
            "STATUS_CANCELED",
            "STATUS_ABORTED",
        )
    )
}


class Server(Node):
    """Order 1 aborts, 2 raises, 3 forgets its state, negative orders are rejected."""

    def __init__(self) -> None:
        super().__init__("fibonacci_server")
        self.trace: list[str] = []
        self.server = ActionServer(
            self, Fibonacci, "fibonacci", execute_callback=self.execute, goal_callback=self.on_goal
        )

    def on_goal(self, request: Fibonacci.Goal) -> GoalResponse:
        self.trace.append(f"goal {request.order}")
        return GoalResponse.ACCEPT if request.order >= 0 else GoalResponse.REJECT

    def execute(self, handle) -> Fibonacci.Result:
        order = handle.request.order
        self.trace.append(f"execute {order} {STATUS[handle.status]} active={handle.is_active}")
        if order == 2:
            raise RuntimeError("on purpose")
        feedback = Fibonacci.Feedback(sequence=[0, 1])
        while len(feedback.sequence) < order:
            feedback.sequence.append(feedback.sequence[-1] + feedback.sequence[-2])
            handle.publish_feedback(feedback)
        if order == 1:
            handle.abort()
        elif order != 3:
            handle.succeed()
        self.trace.append(f"executed {order} {STATUS[handle.status]} active={handle.is_active}")
        return Fibonacci.Result(sequence=feedback.sequence)


def main() -> None:
    user = Node("user")
    client = ActionClient(user, Fibonacci, "fibonacci")
    log("not there", ready=client.server_is_ready(), waited=client.wait_for_server(timeout_sec=0.05))
    server = Server()
    executor = executor_of(server, user)
    log("there", waited=client.wait_for_server(timeout_sec=10.0))

    for order in (5, 0, 1, 2, 3, -1):
        feedbacks: list[list[int]] = []
        server.trace.clear()
        future = client.send_goal_async(
            Fibonacci.Goal(order=order), feedback_callback=lambda m, f=feedbacks: f.append(list(m.feedback.sequence))
        )
        executor.spin_until_future_complete(future, timeout_sec=10.0)
        handle = future.result()
        log("goal", order=order, accepted=handle.accepted)
        if handle.accepted:
            result_future = handle.get_result_async()
            executor.spin_until_future_complete(result_future, timeout_sec=10.0)
            answer = result_future.result()
            expected = max(0, order - 2) if order != 2 else 0
            spin_until(executor, lambda f=feedbacks, n=expected: len(f) == n)
            # The handle learns its state from the status topic, which may come later than the result.
            spin_until(executor, lambda h=handle, a=answer: h.status == a.status)
            log(
                "result",
                order=order,
                status=STATUS[answer.status],
                sequence=answer.result.sequence,
                kind=type(answer.result),
                feedback=feedbacks,
                handle_status=STATUS[handle.status],
            )
        log("server", order=order, trace=server.trace)

    # Asked again after the end, the result is still there.
    future = client.send_goal_async(Fibonacci.Goal(order=4))
    executor.spin_until_future_complete(future, timeout_sec=10.0)
    results = []
    for _ in range(2):
        result_future = future.result().get_result_async()
        executor.spin_until_future_complete(result_future, timeout_sec=10.0)
        results.append(result_future.result().result.sequence)
    log("asked twice", results=results)

    attempt("wrong goal type", lambda: client.send_goal_async(Fibonacci.Result()))
    log("goal id", length=len(future.result().goal_id.uuid), kind=type(future.result().goal_id))
    server.server.destroy()
    assert spin_until(executor, lambda: not client.server_is_ready())
    log("destroyed", ready=client.server_is_ready())


if __name__ == "__main__":
    with ros():
        main()
