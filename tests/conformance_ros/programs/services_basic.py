"""A service answered at once: availability, calls, several clients, wrong types, time limits."""

from conformance import attempt, executor_of, log, ros, spin_until
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger


def main() -> None:
    lonely = Node("lonely")
    nobody = lonely.create_client(Trigger, "nobody")
    log("not there", ready=nobody.service_is_ready(), waited=nobody.wait_for_service(timeout_sec=0.05))
    lost = nobody.call_async(Trigger.Request())
    lonely_executor = executor_of(lonely)
    lonely_executor.spin_until_future_complete(lost, timeout_sec=0.1)
    log("lost call", done=lost.done(), cancelled=lost.cancelled(), result=lost.result(), exception=lost.exception())
    attempt("blocking call without an answer", lambda: nobody.call(Trigger.Request(), timeout_sec=0.1))
    nobody.remove_pending_request(lost)
    log("removed", done=lost.done(), cancelled=lost.cancelled())

    server, first, second = Node("server"), Node("first"), Node("second", namespace="/other")
    executor = executor_of(server, first, second)
    calls: list[bool] = []

    def on_set(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        calls.append(request.data)
        response.success = request.data
        response.message = f"call {len(calls)}"
        return response

    service = server.create_service(SetBool, "switch", on_set)
    clients = [first.create_client(SetBool, "switch"), second.create_client(SetBool, "/switch")]
    log("names", service=service.srv_name, clients=[client.srv_name for client in clients])
    log("there", waited=[client.wait_for_service(timeout_sec=10.0) for client in clients])

    for number, client in enumerate(clients):
        future = client.call_async(SetBool.Request(data=bool(number)))
        log("before spinning", done=future.done())
        executor.spin_until_future_complete(future, timeout_sec=10.0)
        log("answer", done=future.done(), result=future.result(), kind=type(future.result()))
    log("server saw", calls=calls)

    # One server, many requests at once: everybody gets the own answer.
    futures = [clients[number % 2].call_async(SetBool.Request(data=number % 3 == 0)) for number in range(6)]
    assert spin_until(executor, lambda: all(future.done() for future in futures))
    log("many", success=[future.result().success for future in futures])
    log("numbered", messages=sorted(future.result().message for future in futures))

    order: list[str] = []
    future = clients[0].call_async(SetBool.Request(data=True))
    future.add_done_callback(lambda done: order.append(f"one {done.result().success}"))
    future.add_done_callback(lambda done: order.append("two"))
    assert spin_until(executor, lambda: len(order) == 2)
    future.add_done_callback(lambda done: order.append("too late"))
    spin_until(executor, lambda: len(order) == 3, 1.0)
    log("done callbacks", order=order)

    attempt("request of another type", lambda: clients[0].call_async(Trigger.Request()))
    attempt("request class", lambda: clients[0].call_async(SetBool.Request))
    attempt("wrong field", lambda: SetBool.Request(datum=True))
    attempt("wrong value", lambda: SetBool.Request(data="yes"))
    attempt("client of a message", lambda: first.create_client(SetBool.Request, "x"))
    log("counts", servers=first.count_services("switch"), clients=first.count_clients("switch"))

    log("destroyed", result=server.destroy_service(service))
    assert spin_until(executor, lambda: not clients[0].service_is_ready())
    log("gone", ready=clients[0].service_is_ready())


if __name__ == "__main__":
    with ros():
        main()
