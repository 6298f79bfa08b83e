"""Message classes behave as those of genuine rclpy with field checks on."""

from __future__ import annotations

import array

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, Quaternion, Twist, Vector3
from nav_msgs.msg import Path
from sensor_msgs.msg import Image, Imu, JointState, LaserScan, PointField
from std_msgs.msg import Bool, Byte, ByteMultiArray, Float32, String, UInt8
from std_srvs.srv import SetBool, Trigger

from robotbrain.errors import InputError


def test_slots_keywords_and_constants():
    assert Vector3.__slots__ == ("_x", "_y", "_z")
    assert Vector3(x=1.0, z=2.0) == Vector3(x=1.0, y=0.0, z=2.0)
    assert PointField.FLOAT32 == 7
    assert not hasattr(Vector3(), "__dict__")
    assert SetBool.Request(data=True).data is True
    assert Trigger.Response().success is False


def test_defaults_are_not_shared():
    first, second = Imu(), Imu()
    first.header.stamp.sec = 5
    first.orientation_covariance[0] = 1.0
    assert second == Imu()
    first, second = JointState(), JointState()
    first.name.append("a")
    first.position.append(1.0)
    assert second == JointState()


@pytest.mark.parametrize(
    ("cause", "error"),
    [
        (lambda: setattr(Twist(), "speed", 1.0), AttributeError),
        (lambda: Twist(speed=1.0), AssertionError),
        (lambda: Twist().speed, AttributeError),
    ],
)
def test_unknown_field_names_the_fields(cause, error):
    with pytest.raises(error, match=r"'speed'.*linear, angular"):
        cause()


BAD = [
    (Vector3, "x", "fast"),
    (Vector3, "x", 1),  # genuine rclpy refuses an int in a float field
    (Vector3, "x", None),
    (Float32, "data", 1e39),
    (Image, "height", -1),
    (Image, "height", 2**32),
    (Image, "height", 1.0),
    (UInt8, "data", 256),
    (Time, "sec", 2**31),
    (Bool, "data", 1),
    (Byte, "data", 1),
    (Byte, "data", b"ab"),
    (String, "data", b"bytes"),
    (Twist, "linear", 3.0),
    (Twist, "linear", Quaternion()),
    (Imu, "orientation_covariance", [1.0]),
    (Imu, "orientation_covariance", np.zeros(10)),
    (LaserScan, "ranges", ["a"]),
    (LaserScan, "ranges", 3.0),
    (LaserScan, "ranges", "abc"),
    (LaserScan, "ranges", np.zeros((2, 2))),
    (Image, "data", [256]),
    (Image, "data", np.array([300])),
    (Image, "data", np.array([0.5])),
    (Image, "data", "abc"),
    (JointState, "name", "left"),
    (JointState, "name", [1]),
    (Path, "poses", [Twist()]),
    (Path, "poses", PoseStamped()),
    (ByteMultiArray, "data", [1]),
]


@pytest.mark.parametrize(("cls", "field", "value"), BAD)
def test_wrong_values_are_refused(cls, field, value):
    message = cls()
    before = repr(message)
    with pytest.raises(AssertionError, match=f"{cls.__name__}.{field}") as caught:
        setattr(message, field, value)
    assert isinstance(caught.value, InputError)
    assert repr(message) == before


@pytest.mark.parametrize("values", [[1.0, 2.5], (1.0, 2.5), np.array([1.0, 2.5]), np.array([1.0, 2.5], np.float32),
                                    array.array("d", [1.0, 2.5])])  # fmt: skip
def test_sequences_become_arrays(values):
    scan = LaserScan(ranges=values)
    assert isinstance(scan.ranges, array.array) and scan.ranges.typecode == "f"
    assert list(scan.ranges) == [1.0, 2.5]
    assert isinstance(Imu().orientation_covariance, np.ndarray)


def test_fixed_arrays_do_not_share_memory_with_what_was_assigned():
    covariance = np.eye(3).reshape(-1)
    message = Imu(orientation_covariance=covariance)
    covariance[0] = 9.0
    assert message.orientation_covariance[0] == 1.0


def test_strided_numpy_is_taken_in_order():
    values = np.arange(12, dtype=np.float32)[::3]
    assert list(LaserScan(ranges=values).ranges) == [0.0, 3.0, 6.0, 9.0]


def test_bytes_go_into_uint8_sequences():
    for value in (b"\x01\xff", bytearray(b"\x01\xff"), [1, 255], np.array([1, 255])):
        assert Image(data=value).data == array.array("B", [1, 255])


def test_infinities_and_nan_are_allowed():
    assert Float32(data=float("inf")).data == float("inf")
    assert np.isnan(Float32(data=float("nan")).data)


def test_equality_and_repr():
    assert Imu() == Imu() and Twist() != Vector3()
    assert repr(LaserScan(ranges=[1.0]).ranges) == "array('f', [1.0])"
    assert "ranges=[1.0]" in repr(LaserScan(ranges=[1.0]))
    with pytest.raises(TypeError):
        hash(Twist())
