"""From an image and a depth image to labelled points: the plain functions around the segmentation network.

The network itself is an ONNX file (``weights/segmentation.onnx``); ``robotbrain train segmentation`` makes it. What is
here is what a perception engineer writes around any network: preprocessing, decoding and back-projection.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robotbrain.errors import InputError

CLASSES = ("background", "floor", "obstacle", "marker")
"""Names of the class ids 0 to 3; background is what lies beyond the walls, where no ray returns."""

BACKGROUND, FLOOR, OBSTACLE, MARKER = range(4)

MEAN = (0.45, 0.45, 0.45)
STD = (0.25, 0.25, 0.25)
"""Per-channel normalisation the network was trained with, in units of full scale."""

MAT_BELOW, SIGN_ABOVE = 0.08, 0.6
"""The marker is a mat on the floor and a sign that hangs above; what looks like it between these heights, m, is not."""

OBSTACLE_ABOVE = 0.035
"""Lower than this, m, nothing stops the robot (the lowest boxes are 0.10 m high)."""

SIGN_DEPTH = 0.2
"""Half the depth of the hanging sign, m: its axis lies this far behind the face that the camera sees."""


@dataclass(frozen=True)
class CameraModel:
    """A pinhole camera on the robot.

    Attributes:
        fx, fy, cx, cy: intrinsics in pixels; pixel centres lie at integer coordinates.
        position: (x, y, z) of the camera in the base frame, m.
        pitch: downward tilt, rad.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    position: tuple[float, float, float]
    pitch: float = 0.0


def preprocess(image: ArrayLike) -> NDArray[np.float32]:
    """Return the network's input for one camera image.

    Args:
        image: (H, W, 3) uint8, RGB.

    Returns:
        (1, 3, H, W) float32, normalised by MEAN and STD.
    """
    pixels = np.asarray(image)
    if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.dtype != np.uint8:
        raise InputError(
            "image",
            given=f"{pixels.dtype} {pixels.shape}",
            expected="uint8 of shape (height, width, 3), RGB",
            fix="Decode the sensor_msgs/Image with robotbrain.ros.conversions.image_to_numpy first.",
        )
    return normalise(pixels[None])


def normalise(images: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return (N, H, W, 3) uint8 images as the network's (N, 3, H, W) float32 input."""
    mean, std = np.asarray(MEAN, dtype=np.float32), np.asarray(STD, dtype=np.float32)
    scaled = (images.astype(np.float32) / np.float32(255.0) - mean) / std
    return np.ascontiguousarray(scaled.transpose(0, 3, 1, 2))


def decode(logits: ArrayLike) -> NDArray[np.uint8]:
    """Return the (H, W) class ids of (1, classes, H, W) logits."""
    scores = np.asarray(logits)
    if scores.ndim != 4 or scores.shape[0] != 1:
        raise InputError(
            "logits",
            given=scores.shape,
            expected="(1, classes, height, width)",
            fix="Pass the network's output for one image as it is.",
        )
    mask: NDArray[np.uint8] = scores[0].argmax(axis=0).astype(np.uint8)
    return mask


def back_project(depth: ArrayLike, camera: CameraModel) -> NDArray[np.float64]:
    """Return the (H, W, 3) points x, y, z in the base frame of every pixel; NaN where depth is not finite.

    Args:
        depth: (H, W) along the optical axis, m.
        camera: intrinsics and mounting.
    """
    z = np.asarray(depth, dtype=float)
    z = np.where(np.isfinite(z), z, np.nan)
    rows, columns = np.indices(z.shape)
    right = (columns - camera.cx) / camera.fx * z
    down = (rows - camera.cy) / camera.fy * z
    cos, sin = np.cos(camera.pitch), np.sin(camera.pitch)
    forward = cos * z - sin * down
    height = -sin * z - cos * down
    return np.stack([camera.position[0] + forward, camera.position[1] - right, camera.position[2] + height], axis=-1)


def locate_marker(
    mask: NDArray[np.uint8], points: NDArray[np.float64], min_pixels: int = 4
) -> tuple[float, float] | None:
    """Return where the marker stands, x, y in the base frame in m; None if it is not seen well enough.

    The mat on the floor shows its centre best when near; the sign above shows the face towards the camera, so its
    points are moved back by half the sign's depth along their bearing. The median shrugs off a few wrong pixels.

    Args:
        mask: (H, W) class ids.
        points: (H, W, 3) from :func:`back_project`.
        min_pixels: fewer marker pixels than this with a depth count as not seen.
    """
    height = points[..., 2]
    on_mat, on_sign = height < MAT_BELOW, height > SIGN_ABOVE  # false where there is no depth
    seen = (mask == MARKER) & (on_mat | on_sign)
    if int(seen.sum()) < min_pixels:
        return None
    xyz = points[seen]
    flat = xyz[:, :2].copy()
    sign = xyz[:, 2] > SIGN_ABOVE
    distance = np.linalg.norm(flat[sign], axis=1, keepdims=True)
    flat[sign] *= 1.0 + SIGN_DEPTH / np.maximum(distance, 0.1)
    x, y = np.median(flat, axis=0)
    return float(x), float(y)


def ground_points(
    mask: NDArray[np.uint8], points: NDArray[np.float64], max_range: float = 3.0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return floor points and obstacle points (N, 2) in the base frame, m, within ``max_range``.

    Obstacle points above the robot (0.5 m) are left out, and so are those on the floor: a wrong pixel there, at the
    edge of the mat, say, would wall off free ground. The marker's mat counts as floor. Depth has a say, too: no label
    turns something that stands above the floor into free ground.
    """
    finite = np.isfinite(points[..., 0])
    near = finite & (np.hypot(points[..., 0], points[..., 1]) < max_range)
    low = near & (points[..., 2] < 0.5)
    height = points[..., 2]
    floor = low & ((mask == FLOOR) | (mask == MARKER)) & (height < OBSTACLE_ABOVE)
    # What clearly stands above the floor stops the robot, whatever the network takes it for. The margin grows with the
    # distance, because the base pitches a little when it brakes.
    standing = low & (height > 0.06 + 0.01 * np.hypot(points[..., 0], points[..., 1]))
    obstacle = (low & (mask == OBSTACLE) & (height > OBSTACLE_ABOVE)) | standing
    return points[floor][:, :2], points[obstacle][:, :2]
