"""Messages: constructors, fields, wrong values, comparison, text, constants, copies.

Genuine messages check what they are given only with ``ROS_PYTHON_CHECK_FIELDS=1``, which the suite sets; what they
take without is in ``messages_unchecked``.
"""

import copy
import math

import numpy as np
from builtin_interfaces.msg import Time
from conformance import attempt, log
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, Twist, Vector3
from nav_msgs.msg import OccupancyGrid, Odometry
from sensor_msgs.msg import BatteryState, Image, Imu, JointState, LaserScan, NavSatStatus, PointField
from shape_msgs.msg import SolidPrimitive
from std_msgs.msg import Bool, Byte, Char, ColorRGBA, Empty, Float32, Header, Int8, Int64, String, UInt8, UInt64
from std_srvs.srv import SetBool


def constructing() -> None:
    for cls in (Twist, PoseStamped, LaserScan, Odometry, Empty, BatteryState, NavSatStatus, SetBool.Request):
        attempt("default", lambda c=cls: c(), cls=cls)
        log("text", text=repr(cls()))
    log(
        "fields",
        fields=PoseStamped.get_fields_and_field_types(),
        slots=[name for name in PoseStamped.__slots__ if name != "_check_fields"],
    )
    log("keywords", vector=Vector3(x=1.0, z=-2.0), nested=Pose(position=Point(x=3.0)))
    attempt("positional", lambda: Vector3(1.0, 2.0, 3.0))
    attempt("unknown field", lambda: Vector3(w=1.0))
    attempt("assign an unknown field", lambda: setattr(Vector3(), "w", 1.0))
    attempt("service class", lambda: SetBool())
    log(
        "constants",
        ok=DiagnosticStatus.OK,
        sphere=SolidPrimitive.SPHERE,
        float32=PointField.FLOAT32,
        unknown=BatteryState.POWER_SUPPLY_STATUS_UNKNOWN,
    )
    attempt("constant of an instance", lambda: SolidPrimitive().SPHERE)
    attempt("change a constant", lambda: setattr(SolidPrimitive, "SPHERE", 9))
    log("default of a field", w=Quaternion().w, status=NavSatStatus().status)


def assigning() -> None:
    wrong = {
        "int for float64": (Vector3, "x", 1),
        "numpy float": (Vector3, "x", np.float64(1.5)),
        "numpy float32": (Vector3, "x", np.float32(1.5)),
        "bool for float": (Vector3, "x", True),
        "text for float": (Vector3, "x", "1"),
        "None for float": (Vector3, "x", None),
        "nan": (Vector3, "x", math.nan),
        "float32 too large": (Float32, "data", 1e39),
        "float32 infinite": (Float32, "data", math.inf),
        "float for int": (Int64, "data", 1.0),
        "numpy int": (Int64, "data", np.int64(3)),
        "bool for int": (Int64, "data", True),
        "int8 too large": (Int8, "data", 128),
        "int8 lowest": (Int8, "data", -128),
        "uint8 negative": (UInt8, "data", -1),
        "uint64 largest": (UInt64, "data", 2**64 - 1),
        "uint64 too large": (UInt64, "data", 2**64),
        "int for bool": (Bool, "data", 1),
        "numpy bool": (Bool, "data", np.bool_(True)),
        "int for text": (String, "data", 5),
        "bytes for text": (String, "data", b"x"),
        "byte": (Byte, "data", b"\x05"),
        "int for byte": (Byte, "data", 5),
        "two bytes": (Byte, "data", b"ab"),
        "char": (Char, "data", 65),
        "text for char": (Char, "data", "A"),
        "another message": (Pose, "position", Vector3()),
        "dict for a message": (Pose, "position", {"x": 1.0}),
        "None for a message": (Pose, "position", None),
        "class for a message": (Pose, "position", Point),
        "negative time": (Time, "sec", -1),
        "too many nanoseconds": (Time, "nanosec", 2**32),
    }
    for name, (cls, field, value) in wrong.items():
        attempt(f"set {name}", lambda c=cls, f=field, v=value: getattr(assigned(c, f, v), f))
        attempt(f"construct {name}", lambda c=cls, f=field, v=value: getattr(c(**{f: v}), f))
    color = ColorRGBA(r=0.1, a=1.0)
    log("float32 keeps what was given", r=color.r)


def assigned(cls, field: str, value):
    message = cls()
    setattr(message, field, value)
    return message


def covariance_of(value):
    return assigned(Imu, "orientation_covariance", value).orientation_covariance


def arrays() -> None:
    values = {
        "list": [1.0, 2.5], "tuple": (1.0, 2.0), "text": "ab", "texts": ["a"], "None": None, "empty": [],
        "nested": [[1.0], [2.0]], "set": {1.0}, "inf": [math.inf], "number": 1.0,
    }  # fmt: skip
    for name, value in values.items():
        attempt(f"ranges {name}", lambda v=value: described(assigned(LaserScan, "ranges", v).ranges))
    log("kinds", ranges=described(LaserScan().ranges), names=described(JointState().name))
    log("kind of a fixed array", covariance=described(Imu().orientation_covariance))
    for name, value in {
        "right": [0.5] * 9, "short": [0.5] * 8, "long": [0.5] * 10, "array": np.arange(9.0), "tuple": (0.0,) * 9,
        "short array": np.zeros(8), "two-dimensional": np.eye(3), "None": None,
    }.items():  # fmt: skip
        attempt(f"covariance {name}", lambda v=value: described(covariance_of(v)))
    for name, value in {
        "bytes": b"\x00\x01", "bytearray": bytearray(b"ab"), "list": [1, 255], "256": [256], "negative": [-1],
        "text": "ab", "None": None, "floats": [1.5],
    }.items():  # fmt: skip
        attempt(f"image data {name}", lambda v=value: described(assigned(Image, "data", v).data))
    for name, value in {"list": [-1, 100], "300": [300], "-129": [-129]}.items():
        attempt(f"grid data {name}", lambda v=value: described(assigned(OccupancyGrid, "data", v).data))
    for name, value in {"list": ["a", "b"], "tuple": ("a",), "one text": "ab", "ints": [1], "None": None}.items():
        attempt(f"names {name}", lambda v=value: described(assigned(JointState, "name", v).name))
    shape = SolidPrimitive()
    for count in (3, 4):
        attempt(
            f"bounded {count}", lambda n=count: described(assigned(SolidPrimitive, "dimensions", [0.5] * n).dimensions)
        )
    shape.dimensions.extend([1.0, 2.0, 3.0, 4.0])
    log("bounded grows in place", length=len(shape.dimensions))
    odometry = Odometry()
    odometry.pose.covariance[7] = 0.5
    log("fixed in place", value=odometry.pose.covariance[7], length=len(odometry.pose.covariance))
    scan = LaserScan(ranges=[1.0])
    scan.ranges.append(0.1)
    log("float32 rounds in an array", values=scan.ranges)
    log("poses", kind=described(assigned(JointState, "position", [1.0]).position))


def described(value) -> list:
    kind = type(value).__name__
    typecode = getattr(value, "typecode", None) or str(getattr(value, "dtype", ""))
    return [kind, typecode, value]


def comparing() -> None:
    log("equal", same=Vector3(x=1.0) == Vector3(x=1.0), other=Vector3(x=1.0) == Vector3(x=2.0))
    log("other type", point=Point() == Vector3(), none=Point() is None, number=Point() == 0)
    log("nan", equal=Vector3(x=math.nan) == Vector3(x=math.nan))
    log("arrays", same=LaserScan(ranges=[1.0]) == LaserScan(ranges=[1.0]), other=LaserScan(ranges=[1.0]) == LaserScan())
    first, second = Imu(), Imu()
    log("fixed arrays", same=first == second)
    second.orientation_covariance[0] = 1.0
    log("fixed arrays differ", same=first == second)
    attempt("hash", lambda: hash(Vector3()))
    attempt("order", lambda: Vector3() < Vector3())
    pose = PoseStamped(header=Header(frame_id="map", stamp=Time(sec=1, nanosec=2)))
    shallow, deep = copy.copy(pose), copy.deepcopy(pose)
    pose.pose.position.x = 9.0
    log("copies", shallow=shallow.pose.position.x, deep=deep.pose.position.x, frame=deep.header.frame_id)
    twist = Twist()
    linear = twist.linear
    linear.x = 0.5
    log("aliasing", x=twist.linear.x)
    twist.linear = Vector3(x=2.0)
    log("replaced", x=twist.linear.x, old=linear.x)
    scan = LaserScan(ranges=[1.0, 0.1], range_min=0.1)
    scan.header.frame_id = "laser"
    log("text of a full one", text=repr(scan), printed=str(scan) == repr(scan))
    log("text of arrays", text=[repr(Imu()), repr(JointState(name=["a"], position=[0.5])), repr(Image(data=[1, 2]))])


def main() -> None:
    constructing()
    assigning()
    arrays()
    comparing()


if __name__ == "__main__":
    main()
