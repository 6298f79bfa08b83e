"""Callbacks that await another service, tasks, and what an exception in a service does."""

from conformance import attempt, executor_of, log, ros, spin_until
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger


def main() -> None:
    backend, frontend, user = Node("backend"), Node("frontend"), Node("user")
    executor = executor_of(backend, frontend, user)
    trace: list[str] = []

    def on_switch(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        trace.append(f"backend {request.data}")
        response.success = not request.data
        return response

    backend.create_service(SetBool, "switch", on_switch)
    group = ReentrantCallbackGroup()
    inner = frontend.create_client(SetBool, "switch", callback_group=group)

    async def on_trigger(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        trace.append("frontend starts")
        first = await inner.call_async(SetBool.Request(data=True))
        trace.append(f"frontend got {first.success}")
        second = await inner.call_async(SetBool.Request(data=False))
        trace.append(f"frontend got {second.success}")
        response.success = second.success
        response.message = "both"
        return response

    frontend.create_service(Trigger, "chain", on_trigger, callback_group=group)
    client = user.create_client(Trigger, "chain")
    assert client.wait_for_service(timeout_sec=10.0) and inner.wait_for_service(timeout_sec=10.0)
    future = client.call_async(Trigger.Request())
    executor.spin_until_future_complete(future, timeout_sec=10.0)
    log("chain", trace=trace, answer=future.result())

    # Three requests at once: each waits for the backend while the others go on.
    trace.clear()
    futures = [client.call_async(Trigger.Request()) for _ in range(3)]
    assert spin_until(executor, lambda: all(future.done() for future in futures))
    log(
        "interleaved",
        starts=trace.count("frontend starts"),
        backend=sum(line.startswith("backend") for line in trace),
        answers=[future.result().success for future in futures],
    )

    # A timer callback may await, too.
    steps: list[str] = []

    async def on_timer() -> None:
        timer.cancel()
        steps.append("before")
        answer = await inner.call_async(SetBool.Request(data=False))
        steps.append(f"after {answer.success}")

    timer = frontend.create_timer(0.01, on_timer, callback_group=group)
    assert spin_until(executor, lambda: len(steps) == 2)
    log("timer", steps=steps)

    # Tasks of the executor.
    async def coroutine(value: int) -> int:
        answer = await inner.call_async(SetBool.Request(data=True))
        return value + int(answer.success)

    task = executor.create_task(coroutine, 41)
    executor.spin_until_future_complete(task, timeout_sec=10.0)
    log("task", done=task.done(), result=task.result())
    plain_task = executor.create_task(lambda left, right: left + right, 2, 3)
    executor.spin_until_future_complete(plain_task, timeout_sec=10.0)
    log("plain task", result=plain_task.result())

    async def failing() -> None:
        raise ValueError("on purpose")

    task = executor.create_task(failing)
    attempt("spin over a failing task", lambda: executor.spin_until_future_complete(task, timeout_sec=1.0))
    log("failing task", done=task.done(), exception=type(task.exception()))
    attempt("its result", task.result)


if __name__ == "__main__":
    with ros():
        main()
