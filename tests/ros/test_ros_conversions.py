"""Conversions are inverse to each other and agree with geometry."""

from __future__ import annotations

import math

import numpy as np
import pytest
from geometry_msgs.msg import Quaternion
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.time import Time
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Image, LaserScan, PointCloud2, PointField

from robotbrain.errors import InputError
from robotbrain.ros import conversions as convert


def wire(message):
    return deserialize_message(serialize_message(message), type(message))


@pytest.mark.parametrize("encoding", sorted(convert.IMAGE_ENCODINGS))
def test_images_round_trip(encoding):
    dtype, channels = convert.IMAGE_ENCODINGS[encoding]
    rng = np.random.default_rng(0)
    pixels = (rng.random((5, 7, channels)) * 200).astype(dtype)
    pixels = pixels[:, :, 0] if channels == 1 else pixels
    message = convert.numpy_to_image(pixels[::-1], encoding, stamp=1_500_000_000, frame_id="cam")
    assert (message.height, message.width, message.step) == (5, 7, 7 * channels * np.dtype(dtype).itemsize)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1, 500_000_000)
    back = convert.image_to_numpy(wire(message))
    assert back.dtype == np.dtype(dtype) and np.array_equal(back, pixels[::-1])
    back[...] = 0  # writable and not the message's memory
    assert np.array_equal(convert.image_to_numpy(message), pixels[::-1])


def test_infinite_depth_survives():
    depth = np.array([[1.5, np.inf]], np.float32)
    assert np.array_equal(convert.image_to_numpy(wire(convert.numpy_to_image(depth, "32FC1"))), depth)


def test_row_padding_and_big_endian_are_honoured():
    rows = np.arange(6, dtype=">u2").reshape(2, 3)
    padded = b"".join(row.tobytes() + b"\xee\xee" for row in rows)
    message = Image(height=2, width=3, encoding="mono16", is_bigendian=1, step=8, data=padded)
    assert np.array_equal(convert.image_to_numpy(message), [[0, 1, 2], [3, 4, 5]])


@pytest.mark.parametrize(
    ("fields", "match"),
    [({"encoding": "yuv422"}, "encoding"), ({"step": 5}, "step"), ({"height": 3}, "data"), ({"data": b""}, "data")],
)
def test_broken_images_are_refused(fields, match):
    message = convert.numpy_to_image(np.zeros((2, 2, 3), np.uint8), "rgb8")
    for name, value in fields.items():
        setattr(message, name, value)
    with pytest.raises(InputError, match=match):
        convert.image_to_numpy(message)


@pytest.mark.parametrize(("pixels", "encoding"), [
    (np.zeros((2, 2), np.uint8), "rgb8"), (np.zeros((2, 2, 4), np.uint8), "rgb8"),
    (np.zeros((2, 2, 3)), "rgb8"), (np.zeros((2, 2)), "32FC1"), (np.zeros((2, 2, 1), np.uint8), "mono8"),
])  # fmt: skip
def test_wrong_arrays_are_refused(pixels, encoding):
    with pytest.raises(InputError, match="pixels"):
        convert.numpy_to_image(pixels, encoding)


def test_scan_angles():
    scan = LaserScan(angle_min=-math.pi, angle_increment=2 * math.pi / 120, ranges=[1.0] * 119 + [math.inf])
    ranges, angles = convert.scan_to_arrays(scan)
    assert ranges.shape == angles.shape == (120,) and np.isinf(ranges[-1])
    np.testing.assert_allclose(angles, -math.pi + 2 * math.pi * np.arange(120) / 120, atol=1e-12)


def test_clouds_round_trip_and_other_layouts_are_read():
    points = np.random.default_rng(1).normal(size=(9, 3)).astype(np.float32)
    message = convert.points_to_cloud(points, frame_id="base_link")
    assert np.array_equal(convert.cloud_to_points(wire(message)), points)
    assert convert.cloud_to_points(convert.points_to_cloud(np.zeros((0, 3)))).shape == (0, 3)
    layout = np.dtype({"names": ["i", "z", "y", "x"], "formats": ["u1", ">f4", ">f4", ">f4"], "offsets": [0, 4, 8, 16],
                       "itemsize": 24})  # fmt: skip
    rows = np.zeros((3, 3), layout)
    for axis, name in enumerate("xyz"):
        rows[name] = points[:, axis].reshape(3, 3)
    padded = b"".join(row.tobytes() + b"\x00" * 8 for row in rows)
    fields = [
        PointField(name=name, offset=layout.fields[name][1], datatype=PointField.FLOAT32, count=1) for name in "xyz"
    ]
    cloud = PointCloud2(height=3, width=3, fields=fields, is_bigendian=True, point_step=24, row_step=80, data=padded)
    assert np.array_equal(convert.cloud_to_points(cloud), points)
    with pytest.raises(InputError):
        convert.cloud_to_points(PointCloud2(height=3, width=3, fields=fields, point_step=24, row_step=80, data=b""))
    with pytest.raises(InputError, match="x, y and z"):
        convert.cloud_to_points(PointCloud2())
    with pytest.raises(InputError, match="points"):
        convert.points_to_cloud(np.zeros((4, 2)))


def test_grids_round_trip():
    cells = np.array([[-1, 0, 100], [50, 1, 2]], np.int8)
    grid = convert.grid_to_numpy(wire(convert.numpy_to_grid(cells, 0.05, (1.0, -2.0, 0.5))))
    assert np.array_equal(grid.cells, cells) and grid.cells.dtype == np.int8
    assert grid.resolution == pytest.approx(0.05) and grid.origin == pytest.approx((1.0, -2.0, 0.5))
    for bad in (np.full((2, 2), 101), np.zeros((2, 2)), np.zeros(4, int)):
        with pytest.raises(InputError, match="cells"):
            convert.numpy_to_grid(bad, 0.05, (0.0, 0.0))
    with pytest.raises(InputError, match="resolution"):
        convert.numpy_to_grid(cells, 0.0, (0.0, 0.0))


@given(st.floats(-math.pi + 1e-9, math.pi), st.floats(0.1, 10))
def test_yaw_agrees_with_scipy(yaw, scale):
    quaternion = convert.yaw_to_quaternion(yaw)
    expected = Rotation.from_euler("z", yaw).as_quat()
    assert abs(np.dot(expected, [quaternion.x, quaternion.y, quaternion.z, quaternion.w])) == pytest.approx(1.0)
    scaled = Quaternion(z=quaternion.z * scale, w=quaternion.w * scale)
    assert convert.quaternion_to_yaw(scaled) == pytest.approx(yaw, abs=1e-9)


@given(st.floats(-3, 3), st.floats(-1.5, 1.5), st.floats(-3, 3))
def test_yaw_of_a_tilted_body(yaw, pitch, roll):
    x, y, z, w = map(float, Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_quat())
    measured = convert.quaternion_to_yaw(Quaternion(x=x, y=y, z=z, w=w))
    assert math.cos(measured - yaw) == pytest.approx(1.0, abs=1e-6)


def test_zero_quaternion_is_refused():
    with pytest.raises(InputError, match="quaternion"):
        convert.quaternion_to_yaw(Quaternion(w=0.0))


def test_paths_round_trip_and_face_forward():
    points = np.array([[0.0, 0.0], [1.0, 1.0], [1.0, 3.0]])
    path = wire(convert.numpy_to_path(points, stamp=Time(seconds=2), frame_id="map"))
    assert np.array_equal(convert.path_to_numpy(path), points)
    yaws = [convert.quaternion_to_yaw(pose.pose.orientation) for pose in path.poses]
    assert yaws == pytest.approx([math.pi / 4, math.pi / 2, math.pi / 2])
    assert {pose.header.frame_id for pose in path.poses} == {"map"} and path.poses[0].header.stamp.sec == 2
    assert convert.path_to_numpy(convert.numpy_to_path([])).shape == (0, 2)
    for bad in ([[1.0, 2.0, 3.0]], [[float("nan"), 0.0]]):
        with pytest.raises(InputError, match="path"):
            convert.numpy_to_path(bad)


@given(st.integers(0, 2**31 * 10**9 - 1))
def test_stamps_are_exact(nanoseconds):
    assert convert.time_to_ns(convert.ns_to_time(nanoseconds)) == nanoseconds
