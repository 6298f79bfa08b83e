"""tf2 of the kit against homogeneous matrices (scipy), and in simulated time."""

from __future__ import annotations

import math
from array import array

import numpy as np
import pytest
import rclpy
import tf2_geometry_msgs
import tf2_ros
import tf2_sensor_msgs
from geometry_msgs.msg import (
    Point32,
    PointStamped,
    PolygonStamped,
    PoseStamped,
    PoseWithCovarianceStamped,
    TransformStamped,
    Vector3Stamped,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy
from rclpy.time import Time
from scipy.spatial.transform import Rotation, Slerp
from sensor_msgs.msg import LaserScan, PointCloud2, PointField
from tf2_msgs.srv import FrameGraph
from tf2_ros import Buffer, StaticTransformBroadcaster, TransformBroadcaster, TransformListener

from robotbrain.errors import InputError
from robotbrain.ros import SimContext
from robotbrain.ros.tf2.core import BufferCore

coordinate = st.floats(-100, 100, allow_nan=False)
vectors = st.tuples(coordinate, coordinate, coordinate)
rotations = (
    st.tuples(*[st.floats(-1, 1, allow_nan=False)] * 4)
    .filter(lambda q: sum(v * v for v in q) > 1e-2)
    .map(lambda q: tuple(float(v) for v in np.array(q) / np.linalg.norm(q)))
)
poses = st.tuples(vectors, rotations)


def stamped(parent, child, pose=((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)), stamp_ns=0):
    message = TransformStamped(child_frame_id=child)
    message.header.frame_id = parent
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
    v, q = message.transform.translation, message.transform.rotation
    (v.x, v.y, v.z), (q.x, q.y, q.z, q.w) = pose
    return message


def at(x, y=0.0, z=0.0):
    """A pose without rotation."""
    return ((x, y, z), (0.0, 0.0, 0.0, 1.0))


def matrix(pose):
    """The oracle: a 4x4 homogeneous matrix."""
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = Rotation.from_quat(pose[1]).as_matrix(), pose[0]
    return result


def matrix_of(message):
    v, q = message.transform.translation, message.transform.rotation
    assert math.isclose(q.x**2 + q.y**2 + q.z**2 + q.w**2, 1.0, abs_tol=1e-12)
    return matrix(((v.x, v.y, v.z), (q.x, q.y, q.z, q.w)))


def close(a, b, scale=100.0):
    return np.allclose(a, b, atol=1e-12 * scale * 100)


# ---------------------------------------------------------------- values


@given(st.lists(poses, min_size=1, max_size=5), st.lists(poses, min_size=0, max_size=5))
@settings(max_examples=60, deadline=None)
def test_a_lookup_is_the_product_of_matrices_along_the_path(left, right):
    """root - l0 - l1 ... and root - r0 - r1 ...: source at the end of one branch, target at that of the other."""
    core = BufferCore()
    ends = {}
    for side, branch in (("l", left), ("r", right)):
        above, product = "root", np.eye(4)
        for index, pose in enumerate(branch):
            core.set_transform_static(stamped(above, f"{side}{index}", pose), "test")
            above, product = f"{side}{index}", product @ matrix(pose)
        ends[side] = above, product
    (source, to_root_l), (target, to_root_r) = ends["l"], ends["r"]
    found = core.lookup_transform_core(target, source, Time())
    assert (found.header.frame_id, found.child_frame_id) == (target, source)
    assert close(matrix_of(found), np.linalg.inv(to_root_r) @ to_root_l, 1000)
    back = core.lookup_transform_core(source, target, Time())
    assert close(matrix_of(back) @ matrix_of(found), np.eye(4), 1000)


@given(poses, poses, st.integers(0, 10**9))
@settings(max_examples=80, deadline=None)
def test_between_two_stamps_it_interpolates(first, second, offset):
    core = BufferCore()
    for second_number, pose in ((5, first), (6, second)):
        core.set_transform(stamped("map", "base", pose, second_number * 10**9), "test")
    found = matrix_of(core.lookup_transform_core("map", "base", Time(nanoseconds=5 * 10**9 + offset)))
    ratio = offset / 1e9
    expected = Slerp([0, 1], Rotation.from_quat([first[1], second[1]]))([ratio])[0].as_matrix()
    np.testing.assert_allclose(found[:3, 3], (1 - ratio) * np.array(first[0]) + ratio * np.array(second[0]), atol=1e-9)
    half_turn = abs(np.dot(first[1], second[1])) < 1e-6  # two equally short ways round
    assert half_turn or np.allclose(found[:3, :3], expected, atol=1e-7)


def test_midpoint_of_a_quarter_turn(context):
    core = BufferCore()
    half = math.sqrt(0.5)
    core.set_transform(stamped("map", "base", at(0.0), 10**9), "test")
    core.set_transform(stamped("map", "base", ((2.0, 0.0, 0.0), (0.0, 0.0, half, half)), 2 * 10**9), "test")
    found = core.lookup_transform_core("map", "base", Time(seconds=1.5))
    assert found.transform.translation.x == pytest.approx(1.0)
    assert 2 * math.atan2(found.transform.rotation.z, found.transform.rotation.w) == pytest.approx(math.pi / 4)


@given(poses, poses, poses)
@settings(max_examples=40, deadline=None)
def test_full_lookup_goes_through_the_fixed_frame_at_two_times(then, now, mount):
    core = BufferCore()
    core.set_transform(stamped("map", "base", then, 10**9), "test")
    core.set_transform(stamped("map", "base", now, 2 * 10**9), "test")
    core.set_transform_static(stamped("base", "lidar", mount), "test")
    found = core.lookup_transform_full_core("base", Time(seconds=2), "lidar", Time(seconds=1), "map")
    assert found.header.stamp.sec == 2
    assert close(matrix_of(found), np.linalg.inv(matrix(now)) @ matrix(then) @ matrix(mount), 1000)


def test_time_zero_is_the_latest_common_time(context):
    core = BufferCore()
    for second in (1, 2, 3):
        core.set_transform(stamped("map", "odom", at(float(second)), second * 10**9), "a")
    for second in (1, 2):
        core.set_transform(stamped("odom", "base", stamp_ns=second * 10**9), "b")
    core.set_transform_static(stamped("base", "lidar"), "c")
    found = core.lookup_transform_core("map", "lidar", Time())
    assert found.header.stamp.sec == 2 and found.transform.translation.x == pytest.approx(2.0)
    assert core.get_latest_common_time("map", "lidar") == Time(seconds=2)


# ---------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("target", "source", "time", "error", "text"),
    [
        (
            "map",
            "nowhere",
            Time(),
            tf2_ros.LookupException,
            '"nowhere" passed to lookupTransform argument source',
        ),
        ("map", "", Time(), tf2_ros.InvalidArgumentException, "cannot be empty"),
        ("/map", "base", Time(), tf2_ros.InvalidArgumentException, "cannot start with a '/'"),
        ("map", "island", Time(), tf2_ros.ConnectivityException, "'map' and 'island'"),
        ("map", "base", Time(seconds=9), tf2_ros.ExtrapolationException, "into the future.  Requested time 9.000000 "),
        ("map", "base", Time(seconds=1), tf2_ros.ExtrapolationException, "into the past.  Requested time 1.000000 but"),
        ("map", "once", Time(seconds=5), tf2_ros.ExtrapolationException, "at time 5.000000, but only time 3.000000"),
    ],
)
def test_refused_lookups(context, target, source, time, error, text):
    core = BufferCore()
    for second in (2, 3, 4):
        core.set_transform(stamped("map", "base", stamp_ns=second * 10**9), "test")
    core.set_transform(stamped("map", "once", stamp_ns=3 * 10**9), "test")
    core.set_transform(stamped("sea", "island", stamp_ns=3 * 10**9), "test")
    with pytest.raises(error) as caught:
        core.lookup_transform_core(target, source, time)
    assert text in str(caught.value) and isinstance(caught.value, tf2_ros.TransformException)
    assert core.can_transform_core(target, source, time)[0] is False


@pytest.mark.parametrize(
    ("message", "code"),
    [
        (stamped("base", "base"), "TF_SELF_TRANSFORM"),
        (stamped("base", ""), "TF_NO_CHILD_FRAME_ID"),
        (stamped("", "base"), "TF_NO_FRAME_ID"),
        (stamped("map", "base", at(math.nan)), "TF_NAN_INPUT"),
        (stamped("map", "base", ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0))), "TF_DENORMALIZED_QUATERNION"),
    ],
)
def test_unusable_transforms_are_logged_and_ignored(context, message, code):
    core = BufferCore()
    core.set_transform(message, "somebody")
    assert core._getFrameStrings() == []
    [line] = context.log_lines
    assert line.severity.name == "ERROR" and line.message.startswith(code) and line.name == "tf2_buffer"


def test_a_buffer_without_a_context_prints_its_warnings(capsys):
    BufferCore().set_transform(stamped("a", "a"), "somebody")
    assert "TF_SELF_TRANSFORM" in capsys.readouterr().out


def test_a_long_quaternion_is_normalised_with_one_warning(context):
    core = BufferCore()
    for second in (1, 2):
        core.set_transform(stamped("map", "base", ((0.0, 0.0, 0.0), (0.0, 0.0, 2.0, 2.0)), second * 10**9), "test")
    assert matrix_of(core.lookup_transform_core("map", "base", Time()))[0, 1] == pytest.approx(-1.0)
    assert [line.message[:10] for line in context.log_lines] == ["frame base"]


def test_slashes_are_stripped_from_what_is_set(context):
    core = BufferCore()
    core.set_transform(stamped("/map", "/base", stamp_ns=10**9), "test")
    assert core._getFrameStrings() == ["base", "map"]


@given(st.permutations(list(range(8))))
@settings(max_examples=40, deadline=None)
def test_the_order_of_arrival_does_not_matter(order):
    core = BufferCore()
    for index in [*order, *order]:  # repetitions change nothing
        core.set_transform(stamped("map", "base", at(float(index)), (index + 1) * 10**9), "")
    for quarter in range(29):
        found = core.lookup_transform_core("map", "base", Time(nanoseconds=10**9 + quarter * 250_000_000))
        assert found.transform.translation.x == pytest.approx(quarter / 4)


def test_history_expires(context):
    core = BufferCore(Duration(seconds=2))
    for second in (1, 2, 3, 4, 5):
        core.set_transform(stamped("map", "base", stamp_ns=second * 10**9), "test")
    core.set_transform(stamped("map", "base", stamp_ns=int(5.5e9)), "test")
    assert core.can_transform_core("map", "base", Time(seconds=3))[0]
    assert not core.can_transform_core("map", "base", Time(seconds=2.9))[0]
    core.set_transform(stamped("map", "base", stamp_ns=10**9), "late")
    assert context.log_lines[-1].message.startswith(
        "TF_OLD_DATA ignoring data from the past for frame base at time 1.0"
    )


def test_times_are_times(context):
    core = BufferCore()
    core.set_transform(stamped("map", "base", stamp_ns=10**9), "test")
    stamp = PointStamped().header.stamp
    assert core.lookup_transform_core("map", "base", stamp).header.stamp.sec == 1
    with pytest.raises(TypeError, match="Time\\(\\) asks for the latest"):
        core.lookup_transform_core("map", "base", 0.0)


# ---------------------------------------------------------------- messages


def points_of(message, axes="xyz"):
    return np.array([getattr(message, axis) for axis in axes])


@given(poses, poses)
@settings(max_examples=40, deadline=None)
def test_messages_move_as_matrices_do(move, pose):
    transform = stamped("map", "base", move, 7 * 10**9)
    before = str(transform)
    position, orientation = np.array(pose[0]), pose[1]
    T = matrix(move)

    point = PointStamped()
    point.point.x, point.point.y, point.point.z = pose[0]
    moved = tf2_geometry_msgs.do_transform_point(point, transform)
    assert close(points_of(moved.point), (T @ [*position, 1.0])[:3])
    assert moved.header == transform.header and moved.header is not transform.header

    vector = Vector3Stamped()
    vector.vector.x, vector.vector.y, vector.vector.z = pose[0]
    assert close(points_of(tf2_geometry_msgs.do_transform_vector3(vector, transform).vector), T[:3, :3] @ position)

    whole = PoseStamped()
    p, q = whole.pose.position, whole.pose.orientation
    (p.x, p.y, p.z), (q.x, q.y, q.z, q.w) = pose
    result = tf2_geometry_msgs.do_transform_pose_stamped(whole, transform).pose
    assert result.orientation.w >= 0
    expected = T @ matrix((position, orientation))
    assert close(matrix((points_of(result.position), points_of(result.orientation, "xyzw"))), expected)
    assert str(transform) == before


def test_covariance_turns_with_the_axes(context):
    """Against samples: the covariance of turned samples is the turned covariance, exactly (it is linear)."""
    rng = np.random.default_rng(0)
    samples = rng.normal(size=(200, 6)) @ rng.normal(size=(6, 6))
    pose = ((1.0, 2.0, 3.0), tuple(Rotation.random(rng=1).as_quat()))
    R = Rotation.from_quat(pose[1]).as_matrix()
    turned = np.hstack([samples[:, :3] @ R.T, samples[:, 3:] @ R.T])
    message = PoseWithCovarianceStamped()
    message.pose.covariance = np.cov(samples.T).reshape(36)
    found = tf2_geometry_msgs.do_transform_pose_with_covariance_stamped(message, stamped("map", "base", pose))
    np.testing.assert_allclose(found.pose.covariance.reshape(6, 6), np.cov(turned.T), atol=1e-12)
    assert points_of(found.pose.pose.position).tolist() == [1.0, 2.0, 3.0]


def test_polygon(context):
    polygon = PolygonStamped()
    polygon.polygon.points = [Point32(x=1.0), Point32(y=2.0)]
    half = math.sqrt(0.5)
    moved = tf2_geometry_msgs.do_transform_polygon_stamped(
        polygon, stamped("map", "base", ((1.0, 0.0, 0.0), (0.0, 0.0, half, half)))
    )
    np.testing.assert_allclose([points_of(p) for p in moved.polygon.points], [[1, 1, 0], [-1, 0, 0]], atol=1e-12)


@pytest.mark.parametrize(("bigendian", "kind", "code"), [(False, "f4", 7), (True, "f4", 7), (False, "f8", 8)])
def test_cloud_keeps_layout_and_other_fields(context, bigendian, kind, code):
    """A 2x3 organised cloud with a colour between y and z, and padding at the end of each row."""
    rng = np.random.default_rng(3)
    order, size = ">" if bigendian else "<", np.dtype(kind).itemsize
    names = ["x", "y", "rgb", "z"]
    offsets = [0, size, 2 * size, 2 * size + 4]
    step = 3 * size + 4
    dtype = np.dtype({"names": names, "formats": [order + kind] * 2 + [order + "u4", order + kind],
                      "offsets": offsets, "itemsize": step})  # fmt: skip
    rows = np.zeros((2, 3), dtype)
    for name in ("x", "y", "z"):
        rows[name] = rng.normal(size=(2, 3))
    rows["rgb"] = rng.integers(0, 2**24, size=(2, 3))
    data = b"".join(row.tobytes() + b"pad!" for row in rows)
    cloud = PointCloud2(height=2, width=3, point_step=step, row_step=3 * step + 4, is_bigendian=bigendian)
    cloud.fields = [
        PointField(name=name, offset=offset, datatype=6 if name == "rgb" else code, count=1)
        for name, offset in zip(names, offsets, strict=True)
    ]
    cloud.data = array("B", data)
    cloud.header.stamp.sec = 4
    pose = ((1.0, 2.0, 3.0), tuple(Rotation.random(rng=5).as_quat()))
    moved = tf2_sensor_msgs.do_transform_cloud(cloud, stamped("map", "lidar", pose, 10**9))
    assert (moved.header.frame_id, moved.header.stamp.sec, moved.height, moved.row_step) == ("map", 4, 2, 3 * step + 4)
    raw = bytes(moved.data)
    assert raw[3 * step : 3 * step + 4] == b"pad!"
    after = np.stack([np.frombuffer(raw, dtype, 3, row * (3 * step + 4)) for row in range(2)])
    assert (after["rgb"] == rows["rgb"]).all()
    before = np.stack([rows[axis] for axis in "xyz"] + [np.ones((2, 3))])
    expected = np.einsum("ij,jrc->irc", matrix(pose), before.astype(float))[:3]
    np.testing.assert_allclose(np.stack([after[axis] for axis in "xyz"]), expected, atol=1e-6)
    assert bytes(cloud.data) == data


def test_bad_clouds(context):
    transform = stamped("map", "lidar")
    assert tf2_sensor_msgs.do_transform_cloud(cloud_of(0), transform).width == 0
    with pytest.raises(InputError, match="x, y and z"):
        tf2_sensor_msgs.do_transform_cloud(PointCloud2(), transform)
    short = cloud_of(2)
    short.data = short.data[:-1]
    with pytest.raises(InputError, match="row_step"):
        tf2_sensor_msgs.do_transform_cloud(short, transform)


def cloud_of(count):
    cloud = PointCloud2(height=1, width=count, point_step=12, row_step=12 * count, data=array("B", bytes(12 * count)))
    cloud.fields = [PointField(name=axis, offset=4 * index, datatype=7, count=1) for index, axis in enumerate("xyz")]
    return cloud


def test_transform_of_a_stamped_message(context):
    buffer = Buffer()
    buffer.set_transform_static(stamped("base", "lidar", at(0.2, 0.0, 0.5)), "test")
    point = PointStamped()
    point.header.frame_id, point.point.x = "lidar", 1.0
    point.header.stamp.sec = 3
    moved = buffer.transform(point, "base")
    assert points_of(moved.point) == pytest.approx([1.2, 0.0, 0.5]) and moved.header.stamp.sec == 3
    again = buffer.transform_full(point, "base", Time(seconds=8), "base")
    assert again.header.stamp.sec == 8
    assert buffer.transform(point, "base", new_type=PointStamped) == moved
    with pytest.raises(tf2_ros.TypeException, match="import tf2_geometry_msgs"):
        buffer.transform(LaserScan(), "base")
    with pytest.raises(tf2_ros.TypeException):
        buffer.transform(point, "base", new_type=int)


# ---------------------------------------------------------------- in simulated time


def test_broadcaster_to_listener(context):
    robot, brain = Node("robot"), Node("brain")
    buffer = Buffer()
    TransformListener(buffer, brain)
    moving, fixed = TransformBroadcaster(robot), StaticTransformBroadcaster(robot)
    fixed.sendTransform([stamped("base", "lidar", at(0.0, 0.0, 1.0)), stamped("base", "imu")])

    def drive():
        now = robot.get_clock().now()
        moving.sendTransform(stamped("odom", "base", at(now.nanoseconds / 1e9), now.nanoseconds))

    robot.create_timer(0.1, drive)
    context.run_for(1.0)
    found = buffer.lookup_transform("odom", "lidar", Time(seconds=0.55))
    assert points_of(found.transform.translation) == pytest.approx([0.55, 0.0, 1.0])
    late = Buffer()
    TransformListener(late, Node("late"))
    context.run_for(0.01)
    assert late.can_transform("imu", "lidar", Time()), "transient local: the static frames reach who comes later"
    assert not late.can_transform("odom", "lidar", Time())
    assert context.topics["/tf_static"].publishers[0].qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL


def test_a_static_frame_keeps_its_first_transform(context):
    node = Node("robot")
    fixed = StaticTransformBroadcaster(node)
    fixed.sendTransform(stamped("base", "lidar"))
    fixed.sendTransform(stamped("base", "lidar"))
    assert not context.log_lines
    fixed.sendTransform(stamped("base", "lidar", at(1.0)))
    assert "keeps its first transform" in context.log_lines[-1].message
    assert len(fixed.net_message.transforms) == 1


def start_robot(context, period=0.1):
    robot = Node("robot")
    broadcaster = TransformBroadcaster(robot)
    robot.create_timer(
        period, lambda: broadcaster.sendTransform(stamped("odom", "base", stamp_ns=robot.get_clock().now().nanoseconds))
    )
    return robot


def test_outside_callbacks_a_timeout_lets_time_pass(context):
    start_robot(context)
    brain = Node("brain")
    buffer = Buffer(node=brain)
    TransformListener(buffer, brain)
    found = buffer.lookup_transform("odom", "base", Time(seconds=0.25), Duration(seconds=1))
    assert found.header.stamp.nanosec == 250_000_000 and context.now_ns == 300_000_000
    with pytest.raises(tf2_ros.ExtrapolationException, match="into the future"):
        buffer.lookup_transform("odom", "base", Time(seconds=60), Duration(seconds=0.5))
    assert context.now_ns == 800_000_000, "the whole timeout has passed"
    assert not buffer.can_transform("odom", "nowhere", Time(), Duration(seconds=0.2))
    assert context.now_ns == 1_000_000_000
    assert buffer.can_transform_full("base", Time(seconds=1.2), "base", Time(seconds=1.1), "odom", Duration(seconds=1))
    assert context.now_ns == 1_200_000_000


def test_waiting_stops_at_the_horizon(context):
    context.horizon_ns = 100_000_000
    assert not Buffer(node=Node("brain")).can_transform("a", "b", Time(), Duration(seconds=5))
    assert context.now_ns == 100_000_000


def test_inside_a_callback_a_timeout_fails_at_once_with_advice(context):
    start_robot(context)
    brain = Node("brain")
    buffer = Buffer(node=brain)
    TransformListener(buffer, brain)
    caught = []

    def plan():
        try:
            buffer.lookup_transform("odom", "base", brain.get_clock().now(), Duration(seconds=1))
        except tf2_ros.TransformException as error:
            caught.append((context.now_ns, error))
        caught.append(
            buffer.can_transform("odom", "base", Time(seconds=99), Duration(seconds=1), return_debug_tuple=True)
        )

    timer = brain.create_timer(0.25, plan)
    context.run_until(250_000_000)
    timer.cancel()
    (when, error), (can, reason) = caught
    assert when == 250_000_000 and isinstance(error, tf2_ros.ExtrapolationException)
    assert "lookup_transform_async" in str(error) and "lookup_transform_async" in reason and not can
    context.run_until(260_000_000)
    assert context.now_ns == 260_000_000


def test_asynchronous_lookup(context):
    start_robot(context)
    brain = Node("brain")
    buffer = Buffer(node=brain)
    TransformListener(buffer, brain)
    seen = []

    async def plan():
        timer.cancel()
        transform = await buffer.lookup_transform_async("odom", "base", Time(seconds=0.52))
        seen.append((context.now_ns, transform.header.stamp.nanosec))
        await buffer.lookup_transform_full_async("base", Time(seconds=0.7), "base", Time(seconds=0.6), "odom")
        seen.append(context.now_ns)

    timer = brain.create_timer(0.25, plan)
    context.run_for(1.0)
    assert seen == [(600_000_000, 520_000_000), 700_000_000]
    future = buffer.wait_for_transform_async("odom", "base", Time(seconds=0.9))
    assert future.done() and future.result().header.stamp.nanosec == 900_000_000
    given_up = buffer.wait_for_transform_async("odom", "base", Time(seconds=1.05))
    given_up.cancel()
    context.run_for(1.0)
    assert buffer._waiting == [] and given_up.cancelled()


def test_time_that_jumps_back_clears_the_buffer(context):
    brain = Node("brain")
    buffer = Buffer(node=brain)
    buffer.set_transform_static(stamped("base", "lidar"), "test")
    context.run_until(5 * 10**9)
    buffer.set_transform(stamped("odom", "base", stamp_ns=5 * 10**9), "test")
    context.now_ns = 10**9  # a replay begins again
    buffer.set_transform(stamped("odom", "base", stamp_ns=10**9), "test")
    assert [line.message for line in context.log_lines] == ["Detected jump back in time. Clearing tf buffer."]
    assert buffer.lookup_transform("odom", "base", Time()).header.stamp.sec == 1
    assert buffer.can_transform("base", "lidar", Time())


def test_frames_service(context):
    node = Node("brain")
    buffer = Buffer(node=node)
    buffer.set_transform(stamped("odom", "base", stamp_ns=10**9), "test")
    client = node.create_client(FrameGraph, "tf2_frames")
    answer = client.call_async(FrameGraph.Request())
    rclpy.spin_until_future_complete(node, answer, timeout_sec=1.0)
    assert answer.result().frame_yaml == buffer.all_frames_as_yaml()
    assert "parent: 'odom'" in answer.result().frame_yaml
    assert BufferCore().all_frames_as_yaml() == "[]"


def test_imports_as_programs_write_them():
    """A student's file imports from any of these places; all give the same objects."""
    import tf2_py
    from tf2_geometry_msgs.tf2_geometry_msgs import do_transform_point
    from tf2_ros.buffer import Buffer as FromModule
    from tf2_ros.static_transform_broadcaster import StaticTransformBroadcaster as Static
    from tf2_ros.transform_broadcaster import TransformBroadcaster as Moving
    from tf2_ros.transform_listener import TransformListener as Listener

    assert (FromModule, Static, Moving, Listener) == (
        Buffer, StaticTransformBroadcaster, TransformBroadcaster, TransformListener,
    )  # fmt: skip
    assert tf2_ros.buffer.Buffer is Buffer and tf2_geometry_msgs.do_transform_point is do_transform_point
    assert issubclass(Buffer, tf2_py.BufferCore) and issubclass(Buffer, tf2_ros.BufferInterface)
    assert tf2_py.LookupException is tf2_ros.LookupException
    with pytest.raises(ImportError):
        __import__("tf2_ros.nothing")


def test_two_runs_give_the_same_bytes():
    def once():
        context = SimContext(latency_ns=3_000_000)
        lines = []
        context.add_tap(lambda *publication: lines.append(publication))
        with context.as_default():
            start_robot(context)
            context.run_for(1.0)
        return lines

    assert once() == once() and len(once()) == 10
