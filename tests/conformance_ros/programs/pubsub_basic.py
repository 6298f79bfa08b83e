"""A talker and two listeners: order, counts, names, message info, publishing of wrong things."""

from conformance import attempt, await_match, executor_of, log, ros, spin_until
from geometry_msgs.msg import Twist, Vector3
from rclpy.node import Node
from rclpy.serialization import serialize_message
from std_msgs.msg import Float32, String


def main() -> None:
    talker, listener = Node("talker"), Node("listener", namespace="/robot1")
    executor = executor_of(talker, listener)
    seen: list[tuple[str, str]] = []

    publisher = talker.create_publisher(String, "/chatter", 10)
    first = listener.create_subscription(String, "/chatter", lambda message: seen.append(("first", message.data)), 10)
    await_match(executor, (publisher, 1))
    log("names", publisher=publisher.topic_name, subscription=first.topic_name)
    log("counts", subscriptions=publisher.get_subscription_count(), publishers=first.get_publisher_count())

    for number in range(5):
        publisher.publish(String(data=f"message {number}"))
        assert spin_until(executor, lambda number=number: len(seen) == number + 1)
    log("received", seen=seen)

    seen.clear()
    second = talker.create_subscription(String, "/chatter", lambda message: seen.append(("second", message.data)), 10)
    await_match(executor, (publisher, 2))
    publisher.publish(String(data="to both"))
    assert spin_until(executor, lambda: len(seen) == 2)
    log("both", seen=sorted(seen))

    seen.clear()
    log("destroyed", result=talker.destroy_subscription(second))
    await_match(executor, (publisher, 1))
    publisher.publish(serialize_message(String(data="from bytes")))
    assert spin_until(executor, lambda: seen)
    log("bytes", seen=seen)

    attempt("publish another type", lambda: publisher.publish(Twist()))
    attempt("publish a str", lambda: publisher.publish("text"))
    attempt("publish None", lambda: publisher.publish(None))
    attempt("publish the class", lambda: publisher.publish(String))

    # What goes over the wire is a copy, with the precision of the wire.
    values = []
    floats = talker.create_publisher(Float32, "level", 10)
    listener.create_subscription(Float32, "/level", lambda message: values.append(message.data), 10)
    await_match(executor, (floats, 1))
    message = Float32(data=0.1)
    floats.publish(message)
    message.data = 99.0
    assert spin_until(executor, lambda: values)
    log("float32", value=values)

    kept = []
    vectors = talker.create_publisher(Vector3, "vector", 10)
    listener.create_subscription(Vector3, "/vector", kept.append, 10)
    await_match(executor, (vectors, 1))
    original = Vector3(x=1.0)
    vectors.publish(original)
    assert spin_until(executor, lambda: kept)
    log("copy", same_object=kept[0] is original, equal=kept[0] == original)


if __name__ == "__main__":
    with ros():
        main()
