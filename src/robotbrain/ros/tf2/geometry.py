"""``tf2_geometry_msgs``: transforms of points, vectors, poses and polygons; importing it registers them."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np

from robotbrain.ros.tf2.buffer_interface import register_message
from robotbrain.ros.tf2.rotation import Quaternion, Vector, canonical, compose, multiply, rotate

__all__ = [
    "do_transform_point",
    "do_transform_polygon_stamped",
    "do_transform_pose",
    "do_transform_pose_stamped",
    "do_transform_pose_with_covariance_stamped",
    "do_transform_vector3",
    "transform_covariance",
]


def rigid(transform: Any) -> tuple[Vector, Quaternion]:
    """Return translation and unit quaternion of a ``geometry_msgs/msg/Transform``; a zero quaternion is no rotation."""
    v, q = transform.translation, transform.rotation
    given = (float(q.x), float(q.y), float(q.z), float(q.w))
    return (float(v.x), float(v.y), float(v.z)), canonical(given) if any(given) else (0.0, 0.0, 0.0, 1.0)


def rotation_matrix(transform: Any) -> Any:
    """Return the rotation of a ``geometry_msgs/msg/Transform`` as a (3, 3) matrix."""
    turn = rigid(transform)[1]
    return np.array([rotate(turn, axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))]).T


def _store(point: Any, xyz: Vector) -> None:
    point.x, point.y, point.z = xyz


def do_transform_point(point: Any, transform: Any) -> Any:
    """Return a ``PointStamped`` in the frame and with the stamp of the ``TransformStamped``."""
    result = type(point)()
    p = point.point
    _store(result.point, compose(rigid(transform.transform), ((p.x, p.y, p.z), (0.0, 0.0, 0.0, 1.0)))[0])
    result.header = copy.deepcopy(transform.header)
    return result


def do_transform_vector3(vector3: Any, transform: Any) -> Any:
    """Return a ``Vector3Stamped`` (a direction: it is turned, not moved) in the frame of the ``TransformStamped``.

    Unlike genuine tf2_geometry_msgs it leaves the translation of ``transform`` as it is.
    """
    result = type(vector3)()
    v = vector3.vector
    _store(result.vector, rotate(rigid(transform.transform)[1], (v.x, v.y, v.z)))
    result.header = copy.deepcopy(transform.header)
    return result


def do_transform_pose(pose: Any, transform: Any) -> Any:
    """Return a ``Pose`` moved by a ``TransformStamped``; its quaternion is of unit length with w >= 0."""
    result = type(pose)()
    p, q = pose.position, pose.orientation
    given = (q.x, q.y, q.z, q.w)
    move = rigid(transform.transform)
    where, _ = compose(move, ((p.x, p.y, p.z), (0.0, 0.0, 0.0, 1.0)))
    # An orientation that was never set counts as none, as in genuine tf2_geometry_msgs.
    x, y, z, w = canonical(multiply(move[1], given)) if any(given) else move[1]
    _store(result.position, where)
    sign = -1.0 if w < 0.0 else 1.0
    o = result.orientation
    o.x, o.y, o.z, o.w = sign * x, sign * y, sign * z, sign * w
    return result


def do_transform_pose_stamped(pose: Any, transform: Any) -> Any:
    """Return a ``PoseStamped`` in the frame and with the stamp of the ``TransformStamped``."""
    result = type(pose)()
    result.pose = do_transform_pose(pose.pose, transform)
    result.header = copy.deepcopy(transform.header)
    return result


def transform_covariance(cov_in: Any, transform: Any) -> Any:
    """Return a (36,) covariance (x, y, z and rotations about x, y, z) in the frame of a ``TransformStamped``.

    Both blocks turn with the axes: C' = J C J^T with J = diag(R, R).
    """
    jacobian = np.kron(np.eye(2), rotation_matrix(transform.transform))
    return (jacobian @ np.asarray(cov_in, dtype=np.float64).reshape(6, 6) @ jacobian.T).reshape(36)


def do_transform_pose_with_covariance_stamped(pose: Any, transform: Any) -> Any:
    """Return a ``PoseWithCovarianceStamped`` in the frame of the ``TransformStamped``."""
    result = type(pose)()
    result.pose.pose = do_transform_pose(pose.pose.pose, transform)
    result.pose.covariance = transform_covariance(pose.pose.covariance, transform)
    result.header = copy.deepcopy(transform.header)
    return result


def do_transform_polygon_stamped(polygon: Any, transform: Any) -> Any:
    """Return a ``PolygonStamped`` in the frame of the ``TransformStamped``."""
    result = type(polygon)()
    move = rigid(transform.transform)
    for corner in polygon.polygon.points:
        moved = type(corner)()
        _store(moved, compose(move, ((corner.x, corner.y, corner.z), (0.0, 0.0, 0.0, 1.0)))[0])
        result.polygon.points.append(moved)
    result.header = copy.deepcopy(transform.header)
    return result


def to_msg_msg(msg: Any) -> Any:
    """Return ``msg``: a message converts to itself."""
    return msg


from_msg_msg = to_msg_msg

for _name, _apply in {
    "PointStamped": do_transform_point,
    "PolygonStamped": do_transform_polygon_stamped,
    "PoseStamped": do_transform_pose_stamped,
    "PoseWithCovarianceStamped": do_transform_pose_with_covariance_stamped,
    "Vector3Stamped": do_transform_vector3,
}.items():
    register_message(f"geometry_msgs/msg/{_name}", _apply)
