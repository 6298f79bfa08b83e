"""One thread: one callback at a time, in which order those that are ready together, and what spin_once does."""

from conformance import attempt, await_match, executor_of, log, ros, settle, spin_until, steady
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import Int32
from std_srvs.srv import Trigger


def ready_together() -> None:
    """A timer, two subscriptions and a service get ready while the executor is busy with a callback."""
    node = Node("together")
    executor = executor_of(node)
    order: list[str] = []
    go = node.create_publisher(Int32, "go", 10)
    to_first, to_second = (node.create_publisher(Int32, name, 10) for name in ("first", "second"))
    client = node.create_client(Trigger, "serve")

    def on_go(message: Int32) -> None:
        order.append("busy")
        client.call_async(Trigger.Request())
        to_second.publish(message)
        to_first.publish(message)
        timer.reset()
        steady().sleep_for(Duration(seconds=0.2))

    def on_timer() -> None:
        timer.cancel()
        order.append("timer")

    def on_serve(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        order.append("service")
        return response

    timer = node.create_timer(0.05, on_timer, autostart=False)
    node.create_subscription(Int32, "go", on_go, 10)
    node.create_subscription(Int32, "first", lambda message: order.append("first"), 10)
    node.create_subscription(Int32, "second", lambda message: order.append("second"), 10)
    node.create_service(Trigger, "serve", on_serve)
    await_match(executor, (go, 1), (to_first, 1), (to_second, 1))
    assert client.wait_for_service(timeout_sec=10.0)
    go.publish(Int32())
    assert spin_until(executor, lambda: len(order) == 5)
    log("ready together", order=order, set=sorted(order))
    node.destroy_node()


def never_nested() -> None:
    """A publication within a callback is seen after it, never inside it."""
    node = Node("nested")
    executor = executor_of(node)
    trace: list[str] = []
    publisher = node.create_publisher(Int32, "countdown", 10)

    def on_count(message: Int32) -> None:
        trace.append(f"enter {message.data}")
        if message.data:
            publisher.publish(Int32(data=message.data - 1))
        trace.append(f"leave {message.data}")

    node.create_subscription(Int32, "countdown", on_count, 10)
    await_match(executor, (publisher, 1))
    publisher.publish(Int32(data=3))
    assert spin_until(executor, lambda: len(trace) == 8)
    log("never nested", trace=trace)
    node.destroy_node()


def spinning() -> None:
    """spin_once takes one callback; an empty wait ends with its time; nodes come and go."""
    node, other = Node("spinning"), Node("other")
    executor = SingleThreadedExecutor()
    log("add", first=executor.add_node(node), again=executor.add_node(node), second=executor.add_node(other))
    log("nodes", names=sorted(found.get_name() for found in executor.get_nodes()))
    seen: list[int] = []
    publisher = node.create_publisher(Int32, "numbers", 10)
    other.create_subscription(Int32, "numbers", lambda message: seen.append(message.data), 10)
    await_match(executor, (publisher, 1))
    clock = steady()
    start = clock.now()
    executor.spin_once(timeout_sec=0.1)
    log("nothing to do", waited=clock.now() - start >= Duration(seconds=0.09))
    for number in range(3):
        publisher.publish(Int32(data=number))
    settle()
    counts = []
    for _ in range(3):
        executor.spin_once(timeout_sec=1.0)
        counts.append(len(seen))
    log("one at a time", counts=counts, seen=seen)

    executor.remove_node(other)
    publisher.publish(Int32(data=10))
    settle()
    executor.spin_once(timeout_sec=0.05)
    log("without the node", seen=seen)
    executor.add_node(other)
    assert spin_until(executor, lambda: len(seen) == 4)
    log("with it again", seen=seen)
    log("executor", own=node.executor is executor, shutdown=executor.shutdown())
    attempt("spin after shutdown", lambda: executor.spin_once(timeout_sec=0.01))


def main() -> None:
    ready_together()
    never_nested()
    spinning()


if __name__ == "__main__":
    with ros():
        main()
