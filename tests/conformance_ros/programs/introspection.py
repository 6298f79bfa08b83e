"""Asking the graph: topics, services, nodes, who publishes what with which QoS."""

from conformance import attempt, executor_of, log, ros, spin_until
from geometry_msgs.msg import Twist
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from sensor_msgs.msg import LaserScan
from std_srvs.srv import SetBool, Trigger


def main() -> None:
    robot, brain = Node("robot", namespace="/r1"), Node("brain")
    executor = executor_of(robot, brain)
    robot.create_publisher(LaserScan, "scan", qos_profile_sensor_data)
    robot.create_subscription(Twist, "cmd_vel", lambda message: None, 10)
    robot.create_service(Trigger, "stop", lambda request, response: response)
    brain.create_publisher(Twist, "/r1/cmd_vel", QoSProfile(depth=3, deadline=Duration(seconds=1)))
    brain.create_subscription(LaserScan, "/r1/scan", lambda message: None, qos_profile_sensor_data)
    brain.create_publisher(
        Twist,
        "/r1/cmd_vel",
        QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.BEST_EFFORT),
    )
    brain.create_client(SetBool, "/r1/light")
    assert spin_until(executor, lambda: brain.count_publishers("/r1/cmd_vel") == 2)
    assert spin_until(executor, lambda: robot.count_clients("light") == 1)

    def mine(pairs) -> list:
        return sorted([name, types] for name, types in pairs if name.startswith("/r1") and "parameter" not in name)

    log("topics", found=mine(brain.get_topic_names_and_types()))
    services = mine(brain.get_service_names_and_types())
    log("services", found=[pair for pair in services if "type_description" not in pair[0]])
    log("system topics", found=[name for name, _ in brain.get_topic_names_and_types() if not name.startswith("/r1")])
    log("nodes", names=sorted(brain.get_node_names()), full=sorted(brain.get_fully_qualified_node_names()))
    log("with namespaces", found=sorted(brain.get_node_names_and_namespaces()))
    log(
        "counts",
        publishers=brain.count_publishers("/r1/cmd_vel"),
        subscribers=brain.count_subscribers("/r1/scan"),
        relative=robot.count_publishers("cmd_vel"),
        nobody=brain.count_publishers("/nobody"),
        services=brain.count_services("/r1/stop"),
        clients=brain.count_clients("/r1/light"),
    )
    log("published by robot", found=mine(brain.get_publisher_names_and_types_by_node("robot", "/r1")))
    log("subscribed by robot", found=mine(brain.get_subscriber_names_and_types_by_node("robot", "/r1")))
    log("served by robot", found=[
        pair for pair in mine(brain.get_service_names_and_types_by_node("robot", "/r1")) if pair[0] == "/r1/stop"
    ])  # fmt: skip
    log("called by brain", found=mine(robot.get_client_names_and_types_by_node("brain", "/")))
    attempt("of an unknown node", lambda: brain.get_publisher_names_and_types_by_node("ghost", "/"))
    for info in sorted(brain.get_publishers_info_by_topic("/r1/cmd_vel"), key=lambda info: info.qos_profile.durability):
        log(
            "publisher info",
            node=info.node_name,
            namespace=info.node_namespace,
            kind=info.topic_type,
            endpoint=info.endpoint_type.name,
            reliability=info.qos_profile.reliability.name,
            durability=info.qos_profile.durability.name,
            deadline=info.qos_profile.deadline.nanoseconds,
        )
    for info in brain.get_subscriptions_info_by_topic("/r1/scan"):
        log("subscription info", node=info.node_name, reliability=info.qos_profile.reliability.name)
    log("nobody", found=brain.get_publishers_info_by_topic("/nobody"))
    log("wait for node", found=brain.wait_for_node("/r1/robot", 1.0), ghost=brain.wait_for_node("/ghost", 0.05))

    robot.destroy_node()
    assert spin_until(executor, lambda: brain.count_publishers("/r1/scan") == 0)
    log("without the robot", topics=mine(brain.get_topic_names_and_types()), nodes=sorted(brain.get_node_names()))


if __name__ == "__main__":
    with ros():
        main()
