"""Time and duration arithmetic, QoS profiles, names, remapping, parameters and logging."""

from __future__ import annotations

import pytest
import rclpy
from hypothesis import given
from hypothesis import strategies as st
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.clock import ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from rclpy.time import Time
from std_msgs.msg import String

from robotbrain.errors import InputError
from robotbrain.ros.arguments import parse_arguments
from robotbrain.ros.names import expand
from robotbrain.ros.qos import incompatibility

NS = st.integers(0, 2**31 * 10**9 - 1)


@given(NS, NS)
def test_time_arithmetic_is_exact(a, b):
    first, second = Time(nanoseconds=a), Time(nanoseconds=b)
    assert (first - second).nanoseconds == a - b
    assert second + (first - second) == first
    assert (first < second) == (a < b) and (first == second) == (a == b)
    assert Time.from_msg(first.to_msg()).nanoseconds == a
    assert Duration.from_msg((first - second).to_msg()) == first - second
    assert first.seconds_nanoseconds() == divmod(a, 10**9)


def test_times_of_two_clocks_do_not_compare():
    ros = Time(seconds=1, clock_type=ClockType.ROS_TIME)
    with pytest.raises(TypeError, match="ROS_TIME and SYSTEM_TIME"):
        _ = ros < Time(seconds=1)
    with pytest.raises(TypeError):
        _ = ros - Time(seconds=1)
    assert Time.from_msg(ros.to_msg()) == ros


def test_negative_time_is_refused_and_negative_duration_is_not():
    with pytest.raises(InputError):
        Time(seconds=-1)
    assert Duration(seconds=-0.5).to_msg().sec == -1
    assert Duration(seconds=-0.5).to_msg().nanosec == 500_000_000
    with pytest.raises(OverflowError):
        Duration(seconds=1e12)


def test_qos_needs_a_depth():
    with pytest.raises(InputError, match="depth"):
        QoSProfile()
    with pytest.raises(InputError, match="depth"):
        QoSProfile(history=HistoryPolicy.KEEP_LAST)
    with pytest.raises(InputError):
        QoSProfile(depth=-1)
    assert qos_profile_sensor_data.reliability == ReliabilityPolicy.BEST_EFFORT
    assert rclpy.qos.qos_profile_system_default.queue_limit == 1


@pytest.mark.parametrize("offered", [ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT])
@pytest.mark.parametrize("requested", [ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT])
def test_reliability_table(offered, requested):
    matches = not incompatibility(QoSProfile(depth=1, reliability=offered), QoSProfile(depth=1, reliability=requested))
    assert matches == (offered == ReliabilityPolicy.RELIABLE or requested == ReliabilityPolicy.BEST_EFFORT)


@pytest.mark.parametrize("offered", [DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL])
@pytest.mark.parametrize("requested", [DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL])
def test_durability_table(offered, requested):
    matches = not incompatibility(QoSProfile(depth=1, durability=offered), QoSProfile(depth=1, durability=requested))
    assert matches == (offered == DurabilityPolicy.TRANSIENT_LOCAL or requested == DurabilityPolicy.VOLATILE)


@pytest.mark.parametrize(
    ("name", "namespace", "full"),
    [("scan", "/", "/scan"), ("scan", "/r1", "/r1/scan"), ("/scan", "/r1", "/scan"), ("~/x", "/r1", "/r1/n/x"),
     ("~", "/", "/n"), ("a/b", "/", "/a/b"), ("{node}/x", "/r1", "/r1/n/x"), ("{ns}/y", "/r1", "/r1/y")],
)  # fmt: skip
def test_names_expand(name, namespace, full):
    assert expand(name, "n", namespace) == full


@pytest.mark.parametrize("name", ["", "a b", "/a//b", "a/", "1a", "a-b", "/a/2b", "/", None])
def test_bad_topic_names_are_refused(context, name):
    with pytest.raises(InputError, match="topic name"):
        Node("n").create_publisher(String, name, 1)


@pytest.mark.parametrize("name", ["", "1n", "a/b", "a b", "a-b"])
def test_bad_node_names_are_refused(context, name):
    with pytest.raises(InputError, match="node name"):
        Node(name)


def test_namespace_and_remapping(context):
    node = Node("n", namespace="r1", cli_args=["--ros-args", "-r", "scan:=/lidar", "-r", "__node:=m", "-p", "rate:=10"])
    assert node.get_fully_qualified_name() == "/r1/m"
    assert node.create_publisher(String, "scan", 1).topic_name == "/lidar"
    assert node.create_publisher(String, "other", 1).topic_name == "/r1/other"
    assert node.declare_parameter("rate", 5).value == 10
    assert parse_arguments(["scan:=/x"]).remappings == []  # only after --ros-args
    with pytest.raises(InputError, match="from:=to"):
        parse_arguments(["--ros-args", "-r", "scan"])


def test_parameters(context):
    node = Node("n", parameter_overrides=[Parameter("gain", value=2.0)])
    assert node.declare_parameter("gain", 1.0).value == 2.0
    assert node.has_parameter("gain") and not node.has_parameter("other")
    assert node.get_parameter_or("other", Parameter("other", value=3)).value == 3
    assert node.get_parameter("use_sim_time").value is True
    assert node.set_parameters([Parameter("gain", value=4.0)])[0].successful
    assert not node.set_parameters([Parameter("gain", value="fast")])[0].successful  # static typing
    assert node.get_parameter("gain").value == 4.0
    with pytest.raises(InputError, match="declare_parameter"):
        node.get_parameter("other")
    with pytest.raises(InputError):
        node.declare_parameter("gain", 1.0)
    node.add_on_set_parameters_callback(lambda ps: SetParametersResult(successful=ps[0].value < 5.0, reason="too much"))
    result = node.set_parameters([Parameter("gain", value=9.0)])[0]
    assert (result.successful, result.reason) == (False, "too much")
    assert node.get_parameter("gain").value == 4.0
    node.remove_on_set_parameters_callback(node._parameters.on_set[0])
    node.declare_parameters("pid", [("kp", 1.0), ("fixed", 1, ParameterDescriptor(read_only=True))])
    assert node.get_parameter("pid.kp").value == 1.0
    assert not node.set_parameters([Parameter("pid.fixed", value=2)])[0].successful


@pytest.mark.parametrize("value", [True, 3, 2.5, "x", [True], [1, 2], [1.5], ["a"], [b"\x01"]])
def test_parameter_messages_round_trip(value):
    parameter = Parameter("p", value=value)
    back = Parameter.from_parameter_msg(parameter.to_parameter_msg())
    assert (back.name, back.type_, back.value) == (parameter.name, parameter.type_, parameter.value)


def test_logger_stamps_simulated_time_and_filters(context):
    logger = Node("n", namespace="/r").get_logger()
    logger.debug("hidden")
    for _ in range(5):
        logger.info("tick", throttle_duration_sec=1.0)
        logger.info("first", once=True)
        logger.warn("not first", skip_first=True)
        context.run_for(0.5)
    texts = [line.message for line in context.log_lines]
    assert texts.count("tick") == 3 and texts.count("first") == 1 and texts.count("not first") == 4
    assert "hidden" not in texts
    logger.error("late")
    assert str(context.log_lines[-1]) == "[ERROR] [2.500000000] [r.n]: late"
