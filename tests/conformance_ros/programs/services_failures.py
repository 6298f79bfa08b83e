"""What a service callback may not do: raise, or forget to return the response."""

from conformance import attempt, executor_of, log, ros
from rclpy.node import Node
from std_srvs.srv import Trigger


def run(name: str, callback) -> None:
    server, user = Node(f"server_{name}"), Node(f"user_{name}")
    executor = executor_of(server, user)
    server.create_service(Trigger, name, callback)
    client = user.create_client(Trigger, name)
    assert client.wait_for_service(timeout_sec=10.0)
    future = client.call_async(Trigger.Request())
    attempt(name, lambda: executor.spin_until_future_complete(future, timeout_sec=0.5))
    log(f"{name} future", done=future.done())
    for node in (server, user):
        executor.remove_node(node)
        node.destroy_node()


def raises(request, response):
    raise KeyError("planned")


def main() -> None:
    run("raises", raises)
    run("returns_nothing", lambda request, response: None)
    run("returns_another", lambda request, response: Trigger.Request())


if __name__ == "__main__":
    with ros():
        main()
