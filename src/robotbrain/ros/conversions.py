"""Between messages and numpy arrays: images, scans, clouds, grids, paths, poses and times.

All functions read messages by attribute, so they take those of the kit and of genuine rclpy alike; those
that build a message import its class, which is whichever of the two is in use.
"""

from __future__ import annotations

import importlib
import math
import sys
from array import array
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robotbrain.errors import InputError

NS_PER_S = 1_000_000_000
IMAGE_ENCODINGS: dict[str, tuple[str, int]] = {
    "mono8": ("u1", 1),
    "8UC1": ("u1", 1),
    "rgb8": ("u1", 3),
    "bgr8": ("u1", 3),
    "rgba8": ("u1", 4),
    "bgra8": ("u1", 4),
    "mono16": ("u2", 1),
    "16UC1": ("u2", 1),
    "32FC1": ("f4", 1),
}
"""Image encoding -> numpy type and channels (names of ``sensor_msgs/image_encodings``)."""


def msg_class(typename: str) -> Any:
    """Return the class of ``pkg/msg/Name`` or ``pkg/srv/Name``, the kit's or genuine rclpy's."""
    package, kind, name = typename.split("/")
    path = f"{package}.{kind}"
    # Conversions run for every message: skip the import system where the package is already there.
    return getattr(sys.modules.get(path) or importlib.import_module(path), name)


# ---------------------------------------------------------------- time and headers


def time_ns(time: Any) -> int:
    """Return ns of an ``rclpy`` time or duration, a ``builtin_interfaces`` one, a stamped message, or a number of ns.

    Raises:
        InputError: for anything else.
    """
    header = getattr(time, "header", None)
    if header is not None:
        time = header.stamp
    if isinstance(time, (int, np.integer)) and not isinstance(time, bool):
        return int(time)
    if hasattr(time, "nanoseconds"):
        return int(time.nanoseconds)
    if hasattr(time, "sec") and hasattr(time, "nanosec"):
        return int(time.sec) * NS_PER_S + int(time.nanosec)
    raise InputError(
        "time", given=time, expected="a Time, a stamp, a message with a header, or ns", fix="Pass msg.header.stamp."
    )


def time_to_ns(stamp: Any) -> int:
    """Return a ``builtin_interfaces/msg/Time`` (or Duration) as ns."""
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def ns_to_time(nanoseconds: int) -> Any:
    """Return ns as ``builtin_interfaces/msg/Time``."""
    sec, nanosec = divmod(int(nanoseconds), NS_PER_S)
    return msg_class("builtin_interfaces/msg/Time")(sec=sec, nanosec=nanosec)


def header(stamp: Any, frame_id: str) -> Any:
    """Return a ``std_msgs/msg/Header``.

    Args:
        stamp: a Time message, an ``rclpy.time.Time``, or ns as int.
        frame_id: coordinate frame.
    """
    if isinstance(stamp, int):
        stamp = ns_to_time(stamp)
    elif hasattr(stamp, "to_msg"):
        stamp = stamp.to_msg()
    return msg_class("std_msgs/msg/Header")(stamp=stamp, frame_id=frame_id)


# ---------------------------------------------------------------- images


def image_to_numpy(image: Any) -> NDArray[Any]:
    """Return the pixels of a ``sensor_msgs/msg/Image``, (H, W) or (H, W, C), in native byte order.

    Row padding (``step``) is removed and ``is_bigendian`` honoured. The result is writable and owns its memory.

    Raises:
        InputError: unknown encoding, or ``step`` or data size do not fit height and width.
    """
    dtype, channels = _encoding(image.encoding)
    wire = np.dtype(dtype).newbyteorder(">" if image.is_bigendian else "<")
    height, width, step = int(image.height), int(image.width), int(image.step)
    row = width * channels * wire.itemsize
    if step < row:
        raise InputError(
            "image.step",
            given=step,
            expected=f">= {row} bytes ({width} pixels of {image.encoding})",
            fix="step is the length of a row in bytes: width * channels * bytes per channel.",
        )
    data = np.frombuffer(image.data, dtype=np.uint8)
    if data.size != step * height:
        raise InputError(
            "image.data",
            given=f"{data.size} bytes",
            expected=f"{step * height} bytes (step {step} * height {height})",
            fix="Check height and step against the data.",
        )
    rows = data.reshape(height, step)[:, :row]
    shape = (height, width) if channels == 1 else (height, width, channels)
    return np.frombuffer(rows.tobytes(), dtype=wire).reshape(shape).astype(dtype)


def numpy_to_image(pixels: NDArray[Any], encoding: str, *, stamp: Any = 0, frame_id: str = "") -> Any:
    """Return pixels as ``sensor_msgs/msg/Image`` without row padding, little endian.

    Args:
        pixels: (H, W) or (H, W, C) of exactly the encoding's type: uint8 for rgb8 and mono8, float32 for 32FC1.
        encoding: a key of :data:`IMAGE_ENCODINGS`.
        stamp: as :func:`header`.
        frame_id: as :func:`header`.

    Raises:
        InputError: unknown encoding, wrong shape or type.
    """
    dtype, channels = _encoding(encoding)
    pixels = np.asarray(pixels)
    wanted = "(H, W)" if channels == 1 else f"(H, W, {channels})"
    if pixels.ndim != (2 if channels == 1 else 3) or (channels > 1 and pixels.shape[2] != channels):
        raise InputError(
            "pixels",
            given=f"shape {pixels.shape}",
            expected=f"{wanted} for {encoding}",
            fix="Reshape or choose another encoding.",
        )
    if pixels.dtype != np.dtype(dtype):
        raise InputError(
            "pixels",
            given=f"dtype {pixels.dtype}",
            expected=f"{np.dtype(dtype)} for {encoding}",
            fix=f"Scale if needed, then .astype(np.{np.dtype(dtype)}).",
        )
    data = array("B")
    data.frombytes(np.ascontiguousarray(pixels, dtype=np.dtype(dtype).newbyteorder("<")).tobytes())
    return msg_class("sensor_msgs/msg/Image")(
        header=header(stamp, frame_id),
        height=int(pixels.shape[0]),
        width=int(pixels.shape[1]),
        encoding=encoding,
        is_bigendian=0,
        step=int(pixels.shape[1]) * channels * np.dtype(dtype).itemsize,
        data=data,
    )


def _encoding(name: str) -> tuple[str, int]:
    try:
        return IMAGE_ENCODINGS[name]
    except KeyError:
        raise InputError(
            "image encoding",
            given=name,
            expected=f"one of {', '.join(IMAGE_ENCODINGS)}",
            fix="Convert the image first.",
        ) from None


# ---------------------------------------------------------------- lidar


def scan_to_arrays(scan: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return ranges (m) and angles (rad) of a ``sensor_msgs/msg/LaserScan``, both (N,).

    Misses keep their value (+inf, REP 117); ``angles[i] = angle_min + i * angle_increment``.
    """
    ranges = np.array(scan.ranges, dtype=np.float64)
    return ranges, scan.angle_min + scan.angle_increment * np.arange(ranges.size)


# ---------------------------------------------------------------- point clouds


def points_to_cloud(points: ArrayLike, *, stamp: Any = 0, frame_id: str = "") -> Any:
    """Return points (N, 3) in metres as an unorganised ``sensor_msgs/msg/PointCloud2`` of float32 x, y, z.

    Raises:
        InputError: not (N, 3).
    """
    xyz = np.asarray(points, dtype=np.float32)
    if xyz.size == 0:
        xyz = xyz.reshape(0, 3)
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        raise InputError("points", given=f"shape {xyz.shape}", expected="(N, 3) of x, y, z", fix="One row per point.")
    field = msg_class("sensor_msgs/msg/PointField")
    data = array("B")
    data.frombytes(np.ascontiguousarray(xyz, dtype="<f4").tobytes())
    return msg_class("sensor_msgs/msg/PointCloud2")(
        header=header(stamp, frame_id),
        height=1,
        width=len(xyz),
        fields=[
            field(name=name, offset=4 * index, datatype=field.FLOAT32, count=1) for index, name in enumerate("xyz")
        ],
        is_bigendian=False,
        point_step=12,
        row_step=12 * len(xyz),
        data=data,
        is_dense=bool(np.isfinite(xyz).all()),
    )


def cloud_to_points(cloud: Any) -> NDArray[np.float32]:
    """Return x, y, z of a ``sensor_msgs/msg/PointCloud2`` as (N, 3) float32, other fields skipped.

    Raises:
        InputError: x, y or z is missing or not float32, or the data size does not fit.
    """
    height, width = int(cloud.height), int(cloud.width)
    step, row_step = int(cloud.point_step), int(cloud.row_step)
    offsets = {}
    for field in cloud.fields:
        if field.name in ("x", "y", "z"):
            if field.datatype != 7 or field.count not in (0, 1):
                raise InputError(
                    f"cloud field {field.name}",
                    given=f"datatype {field.datatype}, count {field.count}",
                    expected="PointField.FLOAT32 (7), count 1",
                    fix="Convert the cloud to float32 coordinates.",
                )
            offsets[field.name] = int(field.offset)
    if len(offsets) != 3:
        raise InputError(
            "cloud.fields",
            given=[field.name for field in cloud.fields],
            expected="x, y and z",
            fix="Is it a depth image?",
        )
    data = np.frombuffer(cloud.data, dtype=np.uint8)
    if row_step < step * width or data.size < row_step * height or max(offsets.values()) + 4 > step:
        raise InputError(
            "cloud.data",
            given=f"{data.size} bytes, point_step {step}, row_step {row_step}",
            expected=f"{height} rows of at least {width} points of {step} bytes",
            fix="Check height, width, point_step and row_step.",
        )
    grid = data[: row_step * height].reshape(height, row_step)[:, : step * width].reshape(height * width, step)
    wire = ">f4" if cloud.is_bigendian else "<f4"
    columns = [
        np.ascontiguousarray(grid[:, offsets[axis] : offsets[axis] + 4]).view(wire).reshape(-1) for axis in "xyz"
    ]
    return np.stack(columns, axis=1).astype(np.float32)


# ---------------------------------------------------------------- occupancy grids


class Grid(NamedTuple):
    """An occupancy grid: ``cells[row, column]`` int8 (-1 unknown, 0 free .. 100 occupied), metres per cell, origin.

    ``origin`` is (x, y, yaw) of the outer corner of cell (0, 0); columns run along x, rows along y.
    """

    cells: NDArray[np.int8]
    resolution: float
    origin: tuple[float, float, float]


def grid_to_numpy(grid: Any) -> Grid:
    """Return the cells (H, W), resolution (m) and origin (x, y, yaw) of a ``nav_msgs/msg/OccupancyGrid``.

    Raises:
        InputError: data size is not width * height.
    """
    height, width = int(grid.info.height), int(grid.info.width)
    cells = np.array(grid.data, dtype=np.int8)
    if cells.size != height * width:
        raise InputError(
            "grid.data", given=f"{cells.size} cells", expected=f"{width} * {height}", fix="Check info.width and height."
        )
    pose = grid.info.origin
    origin = (float(pose.position.x), float(pose.position.y), quaternion_to_yaw(pose.orientation))
    return Grid(cells.reshape(height, width), float(grid.info.resolution), origin)


def numpy_to_grid(
    cells: NDArray[Any],
    resolution: float,
    origin: tuple[float, float] | tuple[float, float, float],
    *,
    stamp: Any = 0,
    frame_id: str = "map",
) -> Any:
    """Return cells (H, W), -1 or 0..100, as ``nav_msgs/msg/OccupancyGrid``.

    Args:
        cells: integers; row 0 is at the origin and rows grow along y.
        resolution: metres per cell, > 0.
        origin: x, y (m) and optionally yaw (rad) of the outer corner of cell (0, 0).
        stamp: as :func:`header`.
        frame_id: as :func:`header`.

    Raises:
        InputError: wrong shape, type or range.
    """
    cells = np.asarray(cells)
    if cells.ndim != 2 or cells.dtype.kind not in "iu":
        raise InputError(
            "cells",
            given=f"{cells.dtype} of shape {cells.shape}",
            expected="integers (H, W)",
            fix="Use .astype(np.int8).",
        )
    if cells.size and (cells.min() < -1 or cells.max() > 100):
        raise InputError(
            "cells", given=f"{cells.min()}..{cells.max()}", expected="-1 (unknown) or 0..100", fix="Scale to percent."
        )
    if not resolution > 0:
        raise InputError("resolution", given=resolution, expected="metres per cell > 0", fix="0.05 is usual.")
    data = array("b")
    data.frombytes(np.ascontiguousarray(cells, dtype=np.int8).tobytes())
    info = msg_class("nav_msgs/msg/MapMetaData")(
        resolution=float(resolution),
        width=int(cells.shape[1]),
        height=int(cells.shape[0]),
        origin=pose_2d(*origin),
    )
    head = header(stamp, frame_id)
    info.map_load_time = head.stamp
    return msg_class("nav_msgs/msg/OccupancyGrid")(header=head, info=info, data=data)


# ---------------------------------------------------------------- poses and paths


def yaw_to_quaternion(yaw_rad: float) -> Any:
    """Return a rotation about z as ``geometry_msgs/msg/Quaternion`` (ROS order x, y, z, w)."""
    return msg_class("geometry_msgs/msg/Quaternion")(x=0.0, y=0.0, z=math.sin(yaw_rad / 2.0), w=math.cos(yaw_rad / 2.0))


def quaternion_to_yaw(quaternion: Any) -> float:
    """Return the yaw (rad, in (-pi, pi]) of a ``geometry_msgs/msg/Quaternion``, which need not be normalised.

    Raises:
        InputError: the zero quaternion (a message whose orientation was never set by an old sender).
    """
    x, y, z, w = (float(quaternion.x), float(quaternion.y), float(quaternion.z), float(quaternion.w))
    if x * x + y * y + z * z + w * w < 1e-12:
        raise InputError(
            "quaternion", given=(x, y, z, w), expected="a rotation (x, y, z, w)", fix="No rotation is (0, 0, 0, 1)."
        )
    return math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)


def pose_2d(x: float, y: float, yaw_rad: float = 0.0) -> Any:
    """Return x, y (m) and yaw (rad) as ``geometry_msgs/msg/Pose``."""
    position = msg_class("geometry_msgs/msg/Point")(x=float(x), y=float(y), z=0.0)
    return msg_class("geometry_msgs/msg/Pose")(position=position, orientation=yaw_to_quaternion(yaw_rad))


def pose_to_xy_yaw(pose: Any) -> tuple[float, float, float]:
    """Return x, y (m) and yaw (rad) of a ``geometry_msgs/msg/Pose``."""
    return float(pose.position.x), float(pose.position.y), quaternion_to_yaw(pose.orientation)


def path_to_numpy(path: Any) -> NDArray[np.float64]:
    """Return x, y (m) of the poses of a ``nav_msgs/msg/Path`` as (N, 2)."""
    points = [(pose.pose.position.x, pose.pose.position.y) for pose in path.poses]
    return np.array(points, dtype=np.float64).reshape(-1, 2)


def numpy_to_path(points: ArrayLike, *, stamp: Any = 0, frame_id: str = "map") -> Any:
    """Return points (N, 2) in metres as ``nav_msgs/msg/Path``; each pose heads for the next point.

    Raises:
        InputError: not (N, 2), or not finite.
    """
    xy = np.asarray(points, dtype=np.float64)
    if xy.size == 0:
        xy = xy.reshape(0, 2)
    if xy.ndim != 2 or xy.shape[1] != 2 or not np.isfinite(xy).all():
        raise InputError("path points", given=xy, expected="finite (N, 2) of x, y", fix="One row per point.")
    head = header(stamp, frame_id)
    stamped = msg_class("geometry_msgs/msg/PoseStamped")
    poses = []
    yaw = 0.0
    for index, (x, y) in enumerate(xy):
        if index + 1 < len(xy):
            dx, dy = xy[index + 1] - xy[index]
            yaw = math.atan2(dy, dx) if dx or dy else yaw
        poses.append(stamped(header=header(head.stamp, frame_id), pose=pose_2d(x, y, yaw)))
    return msg_class("nav_msgs/msg/Path")(header=head, poses=poses)
