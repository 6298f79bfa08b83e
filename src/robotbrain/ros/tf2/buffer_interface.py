"""``tf2_ros.buffer_interface``: transforming whole messages, and the registry of what can be transformed."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any, ClassVar

from robotbrain.ros.conversions import header, msg_class
from robotbrain.ros.tf2.exceptions import NotImplementedException, TypeException
from robotbrain.ros.time import Duration

__all__ = [
    "BufferInterface",
    "ConvertRegistration",
    "NotImplementedException",
    "Stamped",
    "TransformRegistration",
    "TypeException",
    "convert",
]

_WHERE = {"PointCloud2": "tf2_sensor_msgs"}


class BufferInterface:
    """What every buffer offers on top of ``lookup_transform``."""

    def __init__(self) -> None:
        self.registration = TransformRegistration()

    def transform(
        self, object_stamped: Any, target_frame: str, timeout: Duration | None = None, new_type: Any = None
    ) -> Any:
        """Return a stamped message in another frame, at the time of its stamp.

        Args:
            object_stamped: a message with a header, of a registered type (``import tf2_geometry_msgs``).
            target_frame: frame of the result.
            timeout: as :meth:`lookup_transform`.
            new_type: convert the result to this type.

        Raises:
            TypeException: nothing is registered for the type.
            TransformException: as :meth:`lookup_transform`.
        """
        apply = self.registration.get(type(object_stamped))
        head = object_stamped.header
        transform = self.lookup_transform(target_frame, head.frame_id, head.stamp, timeout or Duration())
        result = apply(object_stamped, transform)
        return result if new_type is None else convert(result, new_type)

    def transform_full(
        self,
        object_stamped: Any,
        target_frame: str,
        target_time: Any,
        fixed_frame: str,
        timeout: Duration | None = None,
        new_type: Any = None,
    ) -> Any:
        """As :meth:`transform`, to ``target_time``, over a frame taken not to have moved in between."""
        apply = self.registration.get(type(object_stamped))
        head = object_stamped.header
        transform = self.lookup_transform_full(
            target_frame, target_time, head.frame_id, head.stamp, fixed_frame, timeout or Duration()
        )
        result = apply(object_stamped, transform)
        return result if new_type is None else convert(result, new_type)

    def lookup_transform(self, target_frame: str, source_frame: str, time: Any, timeout: Duration = Duration()) -> Any:  # noqa: B008 - as tf2
        """Return the transform from ``source_frame`` to ``target_frame``; a subclass implements it."""
        raise NotImplementedException

    def lookup_transform_full(
        self,
        target_frame: str,
        target_time: Any,
        source_frame: str,
        source_time: Any,
        fixed_frame: str,
        timeout: Duration = Duration(),  # noqa: B008 - as tf2
    ) -> Any:
        """Return the transform between two times; a subclass implements it."""
        raise NotImplementedException

    def can_transform(self, target_frame: str, source_frame: str, time: Any, timeout: Duration = Duration()) -> Any:  # noqa: B008 - as tf2
        """Tell whether a transform is possible; a subclass implements it."""
        raise NotImplementedException

    def can_transform_full(
        self,
        target_frame: str,
        target_time: Any,
        source_frame: str,
        source_time: Any,
        fixed_frame: str,
        timeout: Duration = Duration(),  # noqa: B008 - as tf2
    ) -> Any:
        """Tell whether a transform between two times is possible; a subclass implements it."""
        raise NotImplementedException


def Stamped(obj: Any, stamp: Any, frame_id: str) -> Any:  # noqa: N802 - tf2's name
    """Give ``obj`` a header; return it."""
    obj.header = header(stamp, frame_id)
    return obj


class TransformRegistration:
    """Message type -> function ``(message, transform) -> message``; one table for all buffers."""

    _table: ClassVar[dict[Any, Callable[[Any, Any], Any]]] = {}

    def print_me(self) -> None:
        """Print the table."""
        print(self._table)

    def add(self, key: Any, callback: Callable[[Any, Any], Any]) -> None:
        """Register the function for a type."""
        self._table[key] = callback

    def get(self, key: Any) -> Callable[[Any, Any], Any]:
        """Return the function for a type.

        Raises:
            TypeException: there is none.
        """
        if key not in self._table:
            module = _WHERE.get(getattr(key, "__name__", ""), "tf2_geometry_msgs")
            raise TypeException(
                f"Type {key} is not loaded or supported. `import {module}` registers its types; "
                "only stamped messages can be transformed"
            )
        return self._table[key]


class ConvertRegistration:
    """Conversions between message types and types of other libraries."""

    _to_msg: ClassVar[dict[Any, Callable[[Any], Any]]] = {}
    _from_msg: ClassVar[dict[Any, Callable[[Any], Any]]] = {}
    _direct: ClassVar[dict[Any, Callable[[Any], Any]]] = {}

    def add_from_msg(self, key: Any, callback: Callable[[Any], Any]) -> None:
        """Register how ``key`` is made from a message."""
        self._from_msg[key] = callback

    def add_to_msg(self, key: Any, callback: Callable[[Any], Any]) -> None:
        """Register how a message is made from ``key``."""
        self._to_msg[key] = callback

    def add_convert(self, key: tuple[Any, Any], callback: Callable[[Any], Any]) -> None:
        """Register a direct conversion between the two types of ``key``."""
        self._direct[key] = callback

    def get_from_msg(self, key: Any) -> Callable[[Any], Any]:
        """Return how ``key`` is made from a message; TypeException when unknown."""
        return _known(self._from_msg, key)

    def get_to_msg(self, key: Any) -> Callable[[Any], Any]:
        """Return how a message is made from ``key``; TypeException when unknown."""
        return _known(self._to_msg, key)

    def get_convert(self, key: tuple[Any, Any]) -> Callable[[Any], Any]:
        """Return the direct conversion between two types; TypeException when unknown."""
        return _known(self._direct, key)


def _known(table: dict[Any, Callable[[Any], Any]], key: Any) -> Callable[[Any], Any]:
    if key not in table:
        raise TypeException(f"Type {key} is not loaded or supported")
    return table[key]


def convert(a: Any, b_type: Any) -> Any:
    """Return ``a`` as ``b_type``: directly, as a copy, or by way of a message.

    Raises:
        TypeException: no conversion is registered.
    """
    table = ConvertRegistration()
    if (type(a), b_type) in table._direct:
        return table.get_convert((type(a), b_type))(a)
    if type(a) is b_type:
        return copy.deepcopy(a)
    return table.get_from_msg(b_type)(table.get_to_msg(type(a))(a))


def register_message(typename: str, apply: Callable[[Any, Any], Any] | None) -> None:
    """Register a message type: ``apply`` transforms it, and it converts to and from itself."""
    cls = msg_class(typename)
    if apply is not None:
        TransformRegistration().add(cls, apply)
    ConvertRegistration().add_to_msg(cls, lambda message: message)
    ConvertRegistration().add_from_msg(cls, lambda message: message)
