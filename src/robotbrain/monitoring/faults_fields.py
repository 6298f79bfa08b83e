"""What a fault may change in a message: the numbers of each kind of measurement, as an array and back."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from robotbrain.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray


class Field(NamedTuple):
    """Numbers in a message: ``read(message)`` gives a float array, ``write(message, values)`` puts it back."""

    read: Callable[[Any], NDArray[np.float64]]
    write: Callable[[Any, NDArray[np.float64]], None]


def _attributes(path: str, names: str) -> Field:
    def owner(message: Any) -> Any:
        for part in path.split(".") if path else ():
            message = getattr(message, part)
        return message

    def read(message: Any) -> NDArray[np.float64]:
        return np.array([getattr(owner(message), name) for name in names.split()], dtype=np.float64)

    def write(message: Any, values: NDArray[np.float64]) -> None:
        for name, value in zip(names.split(), values, strict=True):
            setattr(owner(message), name, float(value))

    return Field(read, write)


def _array(name: str) -> Field:
    def write(message: Any, values: NDArray[np.float64]) -> None:
        setattr(message, name, type_like(getattr(message, name), values))

    return Field(lambda message: np.array(getattr(message, name), dtype=np.float64), write)


def type_like(before: Any, values: NDArray[np.float64]) -> Any:
    """Return values as a list or an array of the type that a field had."""
    return values.astype(before.dtype) if isinstance(before, np.ndarray) else [float(value) for value in values]


def _velocity() -> Field:
    def read(message: Any) -> NDArray[np.float64]:
        return np.array([message.linear.x, message.angular.z])

    def write(message: Any, values: NDArray[np.float64]) -> None:
        message.linear.x, message.angular.z = (float(value) for value in values)

    return Field(read, write)


def _pixels() -> Field:
    from robotbrain.ros.conversions import image_to_numpy, numpy_to_image

    def read(message: Any) -> NDArray[np.float64]:
        return np.asarray(image_to_numpy(message), dtype=np.float64)

    def write(message: Any, values: NDArray[np.float64]) -> None:
        before = image_to_numpy(message)
        if np.issubdtype(before.dtype, np.integer):
            limits = np.iinfo(before.dtype)
            values = np.clip(np.rint(values), limits.min, limits.max)
        message.data = numpy_to_image(values.astype(before.dtype), message.encoding).data

    return Field(read, write)


def _cloud() -> Field:
    from robotbrain.ros.conversions import cloud_to_points, points_to_cloud

    def read(message: Any) -> NDArray[np.float64]:
        # The third number of the kit's clouds is a label, not a coordinate.
        return np.asarray(cloud_to_points(message)[:, :2], dtype=np.float64)

    def write(message: Any, values: NDArray[np.float64]) -> None:
        points = np.array(cloud_to_points(message))
        points[:, :2] = values
        message.data = points_to_cloud(points).data

    return Field(read, write)


_FIELDS: Mapping[str, Mapping[str, Callable[[], Field]]] = {
    "sensor_msgs/msg/LaserScan": {"ranges": lambda: _array("ranges")},
    "sensor_msgs/msg/Imu": {
        "angular_velocity": lambda: _attributes("angular_velocity", "x y z"),
        "linear_acceleration": lambda: _attributes("linear_acceleration", "x y z"),
    },
    "sensor_msgs/msg/JointState": {"position": lambda: _array("position"), "velocity": lambda: _array("velocity")},
    "sensor_msgs/msg/Image": {"pixels": _pixels},
    "sensor_msgs/msg/PointCloud2": {"points": _cloud},
    "nav_msgs/msg/Odometry": {"position": lambda: _attributes("pose.pose.position", "x y")},
    "geometry_msgs/msg/PointStamped": {"point": lambda: _attributes("point", "x y z")},
    "geometry_msgs/msg/Twist": {"velocity": _velocity},
}
"""Fields that faults can change, by type; the first is the usual one."""


def find_field(type_name: str, name: str | None, topic: str) -> Field:
    """Return a field of a message type.

    Args:
        type_name: e.g. ``sensor_msgs/msg/Imu``.
        name: of the field; None: the usual one of the type.
        topic: for the error message.

    Raises:
        InputError: for a type or field that faults cannot change.
    """
    known = _FIELDS.get(type_name)
    if known is None:
        raise InputError(
            f"fault on {topic}",
            given=type_name,
            expected="numbers in " + ", ".join(sorted(_FIELDS)),
            fix="Choose a topic of one of these types, or write a filter of your own for context.add_filter.",
        )
    make = known.get(name) if name is not None else next(iter(known.values()))
    if make is None:
        raise InputError(
            f"field of the fault on {topic}", given=name, expected="one of " + ", ".join(known), fix="Choose one."
        )
    return make()
