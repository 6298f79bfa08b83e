"""``tf2_ros``: everything a program imports from the package itself."""

from __future__ import annotations

from robotbrain.ros.tf2.buffer import Buffer
from robotbrain.ros.tf2.buffer_interface import (
    BufferInterface,
    ConvertRegistration,
    Stamped,
    TransformRegistration,
    convert,
)
from robotbrain.ros.tf2.core import BufferCore
from robotbrain.ros.tf2.exceptions import (
    ConnectivityException,
    ExtrapolationException,
    InvalidArgumentException,
    LookupException,
    NotImplementedException,
    TimeoutException,
    TransformException,
    TypeException,
)
from robotbrain.ros.tf2.static_transform_broadcaster import StaticTransformBroadcaster
from robotbrain.ros.tf2.transform_broadcaster import TransformBroadcaster
from robotbrain.ros.tf2.transform_listener import TransformListener

__all__ = [
    "Buffer",
    "BufferCore",
    "BufferInterface",
    "ConnectivityException",
    "ConvertRegistration",
    "ExtrapolationException",
    "InvalidArgumentException",
    "LookupException",
    "NotImplementedException",
    "Stamped",
    "StaticTransformBroadcaster",
    "TimeoutException",
    "TransformBroadcaster",
    "TransformException",
    "TransformListener",
    "TransformRegistration",
    "TypeException",
    "convert",
]
