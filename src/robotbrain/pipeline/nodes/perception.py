"""Perception node: images in, labelled points and the marker's position out."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import PointStamped
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from robotbrain.errors import InputError
from robotbrain.jetson.engine import InferenceEngine
from robotbrain.pipeline.segmentation import (
    CameraModel,
    back_project,
    decode,
    ground_points,
    locate_marker,
    preprocess,
)
from robotbrain.ros import charge, charge_work
from robotbrain.ros.conversions import image_to_numpy, numpy_to_image, points_to_cloud

BEST_EFFORT = ReliabilityPolicy.BEST_EFFORT
FLOOR_LABEL, OBSTACLE_LABEL = 0.0, 1.0
"""Third coordinate of a published point: 0 on the floor, 1 on an obstacle (the points themselves are flat)."""


def rgb_of(msg: Image) -> NDArray[np.uint8]:
    """Return an image as (H, W, 3) red, green, blue.

    Raises:
        InputError: for an encoding that is not in colour: the network would see nonsense, and nobody would notice.
    """
    image = image_to_numpy(msg)
    if msg.encoding == "bgr8":
        return np.ascontiguousarray(image[..., ::-1])
    if msg.encoding != "rgb8":
        raise InputError(
            "camera/image",
            given=f"encoding {msg.encoding!r}",
            expected="'rgb8' or 'bgr8'",
            fix="Let the camera driver publish colour, or convert before.",
        )
    return image


class PerceptionNode(Node):
    """Runs the segmentation network on every image.

    Subscribes ``camera/image``, ``camera/depth``, ``camera/camera_info``; publishes ``perception/segmentation``
    (mono8 class ids), ``perception/marker`` (PointStamped in base_link, only when seen) and ``perception/points``
    (PointCloud2 in base_link; z is the label). Every output carries the stamp of the image it came from.

    Args:
        engine: runs the network; its latency (0 on a board, where time passes by itself) is charged to simulated time.
        mounting: (x, y, z, pitch) of the camera on the base, m and rad.
        queue: images that may wait; the oldest makes way. None: as many as come.
    """

    def __init__(
        self, engine: InferenceEngine, mounting: tuple[float, float, float, float], queue: int | None = 1
    ) -> None:
        super().__init__("perception")
        self._engine = engine
        self._mounting = mounting
        self._camera: CameraModel | None = None
        self._depth: Image | None = None
        self._mask_pub = self.create_publisher(Image, "perception/segmentation", 10)
        self._marker_pub = self.create_publisher(PointStamped, "perception/marker", 10)
        self._points_pub = self.create_publisher(PointCloud2, "perception/points", 10)
        self.create_subscription(CameraInfo, "camera/camera_info", self._on_info, 10)
        keep_all = QoSProfile(history=HistoryPolicy.KEEP_ALL)
        # An image is of no use without its depth, which came just before: as many of those must be able to wait.
        depths = keep_all if queue is None else QoSProfile(depth=max(5, queue), reliability=BEST_EFFORT)
        self.create_subscription(Image, "camera/depth", self._on_depth, depths)
        images = keep_all if queue is None else QoSProfile(depth=queue)
        self.create_subscription(Image, "camera/image", self._on_image, images)

    def _on_info(self, msg: CameraInfo) -> None:
        x, y, z, pitch = self._mounting
        self._camera = CameraModel(float(msg.k[0]), float(msg.k[4]), float(msg.k[2]), float(msg.k[5]), (x, y, z), pitch)

    def _on_depth(self, msg: Image) -> None:
        self._depth = msg

    def _on_image(self, msg: Image) -> None:
        if self._camera is None or self._depth is None or self._depth.header.stamp != msg.header.stamp:
            return
        mask = self.segment(rgb_of(msg))
        points = back_project(image_to_numpy(self._depth), self._camera)
        charge_work("back_project", mask.size)
        self._publish(msg, mask, points)

    def segment(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the (H, W) class ids of an (H, W, 3) image."""
        batch = preprocess(image)
        charge_work("preprocess", image.shape[0] * image.shape[1])
        logits = self._engine.infer(batch)
        charge(self._engine.latency_ns, self._engine.resource)
        mask = decode(logits)
        charge_work("decode", mask.size)
        return mask

    def _publish(self, msg: Image, mask: NDArray[np.uint8], points: NDArray[np.float64]) -> None:
        mask_image = numpy_to_image(mask, "mono8", stamp=msg.header.stamp, frame_id=msg.header.frame_id)
        floor, obstacles = ground_points(mask, points)
        marker = locate_marker(mask, points)
        labelled = np.zeros((len(floor) + len(obstacles), 3), dtype=np.float32)
        labelled[: len(floor), :2] = floor
        labelled[len(floor) :, :2] = obstacles
        labelled[: len(floor), 2] = FLOOR_LABEL
        labelled[len(floor) :, 2] = OBSTACLE_LABEL
        cloud = points_to_cloud(labelled, stamp=msg.header.stamp, frame_id="base_link")
        charge_work("label_points", mask.size)
        self._mask_pub.publish(mask_image)
        self._points_pub.publish(cloud)
        if marker is not None:
            out = PointStamped()
            out.header.stamp = msg.header.stamp
            out.header.frame_id = "base_link"
            out.point.x, out.point.y = marker
            self._marker_pub.publish(out)
