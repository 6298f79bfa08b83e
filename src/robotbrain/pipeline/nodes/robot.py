"""Robot driver node: the simulated robot behind the topics that a physical one has."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Twist
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image, Imu, JointState, LaserScan

from robotbrain.ros.conversions import ns_to_time, numpy_to_image
from robotbrain.sim import RobotSim

IMU_HZ, WHEELS_HZ, SCAN_HZ, CAMERA_HZ = 50.0, 50.0, 10.0, 10.0
WHEELS = ("left_wheel_joint", "right_wheel_joint")
CATCH_UP_NS = 500_000_000
"""After a longer pause (a suspended laptop, a debugger) the world has stood still for the rest of it, ns."""


class RobotNode(Node):
    """Publishes the simulator's sensors and obeys ``cmd_vel``. The judge's ground truth is not within its reach.

    The simulator keeps up with the node's clock, which reads ``epoch_ns`` when the simulator is at zero.

    Args:
        sim: the robot in its world, at time zero.
        command_topic: what it obeys; ``cmd_vel_safe`` behind a safety node.

    Attributes:
        epoch_ns: the node's time minus the simulator's, ns; grows when the simulator could not keep up.
    """

    def __init__(self, sim: RobotSim, command_topic: str = "cmd_vel") -> None:
        super().__init__("robot")
        self._sim = sim
        self.epoch_ns = int(self.get_clock().now().nanoseconds) - sim.now_ns
        self._imu_pub = self.create_publisher(Imu, "imu", qos_profile_sensor_data)
        self._wheel_pub = self.create_publisher(JointState, "joint_states", 10)
        self._scan_pub = self.create_publisher(LaserScan, "scan", 10)
        self._image_pub = self.create_publisher(Image, "camera/image", 10)
        self._depth_pub = self.create_publisher(Image, "camera/depth", 10)
        self._info_pub = self.create_publisher(CameraInfo, "camera/camera_info", 10)
        self.create_subscription(Twist, command_topic, self._on_command, 1)
        self.create_timer(1.0 / IMU_HZ, self._imu)
        self.create_timer(1.0 / WHEELS_HZ, self._wheels)
        self.create_timer(1.0 / SCAN_HZ, self._scan)
        self.create_timer(1.0 / CAMERA_HZ, self._camera)

    def _advance(self) -> None:
        due = int(self.get_clock().now().nanoseconds) - self.epoch_ns
        behind = due - self._sim.now_ns
        if behind > CATCH_UP_NS:
            self.get_logger().warning(f"the world stood still for {(behind - CATCH_UP_NS) * 1e-9:.1f} s")
            self.epoch_ns += behind - CATCH_UP_NS
            due = self._sim.now_ns + CATCH_UP_NS
        # A clock that others set may go back; physics does not.
        self._sim.advance_to(max(due, self._sim.now_ns))

    def _stamp(self, stamp_ns: int) -> Time:
        return ns_to_time(stamp_ns + self.epoch_ns)

    def _on_command(self, msg: Twist) -> None:
        self._advance()
        self._sim.set_twist(float(msg.linear.x), float(msg.angular.z))

    def _imu(self) -> None:
        self._advance()
        reading = self._sim.read_imu()
        msg = Imu()
        msg.header.stamp, msg.header.frame_id = self._stamp(reading.stamp_ns), "imu_link"
        rate, force = reading.angular_velocity, reading.linear_acceleration
        msg.angular_velocity.x, msg.angular_velocity.y, msg.angular_velocity.z = (float(v) for v in rate)
        msg.linear_acceleration.x, msg.linear_acceleration.y, msg.linear_acceleration.z = (float(v) for v in force)
        # The unit has no orientation estimate: sensor_msgs/Imu says so by -1.
        msg.orientation_covariance[0] = -1.0
        self._imu_pub.publish(msg)

    def _wheels(self) -> None:
        self._advance()
        reading = self._sim.read_encoders()
        msg = JointState()
        msg.header.stamp = self._stamp(reading.stamp_ns)
        msg.name = list(WHEELS)
        msg.position = [float(v) for v in reading.position]
        msg.velocity = [float(v) for v in reading.velocity]
        self._wheel_pub.publish(msg)

    def _scan(self) -> None:
        self._advance()
        reading = self._sim.read_lidar()
        if reading is None:
            return
        msg = LaserScan()
        msg.header.stamp, msg.header.frame_id = self._stamp(reading.stamp_ns), "lidar_link"
        msg.angle_min, msg.angle_increment = reading.angle_min, reading.angle_increment
        msg.angle_max = reading.angle_min + reading.angle_increment * (len(reading.ranges) - 1)
        msg.scan_time = 1.0 / SCAN_HZ
        msg.range_min, msg.range_max = reading.range_min, reading.range_max
        msg.ranges = reading.ranges
        self._deliver(reading.available_ns, lambda: self._scan_pub.publish(msg))

    def _camera(self) -> None:
        self._advance()
        reading = self._sim.read_camera()
        if reading is None:
            return
        stamp, frame = self._stamp(reading.stamp_ns), "camera_optical_frame"
        k = self._sim.camera.intrinsics
        info = CameraInfo()
        info.header.stamp, info.header.frame_id = stamp, frame
        info.height, info.width = k.height, k.width
        info.distortion_model, info.d = "plumb_bob", [0.0] * 5
        info.k = k.matrix.ravel()
        info.r = np.eye(3).ravel()
        info.p = np.column_stack([k.matrix, np.zeros(3)]).ravel()
        depth = numpy_to_image(reading.depth, "32FC1", stamp=stamp, frame_id=frame)
        image = numpy_to_image(reading.rgb, "rgb8", stamp=stamp, frame_id=frame)

        def publish() -> None:
            self._info_pub.publish(info)
            self._depth_pub.publish(depth)
            self._image_pub.publish(image)

        self._deliver(reading.available_ns, publish)

    def _deliver(self, available_ns: int, publish: Callable[[], None]) -> None:
        """Publish now, or once the sensor's own latency has passed."""
        delay_ns = available_ns - self._sim.now_ns
        if delay_ns <= 0:
            publish()
            return

        def fire() -> None:
            timer.cancel()
            self.destroy_timer(timer)
            publish()

        timer = self.create_timer(delay_ns * 1e-9, fire)
