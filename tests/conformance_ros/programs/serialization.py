"""serialize_message and deserialize_message: bytes, both ways, of messages, services and wrong input."""

from conformance import attempt, log
from geometry_msgs.msg import Pose, PoseArray, Twist, Vector3
from nav_msgs.msg import OccupancyGrid, Odometry
from nav_msgs.srv import GetPlan
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CameraInfo, Image, JointState, LaserScan, PointCloud2, PointField
from std_msgs.msg import Byte, Char, Empty, Float32, Header, Int8, String, UInt64
from std_srvs.srv import Empty as EmptyService
from std_srvs.srv import Trigger
from visualization_msgs.msg import Marker


def examples() -> list:
    scan = LaserScan(angle_min=-1.5, range_max=8.0, ranges=[0.1, 2.0, float("inf")], intensities=[1.0])
    scan.header = Header(frame_id="laser")
    joints = JointState(name=["shoulder", "elbow", ""], position=[0.1, -2.5], velocity=[], effort=[1e-300])
    grid = OccupancyGrid(data=[-1, 0, 100])
    grid.info.width, grid.info.height, grid.info.resolution = 3, 1, 0.05
    odometry = Odometry(child_frame_id="base")
    odometry.pose.covariance[35] = 0.25
    cloud = PointCloud2(
        height=1, width=2, fields=[PointField(name="x", offset=0, datatype=7, count=1)], data=b"\x01\x02"
    )
    camera = CameraInfo(height=4, distortion_model="plumb_bob", d=[0.1, 0.2])
    marker = Marker(ns="n", id=-1, text="häß")
    return [
        Twist(linear=Vector3(x=0.5)), scan, joints, grid, odometry, cloud, camera, marker,
        PoseArray(poses=[Pose(), Pose()]), Image(data=bytes(range(5)), encoding="mono8"), Float32(data=0.1),
        Empty(), String(data="日本"), Byte(data=b"\xff"), Char(data=255), Int8(data=-5), UInt64(data=2**64 - 1),
        Trigger.Response(success=True, message="done"), EmptyService.Request(), GetPlan.Request(tolerance=0.5),
    ]  # fmt: skip


def main() -> None:
    for message in examples():
        cls = type(message)
        data = serialize_message(message)
        back = deserialize_message(data, cls)
        # What lies between aligned values is not defined, nor is the padding at the end: bytes are not compared.
        log("bytes", cls=cls, kind=type(data), header=data[:4])
        log("back", cls=cls, message=back, equal=back == message)
    attempt("a class", lambda: serialize_message(Twist))
    attempt("a number", lambda: serialize_message(5))
    attempt("no bytes", lambda: deserialize_message(b"", Twist))
    attempt("half of it", lambda: deserialize_message(serialize_message(Twist())[:20], Twist))
    attempt("text", lambda: deserialize_message("text", Twist))
    attempt("to no message", lambda: deserialize_message(serialize_message(Twist()), int))
    longer = serialize_message(Float32(data=1.0)) + b"\x00" * 8
    attempt("more than needed", lambda: deserialize_message(longer, Float32).data)
    big = b"\x00\x00\x00\x00\x3f\x80\x00\x00"
    attempt("big-endian", lambda: deserialize_message(big, Float32).data)


if __name__ == "__main__":
    main()
