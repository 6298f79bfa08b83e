"""Parameters of another node: the six services, the client class, events."""

from conformance import attempt, executor_of, log, ros, spin_until
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterDescriptor, ParameterEvent, ParameterType, ParameterValue
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient


def double(name: str, value: float) -> ParameterMessage:
    return ParameterMessage(name=name, value=ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value))


def main() -> None:
    robot, user = Node("robot", namespace="/fleet"), Node("user")
    executor = executor_of(robot, user)
    robot.declare_parameter("speed", 1.0)
    robot.declare_parameter("names", ["a", "b"])
    robot.declare_parameter("pid.p", 0.5)
    robot.declare_parameter("pid.i", 0.1)
    robot.declare_parameter("pid.filter.alpha", 1)
    robot.declare_parameter("fixed", 3, ParameterDescriptor(read_only=True, description="never changes"))

    def call(kind, name: str, request):
        client = user.create_client(kind, f"/fleet/robot/{name}")
        assert client.wait_for_service(timeout_sec=10.0)
        future = client.call_async(request)
        executor.spin_until_future_complete(future, timeout_sec=10.0)
        return future.result()

    def own(names) -> list:
        return sorted(name for name in names if name.startswith(("speed", "names", "pid", "fixed")))

    listed = call(ListParameters, "list_parameters", ListParameters.Request()).result
    log("list", names=own(listed.names), prefixes=sorted(listed.prefixes))
    listed = call(ListParameters, "list_parameters", ListParameters.Request(prefixes=["pid"], depth=2)).result
    log("list two deep", names=own(listed.names), prefixes=sorted(listed.prefixes))
    listed = call(ListParameters, "list_parameters", ListParameters.Request(prefixes=["pid"], depth=0)).result
    log("list recursively", names=own(listed.names), prefixes=sorted(listed.prefixes))

    got = call(GetParameters, "get_parameters", GetParameters.Request(names=["speed", "names"])).values
    log("get", types=[value.type for value in got], speed=got[0].double_value, names=got[1].string_array_value)
    got = call(GetParameters, "get_parameters", GetParameters.Request(names=["unknown"])).values
    log("get unknown", types=[value.type for value in got])
    types = call(GetParameterTypes, "get_parameter_types", GetParameterTypes.Request(names=["speed", "fixed"])).types
    log("types", types=types)
    types = call(GetParameterTypes, "get_parameter_types", GetParameterTypes.Request(names=["unknown"])).types
    log("types of unknown", types=types)
    found = call(DescribeParameters, "describe_parameters", DescribeParameters.Request(names=["fixed"])).descriptors[0]
    log("describe", name=found.name, kind=found.type, read_only=found.read_only, text=found.description)

    answers = call(
        SetParameters,
        "set_parameters",
        SetParameters.Request(parameters=[double("speed", 2.0), double("fixed", 1.0), double("unknown", 1.0)]),
    ).results
    log("set", successful=[answer.successful for answer in answers], reasons=[bool(a.reason) for a in answers])
    log("is set", speed=robot.get_parameter("speed").value, has_unknown=robot.has_parameter("unknown"))
    answer = call(
        SetParametersAtomically,
        "set_parameters_atomically",
        SetParametersAtomically.Request(parameters=[double("speed", 3.0), double("fixed", 1.0)]),
    ).result
    log("set atomically", successful=answer.successful, reason=bool(answer.reason))
    log("is kept", speed=robot.get_parameter("speed").value)

    # The client class does the same with less to write.
    client = AsyncParameterClient(user, "/fleet/robot")
    log("client", ready=client.wait_for_services(timeout_sec=10.0))

    def ask(future):
        executor.spin_until_future_complete(future, timeout_sec=10.0)
        return future.result()

    log("client list", names=own(ask(client.list_parameters(prefixes=["pid"], depth=10)).result.names))
    log("client get", values=[value.double_value for value in ask(client.get_parameters(["pid.p", "pid.i"])).values])
    log("client types", types=ask(client.get_parameter_types(["names"])).types)
    log("client describe", names=[d.name for d in ask(client.describe_parameters(["pid.p"])).descriptors])
    answers = ask(client.set_parameters([Parameter("pid.p", value=0.75), Parameter("names", value=["c"])])).results
    log("client set", successful=[answer.successful for answer in answers])
    answer = ask(client.set_parameters_atomically([Parameter("pid.i", value=0.25)])).result
    log("client set atomically", successful=answer.successful, value=robot.get_parameter("pid.i").value)
    log("client sees", p=robot.get_parameter("pid.p").value, names=robot.get_parameter("names").value)

    # Changes are told on a topic that everybody can hear.
    events: list[dict] = []

    def on_event(event: ParameterEvent) -> None:
        if event.node == "/fleet/robot":
            kinds = ("new_parameters", "changed_parameters", "deleted_parameters")
            events.append({kind: [parameter.name for parameter in getattr(event, kind)] for kind in kinds})

    subscription = user.create_subscription(ParameterEvent, "/parameter_events", on_event, 100)
    assert spin_until(executor, lambda: subscription.get_publisher_count() == 2)
    robot.declare_parameter("fresh", 1)
    robot.set_parameters([Parameter("speed", value=4.0)])
    robot.undeclare_parameter("fresh")
    spin_until(executor, lambda: len(events) == 3, 0.5)
    log("events", events=events)

    silent = Node("silent", start_parameter_services=False)
    executor.add_node(silent)
    other = AsyncParameterClient(user, "silent")
    log("without services", ready=other.wait_for_services(timeout_sec=0.1))
    attempt("by name only", lambda: AsyncParameterClient(user, "silent").services_are_ready())


if __name__ == "__main__":
    with ros():
        main()
