"""``tf2_sensor_msgs``: transforms of point clouds; importing it registers them."""

from __future__ import annotations

import copy
from array import array
from typing import Any

import numpy as np

from robotbrain.errors import InputError
from robotbrain.ros.tf2.buffer_interface import register_message
from robotbrain.ros.tf2.geometry import rigid, rotation_matrix

__all__ = ["do_transform_cloud", "transform_points"]

_KINDS = {7: "f4", 8: "f8"}  # PointField.FLOAT32, FLOAT64


def transform_points(point_cloud: Any, transform: Any) -> Any:
    """Return points (N, 3) moved by a ``geometry_msgs/msg/Transform``, as (N, 3) float64."""
    return np.asarray(point_cloud, dtype=np.float64) @ rotation_matrix(transform).T + np.array(rigid(transform)[0])


def do_transform_cloud(cloud: Any, transform: Any) -> Any:
    """Return a ``PointCloud2`` with x, y and z moved; its other fields, layout and stamp stay as they are.

    Args:
        cloud: with fields x, y and z of FLOAT32 or FLOAT64.
        transform: a ``TransformStamped``, whose frame the result gets, or a ``Transform``.

    Raises:
        InputError: x, y or z is missing or of another type, or the data do not fit the layout.
    """
    result = copy.deepcopy(cloud)
    if hasattr(transform, "header"):
        result.header.frame_id = transform.header.frame_id
        transform = transform.transform
    data = np.frombuffer(bytes(cloud.data), dtype=np.uint8).copy()
    views = _coordinates(cloud, data)
    moved = transform_points(np.stack([view.reshape(-1) for view in views], axis=1), transform)
    for axis, view in enumerate(views):
        view[...] = moved[:, axis].reshape(view.shape)
    result.data = array("B", data.tobytes())
    return result


def _coordinates(cloud: Any, data: Any) -> list[Any]:
    """Return writable (height, width) views of x, y and z in ``data``."""
    fields = {field.name: field for field in cloud.fields}
    views = []
    for axis in "xyz":
        field = fields.get(axis)
        if field is None or field.datatype not in _KINDS or field.count > 1:
            raise InputError(
                "cloud.fields",
                given=[(one.name, one.datatype) for one in cloud.fields],
                expected="x, y and z of FLOAT32 or FLOAT64",
                fix="Is it a cloud of something else than points in space?",
            )
        kind = np.dtype((">" if cloud.is_bigendian else "<") + _KINDS[field.datatype])
        needed = (cloud.height - 1) * cloud.row_step + (cloud.width - 1) * cloud.point_step + field.offset
        if cloud.height and cloud.width and needed + kind.itemsize > data.size:
            raise InputError(
                "cloud.data",
                given=f"{data.size} bytes",
                expected=f"{cloud.height} rows of {cloud.row_step} bytes",
                fix="Check height, width, point_step and row_step.",
            )
        shape, strides = (cloud.height, cloud.width), (cloud.row_step, cloud.point_step)
        full = cloud.height * cloud.width > 0
        views.append(np.ndarray(shape, kind, data, field.offset, strides) if full else np.empty(shape))
    return views


register_message("sensor_msgs/msg/PointCloud2", do_transform_cloud)
