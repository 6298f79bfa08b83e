"""Starting and ending: init twice, nodes before and after, use after destruction, contexts, with blocks."""

import rclpy
from conformance import attempt, await_match, executor_of, log, spin_for
from rclpy.context import Context
from rclpy.node import Node
from std_msgs.msg import Int32
from std_srvs.srv import Trigger


def main() -> None:
    log("before init", ok=rclpy.ok())
    attempt("node before init", lambda: Node("early"))
    rclpy.init(args=[])
    log("init", ok=rclpy.ok())
    attempt("init again", lambda: rclpy.init(args=[]))
    node = Node("node")
    executor = executor_of(node)
    seen: list[int] = []
    publisher = node.create_publisher(Int32, "numbers", 10)
    subscription = node.create_subscription(Int32, "numbers", lambda message: seen.append(message.data), 10)
    client, service = node.create_client(Trigger, "it"), node.create_service(Trigger, "it", lambda q, a: a)
    await_match(executor, (publisher, 1))
    log(
        "entities",
        publishers=[entity.topic_name for entity in node.publishers if entity.topic_name == "/numbers"],
        subscriptions=[entity.topic_name for entity in node.subscriptions],
        clients=[entity.srv_name for entity in node.clients],
        services=sorted(entity.srv_name for entity in node.services if entity.srv_name == "it"),
    )
    log("destroy", first=node.destroy_subscription(subscription), again=node.destroy_subscription(subscription))
    publisher.publish(Int32(data=1))
    spin_for(executor, 0.1)
    log("after destroying the subscription", seen=seen)
    node.destroy_publisher(publisher)
    attempt("publish on a destroyed publisher", lambda: publisher.publish(Int32()))
    node.destroy_client(client)
    attempt("call of a destroyed client", lambda: client.call_async(Trigger.Request()) and None)
    node.destroy_service(service)
    timer = node.create_timer(1.0, lambda: None)
    node.destroy_timer(timer)
    attempt("reset of a destroyed timer", timer.reset)
    other = Node("other")
    log("another node's", result=other.destroy_publisher(node.create_publisher(Int32, "mine", 1)))
    node.destroy_node()
    attempt("publisher of a destroyed node", lambda: node.create_publisher(Int32, "late", 1) and None)
    attempt("node destroyed twice", node.destroy_node)
    log("name of a destroyed node", name=attempt_name(node))
    rclpy.shutdown()
    log("shutdown", ok=rclpy.ok())
    attempt("shutdown again", rclpy.shutdown)
    attempt("try_shutdown", rclpy.try_shutdown)
    attempt("node after shutdown", lambda: Node("late"))

    rclpy.init(args=[])
    inside = Node("inside")
    attempt("with", lambda: name_within(inside))
    attempt("after with", lambda: inside.create_publisher(Int32, "late", 1) and None)
    rclpy.shutdown()

    context = Context()
    log("context", ok=context.ok())
    rclpy.init(args=[], context=context)
    ended: list[str] = []
    context.on_shutdown(lambda: ended.append("ended"))
    own = Node("own", context=context)
    log("own context", ok=context.ok(), same=own.context is context, default=rclpy.ok())
    context.shutdown()
    log("own context ended", ok=context.ok(), callbacks=ended)


def name_within(node: Node) -> str:
    with node as same:
        return same.get_name()


def attempt_name(node: Node) -> str:
    try:
        return node.get_name()
    except Exception as error:
        return type(error).__name__


if __name__ == "__main__":
    main()
