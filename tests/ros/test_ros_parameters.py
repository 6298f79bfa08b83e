"""Parameters: ranges, callbacks, services, events and files, as rclpy documents them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import rclpy
from hypothesis import given
from hypothesis import strategies as st
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    ParameterEvent,
    SetParametersResult,
)
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterImmutableException,
    ParameterNotDeclaredException,
    ParameterUninitializedException,
)
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_dict_from_yaml_file, parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from rclpy.parameter_event_handler import ParameterEventHandler

from robotbrain.errors import InputError
from robotbrain.ros import SimContext
from robotbrain.ros.arguments import matches, parse_arguments
from robotbrain.ros.parameter_files import parse_value, read_parameter_file
from robotbrain.ros.record import DecisionLog

YAML = """
/**:
  ros__parameters: {shared: 1, use_sim_time: true}
planner:
  ros__parameters:
    rate: 5.0
    pid: {kp: 1, ki: 0.5}
    names: [a, b]
/fleet/robot:
  ros__parameters: {speed: 2}
fleet:
  other:
    ros__parameters: {speed: 3}
"""


def declare(context: SimContext, value: Any, **descriptor: Any) -> Node:
    node = Node("n", context=context)
    node.declare_parameter("p", value, ParameterDescriptor(**descriptor))
    return node


def allowed(node: Node, value: Any) -> bool:
    return bool(node.set_parameters([Parameter("p", value=value)])[0].successful)


@given(st.integers(-50, 50), st.integers(0, 40), st.integers(0, 7), st.integers(-100, 100))
def test_integer_ranges(low: int, width: int, step: int, value: int) -> None:
    """Both ends are allowed, and what is a whole number of steps from the lower one."""
    limits = IntegerRange(from_value=low, to_value=low + width, step=step)
    node = declare(SimContext(), low, integer_range=[limits])
    inside = low <= value <= low + width
    fits = value == low + width or step == 0 or (value - low) % step == 0
    assert allowed(node, value) == (inside and fits)


@pytest.mark.parametrize(
    ("step", "value", "fits"),
    [(0.0, 0.33, True), (0.25, 0.75, True), (0.25, 0.6, False), (0.3, 1.0, True), (0.25, 0.75 + 1e-9, True),
     (0.0, 1.0001, False), (0.0, -1e-3, False)],
)  # fmt: skip
def test_floating_point_ranges(context: SimContext, step: float, value: float, fits: bool) -> None:
    limits = FloatingPointRange(from_value=0.0, to_value=1.0, step=step)
    assert allowed(declare(context, 0.0, floating_point_range=[limits]), value) == fits


def test_static_typing_read_only_and_dynamic_typing(context: SimContext) -> None:
    node = Node("n")
    node.declare_parameter("typed", Parameter.Type.DOUBLE)
    with pytest.raises(ParameterUninitializedException):
        node.get_parameter("typed")
    assert node.get_parameter_or("typed", Parameter("x", value=7)).value == 7
    assert node.set_parameters([Parameter("typed", value=1.5)])[0].successful
    assert not node.set_parameters([Parameter("typed", value=2)])[0].successful
    assert not node.set_parameters([Parameter("typed")])[0].successful  # cannot be unset
    node.declare_parameter("loose", 1, ParameterDescriptor(dynamic_typing=True))
    assert node.set_parameters([Parameter("loose", value="text")])[0].successful
    assert node.describe_parameter("loose").type == 4
    assert node.set_parameters([Parameter("loose")])[0].successful and not node.has_parameter("loose")
    node.declare_parameter("fixed", 3, ParameterDescriptor(read_only=True))
    assert not node.set_parameters([Parameter("fixed", value=4)])[0].successful
    with pytest.raises(ParameterImmutableException):
        node.undeclare_parameter("fixed")
    node.undeclare_parameter("typed")
    with pytest.raises(ParameterNotDeclaredException):
        node.set_parameters([Parameter("typed", value=1.0)])
    with pytest.raises(TypeError):
        node.declare_parameter("mixed", [1, "a"])
    with pytest.raises(InvalidParameterValueException, match="dynamic_typing"):
        node.declare_parameter("nothing", None, ParameterDescriptor())
    assert node.declare_parameter("numbers", Parameter.Type.DOUBLE_ARRAY).value is None
    assert node.set_parameters([Parameter("numbers", value=[])])[0].successful


def test_overrides_must_fit(context: SimContext) -> None:
    node = Node("n", parameter_overrides=[Parameter("rate", value="fast"), Parameter("gain", value=2.0)])
    with pytest.raises(InvalidParameterTypeException, match="DOUBLE"):
        node.declare_parameter("rate", 1.0)
    assert not node.has_parameter("rate") and node.declare_parameter("gain", 1.0).value == 2.0
    assert node.declare_parameter("rate", 1.0, ignore_override=True).value == 1.0


def test_callbacks_before_at_and_after_a_change(context: SimContext) -> None:
    node = Node("n")
    trace: list[tuple[Any, ...]] = []
    for name in ("speed", "limit"):
        node.declare_parameter(name, 1.0)

    def names(parameters: list[Parameter]) -> list[str]:
        return [parameter.name for parameter in parameters]

    def before(parameters: list[Parameter]) -> list[Parameter]:
        trace.append(("before", names(parameters)))
        return [*parameters, Parameter("limit", value=9.0)] if parameters[0].value < 100 else []

    def check(parameters: list[Parameter]) -> SetParametersResult:
        trace.append(("check", names(parameters), node.get_parameter("speed").value))
        return SetParametersResult(successful=parameters[0].value > 0, reason="negative")

    def after(parameters: list[Parameter]) -> None:
        trace.append(("after", names(parameters), node.get_parameter("speed").value))

    node.add_pre_set_parameters_callback(before)
    node.add_on_set_parameters_callback(check)
    node.add_post_set_parameters_callback(after)
    assert node.set_parameters([Parameter("speed", value=2.0)])[0].successful
    both = ["speed", "limit"]
    assert trace == [("before", ["speed"]), ("check", both, 1.0), ("after", both, 2.0)]
    assert node.get_parameter("limit").value == 9.0
    trace.clear()
    assert node.set_parameters([Parameter("speed", value=-2.0)])[0].reason == "negative"
    assert trace == [("before", ["speed"]), ("check", both, 2.0)] and node.get_parameter("speed").value == 2.0
    trace.clear()
    assert "empty" in node.set_parameters([Parameter("speed", value=500.0)])[0].reason
    trace.clear()
    node.declare_parameter("extra", 3.0)
    assert [entry[0] for entry in trace] == ["check", "after"]  # declaring does not ask the first
    node.remove_on_set_parameters_callback(check)
    with pytest.raises(ValueError, match="not in list"):
        node.remove_on_set_parameters_callback(check)


def test_all_or_none(context: SimContext) -> None:
    node = Node("n")
    node.declare_parameters("pid", [("kp", 1.0), ("ki", 2.0)])
    bad = [Parameter("pid.kp", value=5.0), Parameter("pid.ki", value="x")]
    assert not node.set_parameters_atomically(bad).successful
    assert {k: p.value for k, p in node.get_parameters_by_prefix("pid").items()} == {"kp": 1.0, "ki": 2.0}
    assert [r.successful for r in node.set_parameters(bad)] == [True, False]
    assert node.get_parameter("pid.kp").value == 5.0


def test_descriptors_can_be_changed(context: SimContext) -> None:
    node = declare(context, 4)
    limits = ParameterDescriptor(type=2, integer_range=[IntegerRange(from_value=0, to_value=3)])
    with pytest.raises(InvalidParameterValueException):
        node.set_descriptor("p", limits)
    value = node.set_descriptor("p", limits, Parameter("p", value=2).get_parameter_value())
    assert parameter_value_to_python(value) == 2 == node.get_parameter("p").value
    assert not allowed(node, 4)


def test_the_parameter_services(context: SimContext) -> None:
    robot, user = Node("robot", namespace="/fleet"), Node("user")
    robot.declare_parameters("pid", [("kp", 1.0), ("filter.alpha", 3)])
    client = AsyncParameterClient(user, "/fleet/robot")
    assert client.wait_for_services(timeout_sec=1.0)

    def ask(future: Any) -> Any:
        rclpy.spin_until_future_complete(user, future)
        return future.result()

    listed = ask(client.list_parameters(["pid"], 1)).result
    assert (list(listed.names), list(listed.prefixes)) == (["pid.kp"], ["pid"])
    assert list(ask(client.list_parameters(["pid"])).result.names) == ["pid.kp", "pid.filter.alpha"]
    assert [value.double_value for value in ask(client.get_parameters(["pid.kp"])).values] == [1.0]
    assert ask(client.get_parameters(["pid.kp", "unknown"])).values == []
    assert list(ask(client.get_parameter_types(["pid.filter.alpha"])).types) == [2]
    assert ask(client.describe_parameters(["pid.kp"])).descriptors[0].name == "pid.kp"
    results = ask(client.set_parameters([Parameter("pid.kp", value=2.5), Parameter("unknown", value=1)])).results
    assert [result.successful for result in results] == [True, False] and robot.get_parameter("pid.kp").value == 2.5
    both = [Parameter("pid.kp", value=9.0), Parameter("pid.filter.alpha", value="x")]
    assert not ask(client.set_parameters_atomically(both)).result.successful
    assert robot.get_parameter("pid.kp").value == 2.5
    silent = AsyncParameterClient(user, "silent")
    Node("silent", start_parameter_services=False)
    assert not silent.wait_for_services(timeout_sec=0.1)
    robot.destroy_node()
    assert not client.services_are_ready()


def test_services_and_events_cost_nothing_while_nobody_uses_them(context: SimContext) -> None:
    """No message, no callback, no event: a run looks as if they were not there."""
    log = DecisionLog(context, topics={"/parameter_events", "/rosout"})
    records: list[Any] = []
    context.add_callback_tap(records.append)
    node = Node("n")
    node.declare_parameter("p", 1)
    node.set_parameters([Parameter("p", value=2)])
    node.get_logger().info("hello")
    context.run_for(1.0)
    assert (len(log), records, context.message_count, context.topics) == (0, [], 0, {})
    assert node.count_publishers("/parameter_events") == 1
    assert "/rosout" in dict(node.get_topic_names_and_types())


def test_events_tell_what_changed(context: SimContext) -> None:
    robot, user = Node("robot"), Node("user")
    events: list[ParameterEvent] = []
    subscription = user.create_subscription(ParameterEvent, "/parameter_events", events.append, 10)
    assert subscription.get_publisher_count() == 2
    everything = DecisionLog(context)
    robot.declare_parameter("a", 1)
    robot.set_parameters([Parameter("a", value=2)])
    robot.declare_parameter("b", 1, ParameterDescriptor(dynamic_typing=True))
    robot.set_parameters([Parameter("b")])
    later = Node("later")
    context.run_for(0.1)
    kinds = ("new_parameters", "changed_parameters", "deleted_parameters")
    seen = [(e.node, *([p.name for p in getattr(e, kind)] for kind in kinds)) for e in events]
    assert seen[:4] == [
        ("/robot", ["a"], [], []),
        ("/robot", [], ["a"], []),
        ("/robot", ["b"], [], []),
        ("/robot", [], [], ["b"]),
    ]
    assert seen[4][:2] == ("/later", ["use_sim_time"]) and later in context.nodes
    assert len(everything) == 0, "decision logs leave these topics out"


def test_the_event_handler(context: SimContext) -> None:
    robot, user = Node("robot", namespace="/fleet"), Node("user", namespace="/fleet")
    robot.declare_parameter("a", 1)
    handler, calls = ParameterEventHandler(user), []
    first = handler.add_parameter_callback("a", "robot", lambda p: calls.append(("first", p.value.integer_value)))
    handler.add_parameter_callback("a", "/fleet/robot", lambda p: calls.append(("second", p.value.integer_value)))
    handler.add_parameter_callback("a", "/other", lambda p: calls.append(("never", 0)))
    handler.add_parameter_event_callback(lambda event: calls.append(("event", event.node)))
    robot.set_parameters([Parameter("a", value=5)])
    context.run_for(0.1)
    assert calls == [("second", 5), ("first", 5), ("event", "/fleet/robot")]
    handler.remove_parameter_callback(first)
    with pytest.raises(RuntimeError):
        handler.remove_parameter_callback(first)
    handler.destroy()
    robot.set_parameters([Parameter("a", value=6)])
    context.run_for(0.1)
    assert len(calls) == 3


@pytest.mark.parametrize(
    ("text", "value"),
    [("true", True), ("3", 3), ("2.5", 2.5), ("1e-3", "1e-3"), ("[1, 2.5]", [1.0, 2.5]), ("[a, b]", ["a", "b"]),
     ("[1, a]", "[1, a]"), ("'7'", "7"), ("a: b", "a: b"), ("[", "["), ("[]", [])],
)  # fmt: skip
def test_values_are_read_as_yaml(text: str, value: Any) -> None:
    found = parse_value(text)
    assert found == value and type(found) is type(value)


def test_parameter_files(context: SimContext, tmp_path: Path) -> None:
    path = tmp_path / "parameters.yaml"
    path.write_text(YAML, encoding="utf-8")
    arguments = ["--ros-args", "--params-file", str(path), "-p", "planner:rate:=7.0"]
    planner = Node("planner", cli_args=arguments, automatically_declare_parameters_from_overrides=True)
    values = {name: planner.get_parameter(name).value for name in ("shared", "rate", "pid.kp", "pid.ki", "names")}
    assert values == {"shared": 1, "rate": 7.0, "pid.kp": 1, "pid.ki": 0.5, "names": ["a", "b"]}
    robot = Node("robot", namespace="/fleet", cli_args=arguments)
    assert robot.declare_parameter("speed", 0).value == 2
    assert Node("other", namespace="/fleet", cli_args=arguments).declare_parameter("speed", 0).value == 3
    assert Node("robot", cli_args=arguments).declare_parameter("speed", 0).value == 0
    found = parameter_dict_from_yaml_file(str(path), target_nodes=["/fleet/robot"])
    assert [(name, message.value.integer_value) for name, message in found.items()] == [("speed", 2)]
    client = AsyncParameterClient(planner, "/fleet/robot")
    assert planner.executor is not None
    planner.executor.spin_until_future_complete(client.load_parameter_file(str(path)))
    with pytest.raises(RuntimeError):
        parameter_dict_from_yaml_file(str(path), target_nodes=["nobody"])
    path.write_text("planner: {rate: 5}", encoding="utf-8")
    with pytest.raises(InputError, match="ros__parameters"):
        read_parameter_file(path)
    with pytest.raises(InputError, match="nowhere"):
        parse_arguments(["--ros-args", "--params-file", str(tmp_path / "nowhere.yaml")])


@pytest.mark.parametrize(
    ("pattern", "name", "fits"),
    [("/**", "/a/b", True), ("/**/robot", "/robot", True), ("/**/robot", "/a/b/robot", True),
     ("/*/robot", "/a/robot", True), ("/*/robot", "/a/b/robot", False), ("/a/robot", "/a/robot", True),
     ("/**/robot", "/myrobot", False), ("/a.b", "/aXb", False)],
)  # fmt: skip
def test_node_patterns(pattern: str, name: str, fits: bool) -> None:
    assert matches(pattern, name) == fits


def test_rules_for_one_node(context: SimContext) -> None:
    rules = ["--ros-args", "-r", "old:__node:=new", "-r", "moved:__ns:=/there", "-r", "special:chatter:=talk"]
    rclpy.init(args=[*rules, "-p", "special:rate:=3", "--log-level", "debug", "--log-level", "special:=error"])
    assert Node("old").get_fully_qualified_name() == "/new"
    assert Node("moved").get_fully_qualified_name() == "/there/moved"
    special, plain = Node("special"), Node("plain")
    assert (special.resolve_topic_name("chatter"), plain.resolve_topic_name("chatter")) == ("/talk", "/chatter")
    assert special.declare_parameter("rate", 1).value == 3 and plain.declare_parameter("rate", 1).value == 1
    own = Node("special", namespace="own", cli_args=["--ros-args", "-r", "chatter:=mine", "-p", "rate:=5"])
    assert (own.resolve_topic_name("chatter"), own.declare_parameter("rate", 1).value) == ("/own/mine", 5)
    assert plain.get_logger().debug("shown") and not special.get_logger().warning("hidden")


def test_listing_agrees_with_the_rule_for_depth(context: SimContext) -> None:
    """Depth counts the levels below a prefix, 0 all of them (rcl_interfaces/srv/ListParameters)."""
    node = Node("n")
    for name in ("a", "a.b", "a.b.c", "ab.c", "d.e.f.g"):
        node.declare_parameter(name, 1)

    def mine(names: list[str]) -> list[str]:
        return sorted(name for name in names if name != "use_sim_time")

    assert mine(node.list_parameters([], 0).names) == ["a", "a.b", "a.b.c", "ab.c", "d.e.f.g"]
    assert mine(node.list_parameters([], 1).names) == ["a"]
    assert mine(node.list_parameters(["a"], 1).names) == ["a", "a.b"]
    assert mine(node.list_parameters(["a", "d.e"], ListParameters.Request.DEPTH_RECURSIVE).names) == [
        "a", "a.b", "a.b.c", "d.e.f.g"
    ]  # fmt: skip
    assert GetParameters.Request(names=["a"]).names == ["a"]
