"""Four threads: what may overlap with mutually exclusive and reentrant callback groups, across groups and nodes."""

from itertools import combinations

from conformance import await_match, log, ros, spin_until, steady
from rclpy.callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.duration import Duration
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import Int32

BUSY = Duration(seconds=0.2)


def overlap(spans: list[tuple[str, int]]) -> tuple[int, list[list[str]]]:
    """Return how many callbacks were busy at once at most, and which pairs overlapped."""
    length = BUSY.nanoseconds
    pairs = [(a, b) for a, b in combinations(spans, 2) if abs(a[1] - b[1]) < 0.7 * length]
    most = max(sum(0 <= start - other < 0.7 * length for _, other in spans) for _, start in spans)
    return most, sorted({tuple(sorted((a[0], b[0]))) for a, b in pairs})


def run(name: str, groups: dict[str, CallbackGroup | None], messages: int = 1, nodes: int = 1) -> None:
    """Each subscription of a topic is busy for a while; all are ready at the same time."""
    made = [Node(f"{name}_{number}") for number in range(nodes)]
    executor = MultiThreadedExecutor(num_threads=4)
    for node in made:
        executor.add_node(node)
    spans: list[tuple[str, int]] = []
    clock = steady()

    def work(label: str):
        def callback(message: Int32) -> None:
            spans.append((label, clock.now().nanoseconds))
            clock.sleep_for(BUSY)

        return callback

    publisher = made[0].create_publisher(Int32, name, 10)
    for number, (label, group) in enumerate(groups.items()):
        made[number % nodes].create_subscription(Int32, name, work(label), 10, callback_group=group)
    await_match(executor, (publisher, len(groups)))
    for number in range(messages):
        publisher.publish(Int32(data=number))
    assert spin_until(executor, lambda: len(spans) == messages * len(groups), 20.0)
    clock.sleep_for(BUSY)
    most, pairs = overlap(spans)
    log(name, calls=len(spans), at_once=most, pairs=pairs if len(groups) <= 4 else "any")
    executor.shutdown()
    for node in made:
        node.destroy_node()


def main() -> None:
    exclusive, reentrant = MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
    run("default_group", {"a": None, "b": None, "c": None})
    one = exclusive()
    run("one_exclusive", {"a": one, "b": one})
    run("two_exclusive", {"a": exclusive(), "b": exclusive()})
    shared = exclusive()
    run("shared_and_alone", {"a": shared, "b": shared, "c": exclusive()})
    run("reentrant_itself", {"a": reentrant()}, messages=3)
    run("exclusive_itself", {"a": exclusive()}, messages=3)
    several = reentrant()
    run("reentrant_pair", {"a": several, "b": several})
    many = reentrant()
    run("more_than_threads", dict.fromkeys("abcdef", many))
    run("two_nodes", {"a": None, "b": None}, nodes=2)

    group = exclusive()
    node = Node("groups")
    timer = node.create_timer(1.0, lambda: None, callback_group=group)
    log(
        "groups",
        default=type(node.default_callback_group).__name__,
        timer=timer.callback_group is group,
        has=group.has_entity(timer),
        default_has=node.default_callback_group.has_entity(timer),
    )


if __name__ == "__main__":
    with ros():
        main()
