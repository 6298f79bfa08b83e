"""Names: relative, absolute, private, substitutions, namespaces, remapping, and names that are not allowed."""

from conformance import attempt, await_match, executor_of, log, ros, spin_until
from rclpy.node import Node
from std_msgs.msg import Int32
from std_srvs.srv import Trigger

ARGUMENTS = [
    "--ros-args",
    "-r", "chatter:=talk",
    "-r", "/absolute:=/elsewhere/absolute",
    "-r", "mapped:__node:=renamed",
    "-r", "moved:__ns:=/moved/here",
    "-r", "special:chatter:=only_special",
    "-r", "service:=remapped_service",
    "-r", "~/private:=public",
]  # fmt: skip


def main() -> None:
    plain, inside = Node("plain"), Node("inside", namespace="robot1")
    for node in (plain, inside, Node("nested", namespace="/a/b")):
        log(
            "node",
            name=node.get_name(),
            namespace=node.get_namespace(),
            full=node.get_fully_qualified_name(),
            logger=node.get_logger().name,
        )
        for topic in ("numbers", "/numbers", "~/numbers", "~", "a/b", "{node}/x", "/chatter", "chatter",
                      "/absolute", "absolute", "~/private"):  # fmt: skip
            attempt("resolve", lambda n=node, t=topic: n.resolve_topic_name(t), node=node.get_name(), topic=topic)
        attempt(f"namespace in braces, {node.get_name()}", lambda n=node: n.resolve_topic_name("{ns}/x"))
        attempt("expand only", lambda n=node: n.resolve_topic_name("chatter", only_expand=True))
        attempt("service", lambda n=node: n.resolve_service_name("service"))
        attempt("private service", lambda n=node: n.resolve_service_name("~/get"))

    renamed, moved, special = Node("mapped"), Node("moved"), Node("special")
    log("renamed", name=renamed.get_name(), full=renamed.get_fully_qualified_name())
    log("moved", namespace=moved.get_namespace(), full=moved.get_fully_qualified_name())
    log("special", topic=special.resolve_topic_name("chatter"))
    own = Node("own", cli_args=["--ros-args", "-r", "__ns:=/from_args", "-r", "numbers:=digits"])
    log("own arguments", full=own.get_fully_qualified_name(), topic=own.resolve_topic_name("numbers"))
    deaf = Node("deaf", use_global_arguments=False)
    log("no global arguments", topic=deaf.resolve_topic_name("chatter"))

    # Two names of one topic.
    executor = executor_of(plain, inside)
    seen: list[int] = []
    publisher = inside.create_publisher(Int32, "numbers", 10)
    plain.create_subscription(Int32, "robot1/numbers", lambda message: seen.append(message.data), 10)
    await_match(executor, (publisher, 1))
    publisher.publish(Int32(data=4))
    assert spin_until(executor, lambda: seen)
    log("same topic", topic=publisher.topic_name, seen=seen)
    remapped = plain.create_publisher(Int32, "chatter", 10)
    service = plain.create_service(Trigger, "service", lambda request, response: response)
    log("remapped", topic=remapped.topic_name, service=service.service_name)

    for name in ("good_name", "2bad", "bad-name", "bad name", "", "a/b", "ünï", "x" * 256):
        attempt("node name", lambda n=name: Node(n).get_name(), name=name[:12])
    for name in ("/ok", "ok", "/ok/", "bad-ns", "/2x", "//x", "/"):
        attempt("namespace", lambda n=name: Node("namespaced", namespace=n).get_namespace(), name=name)
    for name in ("ok", "/ok", "bad topic", "2bad", "bad//double", "trailing/", "", "bad-dash", "{unknown}/x",
                 "ok__double", "~bad", "/with/{node}"):  # fmt: skip
        attempt("topic name", lambda n=name: plain.create_publisher(Int32, n, 1).topic_name, name=name)
        attempt("service name", lambda n=name: plain.create_client(Trigger, n).service_name, name=name)


if __name__ == "__main__":
    with ros(ARGUMENTS):
        main()
